"""Masks by voxels against numpy and scipy, which work on the whole array."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from anatomy.morphology import components, voxels_in, voxels_of, window


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.08, 0.2, 1.0])
def test_parts_of_a_mask_are_those_of_scipy(order: str, share: float) -> None:
    random = np.random.default_rng(5)
    mask = np.asarray(random.random((14, 11, 17)) < share, order=order)
    voxels, part = components(mask)
    numbers, _count = ndimage.label(mask, np.ones((3, 3, 3)))
    assert np.array_equal(voxels, np.argwhere(mask)) and np.array_equal(voxels_of(mask), voxels)
    assert np.array_equal(part + 1, numbers[tuple(voxels.T)])


def test_a_winding_part_is_one() -> None:
    """A spiral: its ends are near each other, and far along it."""
    turns = np.linspace(0.0, 8.0 * np.pi, 4000)
    path = np.stack([20 + 16 * np.cos(turns), 20 + 16 * np.sin(turns), 2 + turns], axis=1).astype(int)
    mask = np.zeros((40, 40, 30), dtype=np.bool_)
    mask[tuple(path.T)] = True
    assert set(components(mask)[1]) == {0}


def test_voxels_of_a_window_have_their_indices_in_the_whole_image() -> None:
    mask = np.random.default_rng(3).random((6, 7, 8)) > 0.7
    part = window(np.array([1, 2, 3]), np.array([5, 6, 8]))
    inside = np.zeros_like(mask)
    inside[part] = mask[part]
    assert voxels_in(part, mask[part]).tolist() == np.argwhere(inside).tolist()
