"""Voxels as solid boxes: distances by trying every box, and random small scenes to try them on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float, Mask
from anatomy.grid import Grid


def rotated_grid(shape: tuple[int, int, int], spacing_mm: Float, turn: Float, first_lps: Float) -> Grid:
    """Return a grid whose axes are the LPS axes turned by a rotation vector in radians."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix() * spacing_mm
    matrix[:3, 3] = first_lps
    return Grid(shape=shape, lps_from_ijk=matrix)


def in_grid_mm(grid: Grid, points_lps: Float) -> Float:
    """Return points `(N, 3)` in mm along the axes of the grid, from the outer corner of voxel 0, 0, 0."""
    axes = grid.lps_from_ijk[:3, :3] / grid.spacing_mm
    return np.asarray((points_lps - grid.lps_from_ijk[:3, 3]) @ axes + grid.spacing_mm / 2)


def boxes_mm(mask: Mask, grid: Grid, points_lps: Float) -> Float:
    """Return the distance `(N,)` from points to the nearest voxel of `mask`; infinite if there is none."""
    local = in_grid_mm(grid, points_lps)
    nearest = np.full(len(local), np.inf)
    for low in np.argwhere(mask) * grid.spacing_mm:
        gap = np.maximum(np.maximum(low - local, local - low - grid.spacing_mm), 0.0)
        nearest = np.minimum(nearest, np.linalg.norm(gap, axis=1))
    return nearest


def edge_mm(grid: Grid, points_lps: Float) -> Float:
    """Return how deep `(N,)` points lie inside the grid; 0 beyond it."""
    local = in_grid_mm(grid, points_lps)
    return np.asarray(np.maximum(np.minimum(local, grid.shape * grid.spacing_mm - local), 0.0).min(axis=1))


@dataclass(frozen=True, eq=False)
class Scene:
    """A mask on a grid, and points in and around the grid: at random, and on corners, edges and faces."""

    grid: Grid
    mask: Mask
    points_lps: Float


@st.composite
def scenes(draw: st.DrawFn, *, points: int = 60) -> Scene:
    """Draw masks on small grids of any voxel size, position and rotation."""
    shape = draw(st.tuples(*[st.integers(1, 5)] * 3))
    mask = draw(arrays(np.bool_, shape))
    spacing = np.array(draw(st.tuples(*[st.floats(0.3, 2.5)] * 3)))
    turn = np.array(draw(st.tuples(*[st.floats(-3.0, 3.0)] * 3)))
    first = np.array(draw(st.tuples(*[st.floats(-300.0, 300.0)] * 3)))
    grid = rotated_grid(shape, spacing, turn, first)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ijk = rng.uniform(-0.5, np.array(shape) - 0.5, (points, 3))
    on_lattice = rng.random((points, 3)) < 0.15
    ijk[on_lattice] = np.round(2.0 * ijk[on_lattice]) / 2.0
    return Scene(grid=grid, mask=np.asfortranarray(mask), points_lps=grid.lps(ijk))
