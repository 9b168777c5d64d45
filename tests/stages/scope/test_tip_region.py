"""The region of scope tips: near the medial axis, and looking on along it."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.lung import Lung
from stages.scope import MAX_OFF_AXIS_MM, MAX_TURN_AT_TIP_RAD, in_tip_region


def test_a_tip_beside_the_axis_is_in_the_region_until_it_is_too_far_or_looks_aside(small_lung: Lung) -> None:
    tree = small_lung.tree
    points = np.flatnonzero(tree.parent_point >= 0)[::7]
    along = np.hstack([tree.points_lps[points], tree.tangents[points]])
    nearest, inside = in_tip_region(tree, along)
    assert (nearest == points).all()
    assert inside.all()
    rng = np.random.default_rng(0)
    across = np.cross(tree.tangents[points], rng.normal(size=(len(points), 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    for angle, kept in ((0.99 * MAX_TURN_AT_TIP_RAD, True), (1.01 * MAX_TURN_AT_TIP_RAD, False)):
        turned = along.copy()
        turned[:, 3:] = Rotation.from_rotvec(angle * across).apply(tree.tangents[points])
        assert (in_tip_region(tree, turned)[1] == kept).all()
    far = along.copy()
    far[:, :3] += 200.0
    assert not in_tip_region(tree, far)[1].any()
    beside = along.copy()
    beside[:, :3] += 0.5 * MAX_OFF_AXIS_MM * across
    nearest, inside = in_tip_region(tree, beside)
    gap = np.linalg.norm(tree.points_lps[nearest] - beside[:, :3], axis=1)
    assert (gap <= MAX_OFF_AXIS_MM).all()
    cosine = (tree.tangents[nearest] * beside[:, 3:]).sum(axis=1)
    assert (inside == (cosine >= math.cos(MAX_TURN_AT_TIP_RAD))).all()
