"""The command `lungaccess needle`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from anatomy.errors import SettingsError
from anatomy.io.frames import Frame
from lungaccess.cli import terminal
from lungaccess.cli.commands.common import (
    DEFAULT_BUDGET_S,
    DEFAULT_SYSTEM,
    NO_PLAN,
    OK,
    ObjectiveText,
    require_budget,
)
from lungaccess.cli.inputs import load_device, load_lung, require_one_target
from lungaccess.cli.progress import progress
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from anatomy.typed import Float

NeedlePlanner = Literal["decide", "rrt", "optimal", "resolution"]


def needle(
    patient: Path,
    *,
    start: str,
    frame: Frame = "lps",
    target: str | None = None,
    nodule: int | None = None,
    system: str = DEFAULT_SYSTEM,
    planner: NeedlePlanner = "decide",
    objective: ObjectiveText = "length",
    budget: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    allow_fissures: bool | None = None,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Plan the needle alone from a given pose, or prove that no path exists.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    start : str
        Number of a start pose that came with the patient, or path of a text file with a 4x4 pose whose +z
        column is the direction of insertion.
    frame : str
        Frame of the numbers in that file.
    target : str
        Target point in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        Go to the centre of this nodule.
    system : str
        Preset or TOML file whose needle and margins are used.
    planner : str
        decide: a path, or a proof that there is none; rrt; optimal: better and better paths; resolution:
        the best path of pieces at a resolution, or the statement that it has none.
    objective : str
        What to make small: length, integral of 1/clearance, integral of the cost map, its sum over voxels, or
        a weighted sum such as length=1,cost-map=0.5.
    budget : float
        Planning time in seconds; 10 if neither this nor --iterations is given.
    iterations : int
        Number of iterations instead of a time.
    seed : int
        Seed of the random numbers.
    allow_fissures : bool
        Whether fissures may be crossed; as the system says if not given.
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.one_stage.needle import plan_needle
    from lungaccess.problem.target import resolve_target

    require_one_target(target, nodule)
    require_budget(budget, iterations)
    weighed = Objective.of(objective)
    device = load_device(system, allow_fissures)
    lung = load_lung(patient, cache)
    limit_s = DEFAULT_BUDGET_S if budget is None and iterations is None else budget
    pose, aim = _start_pose(lung, start, frame), resolve_target(lung, target, nodule)
    with progress("searching" if limit_s is None else f"searching, at most {limit_s:g} s"):
        answer = plan_needle(
            lung,
            device,
            pose,
            aim,
            planner=planner,
            objective=weighed,
            seed=seed,
            iterations=iterations,
            time_s=limit_s,
        )
    if json:
        terminal.show_json(answer.record())
    else:
        terminal.show(terminal.needle_tables(answer))
    return NO_PLAN if answer.path is None else OK


def _start_pose(lung: Lung, start: str, frame: Frame) -> Float:
    """Return a pose by its number among those of the patient, or from a file."""
    from anatomy.io.frames import read_pose

    if not start.isdigit():
        return read_pose(start, frame)
    number = int(start)
    if not 1 <= number <= len(lung.starts):
        raise SettingsError(
            f"There is no start pose {number}",
            expected=f"1 to {len(lung.starts)}" if lung.starts else "a file: the patient came with no pose",
        )
    return lung.starts[number - 1]
