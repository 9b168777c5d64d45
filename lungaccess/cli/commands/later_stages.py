"""The commands `lungaccess replan` and `needle`: the stages after the bronchoscope, from a given pose."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.base.words import of_hundred
from lungaccess.cli import lazy, options, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, Positive, Seed
from lungaccess.cli.plan_search import arcs_table
from lungaccess.cli.progress import progress
from stages.needle import DEFAULT, Objective


def replan(
    patient: options.PatientFolder,
    *,
    scope: str | None = None,
    tube: str | None = None,
    needle: str | None = None,
    frame: options.FrameOfPose = None,
    plan: Path | None = None,
    errors: options.ErrorOptions = options.ErrorOptions(),
    placement: Count = 1,
    radius: Positive | None = None,
    record: Path | None = None,
    target: options.TargetOptions = options.TargetOptions(),
    system: options.SystemOptions = options.SystemOptions(),
    objective: options.ObjectiveText = DEFAULT,
    seed: Seed = 0,
    masks: options.PatientOptions = options.PatientOptions(),
) -> ExitCode:
    """Plan the rest from a measured pose: tubes and needle from the scope's tip, or the needle alone.

    With --plan and --procedure the policy of the procedure says what to do next, with its chance of success.

    Args:
        scope: Where the tip of the bronchoscope really is: a text file with a 4x4 pose, +z forward and +x up
            in the camera's picture; a point moved in 3D Slicer, scene.mrml#name; or a plan.json, whose scope
            ends there.
        tube: Where the tip of the tubes really is, instead: a text file with a 4x4 pose, +z forward; a point
            moved in 3D Slicer, scene.mrml#name; or a plan.json.
        needle: Where the tip of the needle really is, with --procedure: stated as for --tube.
        plan: plan.json that is carried out, with --procedure: the policy says what to do next.
        placement: How often the scope has been placed, with --procedure.
        radius: Radius of the goal in mm, with --procedure.
        record: File to which what was measured and decided is added, with --procedure; it is played again
            first.
        objective: What to make small, as for `plan`.
        seed: Seed of the random numbers.
    """
    if plan is not None or errors.procedure is not None:
        poses = {"scope": scope, "tubes": tube, "needle": needle}
        return _decided(patient, poses, frame, plan, errors, placement, radius, record, masks)
    Objective.of(objective)
    stated, device = target.stated(), system.load()
    given = scope if tube is None else tube
    if given is None or (scope is not None and tube is not None):
        raise SettingsError(
            "Both --scope and --tube are given" if given else "Neither --scope nor --tube is given",
            expected="one of them: where the tip of the scope or of the tubes really is",
            remedy="`lungaccess template pose` prints a file to start from",
        )
    pose, of_plan = _pose(given, "scope" if tube is None else "tubes", frame)
    lung = masks.load(patient)
    if of_plan is not None:
        of_plan.require_lung(lung)
    options.require_map(lung, objective)
    aim, ask = stated.resolve(lung), lazy.replan_from_tube if scope is None else lazy.replan_from_scope
    with progress("planning the rest"):
        found = ask(lung, device, pose, aim, objective=objective, seed=seed)
    terminal.tell(found.record())
    terminal.show(_replan_tables(found, has_map=lung.cost is not None))
    return ExitCode.OK


def _decided(
    patient: Path,
    stated: dict[str, str | None],
    frame: options.FrameOfPose,
    carried_out: Path | None,
    errors: options.ErrorOptions,
    placement: int,
    radius: float | None,
    kept: Path | None,
    masks: options.PatientOptions,
) -> ExitCode:
    procedure = errors.given_procedure()
    if carried_out is None or procedure is None:
        raise SettingsError(
            "Only one of --plan and --procedure is given",
            expected="both: the plan that is carried out, and what is measured on the way",
            remedy="For instance --plan plan.json --procedure measured-tip",
        )
    poses = {name: [_pose(text, name, frame)[0]] for name, text in stated.items() if text is not None}
    plan, lung = lazy.Plan.load(carried_out), masks.load(patient)
    if kept is not None and kept.exists():
        record = lazy.ProcedureRecord.load(kept, plan, lung)
    else:
        record = lazy.ProcedureRecord(lazy.Policy(plan, lung, errors.load(), procedure, radius_mm=radius))
    with progress("asking the policy"):
        decision = record.decide(lazy.Measurements.of(**poses, placements=placement))  # type: ignore[arg-type]
    if kept is not None:
        record.save(kept)
    terminal.tell(decision.record())
    terminal.show(_decision_tables(decision))
    return ExitCode.of(decision.goes_on)


def _pose(given: str, stage: str, frame: options.FrameOfPose) -> tuple[lazy.Float, lazy.Plan | None]:
    """Return a pose as it is stated, and the plan that it is of if it is one of a plan."""
    saved = lazy.parse_reference(given)
    if saved is not None:
        return lazy.read_named_pose(saved), None
    if not given.endswith(".json"):
        return lazy.read_pose(given, frame), None
    plan = lazy.Plan.load(given)
    return (plan.scope.lps_from_scope_tip if stage == "scope" else plan.tube.lps_from_tip), plan


def _replan_tables(found: lazy.RestOfPlan, *, has_map: bool) -> list[Table]:
    length = "none: the tip of the tubes is at the target"
    if found.needle is not None:
        length = f"{found.needle.length_mm:.1f} mm"
    rows = [*tube_rows(found.tube), ("needle", length)]
    rows += [
        (f"least clearance of the {name}", f"{min(each.values()):.2f} mm")
        for name, each in found.clearance_mm.items()
    ]
    rows += lazy.costs_in_words(lazy.known_costs(found.costs, has_map=has_map))
    return _with_arcs("the rest, proved", rows, found.needle)


def _with_arcs(title: str, rows: list[tuple[str, str]], needle: lazy.NeedlePath | None) -> list[Table]:
    """Return a table of rows, and one of the arcs of a needle if there is one."""
    arcs = [] if needle is None else needle.arcs
    of_arcs = [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in arcs]
    return [terminal.table(title, ("", ""), rows), *([] if needle is None else [arcs_table(of_arcs)])]


def tube_rows(tube: lazy.TubeDeployment | None) -> list[tuple[str, str]]:
    """Return how tubes are to be turned and inserted; nothing where none are."""
    if tube is None:
        return []
    turned = tube.shape.relative_rotations_rad
    middle = [("middle tube", f"{tube.middle_insertion_mm:.1f} mm")] if tube.middle_insertion_mm else []
    return [
        ("turn the tubes, from +x of the scope", f"{math.degrees(tube.rotation_rad):.1f} deg"),
        *(
            (f"turn the {name} tube on by", f"{math.degrees(angle):.1f} deg")
            for name, angle in turned.items()
            if angle
        ),
        ("outer tube", f"{tube.outer_insertion_mm:.1f} mm"),
        *middle,
        ("inner tube", f"{tube.inner_insertion_mm:.1f} mm"),
        ("exit through branch", f"{tube.exit.branch}"),
    ]


def _decision_tables(decision: lazy.Decision) -> list[Table]:
    """Return what a policy says is to be done next."""
    rows = [("estimated chance of success so", f"{of_hundred(decision.chance)} of 100")]
    if decision.again:
        rows.append(("if the scope is placed again", f"{of_hundred(decision.again)} of 100"))
    if not decision.goes_on:
        return _with_arcs(str(decision.action), rows, None)
    rows += tube_rows(decision.tube)
    if decision.needle is not None:
        rows.append(("needle", f"{decision.needle.length_mm:.1f} mm"))
    return _with_arcs(str(decision.action), rows, decision.needle)


def needle(
    patient: options.PatientFolder,
    *,
    start: str,
    frame: options.FrameOfPose = None,
    target: options.TargetOptions = options.TargetOptions(),
    system: options.SystemOptions = options.SystemOptions(),
    planner: options.OurPlannerName = "decide",
    objective: options.ObjectiveText = "length",
    budget: options.BudgetOptions = options.BudgetOptions(),
    out: Path | None = None,
    masks: options.PatientOptions = options.PatientOptions(),
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
    if out is not None:
        options.require_picture(out)
    stated, weighed = target.stated(), Objective.of(objective)
    device, lung, limit_s = system.load(), masks.load_organ(patient), budget.time_s
    pose, aim = _start_pose(lung, start, frame), stated.resolve(lung)
    with progress("searching" if limit_s is None else f"searching, at most {limit_s:g} s"):
        answer = lazy.plan_needle(
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
    if answer.path is not None and isinstance(lung, lazy.Lung):
        checked = lazy.check_needle_alone(
            lung, device, pose, answer.path.arcs, aim.lps_mm, branches=answer.branches, at_wall=answer.at_wall
        )
    terminal.tell(answer.record() | {"check": checked and checked.to_mapping()})
    terminal.show(_needle_tables(answer, is_lung=isinstance(lung, lazy.Lung)))
    if checked is not None:
        verdict = "accepts" if checked.accepted else "REFUSES"
        terminal.say("\n".join([f"The independent check {verdict} the path.", *map(str, checked.refusals)]))
    elif answer.path is not None:
        terminal.say("The independent check reads lungs alone: this path was not checked.")
    if out is not None:
        lazy.needle_png(answer, lung, out)
        terminal.say(f"Written to {out}")
    return ExitCode.of(answer.path is not None and (checked is None or checked.accepted))


def _needle_tables(answer: lazy.NeedleAnswer, *, is_lung: bool) -> list[Table]:
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
        rows += lazy.obstruction_rows(answer.obstruction, answer.proved, answer.lobe)
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
    rows += lazy.costs_in_words(answer.known_costs)
    return [terminal.table("needle", ("", ""), rows), arcs_table(path.arcs)]


def _start_pose(lung: lazy.Organ, start: str, frame: options.FrameOfPose) -> lazy.Float:
    """Return a pose by its number among those of the patient, from a plan, or from a file of numbers."""
    if start.endswith(".json"):
        return lazy.Plan.load(start).tube.lps_from_tip
    names = [name.lower() for name in lung.start_names]
    if start.lower() in names:
        return lung.starts[names.index(start.lower())]
    if not start.isdecimal():
        return lazy.read_pose(start, frame)
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
