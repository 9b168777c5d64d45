"""Bounds of distances on drawn grids: rotated, anisotropic, nearly sheared, with points up to the border."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float, Labels
from anatomy.fields import CENTRES, SOLID, DistanceField, corner_geometry, distance_corners
from anatomy.grid import ORTHONORMAL_TOLERANCE, Grid
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.structures import OBSTACLES, OUTSIDE, VESSEL, close_border

POINTS = 50
ROUNDING_MM = 1e-9


def drawn_matrix(rng: np.random.Generator, largest_mm: float) -> Float:
    """Return the matrix of a rotated grid of uneven voxels, the axes not quite perpendicular."""
    direction = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    direction = direction @ (
        np.eye(3) + 0.5 * ORTHONORMAL_TOLERANCE * np.triu(rng.uniform(-1.0, 1.0, (3, 3)), 1)
    )
    matrix = np.eye(4)
    matrix[:3, :3] = direction / np.linalg.norm(direction, axis=0) * rng.uniform(0.2, 1.0, 3) * largest_mm
    matrix[:3, 3] = rng.normal(0.0, 100.0, 3)
    return matrix


def drawn_points(rng: np.random.Generator, shape: tuple[int, ...], count: int) -> Float:
    """Return indices `(N, 3)` of points in a grid: anywhere, at corners, and just inside its faces."""
    points = rng.uniform(-0.5, np.array(shape) - 0.5, (count, 3))
    corners = np.rint(points + 0.5) - 0.5
    points = np.where(rng.uniform(size=(count, 1)) < 0.3, corners, points)
    near = rng.uniform(size=(count, 3)) < 0.1
    return np.where(near, rng.uniform(-0.499, 0.0, (count, 3)), points)


def distances(
    points: Float, voxels: Float, matrix: Float, half: float, lps_from_unit: Float | None = None
) -> Float:
    """Return distances `(N,)` to the nearest voxel, each by its nearest point where axes are perpendicular.

    Where they are not, the distance of that point is still no less than the true one.
    """
    units = matrix[:3, :3] if lps_from_unit is None else lps_from_unit
    gap = points[:, None] - voxels
    gap -= np.clip(gap, -half, half)
    return np.asarray(np.linalg.norm(gap @ units.T, axis=-1).min(axis=1))


def exceeded(
    seed: int, count: int, *, largest_mm: float = 2.0, loss_diagonals: float = 1.0, as_stated: bool = False
) -> tuple[list[str], list[str]]:
    """Draw grids and points; return which bounds exceed the distance, and which lose more than they may.

    `loss_diagonals` is the greatest loss in diagonals of a voxel.  With `as_stated` fields take the matrix as
    it is, though its axes are not quite perpendicular.
    """
    rng = np.random.default_rng(seed)
    above, below = [], []
    for number in range(math.ceil(count / POINTS)):
        shape = tuple(int(n) for n in rng.integers(3, 9, 3))
        stated = drawn_matrix(rng, largest_mm)
        grid = Grid(shape=shape, lps_from_ijk=stated)
        matrix = stated if as_stated else grid.lps_from_ijk
        half = float(rng.choice((SOLID, CENTRES)))
        mask = rng.uniform(size=shape) < rng.choice((0.01, 0.1, 0.5))
        mask.flat[int(rng.integers(mask.size))] = True
        geometry = corner_geometry(grid, half).copy()
        if as_stated:
            geometry[:, :4] = np.linalg.inv(stated)[:3]
            geometry[:, 3] += 0.5
        spacing = np.sqrt(geometry[:, 4])
        field = DistanceField(name="x", corners=distance_corners(mask, spacing, half), geometry=geometry)
        points = drawn_points(rng, shape, POINTS)
        places = points @ matrix[:3, :3].T + matrix[:3, 3]
        found = field.lower_bound_mm(places)
        true = distances(points, np.argwhere(mask).astype(float), matrix, half)
        over = found - true
        if over.max() > ROUNDING_MM:
            above.append(f"{number}: {over.max():.2g} mm above, {shape}, {spacing}")
        # Beyond the outermost corners, or centres, nothing is known.
        inside = ((points > half_of(half)) & (points < np.array(shape) - 1.0 - half_of(half))).all(axis=1)
        lost = (true - found)[inside] - loss_diagonals * float(np.linalg.norm(spacing)) - 1.0 / UNITS_PER_MM
        if lost.max(initial=-1.0) > ROUNDING_MM + 2e-4:
            below.append(f"{number}: {lost.max():.2g} mm more lost, {shape}, {spacing}")
    return above, below


def half_of(half: float) -> float:
    """Return how far a lattice reaches beyond the centres of the outermost voxels, as a number below 0."""
    return -half + 1e-6


def beyond_the_border(seed: int, count: int, close: Callable[[Labels], None] = close_border) -> list[str]:
    """Draw grids and points near their faces; return where a field says more than up to what is beyond."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(math.ceil(count / POINTS)):
        shape = tuple(int(n) for n in rng.integers(4, 9, 3))
        grid = Grid(shape=shape, lps_from_ijk=drawn_matrix(rng, 2.0))
        labels = np.where(rng.uniform(size=shape) < 0.02, VESSEL, 0).astype(np.uint16, order="F")
        close(labels)
        corners = distance_corners((labels & OBSTACLES) != 0, grid.spacing_mm)
        field = DistanceField(name="x", corners=corners, geometry=corner_geometry(grid))
        points = drawn_points(rng, shape, POINTS)
        faces = np.concatenate([points + 0.5, np.array(shape) - 0.5 - points], axis=1)
        to_face = (faces * np.tile(grid.spacing_mm, 2)).min(axis=1)
        over = field.lower_bound_mm(grid.lps(points)) - to_face
        if over.max() > 1e-6:
            found.append(f"{number}: {over.max():.2g} mm beyond the border, {shape}")
    return found


def test_no_bound_on_a_drawn_grid_is_above_the_distance_or_loses_more_than_a_diagonal() -> None:
    assert exceeded(0, 5_000) == ([], [])
    assert exceeded(1, 5_000, largest_mm=40.0)[0] == []


def test_the_same_search_finds_axes_that_are_not_perpendicular() -> None:
    assert exceeded(0, 5_000, largest_mm=40.0, as_stated=True)[0]


def test_the_same_search_finds_a_loss_of_more_than_half_a_diagonal() -> None:
    assert exceeded(0, 5_000, loss_diagonals=0.5)[1]


def test_no_field_of_a_closed_border_says_more_than_up_to_the_border() -> None:
    assert not beyond_the_border(0, 5_000)


def test_the_same_search_finds_a_border_that_is_open() -> None:
    assert beyond_the_border(0, 500, lambda labels: None)


def test_labels_keep_what_they_were_when_the_border_is_closed() -> None:
    labels = np.full((3, 4, 5), VESSEL, dtype=np.uint16)
    close_border(labels)
    assert (labels[1:-1, 1:-1, 1:-1] == VESSEL).all()
    assert ((labels != VESSEL).sum(), labels[0, 0, 0]) == (60 - 6, VESSEL | OUTSIDE)


@pytest.mark.slow
def test_no_bound_of_a_hundred_thousand_is_above_the_distance_or_loses_more_than_a_diagonal() -> None:
    assert exceeded(2, 100_000) == ([], [])
    assert exceeded(3, 100_000, largest_mm=40.0)[0] == []
    assert not beyond_the_border(1, 100_000)
