"""The backward reachable set of a target holds every path to it, and not everything else."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.kernels.arcs import pose_on_arc
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.infeasibility.kernels.backward_reach import never_along
from stages.needle.infeasibility.passage import NOT_BOUNDED, backward_reach
from stages.needle.path import kernel_arcs
from tests.stages.needle.corridors import Corridor, drawn_corridor

CELL = 0.02


@numba.njit
def ruled_out(reach, pose, away, angle, free):  # type: ignore[no-untyped-def]
    return never_along(reach, (pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]), away, angle, free)


def drawn_pose(rng: np.random.Generator, corridor: Corridor) -> tuple[Float, float]:
    """Return a pose on a path, and by how much the needle is inserted there."""
    before = corridor.query.inserted_mm
    at = rng.uniform(0.0, corridor.path.length_mm)
    for pose, bend, length in kernel_arcs(corridor.path):
        if at <= length:
            return np.array(pose_on_arc(pose, bend, at)[:6]), before + at
        at, before = at - length, before + length
    raise AssertionError("The path is shorter than its length")


def moved(rng: np.random.Generator, pose: Float, away: float, angle: float) -> Float:
    """Return a pose at most so far from another."""
    offset, axis = rng.normal(size=(2, 3))
    offset *= away * rng.uniform() / np.linalg.norm(offset)
    axis *= angle * rng.uniform() / np.linalg.norm(axis)
    return np.concatenate([pose[:3] + offset, Rotation.from_rotvec(axis).apply(pose[3:])])


def wrongly_ruled_out(seed: int, corridors: int, poses: int) -> tuple[list[str], int]:
    """Draw poses near paths that are clear; return those from which no path is said to lead, and all others.

    The second number counts poses to the side of a path that are ruled out, most of them rightly.
    """
    rng = np.random.default_rng(seed)
    wrong, others = [], 0
    for number in range(corridors):
        corridor = drawn_corridor(rng)
        if corridor is None:
            continue
        environment, query = corridor.environment, corridor.query
        start = query.lps_from_start[:3, 3] - query.target
        reach = backward_reach(environment, query.target, start + 5.0 * rng.normal(size=3), cell=CELL)
        for _ in range(poses):
            pose, inserted = drawn_pose(rng, corridor)
            exempt = environment.limits.exempt_mm - inserted if query.branch >= 0 else 0.0
            away, angle = (rng.uniform(0.0, most) * rng.choice((0.0, 0.1, 1.0)) for most in (3.0, 0.3))
            near = moved(rng, pose, away, angle)
            margin = away + environment.goal_tolerance_mm
            if ruled_out(reach, near, margin, angle, max(exempt, 0.0)):
                wrong.append(f"corridor {number}: {pose} known to {away} mm and {angle} rad")
            others += ruled_out(reach, moved(rng, pose, 20.0, 1.5), 0.0, 0.0, 0.0)
    return wrong, others


def test_no_start_of_a_drawn_path_is_ruled_out() -> None:
    wrong, others = wrongly_ruled_out(0, 60, 60)
    assert not wrong
    assert others > 600


@pytest.mark.slow
def test_no_start_of_a_hundred_thousand_is_ruled_out() -> None:
    assert not wrongly_ruled_out(1, 2500, 60)[0]


def behind_a_wall(hole_mm: float, radius_mm: float = 121.0) -> tuple[NeedleEnvironment, Float]:
    """A wall across a box with a round hole, and a target behind it."""
    shape = (61, 61, 81)
    grid = Grid.from_spacing(shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    labels = np.zeros(shape, dtype=np.uint16)
    x, y = np.mgrid[:61, :61] - 30
    labels[:, :, 60] = np.where(np.hypot(x, y) < hole_mm, 0, VESSEL)
    needle = Needle(
        diameter_mm=0.8,
        max_curvature_per_mm=1.0 / radius_mm,
        max_length_mm=120.0,
        max_angle_from_start_deg=90.0,
        max_accumulated_turn_deg=180.0,
        exit_exemption_mm=5.0,
    )
    environment = environment_of_labels(labels, grid, needle, required_clearance_mm=1.0)
    return environment, np.array([30.0, 30.0, 70.0])


def test_a_wall_rules_out_all_starts_and_a_hole_those_aside() -> None:
    ahead, aside = (np.array([x, 30.0, 10.0, *(0.0, 0.0, 1.0)]) for x in (30.0, 3.0))
    towards = np.array([27.0, 0.0, 60.0])
    aside[3:] = towards / np.linalg.norm(towards)
    for hole, expected in ((0.0, (True, True)), (2.5, (False, True)), (25.0, (False, False))):
        environment, target = behind_a_wall(hole)
        reach = backward_reach(environment, target, np.array([0.0, 0.0, -1.0]))
        found = tuple(bool(ruled_out(reach, pose, 0.1, 0.01, 5.0)) for pose in (ahead, aside))
        assert found == expected


def test_a_needle_longer_than_half_a_circle_may_come_from_everywhere() -> None:
    environment, target = behind_a_wall(0.0, radius_mm=30.0)
    assert backward_reach(environment, target, np.array([0.0, 0.0, -1.0])) is NOT_BOUNDED


def test_what_is_farther_than_a_circle_is_wide_is_not_ruled_out() -> None:
    environment, target = behind_a_wall(0.0, radius_mm=40.0)
    reach = backward_reach(environment, target, np.array([0.0, 0.0, -1.0]))
    pose = np.array([30.0, 30.0, 70.0, 0.0, 0.0, 1.0])
    for far, expected in ((30.0, True), (79.0, True), (81.0, False)):
        pose[2] = 70.0 - far
        assert bool(ruled_out(reach, pose, 0.1, 0.01, 5.0)) == expected
