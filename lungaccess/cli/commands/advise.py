"""The command `lungaccess advise`: the path of the bronchoscope alone, turn by turn."""

from pathlib import Path
from typing import TYPE_CHECKING

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Positive, Seed
from lungaccess.cli.options import DEFAULT_SYSTEM, PatientFolder, PatientOptions, TargetOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from lungaccess.planning.one_stage import ScopeAdvice


def advise(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    lesion_radius: Positive = 5.0,
    system: str = DEFAULT_SYSTEM,
    seed: Seed = 0,
    out: Path = Path("lungaccess-advice"),
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Advise the bronchoscope: turn by turn to a lesion, or as near as it gets, and why not nearer.

    The goal is the airway voxel nearest to the lesion's centre, if possible one in the lesion where the scope
    fits.  Exit code 0 if the scope reaches it, 1 if it stops before.

    Args:
        lesion_radius: Radius of the lesion, mm.
        system: Preset or TOML file whose scope is used.
        seed: Seed of the random numbers.
        out: Folder for advice.json and camera.mrk.json, the flight of the camera for 3D Slicer.
    """
    from lungaccess.planning.one_stage import ADVICE_FILE, CAMERA_FILE, advise_scope, save_advice
    from lungaccess.problem.system import load_system

    stated = target.stated()
    claim_folder(out, (ADVICE_FILE, CAMERA_FILE), force=force)
    device = load_system(system)
    lung = output.load(patient)
    with progress("steering the scope"):
        advice = advise_scope(lung, device, stated.centre_lps(lung), lesion_radius, seed=seed)
    save_advice(advice, out)
    if output.json:
        terminal.show_json(advice.as_json())
    else:
        _show(advice)
        terminal.say(f"Written to {out}: {ADVICE_FILE}, {CAMERA_FILE}")
    return ExitCode.of(advice.path.reached)


def _show(advice: "ScopeAdvice") -> None:
    path = advice.path
    rows = [("insertion", f"{path.length_mm:.0f} mm"), ("retreats", f"{path.retreats}")]
    if path.reached:
        rows.insert(0, ("outcome", "reaches the goal in the airway"))
    else:
        rows.insert(0, ("outcome", f"stops {path.distance_mm:.1f} mm from the goal"))
        rows.insert(1, ("why", advice.why_stopped))
    inside = (
        "inside it" if path.distance_to_lesion_mm == 0.0 else f"{path.distance_to_lesion_mm:.1f} mm from it"
    )
    rows.append(("tip and lesion", inside))
    if not path.goal.in_lesion:
        rows.append(
            ("lesion", f"touches no lumen; the nearest is {path.goal.distance_mm:.1f} mm from its centre")
        )
    terminal.show([terminal.table("bronchoscope", ("", ""), rows)])
    for number, one in enumerate(advice.instructions, start=1):
        terminal.say(f"{number}. {one.text()}")
    terminal.console.print()
    if advice.thinner:
        thinner = [
            (f"{2.0 * one.radius_mm:.1f}", "yes" if one.reached else "no", f"{one.distance_mm:.1f}")
            for one in advice.thinner
        ]
        headings = ("diameter with gap, mm", "reaches the goal", "left, mm")
        terminal.show([terminal.table("Thinner scopes of the same bends", headings, thinner)])
