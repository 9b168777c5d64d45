"""Noise as an airway mask is refused at once, and a tree with faults is not noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from anatomy.base.errors import AnatomyError
from anatomy.grid import Volume
from anatomy.phantom import Phantom
from anatomy.tree import tree_from_mask
from anatomy.tree.lumen import tunnels


def test_tunnels_are_counted() -> None:
    block = np.ones((7, 5, 3), dtype=bool)
    assert tunnels(np.argwhere(block)) == 0
    block[1:3, 1:4, :] = block[4:6, 1:4, :] = False
    assert tunnels(np.argwhere(block)) == 2
    diagonal_ring = np.array([[0, 1, 0], [1, 0, 0], [2, 1, 0], [1, 2, 0]])
    assert tunnels(diagonal_ring) == 1, "voxels that share an edge are connected"


@pytest.mark.slow
@pytest.mark.parametrize(("share", "what"), [(0.3, "tunnels"), (0.08, "separate pieces")])
def test_noise_over_a_lumen_is_refused(small_phantom: Phantom, share: float, what: str) -> None:
    lumen = small_phantom.images.lumen
    noisy = lumen.array ^ (np.random.default_rng(1).random(lumen.array.shape) < share)
    with pytest.raises(AnatomyError, match=rf"no tree of airways: it has \d+ {what}"):
        tree_from_mask(Volume(grid=lumen.grid, array=np.asfortranarray(noisy)))


@pytest.mark.slow
def test_blobs_are_refused(small_phantom: Phantom) -> None:
    lumen = small_phantom.images.lumen
    smooth = ndimage.gaussian_filter(np.random.default_rng(1).random(lumen.array.shape), 1.5)
    with pytest.raises(AnatomyError, match="tunnels"):
        tree_from_mask(Volume(grid=lumen.grid, array=np.asfortranarray(smooth < np.quantile(smooth, 0.3))))


def test_a_lumen_with_some_noise_is_a_tree(small_phantom: Phantom) -> None:
    lumen = small_phantom.images.lumen
    noisy = lumen.array ^ (np.random.default_rng(1).random(lumen.array.shape) < 0.01)
    assert tree_from_mask(Volume(grid=lumen.grid, array=np.asfortranarray(noisy))).n_branches > 20
