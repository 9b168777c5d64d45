"""Variations of a candidate: other rotation and insertions with a direct arc, or tubes aimed anew."""

import math
from collections.abc import Sequence

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.coupled.kernels.aimed_tubes import COST
from lungaccess.planning.coupled.search.aimed_tubes import TubeAiming, aim_starts, chosen_of
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from stages.tube import ConcentricTubes, Deployment, deployed, design_arrays, shape_of_arrays

TURN_RAD, SHIFT_MM = math.radians(10.0), 2.0
"""Standard deviations of the first variations: less than the spacing of the atlas."""
SMALLEST = 0.02
"""Share of them below which a variation changes nothing that counts."""


def random_change(rng: np.random.Generator, size: float, tubes: ConcentricTubes) -> list[float]:
    """Return what `varied` changes, at random: a turn, two shifts, and turns of tubes against the others.

    The spreads are TURN_RAD and SHIFT_MM times `size`.
    """
    spreads = np.array([TURN_RAD, SHIFT_MM, SHIFT_MM, *[TURN_RAD] * len(tubes.nested)])
    changes: list[float] = (rng.standard_normal(len(spreads)) * spreads * size).tolist()
    return changes


def varied(
    evaluator: CandidateEvaluator,
    candidate: Candidate,
    turn_rad: float,
    shifts: Sequence[float],
    end: Float | None = None,
) -> Candidate | None:
    """Return a candidate that is turned and shifted; None if the tubes refuse it.

    With a needle its arc follows from the tubes.  Without one the tubes have to end where they are to: then
    the first shift is that of the scope along its motion, and the tubes are aimed from the changed ones.

    Args:
        turn_rad: By which all tubes are turned.
        shifts: Of outer and inner tube, mm.  Behind them by how much each is turned against the others, the
            innermost first, rad.
        end ((3,) float64): Where the devices end, LPS mm; what the evaluator aims at if None.
    """
    tubes, old, tip = evaluator.task.system.tubes, candidate.deployment, candidate.tip
    joints = _changed_joints(tubes, old, shifts)
    if evaluator.task.system.needle is None:
        return _aimed_anew(evaluator, candidate, shifts[0], joints, end)
    made = deployed(design_arrays(tubes), *np.split(joints, 2))
    if made is None:
        return None
    turned = (old.rotation_rad + turn_rad) % (2.0 * math.pi)
    return evaluator.direct(tip, turned, shape_of_arrays(made), end)


def _changed_joints(tubes: ConcentricTubes, old: Deployment, shifts: Sequence[float]) -> Float:
    """Return insertions and rotations `(2 n,)`."""
    n = len(tubes.nested)
    inserted = np.maximum(old.shape.insertions_mm + np.linspace(shifts[1], shifts[0], n), 0.0)
    turns = np.array(shifts[2:] or [0.0] * n)
    # The first bent tube is what the others are turned against.
    bent = np.array([bool(tube.bends) for tube in tubes.nested])
    turned = old.shape.rotations_rad + np.where(bent & (np.cumsum(bent) > 1), turns, 0.0)
    return np.concatenate([np.minimum.accumulate(inserted), turned])


def _aimed_anew(
    evaluator: CandidateEvaluator, candidate: Candidate, shift_mm: float, joints: Float, end: Float | None
) -> Candidate | None:
    """Return the tubes aimed from a scope tip farther along its motion, beginning with changed ones."""
    task, row = evaluator.task, evaluator.tip_rows.along(candidate.tip, [shift_mm])
    starts = aim_starts(task.system.tubes, joints, 1)
    if starts is None or not row.proved[0]:
        return None
    ends = evaluator.aim(row.tips[0, :3]) if end is None else end
    aiming = TubeAiming(task.lung, task.system, task.objective, with_fissures=task.with_fissures)
    found, _why = aiming.aim(ends, row.tips, row.proved, np.zeros(1, dtype=np.int64), starts)
    if not np.isfinite(found[0, COST]):
        return None
    return evaluator.aimed(evaluator.tip_rows.tip(row, 0), *chosen_of(task.system.tubes, found[0]))
