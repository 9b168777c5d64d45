"""The command `lungaccess advise`: the path of the bronchoscope alone, turn by turn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.io.files import require_writable_folder
from anatomy.io.frames import parse_point
from lungaccess.cli import terminal
from lungaccess.cli.inputs import load_device, load_lung, require_one_target
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from lungaccess.one_stage.scope import ScopeAdvice

REACHED, NOT_REACHED = 0, 1


def advise(
    patient: Path,
    *,
    target: str | None = None,
    nodule: int | None = None,
    lesion_radius: float = 5.0,
    system: str = "lung-default",
    seed: int = 0,
    out: Path = Path("lungaccess-advice"),
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Advise the bronchoscope: turn by turn to a lesion, or as near as it gets, and why not nearer.

    The goal is the airway voxel nearest to the lesion's centre, if possible one in the lesion where the scope
    fits.  Exit code 0 if the scope reaches it, 1 if it stops before.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    target : str
        Centre of the lesion in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        Go to this nodule of the nodule mask.
    lesion_radius : float
        Radius of the lesion, mm.
    system : str
        Preset or TOML file whose scope is used.
    seed : int
        Seed of the random numbers.
    out : Path
        Folder for advice.json and camera.mrk.json, the flight of the camera for 3D Slicer.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.one_stage.scope import ADVICE_FILE, CAMERA_FILE, advise_scope, save_advice
    from lungaccess.problem.target import nodule_target

    require_one_target(target, nodule)
    require_writable_folder(out)
    device = load_device(system, None)
    lung = load_lung(patient, cache)
    centre = parse_point(target) if target is not None else nodule_target(lung, nodule or 1).lps_mm
    with progress("steering the scope"):
        advice = advise_scope(lung, device, centre, lesion_radius, seed=seed)
    save_advice(advice, out)
    if json:
        terminal.show_json(advice.as_json())
    else:
        _show(advice)
        terminal.console.print(terminal.escaped(f"Written to {out}: {ADVICE_FILE}, {CAMERA_FILE}"))
    return REACHED if advice.path.reached else NOT_REACHED


def _show(advice: ScopeAdvice) -> None:
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
        terminal.console.print(terminal.escaped(f"{number}. {one.text()}"))
    terminal.console.print()
    if advice.thinner:
        thinner = [
            (f"{2.0 * one.radius_mm:.1f}", "yes" if one.reached else "no", f"{one.distance_mm:.1f}")
            for one in advice.thinner
        ]
        headings = ("diameter with gap, mm", "reaches the goal", "left, mm")
        terminal.show([terminal.table("Thinner scopes of the same bends", headings, thinner)])
