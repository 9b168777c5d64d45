"""The commands `lungaccess info` and `lungaccess presets`: what is known of patients and systems."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.table import Table

from lungaccess.cli import anatomy_tables, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import OutputOptions, PatientFolder, PatientOptions
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from lungaccess.problem.system import System


def info(
    patient: PatientFolder,
    *,
    out: Path | None = None,
    details: Annotated[bool, Parameter(negative="")] = False,
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show what was understood of a patient: volumes, airway tree, sources and warnings.

    Args:
        out: Folder for tree.png, a picture of the airway tree, and motion.png; for a liver organ.png.
        details: List every repair of the airway tree.
    """
    if out is not None:
        claim_folder(out, ("tree.png", "motion.png", "organ.png"), force=force)
    lung = output.load_organ(patient, thick_slices=True, refuse=False)
    if output.json:
        terminal.show_json(anatomy_tables.organ_record(lung))
    else:
        terminal.show(anatomy_tables.anatomy_tables(lung, details=details))
        terminal.show_warnings(lung.warnings)
    if out is not None:
        from anatomy.lung import Lung
        from lungaccess.showing.report import motion_png, organ_png, tree_png

        if isinstance(lung, Lung):
            what, picture = "tree", tree_png(lung, out / "tree.png")
        else:
            what, picture = "organ", organ_png(lung, out / "organ.png")
        if not output.json:
            terminal.say(f"Picture of the {what}: {picture}")
        if isinstance(lung, Lung) and lung.motion is not None:
            picture = motion_png(lung, out / "motion.png")
            if not output.json:
                terminal.say(f"Picture of the breathing: {picture}")
    return ExitCode.OK


def presets(*, show: str | None = None, output: OutputOptions = OutputOptions()) -> ExitCode:
    """List the systems that ship with lungaccess, the least invasive first, or print one to start from.

    Its JSON holds every setting.

    Args:
        show: Print the TOML file of this system: edit it, and hand it over with --system FILE.
    """
    from anatomy.base.settings import to_mapping
    from lungaccess.problem.needle_load import system_warnings
    from lungaccess.problem.preset_order import presets_by_invasiveness
    from lungaccess.problem.system import load_system, needle_preset_names, preset_text, tube_preset_names

    if show is not None and not output.json:
        terminal.console.file.write(preset_text(show))
        return ExitCode.OK
    ordered = [system.name for system in presets_by_invasiveness()]
    names = (*ordered, *tube_preset_names(), *needle_preset_names()) if show is None else (show,)
    systems = {name: load_system(name) for name in names}
    if output.json:
        terminal.show_json({name: to_mapping(system) for name, system in systems.items()})
    else:
        terminal.console.print(_preset_table(systems))
        warned = ((name, each) for name, system in systems.items() for each in system_warnings(system))
        terminal.show_warnings(f"{name}: {each}" for name, each in warned)
    return ExitCode.OK


def _preset_table(systems: "Mapping[str, System]") -> Table:
    """Return one line a preset: the sizes that matter, and what it is."""
    rows = [
        (
            name,
            f"{system.scope.outer_diameter_mm:g}",
            " / ".join(f"{tube.outer_diameter_mm:g}" for tube in reversed(system.tubes.nested)),
            *system.needle_sizes,
            system.description,
        )
        for name, system in systems.items()
    ]
    headings = ("name", "scope, mm", "tubes, mm", "needle, mm", "least turning radius, mm", "what it is")
    return terminal.table("Systems, the least invasive first (diameters)", headings, rows)
