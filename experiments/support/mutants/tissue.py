"""Plans that come too near to what they must not touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from anatomy import structures
from anatomy.base.typed import Float
from experiments.support.mutants.draws import Rng, direction
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, of_needle, tube_points
from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.parts import NeedleArc
from lungaccess.plans.plan import Plan
from stages.needle.path import ArcPath, direct_path

SAMPLE_MM = 0.05


def needle_samples(plan: Plan) -> tuple[Float, Float]:
    """Return points of the needle's axis and their path lengths."""
    rows = np.array([[a.length_mm, a.roll_rad, a.curvature_per_mm] for a in plan.needle.arcs])
    return ArcPath(lps_from_start=plan.needle.lps_from_start, arcs=rows).sample(SAMPLE_MM)


@of_needle
def needle_elsewhere(case: Case, rng: Rng) -> Mutant | None:
    """An honest plan from the same tube to another target, through a vessel, an airway or the pleura.

    What it states of itself is true, but for costs and clearances, of which it says nothing it need not.
    """
    plan, lung = case.plan, case.lung
    start, device = plan.needle.lps_from_start, plan.system.needle
    for _ in range(20):
        ahead = rng.uniform(15.0, 60.0)
        aside = rng.uniform(0.0, 0.4 * device.max_curvature_per_mm * ahead**2)
        phi = rng.uniform(0.0, 2.0 * np.pi)
        target = start[:3, 3] + start[:3, :3] @ [aside * np.cos(phi), aside * np.sin(phi), ahead]
        path = direct_path(start, target)
        points, arc = path.sample(SAMPLE_MM)
        index = np.rint(lung.grid.ijk(points)).astype(np.int64)
        if ((index < 0) | (index >= lung.labels.shape)).any():
            continue
        labels = lung.labels[tuple(index.T)]
        through = labels & (structures.VESSEL | structures.OUTSIDE)
        if plan.fissures_are_obstacles:
            through = through | (labels & structures.FISSURE)
        behind = arc > plan.exemption.needle_length_mm + 0.1
        if not (through.any() or (labels[behind] & structures.AIRWAY).any()):
            continue
        length, roll, curvature = (float(v) for v in path.arcs[0])
        costs = {**plan.costs, "length_mm": length}
        return Mutant(
            plan=changed(
                plan,
                target_lps=path.frames()[-1][:3, 3],
                target_origin="point",
                needle__arcs=(NeedleArc(length_mm=length, roll_rad=roll, curvature_per_mm=curvature),),
                needle__end_lps=path.frames()[-1][:3, 3],
                needle__length_mm=length,
                needle__max_angle_from_start_rad=path.max_angle_from_start_rad(),
                needle__accumulated_turn_rad=path.accumulated_turn_rad,
                clearance_mm={"tube": {}, "needle": {}},
                costs=costs,
            )
        )
    return None


def beside(points: Float, tangents: Float, least: int, within_mm: float, rng: Rng) -> Float:
    """Return a point less than `within_mm` beside one of the points from number `least` on."""
    n = int(rng.integers(least, len(points)))
    aside = np.cross(tangents[n], direction(rng))
    share = float(rng.uniform(0.0, 0.98))
    return np.asarray(points[n] + share * within_mm * aside / np.linalg.norm(aside))


def with_voxel(case: Case, point: Float, relabel: Callable[[int], int]) -> Mutant | None:
    """Return the plan with another label of the voxel that holds a point."""
    voxel = np.rint(case.lung.grid.ijk(point)).astype(np.int64)
    if ((voxel < 0) | (voxel >= case.lung.labels.shape)).any():
        return None
    old = int(case.lung.labels[tuple(voxel)])
    new = relabel(old)
    return None if new == old else Mutant(plan=case.plan, voxel=voxel, label=new)


def obstacle(case: Case, rng: Rng) -> Callable[[int], int]:
    """Return the label of a voxel in which a forbidden structure has been put."""
    bits = [structures.VESSEL, structures.OUTSIDE]
    if case.plan.fissures_are_obstacles:
        bits.append(structures.FISSURE)
    bit = int(rng.choice(bits))
    return lambda label: label | bit


def foreign_airway(case: Case, rng: Rng) -> Callable[[int], int]:
    """Return the label of a voxel that became airway of another branch than the pierced one."""
    branches = np.setdiff1d(np.arange(case.lung.tree.n_branches), [case.plan.exemption.branch])
    name = (int(rng.choice(branches)) + 1) << structures.BRANCH_SHIFT
    below = (1 << structures.BRANCH_SHIFT) - 1
    return lambda label: (label & below) | structures.AIRWAY | name


@of_needle
def voxel_at_the_needle(case: Case, rng: Rng) -> Mutant | None:
    """A voxel of vessel, pleura, fissure or another airway within the needle's clearance."""
    points, _ = needle_samples(case.plan)
    tangents = np.gradient(points, axis=0)
    relabel = foreign_airway(case, rng) if rng.integers(4) == 0 else obstacle(case, rng)
    within = case.plan.required_clearance_mm["needle"] - 0.002
    return with_voxel(case, beside(points, tangents, 0, within, rng), relabel)


def voxel_at_the_tube(case: Case, rng: Rng) -> Mutant | None:
    """The same within the clearance of the tube, behind the wall."""
    plan, tube = case.plan, case.plan.tube
    begin = tube.exit.arc_length_mm + 0.05
    arc = np.linspace(begin, tube.inner_insertion_mm, 200)
    points = tube_points(plan, arc)
    relabel = foreign_airway(case, rng) if rng.integers(4) == 0 else obstacle(case, rng)
    within = plan.required_clearance_mm["inner_tube"] - 0.002
    return with_voxel(case, beside(points, np.gradient(points, axis=0), 0, within, rng), relabel)


def voxel_at_the_scope(case: Case, rng: Rng) -> Mutant | None:
    """A voxel of the lumen became wall, within the radius and margin of the scope on its way."""
    scope, motion = case.plan.system.scope, scope_motion(case.plan).between(1.0, 0.1)
    until = replace(motion, states=motion.states[: 1 + int(rng.integers(len(motion.states)))])
    points = until.body(0.2)[-int(scope.bending_length_mm / 0.2) :, :3, 3]
    within = scope.radius_mm + scope.lumen_margin_mm - 0.002
    point = beside(points, np.gradient(points, axis=0), 1, within, rng)
    return with_voxel(case, point, lambda label: label & ~structures.LUMEN)


MUTATIONS: tuple[Mutation, ...] = (
    needle_elsewhere, voxel_at_the_needle, voxel_at_the_tube, voxel_at_the_scope,
)  # fmt: skip
