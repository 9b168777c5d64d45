"""The airway is cut below the larynx, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.grid import Grid
from anatomy.segmentation.central_airway import narrowest_level, throat_level, without_throat

SEED = np.array([20, 20, 35])


def _trachea(*stretches: tuple[int, float]) -> np.ndarray:
    """A tube along k from level 3 up: lengths and radii in voxels, each from the radius before on."""
    i, j = np.indices((40, 40))
    radii = [0.0] * 3
    for length, radius in stretches:
        radii += [radius] * length
    return np.stack([np.hypot(i - 20, j - 20) <= r if r else i < 0 for r in radii], axis=2)


def _cut(lumen: np.ndarray) -> tuple[np.ndarray, float]:
    return without_throat(lumen, SEED, Grid.from_spacing(lumen.shape, (1.0, 1.0, 1.5), (0, 0, 0)))


def test_a_tapered_end_is_cut_to_a_flat_one() -> None:
    lumen = _trachea((42, 8.0), *((1, 0.8 * (10 - n)) for n in range(10)))
    cut, length_mm = _cut(lumen)
    assert not (cut & ~lumen).any()
    levels = np.flatnonzero(cut.any(axis=(0, 1)))
    kept = np.count_nonzero(cut, axis=(0, 1))[levels]
    assert kept.min() >= 0.6 * kept.max()
    assert length_mm == pytest.approx(1.5 * (np.count_nonzero(lumen.any(axis=(0, 1))) - len(levels)))
    assert 9.0 <= length_mm <= 15.0


@pytest.mark.parametrize("share", [0.2, 0.56, 0.61, 0.66])
def test_an_open_glottis_below_a_wide_pharynx_is_the_end(share: float) -> None:
    lumen = _trachea((42, 8.0), (4, 8.0 * share**0.5), (10, 9.0), (20, 12.0))
    assert throat_level(lumen, SEED, 1.5) == 45
    assert _cut(lumen)[1] == pytest.approx(1.5 * 34)


@pytest.mark.parametrize("above", [(42, 8.0), (42, 8.4)])
def test_a_narrow_place_of_a_trachea_stays(above: tuple[int, float]) -> None:
    lumen = _trachea((42, 8.0), (4, 6.0), above)
    cut, length_mm = _cut(lumen)
    assert length_mm == 0.0
    assert (cut == lumen).all()
    assert 45 <= narrowest_level(lumen, SEED) < 49


def test_a_wide_end_stays() -> None:
    lumen = _trachea((52, 8.0))
    cut, length_mm = _cut(lumen)
    assert length_mm == 0.0
    assert (cut == lumen).all()
