"""The command `lungaccess replan`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.io.frames import Frame
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Seed
from lungaccess.cli.options import (
    ObjectiveText,
    PatientFolder,
    PatientOptions,
    SystemOptions,
    TargetOptions,
    require_map,
)
from lungaccess.cli.progress import progress
from stages.needle import DEFAULT, Objective

if TYPE_CHECKING:
    from anatomy.base.typed import Float
    from lungaccess.planning.one_stage import RestOfPlan
    from lungaccess.plans.plan import Plan


def replan(
    patient: PatientFolder,
    *,
    scope: Annotated[
        str | None,
        Parameter(
            help="Where the tip of the bronchoscope really is: a text file with a 4x4 pose, +z forward and "
            "+x up in the camera's picture; a point moved in 3D Slicer, scene.mrml#name; or a plan.json, "
            "whose scope ends there."
        ),
    ] = None,
    tube: Annotated[
        str | None,
        Parameter(
            help="Where the tip of the tubes really is, instead: a text file with a 4x4 pose, +z forward; a "
            "point moved in 3D Slicer, scene.mrml#name; or a plan.json."
        ),
    ] = None,
    frame: Annotated[Frame, Parameter(help="Frame of the numbers in that text file.")] = "lps",
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    objective: Annotated[ObjectiveText, Parameter(help="What to make small, as for `plan`.")] = DEFAULT,
    seed: Annotated[Seed, Parameter(help="Seed of the random numbers.")] = 0,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the rest from a measured pose: tubes and needle from the scope's tip, or the needle alone."""
    from lungaccess.cli.plan_tables import no_plan_record
    from lungaccess.planning.one_stage import replan_from_scope, replan_from_tube
    from lungaccess.plans.no_plan import NoPlan

    Objective.of(objective)
    stated, device = target.stated(), system.load()
    pose, plan = _measured(scope, tube, frame)
    lung = output.load(patient)
    if plan is not None:
        plan.require_lung(lung)
    require_map(lung, objective)
    aim, ask = stated.resolve(lung), replan_from_tube if scope is None else replan_from_scope
    try:
        with progress("planning the rest"):
            found = ask(lung, device, pose, aim, objective=objective, seed=seed)
    except NoPlan as failure:
        if not output.json:
            raise
        terminal.show_json(no_plan_record(failure))
        return ExitCode.NEGATIVE
    if output.json:
        terminal.show_json(found.record())
    else:
        terminal.show(_tables(found, has_map=lung.cost is not None))
    return ExitCode.OK


def _measured(scope: str | None, tube: str | None, frame: Frame) -> tuple[Float, Plan | None]:
    """Return the pose as measured, and the plan that it is of if it is one of a plan."""
    from anatomy.io.frames import read_pose
    from anatomy.io.markups import parse_reference, read_named_pose
    from lungaccess.plans.plan import Plan

    given = scope if tube is None else tube
    if given is None or (scope is not None and tube is not None):
        raise SettingsError(
            "Both --scope and --tube are given" if given else "Neither --scope nor --tube is given",
            expected="one of them: where the tip of the scope or of the tubes really is",
            remedy="`lungaccess template pose` prints a file to start from",
        )
    saved = parse_reference(given)
    if saved is not None:
        return read_named_pose(saved), None
    if not given.endswith(".json"):
        return read_pose(given, frame), None
    plan = Plan.load(given)
    return (plan.tube.lps_from_tip if scope is None else plan.scope.lps_from_scope_tip), plan


def _tables(found: RestOfPlan, *, has_map: bool) -> list[Table]:
    from lungaccess.cli.plan_tables import arcs_table
    from lungaccess.plans.costs import costs_in_words, known_costs

    rows, tube, needle = [], found.tube, found.needle
    if tube is not None:
        rows += [
            ("turn the tubes, from +x of the scope", f"{np.degrees(tube.rotation_rad):.1f} deg"),
            *(
                (f"turn the {name} tube on by", f"{np.degrees(angle):.1f} deg")
                for name, angle in ({} if tube.shape is None else tube.shape.relative_rotations_rad).items()
                if angle
            ),
            ("outer tube", f"{tube.outer_insertion_mm:.1f} mm"),
            *([("middle tube", f"{tube.middle_insertion_mm:.1f} mm")] if tube.middle_insertion_mm else []),
            ("inner tube", f"{tube.inner_insertion_mm:.1f} mm"),
            ("exit through branch", f"{tube.exit.branch}"),
        ]
    rows += [
        (
            "needle",
            "none: the tip of the tubes is at the target" if needle is None else f"{needle.length_mm:.1f} mm",
        )
    ]
    rows += [
        (f"least clearance of the {name}", f"{min(each.values()):.2f} mm")
        for name, each in found.clearance_mm.items()
    ]
    rows += costs_in_words(known_costs(found.costs, has_map=has_map))
    tables = [terminal.table("the rest, proved", ("", ""), rows)]
    if needle is not None:
        arcs = [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in needle.arcs]
        tables.append(arcs_table(arcs))
    return tables
