"""The key figures of a plan as labels and values."""

from itertools import pairwise

import numpy as np

from anatomy.base.words import plural
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Appraisal
from lungaccess.judging.appraisal.limits import SHOWN_LIMITS
from lungaccess.plans.costs import costs_in_words, known_costs
from lungaccess.plans.plan import Plan, redirection_mm
from lungaccess.plans.view import view_rows
from lungaccess.problem.nodules import target_words

STRUCTURES = {"airway": "airway wall", "outside": "outside of the lung"}
Row = tuple[str, str]


def key_numbers(plan: Plan, lung: Lung, appraisal: Appraisal | None = None) -> list[tuple[str, list[Row]]]:
    """Return headed rows of a label and a value; distances are those of the appraisal, if there is one."""
    if appraisal is None:
        distances = _clearance_rows(plan)
    else:
        near = [(each.what, each.comparison) for each in appraisal.limits[:SHOWN_LIMITS]]
        distances = "Nearest to a limit", near
    return [*figures_of_plan(plan, lung), distances]


def figures_of_plan(plan: Plan, lung: Lung) -> list[tuple[str, list[Row]]]:
    """Return headed rows of what the plan does and costs, without its limits."""
    costs = costs_in_words(known_costs(plan.costs, has_map=lung.cost is not None))
    passes = []
    for number, (before, after) in enumerate(pairwise(plan.passes), 2):
        back_mm, on_mm = redirection_mm(before, after)
        tubes = "same tubes" if plan.same_tubes[number - 1] == plan.same_tubes[number - 2] else "tubes moved"
        passes.append((f"pass {number}", f"back {back_mm:.1f}, on {on_mm:.1f} mm, {tubes}"))
    more = [("Further passes", passes)] if passes else []
    return [("Plan", _general_rows(plan, lung)), *_stage_rows(plan, lung), *more, ("Cost", costs)]


def _general_rows(plan: Plan, lung: Lung) -> list[Row]:
    x, y, z = (float(c) for c in plan.target_lps)
    return [
        ("patient", plan.patient_name),
        ("system", plan.system.name),
        ("target, LPS mm", f"{x:.1f}, {y:.1f}, {z:.1f}"),
        ("target, RAS mm", f"{-x + 0.0:.1f}, {-y + 0.0:.1f}, {z:.1f}"),
        *((("place of the target", place),) if (place := target_words(lung, plan.target_lps)) else ()),
        *view_rows(plan, lung),
        ("fissures", _fissures(plan)),
        ("breath hold", plan.breath_hold or "not stated"),
        ("method, seed", f"{plan.method}, {plan.seed}"),
    ]


def _fissures(plan: Plan) -> str:
    if plan.fissure_chance is not None:
        return f"crossed with a chance of {plan.fissure_words}"
    if plan.fissures_are_obstacles:
        return "are obstacles"
    return "may be crossed" if plan.system.fissures_allowed else "not checked: no mask"


def _stage_rows(plan: Plan, lung: Lung) -> list[tuple[str, list[Row]]]:
    scope, tube, tubes = plan.scope, plan.tube, plan.system.tubes
    names = " / ".join(name for name, _tube in tubes.named) if tubes.outer is not None else "length"
    insertions = " / ".join(f"{length:.1f}" for length in tube.insertions_mm(tubes)) + " mm"
    alike = not any(tube.shape.relative_rotations_rad.values())
    rotations = [tube.rotation_rad] if alike else tube.rotations_rad(tubes)
    turned = " / ".join(f"{np.degrees(angle) % 360.0:.1f}°" for angle in rotations)
    scope_rows = [
        ("airway generation at the tip", f"{scope.generation}"),
        ("advance beyond the carina", f"{scope.length_from_carina_mm:.1f} mm"),
    ]
    tube_rows = [
        ("rotation", turned),
        (f"{names} beyond scope", insertions),
        ("pierced branch", lung.branch_words(tube.exit.branch)),
    ]
    return [("Scope", scope_rows), ("Tube", tube_rows), *_needle_rows(plan)]


def _needle_rows(plan: Plan) -> list[tuple[str, list[Row]]]:
    needle = plan.needle
    if needle is None:
        return [("No needle", [("tubes, from lumen to target", f"{plan.tissue_mm:.1f} mm")])]
    rows = [
        ("length", f"{needle.length_mm:.1f} mm in {plural(len(needle.arcs), 'arc')}"),
        ("greatest angle from start", f"{np.degrees(needle.max_angle_from_start_rad):.1f}°"),
        ("accumulated turn", f"{np.degrees(needle.accumulated_turn_rad):.1f}°"),
    ]
    return [("Needle", rows)]


def _clearance_rows(plan: Plan) -> tuple[str, list[Row]]:
    return "Least distance stated / required", [
        (f"{device} to {STRUCTURES.get(name, name)}", f"{value:.2f} / {_least(plan, device, name)}")
        for device, distances in plan.clearance_mm.items()
        for name, value in distances.items()
    ]


def _least(plan: Plan, device: str, structure: str) -> str:
    if structure == "fissure" and not plan.fissures_are_obstacles:
        return "allowed"
    return f"{plan.required_clearance_mm[{'tube': 'inner_tube'}.get(device, device)]:.2f} mm"
