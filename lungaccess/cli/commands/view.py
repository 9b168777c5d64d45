"""The command `lungaccess view`: the explorer of a patient on a page of this machine."""

from pathlib import Path

from anatomy.base.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Port
from lungaccess.cli.options import DEFAULT_SYSTEM, PatientOptions
from lungaccess.cli.result_folder import held
from lungaccess.cli.shown_ct import CtOption, shown_ct


def view(
    patient: Path | None = None,
    *,
    system: str = DEFAULT_SYSTEM,
    ct: CtOption = None,
    series: str | None = None,
    out: Path | None = None,
    port: Port | None = None,
    browser: bool = True,
    thick_slices: bool = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Explore a patient or a CT: click a target, see the feasible exits and better and better plans.

    The page is served to this machine alone, at the address that is printed, until Ctrl-C; nothing is fetched
    from elsewhere.  Needs the extra `view`.

    Args:
        patient: Folder of masks: Med-RAD, TotalSegmentator, or own masks with a patient.toml; or a CT, an
            image file or a folder of DICOM, which is segmented first. Without one the page lets you choose.
        system: System that is shown first: name of a preset, or path of a TOML file.
        series: UID of the DICOM series of a CT, where the folder holds several.
        out: Patient folder for a CT; NAME-patient here if not given. It is taken up again.
        port: Port of this machine; a free one if not given.
        browser: Whether the page is opened in the browser.
        thick_slices: Explore masks from slices of more than 3 mm, which lack small structures.
    """
    import asyncio
    import webbrowser

    from anatomy.io.patients import is_ct
    from lungaccess.cli.commands.segment import segment
    from lungaccess.problem import load_system, shipped_names
    from lungaccess.showing.report.segmented import patient_folder

    try:
        from lungaccess.showing.explorer import Address, Explorer, PatientSource
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"The explorer needs {error.name}, which is not installed",
            expected="the extra `view`",
            remedy="pip install 'lungaccess[view]'",
        ) from error
    first = load_system(system)
    if patient is not None and is_ct(patient):
        made = out or patient_folder(patient)
        terminal.console.quiet |= output.json  # Only the address is printed then.
        segment(patient, out=made, series=series, thick_slices=thick_slices, accept=output.accept)
        held.close()  # The explorer writes into the folder, too, when a nodule is added.
        patient = made
    elif out is not None or series is not None:
        raise SettingsError(
            f"{patient or 'No patient'} is no CT, and --{'series' if out is None else 'out'} is for a CT",
            expected="a CT, which is segmented first",
            remedy="Leave the option out to explore masks, or to choose on the page",
        )
    shown = None if patient is None else shown_ct(ct, patient)
    if shown is not None:
        shown.read()  # Here, where a file that is none is refused before anything is shown.
    if patient is not None:
        output.load(patient, thick_slices=thick_slices)  # Prepared and kept here, with its progress shown.
        patient = patient.resolve()
    own = () if system in shipped_names() else ((Path(system).resolve(), first),)
    source = PatientSource(
        folder=patient, system=first.name, own=own, cache=output.cache,
        ct=shown, accept=output.accept,
    )  # fmt: skip

    def started(address: Address) -> None:
        if output.json:
            terminal.show_json({"address": address.url, "port": address.port})
        else:
            terminal.say(f"The explorer is at {address.url}\nCtrl-C ends it.")
        if browser:
            webbrowser.open(address.url)

    asyncio.run(Explorer(source, port or 0).serve(started))
    return ExitCode.OK
