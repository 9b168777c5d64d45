"""Repair a route by a nonlinear program on its spline."""

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import DEGREE, Curve
from stages.scope.route.guide_path import GuidePath
from stages.scope.route.kernels.repair import Program, repair
from stages.scope.route.kernels.spline import take_samples
from stages.scope.route.proof import Proof, RouteLimits, prove

BENDING = 0.02
"""Weight of the squared curvature, in limits."""
ROUNDS, STEPS = 12, 30
ANY_CURVATURE = 1e9

Stage = tuple[float, float, int, int]
"""Weight of bending, times the limit of curvature, rounds and steps."""
FINAL_STAGE: Stage = (BENDING, 1.0, ROUNDS, STEPS)

SMOOTH: tuple[Stage, ...] = ((2.0, ANY_CURVATURE, 2, 10),)
SMOOTH_WITHIN: tuple[Stage, ...] = ((2.0, ANY_CURVATURE, 1, 8), (2.0, 1.0, 2, 10))
FALLING: tuple[Stage, ...] = (
    (30.0, ANY_CURVATURE, 1, 8),
    (30.0, 1.0, 1, 10),
    (3.0, 1.0, 1, 10),
    (0.3, 1.0, 1, 10),
)
STIFF: tuple[Stage, ...] = ((30.0, ANY_CURVATURE, 4, STEPS), (30.0, 1.0, 4, STEPS))
AS_IT_IS: tuple[Stage, ...] = ()
TIGHTENED: tuple[Stage, ...] = tuple((BENDING, times, 4, STEPS) for times in (8.0, 4.0, 2.0, 1.4, 1.15))
"""The program is not convex: what is solved before its last stage decides where it ends."""

FURTHER_STARTS: tuple[tuple[float, tuple[Stage, ...]], ...] = (
    (6.0, SMOOTH),
    (4.5, AS_IT_IS),
    (2.0, SMOOTH_WITHIN),
    (3.0, SMOOTH_WITHIN),
    (1.5, TIGHTENED),
    (2.0, FALLING),
    (1.5, AS_IT_IS),
    (2.0, AS_IT_IS),
    (2.0, SMOOTH),
    (4.5, FALLING),
    (2.0, STIFF),
    (1.5, FALLING),
    (1.5, STIFF),
)
"""Spacings of the waypoints in mm, and starts, that are tried with the whole curve where the first did not
work: the quick ones first."""


Level = tuple[int, float, float]
"""Samples a span, of which the first is the knot, where the curvature can peak; and how much stricter the
program is than the limits: a share of that of curvature, and a depth in mm."""
LEVELS: tuple[Level, ...] = ((4, 0.01, 0.02), (8, 0.01, 0.02), (16, 0.02, 0.03))


@frozen_record
class Problem:
    """What a route has to keep to; the ends of the guide path are the wanted ones."""

    guide: GuidePath
    centreline: Centreline
    limits: RouteLimits

    def prove(self, curve: Curve) -> Proof:
        """Prove or disprove a curve."""
        return prove(curve, self.centreline, self.limits.max_curvature_per_mm, self.limits.needed_mm)


def repaired(
    curve: Curve, problem: Problem, free: tuple[int, int], level: Level, start: Sequence[Stage]
) -> tuple[Curve, float]:
    """Move the control points `free[0]` to `free[1] - 1` of a curve until it keeps to its limits.

    The other control points stay, and with them the curve three spans away and its smoothness.  Returned are
    the new curve and the largest violation of the stricter limits, a share of the limit of curvature or of
    the local radius.  `start` says what to solve before, as `SMOOTH` does.
    """
    low, high = free
    guide, lumen, limits = problem.guide, problem.centreline, problem.limits
    begin, end = max(low - DEGREE, 0), min(high, curve.n_spans)
    per_span, spare_curvature, spare_mm = level
    count = per_span * (end - begin) + 1
    first, rows, samples = np.zeros(count, dtype=np.int64), np.zeros((count, 3, 4)), np.zeros((count, 7))
    along, with_radius = guide.along_mm, np.column_stack((guide.points_mm, guide.radius_mm))
    control = np.array(curve.control_mm)
    take_samples(control, curve.knots, begin, end, per_span, along, with_radius, first, rows, samples)
    limit, worst, ends = limits.max_curvature_per_mm, np.inf, guide.points_mm[[0, -1]]
    for bending, times, rounds, steps in (*start, FINAL_STAGE):
        # Weight of the squared distance from the guide path, in radii; small against the limits.
        weights = np.array((
            0.02, bending / limit**2, times * limit, limits.needed_mm, spare_curvature,
            spare_mm, limits.end_tolerance_mm,
        ))  # fmt: skip
        task = Program(low, high, first, rows, samples, lumen.cones, *lumen.cells, guide.cones, weights, ends)
        # Violation that counts as none; the spares are larger, so that the limits themselves hold.
        worst, _taken = repair(control, task, rounds, steps, 2e-3)
    return Curve(control_mm=control, knots=curve.knots), float(worst)


def segments(proof: Proof, n_control: int, margin: int, *, ends_free: bool) -> list[tuple[int, int]]:
    """Return control points to free for unproved spans and `margin` more, ends too where they are free."""
    lowest, highest = (0, n_control) if ends_free else (1, n_control - 1)
    found: list[tuple[int, int]] = []
    for span in proof.failed_spans.tolist():
        low, high = max(span - margin, lowest), min(span + DEGREE + 1 + margin, highest)
        if found and low <= found[-1][1] + DEGREE:
            found[-1] = (found[-1][0], high)
        else:
            found.append((low, high))
    return found


def repair_exact(tentative: Curve, problem: Problem, executor: Executor | None = None) -> tuple[Curve, Proof]:
    """Return a curve that is proved to keep its limits, else the one found with the fewest spans that fail.

    It begins with the spline through points of the guide path.  An executor repairs the segments of a round
    side by side; threads are enough, the program runs without the lock.
    """
    # Share of all spans by which a segment is widened on both sides, as in [Li2021].
    curve, proof = _by_segments(tentative, problem, 0.05, SMOOTH, executor)
    for spacing, start in FURTHER_STARTS:
        if proof.holds:
            break
        whole = _by_segments(problem.guide.curve(spacing), problem, 1.0, start, None)
        if _failed_share(whole[1]) < _failed_share(proof):
            curve, proof = whole
    return curve, proof


def _failed_share(proof: Proof) -> float:
    return len(proof.failed_spans) / len(proof.verdicts)


def _by_segments(
    curve: Curve, problem: Problem, share: float, start: Sequence[Stage], executor: Executor | None
) -> tuple[Curve, Proof]:
    """Repair what is not proved, with `share` of all spans on both sides."""
    proof = problem.prove(curve)
    if proof.holds:
        return curve, proof
    # A segment is widened by at least so many spans on both sides: a bend needs length.
    margin = max(8, round(share * curve.n_spans))
    parts = segments(proof, len(curve.control_mm), margin, ends_free=problem.limits.end_tolerance_mm > 0)
    work = partial(_repaired_segment, curve, problem, start)
    done = map(work, parts) if executor is None or len(parts) < 2 else executor.map(work, parts)
    control = np.array(curve.control_mm)
    for (low, high), moved in zip(parts, done, strict=True):
        control[low:high] = moved
    curve = Curve(control_mm=control, knots=curve.knots)
    return curve, problem.prove(curve)


def _repaired_segment(curve: Curve, problem: Problem, start: Sequence[Stage], free: tuple[int, int]) -> Float:
    """Return the control points `free` of the curve: those with the fewest failed spans that were found."""
    low, high = free
    spans = slice(max(low - DEGREE, 0), high)
    best, fewest = curve, np.count_nonzero(problem.prove(curve).verdicts[spans])
    for level in LEVELS:
        new, worst = repaired(curve, problem, free, level, start)
        failed = np.count_nonzero(problem.prove(new).verdicts[spans])
        if failed < fewest:
            best, fewest = new, failed
        # With a larger violation, finer samples do not help; a wider segment may.
        if worst > 0.02 or failed == 0:
            break
    return best.control_mm[low:high]
