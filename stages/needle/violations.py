"""Why a path is no answer to a query, whoever found it."""

from __future__ import annotations

import math

import numpy as np

from anatomy.structures import BITS
from anatomy.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels.connections import least_cosine
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.path import ArcPath, bend_direction
from stages.needle.query import Query

SAME_MM = 1e-6
SAME_RAD = 1e-6
"""Rounding that is forgiven."""


def violation(
    environment: NeedleEnvironment, query: Query, path: ArcPath, *, goal_tolerance_mm: float = 0.0
) -> str:
    """Tell why a path is no answer to a query; "" if it is one.

    All limits of the needle are tested, and every arc is proved clear.

    Parameters
    ----------
    environment : NeedleEnvironment
    query : Query
    path : ArcPath
    goal_tolerance_mm : float
        How far from the target the path may end, where the environment's own tolerance is smaller.
    """
    needle = environment.needle
    reference = query.lps_from_start[:3, 2] if query.reference is None else query.reference
    lengths, curvatures = path.arcs[:, 0], path.arcs[:, 2]
    tolerance = max(goal_tolerance_mm, environment.goal_tolerance_mm)
    turned = query.turned_rad + path.accumulated_turn_rad
    # Not a number fails every one of these comparisons.
    tests = {
        "starts elsewhere": np.abs(path.lps_from_start - query.lps_from_start).max() <= SAME_MM,
        "goes backwards": bool((lengths >= 0.0).all()),
        "longer than the needle": query.inserted_mm + path.length_mm <= needle.max_length_mm + SAME_MM,
        "bends too tightly": bool(
            ((curvatures >= 0.0) & (curvatures <= needle.max_curvature_per_mm * (1.0 + SAME_MM))).all()
        ),
        "turns too far in all": turned <= math.radians(needle.max_accumulated_turn_deg) + SAME_RAD,
        "points too far from its direction at the start": largest_angle_rad(path, reference)
        <= math.radians(needle.max_angle_from_start_deg) + SAME_RAD,
        "misses the target": np.linalg.norm(path.frames()[-1][:3, 3] - query.target) <= tolerance + SAME_MM,
    }
    for reason, passed in tests.items():
        if not passed:
            return reason
    label = _blocker(environment, query, path)
    return "" if label == 0 else "too near: " + next(name for name, bit in BITS.items() if label & bit)


def largest_angle_rad(path: ArcPath, reference: Float) -> float:
    """Return the largest angle between the tip and a direction (3,) on all of a path."""
    least = 1.0
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs, strict=False):
        forward, aside = float(reference @ frame[:3, 2]), float(reference @ bend_direction(frame, roll))
        least = min(least, least_cosine(forward, aside, length * curvature))
    return math.acos(least)


def _blocker(environment: NeedleEnvironment, query: Query, path: ArcPath) -> int:
    """Prove every arc clear as `blocker_on_path` does, behind what is inserted already."""
    begin = query.inserted_mm
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs.tolist(), strict=False):
        pose = (*frame[:3, 3].tolist(), *frame[:3, 2].tolist())
        bend = (curvature, *bend_direction(frame, roll).tolist())
        label = blocker_on_arc(
            environment.obstacles, environment.limits, pose, bend, length, begin, query.branch
        )
        if label:
            return int(label)
        begin += length
    return 0
