"""The command `lungaccess needle`."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from anatomy.base.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import (
    BudgetOptions,
    FrameOfPose,
    ObjectiveText,
    OurPlannerName,
    PatientFolder,
    PatientOptions,
    SystemOptions,
    TargetOptions,
    require_picture,
)
from lungaccess.cli.progress import progress
from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.base.typed import Float
    from anatomy.organ import Organ
    from lungaccess.planning.one_stage import NeedleAnswer


def needle(
    patient: PatientFolder,
    *,
    start: str,
    frame: FrameOfPose = None,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    planner: OurPlannerName = "decide",
    objective: ObjectiveText = "length",
    budget: BudgetOptions = BudgetOptions(),
    out: Path | None = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the needle alone from a given pose, or prove that no path exists and say what is blocked.

    Args:
        start: Number or name of a start pose that came with the patient; a plan.json, whose needle starts
            there; or a text file with a 4x4 pose whose +z column is the direction of insertion.
        planner: decide: a path, or a proof that there is none; rrt; ao-rrt and optimal: better and better
            paths; resolution: the best path of pieces at a resolution, or the statement that it has none.
        objective: What to make small: length, inverse-clearance (nearness to obstacles), cost-map, voxel-sum,
            or a weighted sum such as length=1,cost-map=0.5.
        out: PNG file for a picture of start, path or blocked place, and target.
    """
    from anatomy.lung import Lung
    from lungaccess.planning.one_stage import plan_needle

    if out is not None:
        require_picture(out)
    stated, weighed = target.stated(), Objective.of(objective)
    device = system.load()
    lung = output.load_organ(patient)
    limit_s = budget.time_s
    pose, aim = _start_pose(lung, start, frame), stated.resolve(lung)
    with progress("searching" if limit_s is None else f"searching, at most {limit_s:g} s"):
        answer = plan_needle(
            lung,
            device,
            pose,
            aim,
            planner=planner,
            objective=weighed,
            seed=budget.seed,
            iterations=budget.iterations,
            time_s=limit_s,
        )
    checked = None
    if answer.path is not None and isinstance(lung, Lung):
        from lungaccess.judging.checking import check_needle_alone

        checked = check_needle_alone(
            lung, device, pose, answer.path.arcs, aim.lps_mm, branches=answer.branches, at_wall=answer.at_wall
        )
    if output.json:
        terminal.show_json(answer.record() | {"check": checked and checked.to_mapping()})
    else:
        terminal.show(_tables(answer, is_lung=isinstance(lung, Lung)))
        if checked is not None:
            verdict = "accepts" if checked.accepted else "REFUSES"
            terminal.say(
                "\n".join([f"The independent check {verdict} the path.", *map(str, checked.refusals)])
            )
        elif answer.path is not None:
            terminal.say("The independent check reads lungs alone: this path was not checked.")
    if out is not None:
        from lungaccess.showing.report import needle_png

        needle_png(answer, lung, out)
        if not output.json:
            terminal.say(f"Written to {out}")
    return ExitCode.of(answer.path is not None and (checked is None or checked.accepted))


def _tables(answer: "NeedleAnswer", *, is_lung: bool) -> list[Table]:
    """Return what a needle planner found: the outcome, and the path arc by arc."""
    from lungaccess.cli.plan_tables import arcs_table
    from lungaccess.planning.one_stage import obstruction_rows
    from lungaccess.plans.costs import costs_in_words

    words = {
        "path": "a path, proved clear",
        "no path": "no path exists (proved against the masks)",
        "nothing found": "nothing found within the limit; not proved that there is none",
    }
    rows = [("outcome", words.get(answer.outcome, answer.outcome))]
    if answer.branches:
        pierced = ", ".join(f"{branch}" for branch in answer.branches)
        how = "begins at the wall of branch" if answer.at_wall else "taken to have pierced branch"
        rows.append((how, pierced) if is_lung else ("enters through", "the surface of the organ"))
    path = answer.path
    if answer.obstruction is not None:
        rows += obstruction_rows(answer.obstruction, answer.proved, answer.lobe)
    if (passage := answer.open_passage) is not None:
        rows += [
            ("open at a resolution of", f"{passage.cell_mm:.2g} mm and a slope of {passage.slope_cell:.2g}"),
            (
                "a path would pass",
                f"a place {passage.width_mm:.2f} mm wide, {passage.from_start_mm:.1f} mm ahead",
            ),
        ]
    if path is None:
        return [terminal.table("needle", ("", ""), rows)]
    if answer.first_path_s is not None:
        rows.append(("first path after", f"{1000.0 * answer.first_path_s:.1f} ms"))
    rows += [
        ("length", f"{path.length_mm:.2f} mm"),
        ("largest angle from the start", f"{np.degrees(path.max_angle_from_start_rad()):.1f} deg"),
        ("turning in all", f"{np.degrees(path.accumulated_turn_rad):.1f} deg"),
    ]
    rows += costs_in_words(answer.known_costs)
    return [terminal.table("needle", ("", ""), rows), arcs_table(path.arcs)]


def _start_pose(lung: "Organ", start: str, frame: FrameOfPose) -> "Float":
    """Return a pose by its number among those of the patient, from a plan, or from a file of numbers."""
    from anatomy.io.frames import read_pose
    from lungaccess.plans.plan import Plan

    if start.endswith(".json"):
        return Plan.load(start).tube.lps_from_tip
    names = [name.lower() for name in lung.start_names]
    if start.lower() in names:
        return lung.starts[names.index(start.lower())]
    if not start.isdecimal():
        return read_pose(start, frame)
    number = int(start)
    if not 1 <= number <= len(lung.starts):
        raise SettingsError(
            f"There is no start pose {number}",
            expected=f"1 to {len(lung.starts)}, or {', '.join(lung.start_names)}"
            if lung.starts
            else "a file: the patient came with no pose",
            remedy="Give a plan.json, or a file as `lungaccess template pose` prints one",
        )
    return lung.starts[number - 1]
