"""The airway is cut below the larynx, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.grid import Grid
from anatomy.segmentation.central_airway import without_larynx


def _trachea(taper_voxels: int) -> np.ndarray:
    """A tube of 8 voxels radius along k that tapers to a point at its upper end."""
    i, j, k = np.indices((40, 40, 60))
    top = 55
    radius = np.where(k > top - taper_voxels, 8.0 * (top - k) / max(taper_voxels, 1), 8.0)
    return np.asfortranarray((np.hypot(i - 20, j - 20) <= radius) & (k < top) & (k > 2))


@pytest.mark.parametrize("flipped", [False, True])
def test_a_tapered_end_is_cut_to_a_flat_one(flipped: bool) -> None:
    lumen = _trachea(10)
    grid = Grid.from_spacing(lumen.shape, (1.0, 1.0, 1.5), (0, 0, 0))
    seed = np.array([20, 20, 35])
    if flipped:
        matrix = grid.lps_from_ijk.copy()
        matrix[:3, 1:3] *= -1
        lumen, grid = lumen[:, :, ::-1], Grid(shape=grid.shape, lps_from_ijk=matrix)
        seed = np.array([20, 20, 24])
    cut, length_mm = without_larynx(lumen, seed, grid)
    assert not (cut & ~lumen).any()
    levels = np.flatnonzero(cut.any(axis=(0, 1)))
    kept = np.count_nonzero(cut, axis=(0, 1))[levels]
    assert kept.min() >= 0.6 * kept.max()
    assert length_mm == pytest.approx(1.5 * (np.count_nonzero(lumen.any(axis=(0, 1))) - len(levels)))
    assert 9.0 <= length_mm <= 15.0


def test_a_wide_end_stays() -> None:
    lumen = _trachea(0)
    cut, length_mm = without_larynx(
        lumen, np.array([20, 20, 35]), Grid.from_spacing(lumen.shape, (1.0, 1.0, 1.5), (0, 0, 0))
    )
    assert length_mm == 0.0
    assert (cut == lumen).all()
