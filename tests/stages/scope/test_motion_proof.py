"""The proof of scope motions: random airways and random changes in place, sampled densely by other code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.lung import Lung
from anatomy.poses import pose
from anatomy.structures import LUMEN, VESSEL
from stages.scope import MotionProver, ScopeMotion, find_motions
from tests.stages.scenes import Canvas, brute_clearance, forked_tree
from tests.stages.scope.airways import forked_lung
from tests.stages.scope.sampled_motion import SCOPE, axis_places

NEEDED_MM = SCOPE.radius_mm + SCOPE.lumen_margin_mm


def depth_mm(lung: Lung, points: np.ndarray) -> float:
    """Distance of the nearest of some points to the voxels that are not lumen."""
    outside = np.where(lung.labels & LUMEN, 0, VESSEL).astype(np.uint16)
    return float(brute_clearance(outside, lung.grid, points, VESSEL, 9.0).min())


def crooked_lung(turns: list[tuple[float, float]], radius_mm: float) -> Lung:
    """A tube of pieces of 18 mm, each turned from the one before by two angles."""
    ends, way = [np.zeros(3), np.array([0.0, 0.0, -30.0])], np.array([0.0, 0.0, -1.0])
    for polar, azimuth in turns:
        frame = pose(ends[-1], way)
        aside = np.cos(azimuth) * frame[:3, 0] + np.sin(azimuth) * frame[:3, 1]
        way = np.cos(polar) * way + np.sin(polar) * aside
        ends.append(ends[-1] + 18.0 * way)
    lines = [(a, b, radius_mm, n - 1) for n, (a, b) in enumerate(zip(ends[:-1], ends[1:], strict=True))]
    spare = radius_mm + 2.5
    low, high = np.min(ends, axis=0) - spare, np.max(ends, axis=0) + spare
    canvas = Canvas.empty(low, high, [0.7, 0.7, 0.8])
    for branch, (a, b, _, _) in enumerate(lines):
        canvas.airway(canvas.capsule(a, b, radius_mm), canvas.capsule(a, b, radius_mm + 1.0), branch)
    return canvas.lung(forked_tree(lines))


@settings(max_examples=6, deadline=None)
@given(
    turns=st.lists(st.tuples(st.floats(0.0, 0.7), st.floats(-3.0, 3.0)), min_size=1, max_size=2),
    radius=st.floats(3.0, 4.5),
)
def test_motions_through_crooked_tubes_stay_inside(turns: list[tuple[float, float]], radius: float) -> None:
    lung = crooked_lung(turns, radius)
    motions = find_motions(lung, SCOPE, reach_mm=100.0)
    assert motions.count
    prover = MotionProver(lung, SCOPE)
    for tip in np.linspace(0, motions.count - 1, 3).astype(int):
        motion = motions.motion(int(tip))
        margin = prover.prove(motion)
        depth = depth_mm(lung, axis_places(motion, times=9))
        assert isinstance(margin, float)
        assert NEEDED_MM + margin <= depth + 1e-3
        assert NEEDED_MM + motions.room_mm[tip] <= depth + 1e-3


@pytest.fixture(scope="module")
def lung() -> Lung:
    return forked_lung()


def test_proved_changes_in_place_touch_nothing(lung: Lung) -> None:
    """Random ones from places in the trachea and main bronchi: some have a proof, and some touch the wall."""
    rng, prover = np.random.default_rng(3), MotionProver(lung, SCOPE)
    low, high = SCOPE.bends_rad
    proved = refused = 0
    for _ in range(80):
        point = int(rng.integers(lung.tree.n_points // 2))
        forward = lung.tree.tangents[point] + 0.15 * rng.normal(size=3)
        entry = pose(lung.tree.points_lps[point] + rng.normal(size=3), forward)
        states = np.zeros((2, 3))
        states[:, 1] = rng.uniform(-3.0, 3.0, 2)
        states[:, 2] = rng.uniform(low, high, 2) * rng.uniform(0.0, 0.6)
        motion = ScopeMotion(lps_from_entry=entry, states=states, bending_length_mm=SCOPE.bending_length_mm)
        margin = prover.prove(motion)
        if isinstance(margin, str):
            refused += 1
            continue
        proved += 1
        assert NEEDED_MM + margin <= depth_mm(lung, axis_places(motion, times=25)) + 1e-3
    assert proved > 8 and refused > 8


def test_room_for_a_thicker_scope_ends_where_the_margin_says(lung: Lung) -> None:
    """With the margin added to its gap the motion is still free; with the true depth nothing is left."""
    motion = find_motions(lung, SCOPE, reach_mm=60.0).motion(40)
    margin = MotionProver(lung, SCOPE).prove(motion)
    assert isinstance(margin, float)
    depth = depth_mm(lung, axis_places(motion, times=30))
    fits = replace(SCOPE, lumen_margin_mm=SCOPE.lumen_margin_mm + 0.98 * margin)
    assert isinstance(MotionProver(lung, fits).prove(motion), float)
    thick = replace(SCOPE, lumen_margin_mm=depth - SCOPE.radius_mm + 0.01)
    assert isinstance(MotionProver(lung, thick).prove(motion), str)
