"""Deployments and needles that are not what is stated about them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from anatomy import structures
from anatomy.base.typed import Float
from experiments.support.mutants.draws import Rng, direction, far, signed
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, of_needle, tube_points
from lungaccess.plans.parts import NeedleArc, NeedlePath
from lungaccess.plans.plan import Plan
from stages.needle.path import ArcPath


def tube_edited(case: Case, rng: Rng) -> Mutant | None:
    """Another rotation or insertion than leads to the stated tip."""
    tube, inner = case.plan.tube, case.plan.system.tubes.inner
    kind = int(rng.integers(3))
    if kind == 0:
        return Mutant(
            plan=changed(case.plan, tube__rotation_rad=tube.rotation_rad + signed(rng, 1e-3, np.pi))
        )
    if kind == 1:
        inserted = tube.inner_insertion_mm + signed(rng, 0.01, 10.0)
        return Mutant(plan=changed(case.plan, tube__inner_insertion_mm=inserted))
    inserted = tube.outer_insertion_mm + signed(rng, 0.1, 10.0)
    # Where the tubes are straight the outer tube's end changes no shape.
    if min(inserted, tube.outer_insertion_mm) < tube.inner_insertion_mm - inner.curved_length_mm:
        return None
    return Mutant(plan=changed(case.plan, tube__outer_insertion_mm=inserted))


def exit_edited(case: Case, rng: Rng) -> Mutant | None:
    """Another place, angle or branch of the exit."""
    way_out = case.plan.tube.exit
    point = way_out.point_lps + far(rng, 0.1, 20.0) * direction(rng)
    branch = int(rng.choice(np.setdiff1d(np.arange(-1, case.lung.tree.n_branches + 1), [way_out.branch])))
    edits: list[dict[str, Any]] = [
        {"tube__exit__point_lps": point},
        {"exemption__exit_point_lps": point},
        {"tube__exit__point_lps": point, "exemption__exit_point_lps": point},
        {"tube__exit__arc_length_mm": way_out.arc_length_mm + signed(rng, 0.05, 20.0)},
        {"tube__exit__wall_angle_rad": way_out.wall_angle_rad + signed(rng, 0.12, 1.5)},
        {"tube__exit__branch": branch},
        {"exemption__branch": branch},
        {"tube__exit__branch": branch, "exemption__branch": branch},
    ]
    return Mutant(plan=changed(case.plan, **edits[int(rng.integers(len(edits)))]))


def exit_at_a_corner(case: Case, rng: Rng) -> Mutant | None:
    """The exit is stated where the axis cuts a corner of the wall, before it leaves for good.

    Where there is no such corner, one voxel that the axis passes behind the exit becomes lumen.
    """
    tube, lung = case.plan.tube, case.lung
    arc = np.arange(0.0, tube.inner_insertion_mm, 0.005)
    points = tube_points(case.plan, arc)
    index = np.rint(lung.grid.ijk(points)).astype(np.int64)
    wet = (lung.labels[tuple(index.T)] & structures.LUMEN) != 0
    leaves = np.flatnonzero(wet[:-1] & ~wet[1:] & (arc[1:] < tube.exit.arc_length_mm - 0.05))
    if not len(leaves):
        # The axis stays 0.05 mm in the voxel: shorter ways through lumen may be overlooked.
        passed = (index[:-10] == index[10:]).all(axis=1) & (arc[5:-5] > tube.exit.arc_length_mm + 0.1)
        if not passed.any():
            return None
        n = 5 + int(rng.choice(np.flatnonzero(passed)))
        label = int(lung.labels[tuple(index[n])]) | structures.LUMEN
        return Mutant(plan=case.plan, voxel=index[n], label=label)
    n = int(rng.choice(leaves))
    edits = {"tube__exit__arc_length_mm": float(arc[n]), "tube__exit__point_lps": points[n]}
    return Mutant(plan=changed(case.plan, **edits, exemption__exit_point_lps=points[n]))


def wall_run_edited(case: Case, rng: Rng) -> Mutant | None:
    """Less or more of the tube is said to lie in the wall than does."""
    least, most = (case.limit(f"tube.wall_run.stated{end}") for end in ("", ".most"))
    if least is None or most is None or least < 0.1:
        return None
    run = least - far(rng, 0.05, least) if rng.integers(2) else most + far(rng, 0.05, 5.0)
    return Mutant(plan=changed(case.plan, tube__exit__wall_run_mm=run))


@of_needle
def exemption_longer(case: Case, rng: Rng) -> Mutant | None:
    """More needle is exempt than the device allows, or less than none."""
    limit = case.plan.system.needle.exit_exemption_mm
    length = -far(rng, 0.01, 5.0) if rng.integers(4) == 0 else limit + far(rng, 1e-4, 30.0)
    return Mutant(plan=changed(case.plan, exemption__needle_length_mm=length))


@of_needle
def arcs_edited(case: Case, rng: Rng) -> Mutant | None:
    """Length, roll or curvature of arcs, or arcs lost or swapped: the needle ends elsewhere."""
    arcs = list(case.plan.needle.arcs)
    n = int(rng.integers(len(arcs)))
    arc = arcs[n]
    kind = int(rng.integers(6))
    if kind == 0:
        arcs[n] = replace(arc, length_mm=arc.length_mm + signed(rng, 0.01, 10.0))
    elif kind == 1:
        arcs[n] = replace(arc, roll_rad=arc.roll_rad + signed(rng, 0.01, np.pi))
    elif kind == 2:
        arcs[n] = replace(arc, curvature_per_mm=-arc.curvature_per_mm)
    elif kind == 3:
        arcs[n] = replace(arc, curvature_per_mm=arc.curvature_per_mm * far(rng, 1.1, 3.0))
    elif kind == 4 and len(arcs) > 1:
        del arcs[n]
    elif kind == 5 and len(arcs) > 1:
        arcs[n], arcs[n - 1] = arcs[n - 1], arcs[n]
    ends = [end_of(case.plan, each) for each in (arcs, case.plan.needle.arcs)]
    moved = float(np.linalg.norm(ends[0] - ends[1]))
    if moved < 0.01:
        return None
    edits: dict[str, Any] = {"needle__arcs": tuple(arcs)}
    if rng.integers(2):
        length = float(sum(each.length_mm for each in arcs))
        edits |= {"needle__length_mm": length, "costs": {**case.plan.costs, "length_mm": length}}
    if rng.integers(2) and not case.plan.target_origin.startswith("nodule"):
        edits |= {"needle__end_lps": ends[0]}
    return Mutant(plan=changed(case.plan, **edits))


def end_of(plan: Plan, arcs: Any) -> Float:
    """Return where the needle ends with these arcs."""
    rows = np.array([[a.length_mm, a.roll_rad, a.curvature_per_mm] for a in arcs])
    return np.asarray(ArcPath(lps_from_start=plan.needle.lps_from_start, arcs=rows).frames()[-1][:3, 3])


@of_needle
def needle_statement_edited(case: Case, rng: Rng) -> Mutant | None:
    """A number about the needle that is not so."""
    needle = case.plan.needle
    edits: dict[str, Any] = {
        "needle__length_mm": needle.length_mm + signed(rng, 1e-5, 20.0),
        "needle__accumulated_turn_rad": needle.accumulated_turn_rad + signed(rng, 2e-3, 1.0),
        "needle__max_angle_from_start_rad": needle.max_angle_from_start_rad + signed(rng, 2e-3, 1.0),
        "needle__end_lps": needle.end_lps + far(rng, 0.01, 20.0) * direction(rng),
        "needle__arcs": (),
    }
    key = str(rng.choice(list(edits)))
    return Mutant(plan=changed(case.plan, **{key: edits[key]}))


def needle_added_or_removed(case: Case, rng: Rng) -> Mutant | None:
    """A plan without the needle that its system has, or with one that its system does not have."""
    plan, tip = case.plan, case.plan.tube.lps_from_tip
    if plan.needle is not None:
        clearance = {"tube": plan.clearance_mm["tube"]}
        return Mutant(plan=changed(plan, needle=None, clearance_mm=clearance))
    length = far(rng, 0.01, 30.0)
    needle = NeedlePath(
        lps_from_start=tip,
        arcs=(NeedleArc(length_mm=length, roll_rad=0.0, curvature_per_mm=0.0),),
        end_lps=tip[:3, 3] + length * tip[:3, 2],
        length_mm=length,
        max_angle_from_start_rad=0.0,
        accumulated_turn_rad=0.0,
    )
    if rng.integers(2):
        return Mutant(plan=changed(plan, needle=needle))
    return Mutant(plan=changed(plan, needle=needle, target_lps=needle.end_lps, target_origin="point"))


MUTATIONS: tuple[Mutation, ...] = (
    needle_added_or_removed,
    tube_edited,
    exit_edited,
    exit_at_a_corner,
    wall_run_edited,
    exemption_longer,
    arcs_edited,
    needle_statement_edited,
)
