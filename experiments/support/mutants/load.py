"""Tubes whose shape does not bear the needle that is in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anatomy.poses import poses_on_pieces
from experiments.support.mutants.draws import Rng, far
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, of_needle, with_system
from experiments.support.mutants.twisted import MOVED_MM
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from stages.tube import Neighbourhood, pieces_of_arcs
from stages.tube.one_shape import NearbyShape


@of_needle
def needle_stiffer(case: Case, rng: Rng) -> Mutant | None:
    """The needle is stiffer than the one with which the tubes have the stated shape."""
    needle = case.plan.system.require_needle("It")
    modulus = min(needle.youngs_modulus_gpa * far(rng, 1.1, 10.0), 1000.0)
    system = replace(case.plan.system, needle=replace(needle, youngs_modulus_gpa=modulus), name="own")
    return _if_moved(case.plan, system)


@of_needle
def needle_slots_left_out(case: Case, _rng: Rng) -> Mutant | None:
    """The needle has lost the slots that make its shaft flexible."""
    needle = case.plan.system.require_needle("It")
    plain = replace(needle, slotted_segments=(), max_strain=0.2)
    return _if_moved(case.plan, replace(case.plan.system, needle=plain, name="own"))


@of_needle
def needle_left_out_of_shape(case: Case, _rng: Rng) -> Mutant | None:
    """Shape and tip are those of the tubes without the needle that lies in them."""
    plan, system = case.plan, case.plan.system
    if not system.needle_preloaded:
        return _if_moved(plan, replace(system, needle_preloaded=True, name="own"))
    alone = _shape(plan, replace(system, needle_preloaded=False))
    if alone is None or not _moves(plan, alone):
        return None
    pieces = pieces_of_arcs(alone.arcs, plan.tube.rotation_rad)
    end = poses_on_pieces(plan.scope.lps_from_scope_tip, pieces, 1e3)[0][-1]
    return Mutant(plan=changed(plan, tube__shape__arcs=alone.arcs, tube__lps_from_tip=end))


def _if_moved(plan: Plan, system: System) -> Mutant | None:
    """Return the plan for a system with another needle, if the tubes with it are elsewhere than stated."""
    if not system.needle_preloaded:
        return None
    shape = _shape(plan, system)
    return None if shape is None or not _moves(plan, shape) else Mutant(plan=with_system(plan, system))


def _shape(plan: Plan, system: System) -> NearbyShape | None:
    """Return the shape that the tubes of a system have at the joint values of a plan."""
    tube, tubes = plan.tube, system.tubes
    inserted = np.array(tube.insertions_mm(tubes))[::-1]
    turned = np.array(tube.rotations_rad(tubes))[::-1] - tube.rotation_rad
    around = Neighbourhood.of(tubes.nested, inserted, turned, needle=tubes.needle_shaft)
    return around.at(inserted, turned)


def _moves(plan: Plan, shape: NearbyShape) -> bool:
    """Tell whether the tip of a shape is elsewhere than the stated one."""
    pieces = pieces_of_arcs(shape.arcs, plan.tube.rotation_rad)
    end = poses_on_pieces(plan.scope.lps_from_scope_tip, pieces, 1e3)[0][-1]
    return float(np.linalg.norm(end[:3, 3] - plan.tube.lps_from_tip[:3, 3])) > MOVED_MM


MUTATIONS: tuple[Mutation, ...] = (needle_stiffer, needle_slots_left_out, needle_left_out_of_shape)
