"""Motions of a bronchoscope in hand-made airways, re-proved by code of its own."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.structures import LUMEN, VESSEL
from stages.scope import MotionProver, ScopeMotions, evenly, find_motions, prove_motion
from stages.scope.motion_proof import in_tip_region
from tests.stages.scenes import brute_clearance
from tests.stages.scope.airways import forked_lung
from tests.stages.scope.sampled_motion import SCOPE, axis_places


@pytest.fixture(scope="module")
def lung() -> Lung:
    return forked_lung()


@pytest.fixture(scope="module")
def motions(lung: Lung) -> ScopeMotions:
    return find_motions(lung, SCOPE, reach_mm=60.0)


def test_bodies_stay_in_the_lumen_in_and_between_states(lung: Lung, motions: ScopeMotions) -> None:
    """Places all over the motion, measured to every voxel around the lumen."""
    outside = np.where(lung.labels & LUMEN, 0, VESSEL).astype(np.uint16)
    for tip in range(0, motions.count, max(motions.count // 8, 1)):
        motion = motions.motion(tip)
        points = axis_places(motion)
        depth = brute_clearance(outside, lung.grid, points, VESSEL, 9.0).min()
        assert depth >= SCOPE.radius_mm + SCOPE.lumen_margin_mm
        assert np.allclose(points[-1], motions.tips[tip, :3], atol=2e-3)
        margin = prove_motion(lung, SCOPE, motion)
        assert isinstance(margin, float)
        assert margin <= depth - SCOPE.radius_mm - SCOPE.lumen_margin_mm + 1e-3


def test_tips_are_where_their_motions_end(lung: Lung, motions: ScopeMotions) -> None:
    nearest, inside = in_tip_region(lung.tree, motions.tips)
    assert inside.all() and np.array_equal(nearest, motions.tree_point)
    for tip in range(0, motions.count, 37):
        motion = motions.motion(tip)
        frame = motion.lps_from_tip
        expected = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])
        assert np.allclose(motions.tips[tip], expected, atol=1e-9)
        assert motion.max_curvature_per_mm == pytest.approx(motions.max_curvature_per_mm[tip])


def test_tips_are_all_over_the_airway(lung: Lung, motions: ScopeMotions) -> None:
    """In each branch, to within 4 mm of its closed end, about every mm, and looking many ways."""
    tree = lung.tree
    for branch in range(1, tree.n_branches):
        points = tree.branch_points(branch)
        mine = np.isin(motions.tree_point, points)
        if motions.passages.passable[points[-1]]:
            last = tree.distance_from_root_mm[motions.tree_point[mine]].max()
            assert last > tree.distance_from_root_mm[points[-1]] - 4.0
    cosine = np.einsum("sk,sk->s", motions.tips[:, 3:6], tree.tangents[motions.tree_point])
    assert (np.degrees(np.arccos(np.clip(cosine, -1, 1))) > 30.0).sum() > 50
    assert (~motions.turned).sum() > 50


def test_the_same_twice(lung: Lung, motions: ScopeMotions) -> None:
    again = find_motions(lung, SCOPE, reach_mm=60.0)
    assert np.array_equal(again.tips, motions.tips)
    assert np.array_equal(again.motion(7).states, motions.motion(7).states)


def test_bodies_keep_the_curvature_that_tubes_stand(lung: Lung) -> None:
    found = find_motions(lung, SCOPE, reach_mm=60.0, max_curvature_per_mm=0.04)
    assert found.count
    worst = max(found.motion(tip).max_curvature_per_mm for tip in range(0, found.count, 5))
    assert worst <= 0.04 + 1e-12


def test_tips_bend_as_far_as_tubes_in_them_let(lung: Lung) -> None:
    found = find_motions(lung, SCOPE, reach_mm=60.0, tip_bends_rad=(-0.1, 0.4))
    bends = np.array([found.motion(tip).states[-1, 2] for tip in range(found.count)])
    assert found.count and bends.min() >= -0.1 and bends.max() <= 0.4
    assert bends.min() < -0.05 and bends.max() > 0.35


def test_bends_stay_within_the_device(motions: ScopeMotions) -> None:
    low, high = SCOPE.bends_rad
    for tip in range(0, motions.count, 11):
        motion = motions.motion(tip)
        assert motion.states[:, 2].min() >= low - 1e-12 and motion.states[:, 2].max() <= high + 1e-12


def test_a_thick_scope_gets_nowhere(lung: Lung) -> None:
    from dataclasses import replace

    found = find_motions(lung, replace(SCOPE, outer_diameter_mm=15.0), reach_mm=60.0)
    assert found.count == 0 and found.tips.shape == (0, 9)


def test_a_row_of_tips_along_a_motion(lung: Lung, motions: ScopeMotions) -> None:
    """Every tip that the row calls proved has a motion that the proof of single motions accepts."""
    prover, seen = MotionProver(lung, SCOPE), 0
    for tip in range(0, motions.count, max(motions.count // 12, 1)):
        motion = motions.motion(tip)
        row = prover.row(motion, evenly(0.5, 3.0))
        home = row.shifts_mm.tolist().index(0.0)
        assert np.allclose(row.tips[home], motions.tips[tip]) and row.proved[home]
        for k in np.flatnonzero(row.proved):
            moved = row.motion_to(int(k))
            frame = moved.lps_from_tip
            assert np.allclose(row.tips[k], np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]]))
            assert isinstance(prover.prove(moved), float)
            seen += 1
    assert seen > 60


def test_the_tip_nearest_to_a_measured_pose(motions: ScopeMotions) -> None:
    pose = motions.tips[motions.count // 2]
    assert motions.nearest(pose[:3] + [0.01, 0.0, 0.0], pose[3:6]) == motions.count // 2


@pytest.mark.parametrize("fault", ["bend", "twist", "advance", "both", "back", "shaft", "length", "wall"])
def test_tampered_motions_have_no_proof(lung: Lung, motions: ScopeMotions, fault: str) -> None:
    from dataclasses import replace

    motion = motions.motion(int(np.argmax(motions.tree_point)))
    states = motion.states.copy()
    if fault == "bend":
        states[-1, 2] = 2.0
    elif fault == "twist":
        states = np.vstack([states, states[-1]])
        states[-1, 1] = 3.3
    elif fault == "advance":
        states = np.vstack([states, states[-1] + [30.0, 0.0, 0.0]])
        states[-2, 2] = states[-1, 2] = 0.0
    elif fault == "both":
        states = np.vstack([states, states[-1] + [0.5, 0.1, 0.0]])
    elif fault == "back":
        states = np.vstack([states, states[-1] - [0.5, 0.0, 0.0]])
    elif fault == "shaft":
        states = np.vstack([states, states[-1], states[-1]])
        states[-2:, 2] = 1.8
        states[-1, 0] += 1.0
    elif fault == "wall":
        states = states * [1.0, 1.0, 0.0]
    length = motion.bending_length_mm + (1.0 if fault == "length" else 0.0)
    tampered = replace(motion, states=states, bending_length_mm=length)
    assert isinstance(prove_motion(lung, SCOPE, tampered), str)
