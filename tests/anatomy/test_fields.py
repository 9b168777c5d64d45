"""Clearance fields: never above the true distance, and not far below it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import GridMismatchError
from anatomy.fields import (
    CENTRES,
    MAX_STORED,
    corner_geometry,
    distance_corners,
    distance_field,
    renewed_corners,
    touched_corners,
)  # fmt: skip
from anatomy.fields import DistanceField as Field
from anatomy.grid import Grid
from anatomy.kernels.field import UNITS_PER_MM, distance_estimate
from anatomy.morphology import window
from tests.anatomy.boxes import Scene, boxes_mm, edge_mm, in_grid_mm, scenes

# Distances are stored in these steps, after a little has been taken off for the rounding of places.
STEP_MM = 1 / UNITS_PER_MM + 1e-6
# Distances are computed in float64 from corners that are known to this.
TINY_MM = 1e-9


def _field(scene: Scene) -> Field:
    return distance_field("test", scene.mask, scene.grid)


def _spread_mm2(scene: Scene) -> np.ndarray:
    """Return the variance of a random corner of each point's cell, about the point."""
    spacing = scene.grid.spacing_mm
    share = np.mod(in_grid_mm(scene.grid, scene.points_lps) / spacing, 1.0)
    return np.asarray((share * (1.0 - share) * spacing**2).sum(axis=1))


def _corner_lps(grid: Grid) -> np.ndarray:
    index = np.stack(np.meshgrid(*[np.arange(n + 1) for n in grid.shape], indexing="ij"), axis=-1)
    return grid.lps(index.reshape(-1, 3) - 0.5)


@given(scene=scenes())
def test_bound_is_never_above_the_distance_to_the_boxes(scene: Scene) -> None:
    bound = _field(scene).lower_bound_mm(scene.points_lps)
    assert (bound <= boxes_mm(scene.mask, scene.grid, scene.points_lps) + TINY_MM).all()


@given(scene=scenes())
def test_bound_loses_at_most_what_minkowski_allows(scene: Scene) -> None:
    true = boxes_mm(scene.mask, scene.grid, scene.points_lps)
    inside = edge_mm(scene.grid, scene.points_lps) > 1e-6
    bound = _field(scene).lower_bound_mm(scene.points_lps)
    spread = _spread_mm2(scene)
    known = np.maximum(np.minimum(true, 255.0) - np.sqrt(spread) - STEP_MM, 0.0)
    least = np.sqrt(np.maximum(known**2 - spread, 0.0))
    assert (bound[inside] >= least[inside] - 1e-6).all()
    diagonal = float(np.linalg.norm(scene.grid.spacing_mm))
    assert (bound >= np.minimum(true, 255.0) - diagonal - STEP_MM - TINY_MM)[inside].all()


@given(scene=scenes(points=20))
def test_corners_hold_the_distance_rounded_down(scene: Scene) -> None:
    stored = _field(scene).corners.ravel() / UNITS_PER_MM
    true = boxes_mm(scene.mask, scene.grid, _corner_lps(scene.grid))
    assert (stored <= true).all()
    assert (stored >= np.minimum(true, 255.0) - STEP_MM).all()


@given(scene=scenes(points=20))
def test_estimate_lies_between_the_bound_and_a_voxel_diagonal(scene: Scene) -> None:
    field = _field(scene)
    true = np.minimum(boxes_mm(scene.mask, scene.grid, scene.points_lps), 255.0)
    bound = field.lower_bound_mm(scene.points_lps)
    estimate = np.array([distance_estimate(field.corners, field.geometry, *p) for p in scene.points_lps])
    assert (estimate >= bound).all()
    if scene.mask.any():
        assert (estimate**2 <= true**2 + 0.5 * _spread_mm2(scene) + TINY_MM).all()
    inside = edge_mm(scene.grid, scene.points_lps) > 1e-6
    diagonal = float(np.linalg.norm(scene.grid.spacing_mm))
    assert (estimate >= true - diagonal - STEP_MM)[inside].all()


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.55, 0.55, 0.7), (0.4, 2.0, 1.1)])
def test_bound_is_exact_where_one_box_corner_is_nearest(spacing: tuple[float, float, float]) -> None:
    grid = Grid.from_spacing((24, 24, 24), spacing, (10.0, -20.0, 30.0))
    mask = np.zeros(grid.shape, dtype=bool)
    mask[0, 0, 0] = True
    points = grid.lps(np.random.default_rng(1).uniform(1.5, 23.0, (500, 3)))
    true = boxes_mm(mask, grid, points)
    assert (true - distance_field("one", mask, grid).lower_bound_mm(points) <= 3 * STEP_MM).all()


@given(
    length=st.integers(200, 900),
    spacing=st.floats(0.25, 1.2),
    others=st.tuples(st.floats(0.3, 2.5), st.floats(0.3, 2.5)),
    axis=st.integers(0, 2),
)
def test_far_distances_are_as_exact_as_near_ones(
    length: int, spacing: float, others: tuple[float, float], axis: int
) -> None:
    shape, size = [2, 3, 4], [*others, 1.0]
    shape[axis], size[axis] = length, spacing
    grid = Grid.from_spacing(shape, size, (0.0, 0.0, 0.0))
    mask = np.zeros(shape, dtype=bool, order="F")
    mask[0, 0, 0] = True
    stored = distance_corners(mask, grid.spacing_mm) / UNITS_PER_MM
    index = np.stack(np.meshgrid(*[np.arange(n + 1) for n in shape], indexing="ij"), axis=-1)
    true = np.linalg.norm(np.maximum(index - 1, 0) * grid.spacing_mm, axis=-1)
    assert (stored <= true).all()
    assert (stored >= np.minimum(true, 255.0) - STEP_MM).all()


def test_voxels_that_are_too_flat_for_exact_distances_are_refused() -> None:
    for shape, spacing in (((3, 4, 5), (300.0, 1.0, 1.0)), ((9000, 1, 1), (1.0, 1.0, 1.0))):
        with pytest.raises(GridMismatchError, match="voxels of"):
            distance_corners(np.ones(shape, dtype=bool, order="F"), spacing)


@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 50), st.integers(1, 50), st.integers(1, 50)),
    spacing=st.tuples(st.floats(0.3, 3.0), st.floats(0.3, 3.0), st.floats(0.3, 3.0)),
    share=st.sampled_from([0.0, 1e-4, 1e-3, 0.02, 0.5]),
)
def test_a_field_that_is_renewed_where_a_mask_has_changed_is_that_of_the_whole_mask(
    seed: int, shape: tuple[int, ...], spacing: tuple[float, ...], share: float
) -> None:
    rng = np.random.default_rng(seed)
    mask = np.asfortranarray(rng.uniform(size=shape) < share)
    corners = distance_corners(mask, spacing)
    for _ in range(4):
        before = corners
        middle, half = rng.integers(shape), rng.integers(0, 4, 3)
        changed = window(np.maximum(middle - half, 0), np.minimum(middle + half + 1, shape))
        part = mask[changed]
        # Painted, erased, both, or nothing.
        part[...] = rng.uniform(size=part.shape) < rng.choice([0.0, 1.0, 0.3])
        corners, box = renewed_corners(before, lambda cut: mask[cut], changed, spacing)
        assert np.array_equal(corners, distance_corners(mask, spacing))
        differs = corners != before
        differs[box] = False
        assert not differs.any()


def test_distances_are_the_least_of_all_in_whole_numbers() -> None:
    """A box of the grid has the very numbers of the whole: nothing depends on the order of the sums."""
    rng = np.random.default_rng(4)
    spacing = np.array([0.703125, 0.703125, 1.25])
    for count in (1, 7, 300):
        points = np.unique(rng.integers(0, (40, 30, 20), (count, 3)), axis=0)
        mask = np.zeros((40, 30, 20), dtype=bool, order="F")
        mask[tuple(points.T)] = True
        index = np.stack(np.meshgrid(*map(np.arange, mask.shape), indexing="ij"), axis=-1)
        steps = (index[..., None, :] - points).astype(np.int64)
        squares = np.floor((spacing * 2.0**16) ** 2 * (1.0 - 2.0**-32)).astype(np.int64)
        least = (steps**2 * squares).sum(axis=-1).min(axis=-1)
        exact = np.array([math.isqrt(each) >> 8 for each in least.ravel().tolist()]).reshape(mask.shape)
        assert np.array_equal(distance_corners(mask, spacing, CENTRES), exact)


def test_no_structure_is_as_far_as_can_be_told() -> None:
    grid = Grid.from_spacing((4, 5, 6), (1.0, 0.5, 2.0), (0.0, 0.0, 0.0))
    field = distance_field("nothing", np.zeros(grid.shape, dtype=bool), grid)
    assert (field.corners == MAX_STORED).all()
    bound = field.lower_bound_mm(grid.lps(np.random.default_rng(0).uniform(-0.4, 3.4, (50, 3))))
    assert ((bound > 255.9) & (bound < 256.0)).all()


def test_farther_than_can_be_stored_is_cut_off() -> None:
    grid = Grid.from_spacing((300, 2, 2), (1.5, 1.0, 1.0), (0.0, 0.0, 0.0))
    mask = np.zeros(grid.shape, dtype=bool)
    mask[0] = True
    bound = distance_field("wall", mask, grid).lower_bound_mm([[440.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
    assert 255.9 < bound[0] < 256.0
    assert 99.2 < bound[1] <= 99.25


def test_inside_the_structure_is_no_distance() -> None:
    grid = Grid.from_spacing((3, 3, 3), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    field = distance_field("all", np.ones(grid.shape, dtype=bool), grid)
    assert not field.corners.any()
    assert not field.lower_bound_mm(grid.lps(np.random.default_rng(0).uniform(-0.5, 2.5, (50, 3)))).any()


def test_beyond_the_grid_nothing_is_known() -> None:
    grid = Grid.from_spacing((4, 4, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    mask = np.zeros(grid.shape, dtype=bool)
    mask[0] = True
    field = distance_field("wall", mask, grid)
    outside = [[3.6, 1, 1], [1, -0.6, 1], [1, 1, 1e300], [-1e300, 0, 0], [np.nan, 1, 1], [np.inf, 1, 1]]
    assert field.lower_bound_mm(outside).tolist() == [0.0] * len(outside)
    assert field.lower_bound_mm([3.4, 1.0, 1.0])[0] > 2.0


def test_touched_corners_are_the_corners_of_the_voxels() -> None:
    mask = np.zeros((3, 2, 2), dtype=bool)
    mask[1, 0, 1] = True
    expected = np.zeros((4, 3, 3), dtype=bool)
    expected[1:3, 0:2, 1:3] = True
    corners = touched_corners(mask)
    assert (corners == expected).all()
    assert corners.flags.f_contiguous


def test_fields_cannot_be_written_and_lie_in_fortran_order() -> None:
    grid = Grid.from_spacing((3, 4, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    field = distance_field("test", np.eye(3, 4, dtype=bool)[:, :, None] | np.zeros(grid.shape, bool), grid)
    assert field.corners.flags.f_contiguous
    for array in (field.corners, field.geometry, corner_geometry(grid)):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


def test_mapped_files_become_plain_arrays(tmp_path: Path) -> None:
    """One type of array means one compilation of every kernel."""
    grid = Grid.from_spacing((3, 4, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    field = distance_field("test", np.ones(grid.shape, dtype=bool), grid)
    np.save(tmp_path / "corners.npy", field.corners)
    mapped = np.load(tmp_path / "corners.npy", mmap_mode="r")
    again = Field(name="test", corners=mapped, geometry=field.geometry)
    assert type(again.corners) is np.ndarray
    assert again.corners.flags.f_contiguous


def test_geometry_counts_corners_from_the_outer_corner() -> None:
    grid = Grid.from_spacing((3, 4, 5), (1.0, 2.0, 0.5), (7.0, 8.0, 9.0))
    geometry = corner_geometry(grid)
    np.testing.assert_allclose(geometry[:, :3] @ (6.5, 7.0, 8.75) + geometry[:, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(geometry[:, 4], (1.0, 4.0, 0.25))


def test_a_geometry_of_another_shape_is_refused() -> None:
    """Kernels do not look at shapes: they would read beyond it."""
    grid = Grid.from_spacing((3, 3, 3), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    corners = np.zeros((4, 4, 4), dtype=np.uint16, order="F")
    with pytest.raises(GridMismatchError, match="shape"):
        Field(name="x", corners=corners, geometry=corner_geometry(grid)[:, :5])
