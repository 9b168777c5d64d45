"""Rays in voxels: how far they go on within a structure, against small steps and by hand."""

from __future__ import annotations

import numpy as np

from anatomy.fields import corner_geometry
from anatomy.grid import Grid
from anatomy.kernels.sight import follow_rays

GRID = Grid.from_spacing((12, 10, 8), (1.0, 0.5, 2.0), (0.0, 0.0, 0.0))
INSIDE, FARTHEST_MM, STEP_MM = 16, 9.0, 0.001


def followed(labels: np.ndarray, starts: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    away, ends = np.zeros(len(rays)), np.zeros(len(rays), dtype=np.int64)
    follow_rays(labels, corner_geometry(GRID), INSIDE, starts, rays, FARTHEST_MM, away, ends)
    return away, ends


def test_lengths_along_the_axes_are_exact() -> None:
    labels = np.zeros(GRID.shape, dtype=np.uint16, order="F")
    labels[2:9, 3:8, 1:5] = INSIDE
    labels[8, 4, 2] |= 64
    start = np.array([4.0, 2.0, 4.0])
    rays = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, -1.0]])
    away, ends = followed(labels, np.tile(start, (4, 1)), rays)
    np.testing.assert_allclose(away, [4.5, 2.5, 1.75, 3.0])
    assert ends.tolist() == [INSIDE | 64, INSIDE, INSIDE, INSIDE]


def test_a_start_beyond_the_structure_the_border_of_the_grid_and_the_farthest_length_end_a_ray() -> None:
    labels = np.full(GRID.shape, INSIDE, dtype=np.uint16, order="F")
    labels[0, 0, 0] = 0
    starts = np.array([[0.0, 0.0, 0.0], [-9.0, 0.0, 0.0], [9.0, 2.0, 4.0], [1.0, 2.0, 4.0]])
    away, ends = followed(labels, starts, np.tile([1.0, 0.0, 0.0], (4, 1)))
    np.testing.assert_allclose(away, [0.0, 0.0, 2.5, FARTHEST_MM])
    assert ends.tolist() == [0, 0, INSIDE, INSIDE]


def test_any_ray_ends_where_small_steps_leave_the_structure() -> None:
    rng = np.random.default_rng(4)
    labels = np.asfortranarray(np.where(rng.random(GRID.shape) < 0.85, INSIDE, 1).astype(np.uint16))
    starts = GRID.lps(rng.uniform(0, np.array(GRID.shape) - 1.0, (60, 3)))
    rays = rng.normal(size=(60, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    away, ends = followed(labels, starts, rays)
    steps = np.arange(0.0, FARTHEST_MM, STEP_MM)
    for n, ray in enumerate(rays):
        held = GRID.values_at(labels, starts[n] + steps[:, None] * ray, 0) & INSIDE
        wanted = FARTHEST_MM if held.all() else steps[np.argmin(held)]
        assert abs(away[n] - wanted) <= STEP_MM
        assert (ends[n] == INSIDE) == (away[n] > 0.0)
