"""The bounds of boxes of deployments hold."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float
from lungaccess.planning.coupled.kernels.box_of_tubes import sample_of, seen_target, tip_of
from lungaccess.planning.reachability.kernels import deployment_boxes as boxes
from stages.tube.kernels import (
    CURVED_LENGTH,
    INSERTION_STEP_MM,
    MAX_SWEEP,
    greatest_insertions,
    lateral_sweep,
    planar_point,
    sweep_slope,
)
from tests.lungaccess.planning.reachability.deployment_cases import KAPPA, draw, random_case


@numba.njit
def seen_from_middle(tubes, kappa, target, frame, box, sums, costs):  # type: ignore[no-untyped-def]
    place = target[0], target[1], target[2]
    family = boxes.box_tubes(tubes, frame, box)
    tip, tangent, _away, _swing = tip_of(tubes, family, box)
    seen = seen_target(tubes, kappa, place, family, tip, tangent, box)
    boxes.sum_changes(seen, family, tangent, place, frame, box, sums, costs)
    return tip, seen.aside, seen.ahead, seen.size, seen.moved, seen.second


@numba.njit
def sampled(tubes, frame, box, s):  # type: ignore[no-untyped-def]
    return sample_of(tubes, boxes.box_tubes(tubes, frame, box), s)


def tip_frame(tubes: Float, frame: Float, place: Float, values: Float) -> Float:
    """Return the pose (4, 4) of the tubes' tip: x towards the bend, z ahead."""
    east, north, rotation, outer, inner = values
    base = Rotation.from_rotvec(east * frame[0] + north * frame[1]).as_matrix()
    base = base @ frame.T @ Rotation.from_euler("z", rotation).as_matrix()
    x, z = planar_point(tubes, outer, inner, inner)
    step = 1e-5
    x0, z0 = planar_point(tubes, outer, inner, inner - step)
    heading = math.atan2(x - x0, z - z0)
    pose = np.eye(4)
    pose[:3, :3] = base @ Rotation.from_euler("y", heading).as_matrix()
    pose[:3, 3] = place + base @ [x, 0.0, z]
    return pose


def seeds(first: int, of_all: int) -> list[Any]:
    """Return the seeds of a quick run, and those that make it a hundred thousand cases, marked slow."""
    return [*range(first), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(first, of_all))]


@pytest.mark.parametrize("seed", seeds(1, 12))
def test_no_deployment_of_a_box_sees_the_target_farther_off_than_its_bounds(tubes: Float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tight = 0
    for _ in range(300):
        frame, box, target = random_case(rng)
        if box[3] - box[11] > box[4] + box[12] - 0.02:
            continue
        sums, costs = np.zeros(3), np.zeros(boxes.SIDES)
        tip, rho, ahead, size, moved, second = seen_from_middle(tubes, KAPPA, target, frame, box, sums, costs)
        middle = tip_frame(tubes, frame, box[5:8] @ frame, box[:5]) if box[3] <= box[4] else None
        for _ in range(40):
            place, values = draw(rng, frame, box)
            there = tip_frame(tubes, frame, place, values)
            seen = there[:3, :3].T @ (target - there[:3, 3])
            if middle is None:
                continue
            first = middle[:3, :3].T @ (target - middle[:3, 3])
            assert abs(math.hypot(first[0], first[1]) - rho) < 1e-3
            assert abs(first[2] - ahead) < 1e-3
            assert (np.abs(tip - middle[:3, 3]) < 1e-6).all()
            displaced = float(np.linalg.norm(seen - first))
            assert displaced <= moved + 2e-3
            towards = first[:2] / max(np.hypot(*first[:2]), 1e-9)
            ring = np.array([*(towards / KAPPA), 0.0])
            assert abs(np.linalg.norm(first - ring) - size) < 1e-2
            assert np.linalg.norm(seen - ring) <= math.hypot(size + sums[0], sums[1]) + second + 2e-3
            assert seen[2] <= ahead + sums[2] + second + 2e-3
            tight += displaced > 0.5 * moved
    assert tight > 20


@pytest.mark.parametrize("seed", seeds(2, 30))
def test_no_tube_of_a_box_is_farther_from_its_samples_than_they_say(tubes: Float, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    for _ in range(200):
        frame, box, _target = random_case(rng)
        if box[3] - box[11] > box[4] + box[12] - 0.02:
            continue
        for _ in range(20):
            place, values = draw(rng, frame, box)
            s = rng.uniform(0.0, values[4])
            point, away = sampled(tubes, frame, box, s)
            x, z = planar_point(tubes, values[3], values[4], s)
            turned = Rotation.from_rotvec(values[0] * frame[0] + values[1] * frame[1]).as_matrix()
            turned = turned @ frame.T @ Rotation.from_euler("z", values[2]).as_matrix()
            assert np.linalg.norm(place + turned @ [x, 0.0, z] - point) <= away + 1e-6


def test_insertions_that_sweep_little_are_in_the_table(tubes: Float) -> None:
    table = np.zeros(int(60.0 / INSERTION_STEP_MM) + 1)
    greatest_insertions(tubes, 60.0, 0.02, table)
    assert table.max() < 60.0
    rng = np.random.default_rng(3)
    near = 0
    for outer, inner in rng.uniform(0.0, 60.0, (20_000, 2)):
        if outer <= inner and lateral_sweep(tubes, outer, inner) <= tubes[MAX_SWEEP]:
            limit = table[int(outer / INSERTION_STEP_MM)]
            assert inner <= limit
            near += inner > max(limit - 0.5, tubes[CURVED_LENGTH])
    assert near > 20


def test_the_sweep_changes_no_faster_than_stated(tubes: Float) -> None:
    rng = np.random.default_rng(4)
    bend = float(np.abs(tubes[:2]).max() * tubes[CURVED_LENGTH])
    slope = 2.0 + 3.0 * bend
    assert sweep_slope.py_func(bend) == slope
    for outer, inner in rng.uniform(0.0, 60.0, (3000, 2)):
        step = rng.normal(0.0, 0.05, 2)
        other = np.maximum([outer, inner] + step, 0.0)
        if outer <= inner and other[0] <= other[1]:
            change = lateral_sweep(tubes, *other) - lateral_sweep(tubes, outer, inner)
            assert abs(change) <= slope * np.abs(step).sum() + 1e-9
