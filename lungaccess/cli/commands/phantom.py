"""The command `lungaccess phantom`: a synthetic patient as a folder, to try the other commands on."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Positive, Seed
from lungaccess.cli.options import OutputOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, require_empty_folder


def phantom(
    *,
    out: Path = Path("PATIENT"),
    seed: Seed = 2,
    size: Literal["adult", "small"] = "adult",
    spacing: Positive | None = None,
    breathing: Annotated[bool, Parameter(negative="")] = False,
    force: Force = False,
    output: OutputOptions = OutputOptions(),
) -> ExitCode:
    """Write a synthetic patient: masks, CT and the truth about it; no data are needed.

    Args:
        out: Folder for patient.toml, masks and CT.
        seed: Seed of the patient: another one, another patient.
        size: small: 0.7 times an adult, a child of about ten years.
        spacing: Edge of the voxels, mm; 1 for the adult, 1.25 for the small patient.
        breathing: Also motion.nrrd, how the lungs breathe; the masks show end-inhale.
    """
    from anatomy.phantom import make_phantom, write_phantom

    require_empty_folder(out, force=force)
    with progress("making a synthetic patient"):
        made = make_phantom(seed=seed, spacing_mm=spacing, size=size)
    with progress(f"writing {out}"):
        write_phantom(made, out, breathing=breathing)
    nodules = [
        {"lps_mm": nodule.centre_lps.tolist(), "radius_mm": float(nodule.radius_mm)}
        for nodule in made.nodules
    ]
    if output.json:
        terminal.show_json({"folder": str(out), "name": made.images.name, "nodules": nodules})
        return ExitCode.OK
    rows = [
        ("lps:" + ",".join(f"{value:.1f}" for value in nodule.centre_lps), f"{2.0 * nodule.radius_mm:.1f}")
        for nodule in made.nodules
    ]
    terminal.show([terminal.table(f"Nodules of {made.images.name}", ("centre, mm", "diameter, mm"), rows)])
    terminal.say(f"Written to {out}: patient.toml, its masks, ct.nii.gz, truth.json.")
    terminal.say(f"Plan with: lungaccess plan {out} --nodule")
    return ExitCode.OK
