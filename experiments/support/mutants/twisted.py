"""Tubes with joint values or a shape that do not belong together."""

from __future__ import annotations

import numpy as np

from anatomy.poses import poses_on_pieces
from experiments.support.mutants.draws import Rng, signed
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed
from lungaccess.plans.plan import Plan
from stages.tube import Neighbourhood, pieces_of_arcs

MOVED_MM = 0.05
"""Less far no point of the tubes may be moved by what is falsified: the check sees a hundredth of that."""


def rear_end_turned(case: Case, rng: Rng) -> Mutant | None:
    """One of several bent tubes is turned on, and the rest of the plan stays."""
    shape, tubes = case.plan.tube.shape, case.plan.system.tubes
    bent = [name for name, tube in tubes.named if tube.bends]
    if len(bent) < 2:
        return None
    name, by = str(rng.choice(bent)), signed(rng, 0.02, 3.0)
    turned = {**shape.relative_rotations_rad, name: shape.relative_rotations_rad[name] + by}
    mutant = changed(case.plan, tube__shape__relative_rotations_rad=turned)
    return Mutant(plan=mutant) if _moves(case.plan, mutant) else None


def tube_moved(case: Case, rng: Rng) -> Mutant | None:
    """One tube is inserted farther or less far, and the rest of the plan stays."""
    tube = case.plan.tube
    name = str(rng.choice([name for name, _tube in case.plan.system.tubes.named]))
    key = f"{name}_insertion_mm"
    inserted = getattr(tube, key) + signed(rng, 0.3, 8.0)
    return Mutant(plan=changed(case.plan, **{f"tube__{key}": max(inserted, 0.0)})) if inserted > 0.0 else None


def shape_of_another_equilibrium(case: Case, rng: Rng) -> Mutant | None:
    """Arcs and tip are those of other rotations than are stated."""
    tube, tubes = case.plan.tube, case.plan.system.tubes
    inserted = np.array(tube.insertions_mm(tubes))[::-1]
    turned = np.array(tube.rotations_rad(tubes))[::-1] - tube.rotation_rad
    other = Neighbourhood.of(tubes.nested, inserted, turned, needle=tubes.needle_shaft).at(
        inserted, turned + np.append(0.0, np.full(len(turned) - 1, signed(rng, 0.05, 1.0)))
    )
    if other is None:
        return None
    pieces = pieces_of_arcs(other.arcs, tube.rotation_rad)
    end = poses_on_pieces(case.plan.scope.lps_from_scope_tip, pieces, 1e3)[0][-1]
    if np.linalg.norm(end[:3, 3] - tube.lps_from_tip[:3, 3]) < MOVED_MM:
        return None
    return Mutant(plan=changed(case.plan, tube__shape__arcs=other.arcs))


def arcs_edited(case: Case, rng: Rng) -> Mutant | None:
    """An arc is longer, turned, more bent or thinner than it is."""
    shape = case.plan.tube.shape
    arcs = shape.arcs.copy()
    row, column = int(rng.integers(len(arcs))), int(rng.integers(4))
    if column == 1 and arcs[row, 0] * arcs[row, 2] < 0.1:
        return None
    arcs[row, column] += signed(rng, (0.3, 0.1, 0.003, 0.02)[column], (3.0, 1.0, 0.02, 0.2)[column])
    if (arcs[:, [0, 2, 3]] < 0.0).any() or arcs[row, 0] < 0.5:
        return None
    return Mutant(plan=changed(case.plan, tube__shape__arcs=arcs))


def shape_left_out(case: Case, rng: Rng) -> Mutant | None:
    """The shape of the tubes is missing, or its stability is prettier."""
    shape = case.plan.tube.shape
    if shape.least_determinant < 0.8 and rng.integers(2):
        return Mutant(plan=changed(case.plan, tube__shape__least_determinant=1.0))
    return Mutant(plan=changed(case.plan, tube__shape__arcs=shape.arcs[:0]))


def _moves(plan: Plan, mutant: Plan) -> bool:
    """Tell whether other rotations of the rear ends move the tip, at most in part by the tubes' twist."""
    tubes = plan.system.tubes
    tips = []
    for each in (plan, mutant):
        inserted, turned = (
            np.array(values)[::-1]
            for values in (each.tube.insertions_mm(tubes), each.tube.rotations_rad(tubes))
        )
        found = Neighbourhood.of(tubes.nested, inserted, turned, needle=tubes.needle_shaft).at(
            inserted, turned
        )
        if found is None:
            return True
        tips.append(found.scope_from_tip[:3, 3])
    return float(np.linalg.norm(tips[0] - tips[1])) > MOVED_MM


MUTATIONS: tuple[Mutation, ...] = (
    rear_end_turned,
    tube_moved,
    shape_of_another_equilibrium,
    arcs_edited,
    shape_left_out,
)
