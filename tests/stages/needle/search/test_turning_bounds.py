"""No path within the limits is shorter than the bounds that searches prune by: paths are drawn at random."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from anatomy.kernels.arcs import pose_on_arc
from stages.needle.kernels.connections import least_cosine, seen_from
from stages.needle.kernels.goal_ball import least_length, least_length_from, workspace_length
from stages.needle.kernels.proof import Limits

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


Pose = tuple[float, ...]
Bound = Callable[[Pose, Pose, Limits, Pose, float], float]


def _drawn_path(rng: np.random.Generator, limits: Limits) -> tuple[list[Pose], list[float], list[float]]:
    """Return poses along a path within the limits, from its start on, and length and turn so far.

    A third are words of the resolution search: steps of one length in one of 16 directions.
    """
    pose = _tilted(rng, min(limits.max_angle_rad, 0.5 * math.pi))
    poses, lengths, turns = [pose], [0.0], [0.0]
    winding = float(rng.choice((0.0, rng.uniform(-1.6, 1.6))))
    is_word, step_rad = rng.uniform() < 1 / 3, float(rng.uniform(0.05, 1.2))
    for _ in range(int(rng.integers(1, 15 if is_word else 8))):
        if not is_word:
            step_rad = float(rng.uniform(0.05, 1.2))
        left = limits.max_turn_rad - turns[-1]
        if step_rad > left and not is_word:
            step_rad = left  # The last piece, which uses up what there is.
        turn = step_rad * float(rng.uniform() < 0.95)
        if turn > left or step_rad < 1e-3:
            break
        direction = winding * (1.0 if is_word else rng.uniform(0.5, 1.5))
        normal = _normal(
            rng, pose, math.pi / 8.0 * round(direction / (math.pi / 8.0)) if is_word else direction
        )
        if least_cosine(pose[5], float(normal[2]), turn) < math.cos(limits.max_angle_rad):
            continue
        pose = pose_on_arc(pose, (1.0 / RADIUS_MM if turn else 0.0, *normal), RADIUS_MM * step_rad)
        poses.append(pose)
        lengths.append(lengths[-1] + RADIUS_MM * step_rad)
        turns.append(turns[-1] + turn)
    return poses, lengths, turns


def _by_a_single_arc(pose: Pose, goal: Pose, limits: Limits, reference: Pose, turn_left: float) -> float:
    """Return a bound as if a tilted tip reached no farther than by one arc within the limits."""
    leaning = math.acos(min(max(float(np.dot(pose[3:], reference)), -1.0), 1.0))
    allowed = min(limits.max_angle_rad + leaning, turn_left)
    free = limits._replace(max_angle_rad=math.pi)
    return float(least_length(*seen_from(pose, goal), free, 1.0, allowed))


def _counterexamples(seed: int, count: int, bound: Bound = least_length_from) -> list[str]:
    """Draw paths, and goals that they reach; return what a bound rules out or calls longer than it is."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        limits = _limits(*(float(rng.choice(each)) for each in (ANGLES_DEG, TURNS_DEG, (0.0, 1.0))))
        poses, lengths, turns = _drawn_path(rng, limits)
        at = int(rng.integers(len(poses))) if rng.uniform() < 0.5 else 0
        offset = rng.normal(size=3)
        offset *= rng.uniform() * limits.goal_tolerance_mm / np.linalg.norm(offset)
        goal = tuple(float(v) for v in np.array(poses[-1][:3]) + offset)
        least, length = (
            bound(poses[at], goal, limits, REFERENCE, limits.max_turn_rad - turns[at]),
            lengths[-1] - lengths[at],
        )
        if not least <= length + 1e-6:
            found.append(f"{number}: {least} > {length} for {limits}, tip {poses[at][3:]}, goal {goal}")
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


def test_the_same_search_finds_what_winding_around_the_reference_reaches() -> None:
    assert _counterexamples(0, 4000, _by_a_single_arc)


@pytest.mark.slow
def test_no_path_of_a_hundred_thousand_is_shorter_than_the_bound() -> None:
    found = _counterexamples(1, 100_000)
    assert not found, f"{len(found)}: {found[:3]}"


def _to_the_goal_itself(rho: float, h: float, limits: Limits) -> float:
    """Return the length of a path that uses the tolerance up only where the goal itself is out of reach."""
    exact = workspace_length(rho, h, limits._replace(goal_tolerance_mm=0.0, max_length_mm=math.inf))
    if exact < math.inf:
        return float(exact if exact <= limits.max_length_mm else math.inf)
    return float(workspace_length(rho, h, limits))


def _rejected(
    seed: int, count: int, workspace: Callable[[float, float, Limits], float] = workspace_length
) -> list[str]:
    """Draw needles just as long as a path into the ball about the goal; return what is rejected."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(count):
        limits = _limits(*(float(rng.choice(each)) for each in (ANGLES_DEG, TURNS_DEG, (0.1, 1.0))))
        angle = float(rng.uniform(0.0, min(limits.max_angle_rad, limits.max_turn_rad, 0.5 * math.pi)))
        straight = float(rng.choice((0.0, rng.uniform(0.0, 100.0))))
        bent = RADIUS_MM * angle
        x = RADIUS_MM * (1.0 - math.cos(angle)) + straight * math.sin(angle)
        z = RADIUS_MM * math.sin(angle) + straight * math.cos(angle)
        beyond, aside = limits.goal_tolerance_mm * rng.uniform(), rng.uniform(-math.pi, math.pi)
        rho, h = abs(x + beyond * math.sin(angle + aside)), z + beyond * math.cos(angle + aside)
        limits = limits._replace(max_length_mm=bent + straight + 1e-9)
        if not workspace(rho, h, limits) <= limits.max_length_mm:
            found.append(f"{number}: ({rho}, {h}) for {limits}")
    return found


def test_no_drawn_path_into_the_ball_is_rejected() -> None:
    assert not _rejected(0, 4000)


def test_the_same_search_finds_what_ends_within_the_tolerance() -> None:
    assert _rejected(0, 1000, _to_the_goal_itself)


@pytest.mark.slow
def test_no_path_of_a_hundred_thousand_into_the_ball_is_rejected() -> None:
    assert not _rejected(1, 100_000)
