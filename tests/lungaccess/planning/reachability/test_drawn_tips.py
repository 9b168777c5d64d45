"""What a drawn needle path reaches from a tip is never outside the workspace of a box that holds the tip."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest

from anatomy.base.typed import Float
from anatomy.kernels.arcs import pose_on_arc
from lungaccess.planning.reachability.kernels import unreachable as kernel
from stages.needle.infeasibility.kernels import escape_depth
from stages.needle.kernels.connections import least_cosine
from stages.needle.kernels.proof import Limits

RADIUS_MM = 30.0
AHEAD = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
Rule = Callable[[Limits, Any, Float, float], bool]


@numba.njit
def outside_workspace(limits, seen, sums, away):  # type: ignore[no-untyped-def]
    _tip, aside, ahead, size, moved, second = seen
    return kernel._outside_workspace(limits, aside, ahead, size, moved, second, sums, away)


def without_the_turn(limits: Limits, seen: Any, sums: Float, away: float) -> bool:
    """Tell the same as if no needle came to the points in the circles by turning on and on."""
    _pose, rho, ahead, size, moved, second = seen
    forward_only = limits.max_angle_rad <= 0.5 * math.pi
    depth = min(escape_depth(rho, ahead, RADIUS_MM), ahead if forward_only else math.inf)
    spare = limits.goal_tolerance_mm + 1e-6
    return bool(
        depth + moved + spare < 0.0 or math.hypot(size + sums[0], sums[1]) + second + spare < RADIUS_MM
    )


def drawn_path(rng: np.random.Generator, max_angle: float, max_turn: float) -> tuple[Float, float]:
    """Return the end of a path from AHEAD and its length; half of the paths keep to few planes."""
    pose: tuple[float, ...] = AHEAD
    length = turned = 0.0
    aside = rng.normal(size=3)
    for _ in range(int(rng.integers(1, 9))):
        if rng.uniform() < 0.5:
            aside = rng.normal(size=3)
        tangent = np.array(pose[3:])
        normal = aside - (aside @ tangent) * tangent
        normal /= np.linalg.norm(normal)
        turn = min(float(rng.uniform(0.05, 2.5)), max_turn - turned)
        if turn <= 0.0 or least_cosine(pose[5], float(normal[2]), turn) < math.cos(max_angle):
            continue
        share = float(rng.choice((1.0, 1.0, rng.uniform(0.1, 1.0))))
        pose = pose_on_arc(pose, (share / RADIUS_MM, *normal), RADIUS_MM * turn / share)
        length, turned = length + RADIUS_MM * turn / share, turned + turn
    return np.array(pose[:3]), length


def ruled_out(seed: int, count: int, rule: Rule = outside_workspace) -> list[str]:
    """Draw targets that a path reaches from a tip near the middle of a box; return those ruled out."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        angle_deg, turn_deg = float(rng.choice((60, 90, 120, 180))), float(rng.choice((90, 180, 360, 540)))
        max_angle, max_turn = math.radians(angle_deg), math.radians(turn_deg)
        target, length = drawn_path(rng, max_angle, max_turn)
        tolerance = float(rng.choice((0.0, 0.5)))
        values = dict.fromkeys(Limits._fields, 0.0) | {
            "kappa": 1.0 / RADIUS_MM,
            "max_length_mm": length + 1e-9,
            "max_angle_rad": max_angle,
            "max_turn_rad": max_turn,
            "goal_tolerance_mm": tolerance,
        }
        offset, moved = rng.normal(size=(2, 3))
        offset *= tolerance * rng.uniform() / np.linalg.norm(offset)
        moved *= float(rng.choice((0.0, rng.uniform(0.0, 3.0)))) / np.linalg.norm(moved)
        # Seen from the middle of the box, the target is where the motion to the tip takes it from.
        at = target + offset + moved
        rho = math.hypot(at[0], at[1])
        away = float(np.linalg.norm(moved))
        seen = (AHEAD, rho, float(at[2]), math.hypot(rho - RADIUS_MM, at[2]), away, away)
        if rule(Limits(**values), seen, np.zeros(3), away):
            found.append(f"{number}: {at} with {angle_deg} and {turn_deg} degrees, {length:.1f} mm")
    return found


def test_no_target_that_a_drawn_path_reaches_is_ruled_out() -> None:
    assert not ruled_out(0, 2000)


def test_the_same_search_finds_what_turning_on_and_on_reaches() -> None:
    assert ruled_out(0, 1000, without_the_turn)


@pytest.mark.slow
def test_no_target_of_a_hundred_thousand_is_ruled_out() -> None:
    assert not ruled_out(1, 100_000)
