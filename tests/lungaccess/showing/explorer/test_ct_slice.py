"""Slices of the CT at the pixels of a plane: as the page would look them up, voxel by voxel."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid, Volume
from lungaccess.showing.explorer.patient import ct_slice

SHAPE, SPACING_MM, FIRST = (9, 8, 7), (0.7, 0.8, 1.5), (-10.0, 5.0, 30.0)
SLOPE = np.array([3.0, -2.0, 5.0])


def ramp() -> Volume:
    """Return a CT whose values are linear in the place: between voxels they are known exactly."""
    grid = Grid.from_spacing(SHAPE, SPACING_MM, FIRST)
    ijk = np.stack(np.meshgrid(*[np.arange(n) for n in SHAPE], indexing="ij"), axis=-1)
    values = grid.lps(ijk.reshape(-1, 3)) @ SLOPE
    return Volume(grid=grid, array=values.reshape(SHAPE).astype(np.float32))


def test_an_oblique_slice_has_the_values_between_the_voxels_and_none_beyond() -> None:
    ct = ramp()
    middle = ct.grid.lps(np.array([[4.013, 3.517, 3.029]]))[0]
    across, down = np.array([0.3, 0.1, 0.2]), np.array([-0.1, 0.4, 0.3])
    values = ct_slice(ct, middle - 20 * across - 15 * down, across, down, 41, 31)
    assert values.shape == (31, 41) and values.dtype == np.float32
    row, column = np.meshgrid(np.arange(31), np.arange(41), indexing="ij")
    places = middle + (column - 20)[..., None] * across + (row - 15)[..., None] * down
    ijk = ct.grid.ijk(places.reshape(-1, 3)).reshape(31, 41, 3)
    inside = ((ijk >= 0) & (ijk <= np.array(SHAPE) - 1)).all(axis=-1)
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(np.isnan(values), ~inside)
    np.testing.assert_allclose(values[inside], (places @ SLOPE)[inside], atol=1e-3)


def test_a_plane_beyond_the_ct_has_no_values() -> None:
    values = ct_slice(ramp(), (500.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 4, 3)
    assert values.shape == (3, 4) and np.isnan(values).all()
