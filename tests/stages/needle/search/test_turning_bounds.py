"""No path within the limits is shorter than the bounds that searches prune by: paths are drawn at random."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.kernels.arcs import pose_on_arc
from stages.needle.kernels.connections import least_cosine
from stages.needle.kernels.goal_ball import least_length_from, workspace_length
from stages.needle.kernels.limits import Limits

RADIUS_MM = 30.0
REFERENCE = (0.0, 0.0, 1.0)
ANGLES_DEG = (30.0, 60.0, 90.0, 120.0, 180.0)
TURNS_DEG = (60.0, 90.0, 179.0, 180.0, 540.0)


def _limits(max_angle_deg: float, max_turn_deg: float, tolerance_mm: float) -> Limits:
    values = dict.fromkeys(Limits._fields, 0.0) | {
        "kappa": 1.0 / RADIUS_MM,
        "goal_tolerance_mm": tolerance_mm,
        "max_angle_rad": math.radians(max_angle_deg),
        "max_turn_rad": math.radians(max_turn_deg),
        "max_length_mm": math.inf,
    }
    return Limits(**values)


def _tilted(rng: np.random.Generator, most_rad: float) -> tuple[float, ...]:
    """Return a pose at the origin whose tangent leans from +z by at most an angle, a third not at all."""
    tilt = most_rad * float(rng.choice((0.0, 0.999, math.sqrt(rng.uniform()))))
    around = rng.uniform(0.0, 2.0 * math.pi)
    return 0.0, 0.0, 0.0, math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)


def _inward(pose: tuple[float, ...], winding: float) -> np.ndarray:
    """Return the direction from the tangent towards +z, turned about the tangent."""
    tangent = np.array(pose[3:])
    inward = np.array((0.0, 0.0, 1.0)) - pose[5] * tangent
    inward /= np.linalg.norm(inward)
    return math.cos(winding) * inward + math.sin(winding) * np.cross(inward, tangent)


def _normal(rng: np.random.Generator, pose: tuple[float, ...], winding: float) -> np.ndarray:
    """Return a direction to bend to: around +z and more or less towards it, or at random."""
    if winding != 0.0 and pose[5] < 1.0 - 1e-9 and rng.uniform() < 0.8:
        return _inward(pose, winding)
    tangent, aside = np.array(pose[3:]), rng.normal(size=3)
    aside -= (aside @ tangent) * tangent
    return aside / np.linalg.norm(aside)


def _drawn_path(
    rng: np.random.Generator, limits: Limits
) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Return the start and the end of a path within the limits, and its length."""
    start = pose = _tilted(rng, min(limits.max_angle_rad, 0.5 * math.pi))
    length, turned, winding = 0.0, 0.0, float(rng.choice((0.0, rng.uniform(-1.6, 1.6))))
    for _ in range(int(rng.integers(1, 8))):
        normal = _normal(rng, pose, winding * rng.uniform(0.5, 1.5))
        step_rad = float(rng.uniform(0.05, 1.2))
        turn = step_rad * float(rng.uniform() < 0.95)
        if turned + turn > limits.max_turn_rad:
            break
        if least_cosine(pose[5], float(normal[2]), turn) < math.cos(limits.max_angle_rad):
            continue
        bend = (1.0 / RADIUS_MM if turn else 0.0, *normal)
        pose = pose_on_arc(pose, bend, RADIUS_MM * step_rad)
        length, turned = length + RADIUS_MM * step_rad, turned + turn
    return start, pose, length


def _counterexamples(seed: int, count: int) -> list[str]:
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        limits = _limits(*(float(rng.choice(each)) for each in (ANGLES_DEG, TURNS_DEG, (0.0, 1.0))))
        start, end, length = _drawn_path(rng, limits)
        offset = rng.normal(size=3)
        goal = np.array(end[:3]) + offset / np.linalg.norm(offset) * rng.uniform() * limits.goal_tolerance_mm
        bound = least_length_from(start, tuple(goal), limits, REFERENCE, limits.max_turn_rad)
        if not bound <= length + 1e-6:
            found.append(f"{number}: {bound} > {length} for {limits}, tip {start[3:]}, goal {goal}")
    return found


WINDING = (
    (60.0, 59.8, ((36.0, 39.6), (62.0, 66.9), (101.0, 16.4), (80.0, 32.5), (-70.0, 8.4))),
    (75.0, 65.3, ((48.0, 81.1), (99.0, 57.2), (86.0, 28.9), (65.0, 12.2))),
    (90.0, 51.37, ((-69.0, 23.0), (-77.0, 103.0), (-90.0, 53.7))),
)
"""Limit of the angle, tilt of the tip, and arcs: direction from the inward one, and turn; degrees."""


@pytest.mark.parametrize(("max_angle_deg", "tilt_deg", "word"), WINDING)
def test_a_path_that_winds_around_the_reference_reaches_farther_than_one_arc(
    max_angle_deg: float, tilt_deg: float, word: tuple[tuple[float, float], ...]
) -> None:
    limits, tilt = _limits(max_angle_deg, 180.0, 0.0), math.radians(tilt_deg)
    start = pose = (0.0, 0.0, 0.0, math.sin(tilt), 0.0, math.cos(tilt))
    length = 0.0
    for winding_deg, turn_deg in word:
        normal, turn = _inward(pose, math.radians(winding_deg)), math.radians(turn_deg)
        least = least_cosine(pose[5], float(normal[2]), turn)
        assert least >= math.cos(limits.max_angle_rad) - 3e-3, "the path keeps the limit of the angle"
        pose = pose_on_arc(pose, (1.0 / RADIUS_MM, *normal), RADIUS_MM * turn)
        length += RADIUS_MM * turn
    assert length <= RADIUS_MM * limits.max_turn_rad
    assert least_length_from(start, pose[:3], limits, REFERENCE, limits.max_turn_rad) <= length + 1e-6


def test_no_drawn_path_is_shorter_than_the_bound() -> None:
    found = _counterexamples(0, 4000)
    assert not found, f"{len(found)}: {found[:3]}"


@pytest.mark.slow
def test_no_path_of_a_hundred_thousand_is_shorter_than_the_bound() -> None:
    found = _counterexamples(1, 100_000)
    assert not found, f"{len(found)}: {found[:3]}"


def test_a_straight_path_that_ends_within_the_tolerance_is_in_the_workspace() -> None:
    limits = _limits(90.0, 180.0, 1.0)._replace(max_length_mm=100.0)
    assert workspace_length(0.0, 100.5, limits) < math.inf
    assert workspace_length(0.0, 101.5, limits) == math.inf
