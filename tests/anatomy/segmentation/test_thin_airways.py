"""Thin airways that are followed from the end of a wider one, and what is not taken for them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from anatomy.base.typed import Float, Int16, Mask
from anatomy.segmentation.growing import follow_thin_airways
from anatomy.segmentation.kernels.states import BANNED, LUMEN

SHAPE = (96, 60, 60)
SPACING_MM = np.full(3, 0.7)
AIR_HU, WALL_HU, LUNG_HU, BLOOD_HU = -990.0, 0.0, -865.0, 40.0
FINE = 3
END = 40
"""The plane in which the wide airway ends; it begins at the first."""
VESSELS = ((10.0, 10.0), (12.0, 46.0), (50.0, 10.0), (52.0, 52.0))
VESSEL_VOXELS = 1.8
"""There are vessels, too, as in all lungs: it is beside them that false airways are looked for."""


def slow(*values: float) -> list[Any]:
    """Return more of the same parameters, which take long together."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def course(k: Float) -> tuple[Float, Float]:
    """Return where the airway runs in each plane: straight, then in a gentle bend."""
    beyond = np.maximum(k - END, 0.0)
    return 30.0 + 0.25 * beyond - 0.004 * beyond**2, 28.0 + 0.15 * beyond


def block(
    lumen_mm: float, outer_mm: float, fill_hu: float, seed: int = 0, narrow: tuple[int, int] = (0, 0)
) -> Int16:
    """Render lung with a wider airway, and from its end on a tube with what fills it and a wall.

    Between the `narrow` planes its lumen has 0.7 of its radius.
    """
    fine = tuple(FINE * n for n in SHAPE)
    k, j, i = ((np.arange(n) + 0.5) / FINE - 0.5 for n in fine)
    middle_j, middle_i = course(k)
    offset = np.hypot(j[None, :, None] - middle_j[:, None, None], i[None, None, :] - middle_i[:, None, None])
    away_mm = 0.7 * offset
    wide = (k <= END)[:, None, None]
    image = np.full(fine, LUNG_HU, dtype=np.float32)
    for at in VESSELS:
        image[:, np.hypot(j[:, None] - at[0], i[None, :] - at[1]) <= VESSEL_VOXELS] = BLOOD_HU
    image[away_mm <= np.where(wide, 2.0, outer_mm)] = WALL_HU
    image[wide & (away_mm <= 1.1)] = AIR_HU
    radius_mm = np.where((k > narrow[0]) & (k <= narrow[1]), 0.7 * lumen_mm, lumen_mm)[:, None, None]
    image[~wide & (away_mm <= radius_mm)] = fill_hu
    image = image.reshape(SHAPE[0], FINE, SHAPE[1], FINE, SHAPE[2], FINE).mean(axis=(1, 3, 5))
    image = ndimage.gaussian_filter(image, 0.6 / 0.7)
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(SHAPE), 0.5)
    return np.rint(image + 25.0 * noise / noise.std()).astype(np.int16)


def follow(hu: Int16, banned: Mask | None = None) -> tuple[int, Mask]:
    """Follow from the wide airway, whose first planes are the start; return what was added too."""
    state = np.zeros(SHAPE, dtype=np.uint8)
    k, j, i = np.indices(SHAPE)
    wide = (np.hypot(j - 30.0, i - 28.0) <= 1.2) & (k <= END) & (k >= 4)
    state[wide] = LUMEN
    if banned is not None:
        state[banned] = BANNED
    lung = np.zeros(SHAPE, dtype=np.bool_)
    lung[3:-3, 3:-3, 3:-3] = True
    at = np.flatnonzero(wide)
    lumen = np.zeros(2 * len(at), dtype=np.int64)
    lumen[: len(at)] = at
    smooth = np.rint(ndimage.gaussian_filter(hu.astype(np.float32), 0.85)).astype(np.int16)
    known = int((at < 20 * SHAPE[1] * SHAPE[2]).sum())
    count, n_tubes = follow_thin_airways(hu, smooth, state, lung, SPACING_MM, lumen, known, len(at))
    added = np.zeros(SHAPE, dtype=np.bool_)
    added.reshape(-1)[lumen[len(at) : count]] = True
    assert (state[added] == LUMEN).all()
    return n_tubes, added


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
def test_a_thin_airway_is_followed(seed: int) -> None:
    n_tubes, added = follow(block(0.85, 1.65, AIR_HU, seed))
    k, j, i = np.nonzero(added)
    middle_j, middle_i = course(k.astype(np.float64))
    away = np.hypot(j - middle_j, i - middle_i)
    assert n_tubes >= 1
    assert k.max() > 80, "it is followed nearly to the end of the lung, plane 92"
    assert (away <= 2.0).mean() > 0.95
    wide = np.zeros(SHAPE, dtype=np.bool_)
    wide[END, 29:32, 27:30] = True
    _, pieces = ndimage.label(added | wide, np.ones((3, 3, 3)))
    assert pieces == 1


@pytest.mark.slow
def test_a_tube_goes_on_beyond_a_short_narrow_place_and_not_beyond_a_long_one() -> None:
    _, beyond = follow(block(0.85, 1.65, AIR_HU, narrow=(54, 60)))
    assert np.nonzero(beyond)[0].max() > 80
    _, before = follow(block(0.85, 1.65, AIR_HU, narrow=(54, 66)))
    assert 48 < np.nonzero(before)[0].max() < 62


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *slow(2, 3, 4, 5)])
def test_nothing_is_followed_into_lung(seed: int) -> None:
    n_tubes, added = follow(block(0.0, 0.0, LUNG_HU, seed))
    assert n_tubes == 0
    assert not added.any()


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [1.0, 2.4, *slow(0.6, 1.6)])
def test_a_vessel_at_the_end_is_not_followed(radius_mm: float) -> None:
    n_tubes, added = follow(block(radius_mm, radius_mm, BLOOD_HU))
    assert n_tubes == 0
    assert not added.any()


@pytest.mark.slow
def test_lung_without_anything_bright_is_no_obstacle() -> None:
    rng = np.random.default_rng(0)
    hu = np.rint(LUNG_HU + 25.0 * rng.standard_normal(SHAPE)).astype(np.int16)
    n_tubes, _ = follow(hu)
    assert n_tubes == 0


@pytest.mark.slow
def test_a_cord_without_lumen_is_not_followed() -> None:
    n_tubes, _ = follow(block(0.0, 1.65, AIR_HU))
    assert n_tubes == 0


@pytest.mark.slow
def test_what_is_banned_is_not_entered() -> None:
    banned = np.zeros(SHAPE, dtype=np.bool_)
    banned[60:] = True
    _, added = follow(block(0.85, 1.65, AIR_HU), banned)
    assert added.any()
    assert not (added & banned).any()


@pytest.mark.slow
def test_the_same_image_gives_the_same_tubes() -> None:
    hu = block(0.85, 1.65, AIR_HU)
    first, again = follow(hu), follow(hu)
    assert first[0] == again[0]
    np.testing.assert_array_equal(first[1], again[1])
