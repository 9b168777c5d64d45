"""Why a path is no answer to a query, whoever found it."""

import math

import numpy as np

from anatomy.structures import BITS
from stages.needle.environment import NeedleEnvironment
from stages.needle.path import ArcPath, blocker_on_path
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
        "points too far from its direction at the start": path.max_angle_from_start_rad(reference)
        <= math.radians(needle.max_angle_from_start_deg) + SAME_RAD,
        "misses the target": np.linalg.norm(path.frames()[-1][:3, 3] - query.target) <= tolerance + SAME_MM,
    }
    for reason, passed in tests.items():
        if not passed:
            return reason
    label = blocker_on_path(environment, path, query.branch, query.inserted_mm)
    return "" if label == 0 else "too near: " + next(name for name, bit in BITS.items() if label & bit)
