"""Variations of a candidate: other rotation and insertions from the same scope tip, and a direct arc."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator

TURN_RAD, SHIFT_MM = math.radians(10.0), 2.0
"""Standard deviations of the first variations: less than the spacing of the atlas."""
SMALLEST = 0.02
"""Share of them below which a variation changes nothing that counts."""


def varied(
    evaluator: CandidateEvaluator, candidate: Candidate, turn_rad: float, shifts_mm: Sequence[float]
) -> Candidate | None:
    """Return a candidate turned and shifted; None if the tubes refuse it, or are not planar."""
    old = candidate.deployment
    if old.shape is not None:
        return None
    outer = max(old.outer_mm + shifts_mm[0], 0.0)
    inner = max(old.inner_mm + shifts_mm[1], outer)
    if evaluator.task.system.tubes.outer is None:
        outer = inner
    turned = (old.rotation_rad + turn_rad) % (2.0 * math.pi)
    return evaluator.direct(candidate.tip, turned, outer, inner)
