"""Grids: what is refused, mapping both ways, cropping, comparing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import FrameError, GridMismatchError
from anatomy.grid import Grid, Volume, read_only, transform_points
from tests.anatomy.boxes import rotated_grid

vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


def _grid(**changes: Any) -> Grid:
    return Grid.from_spacing(
        **{"shape": (4, 5, 6), "spacing_mm": (1.0, 2.0, 0.5), "origin_lps": (7.0, -8.0, 9.0)} | changes
    )


def _matrix(*, entries: dict[tuple[int, int], float]) -> np.ndarray:
    matrix = np.eye(4)
    for index, value in entries.items():
        matrix[index] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "found"),
    [
        (_matrix(entries={(0, 1): 0.01}), "not orthonormal"),
        (_matrix(entries={(0, 0): -1.0}), "left-handed"),
        (_matrix(entries={(0, 0): 0.0, (1, 1): 0.0, (0, 1): 1.0, (1, 0): 1.0}), "left-handed"),
        (_matrix(entries={(1, 3): np.nan}), "not a finite 4x4"),
        (_matrix(entries={(2, 2): np.inf}), "not a finite 4x4"),
        (np.eye(3), "not a finite 4x4"),
        (_matrix(entries={(2, 2): 0.0}), "voxel size"),
        (_matrix(entries={(0, 3): 5.0, (1, 3): -3.0}).T, "last row"),
        (_matrix(entries={(3, 3): 2.0}), "last row"),
    ],
)
def test_frames_that_are_not_rigid_are_refused(matrix: np.ndarray, found: str) -> None:
    with pytest.raises(FrameError, match=found) as caught:
        Grid(shape=(2, 2, 2), lps_from_ijk=matrix)
    assert caught.value.expected
    assert caught.value.remedy


def test_the_rounding_of_file_headers_is_accepted() -> None:
    exact = rotated_grid((2, 2, 2), np.array([0.7, 0.7, 1.0]), np.array([0.1, -0.2, 0.3]), np.zeros(3))
    header = exact.lps_from_ijk.astype(np.float32).astype(np.float64)
    grid = Grid(shape=(2, 2, 2), lps_from_ijk=header)
    np.testing.assert_allclose(grid.spacing_mm, (0.7, 0.7, 1.0), rtol=1e-6)


@given(
    spacing=st.tuples(*[st.floats(0.2, 5.0)] * 3),
    turn=vectors,
    first=st.tuples(*[st.floats(-500.0, 500.0)] * 3),
    ijk=st.tuples(*[st.floats(-10.0, 600.0)] * 3),
)
def test_points_map_there_and_back(
    spacing: tuple[float, ...], turn: tuple[float, ...], first: tuple[float, ...], ijk: tuple[float, ...]
) -> None:
    grid = rotated_grid((3, 4, 5), np.array(spacing), np.array(turn), np.array(first))
    np.testing.assert_allclose(grid.ijk(grid.lps(ijk)), ijk, atol=1e-6)
    np.testing.assert_allclose(grid.spacing_mm, spacing, rtol=1e-12)
    assert grid.voxel_volume_mm3 == pytest.approx(np.prod(spacing))


def test_indices_are_voxel_centres() -> None:
    grid = _grid()
    assert grid.lps((0, 0, 0)).tolist() == [7.0, -8.0, 9.0]
    assert grid.lps([(1, 0, 0), (0, 1, 0), (0.5, 0, 2)]).tolist() == [
        [8.0, -8.0, 9.0],
        [7.0, -6.0, 9.0],
        [7.5, -8.0, 10.0],
    ]


def test_a_grid_contains_its_voxels_up_to_their_faces() -> None:
    grid = _grid()
    inside = [(-0.49, 0, 0), (3.49, 4.49, 5.49), (0, 0, 0)]
    outside = [(-0.51, 0, 0), (3.51, 0, 0), (0, 4.51, 0), (0, 0, -0.51)]
    assert grid.contains(grid.lps(inside)).all()
    assert not grid.contains(grid.lps(outside)).any()


def test_a_crop_keeps_every_voxel_in_place() -> None:
    grid = rotated_grid((9, 9, 9), np.array([1.0, 2.0, 0.5]), np.array([0.3, 0.2, -0.1]), np.zeros(3))
    crop = grid.crop((2, 3, 4), (5, 8, 9))
    assert crop.shape == (3, 5, 5)
    np.testing.assert_allclose(crop.lps((1, 1, 1)), grid.lps((3, 4, 5)))


def test_a_crop_may_reach_beyond_the_grid() -> None:
    grid = _grid()
    crop = grid.crop((-2, -2, -2), (6, 7, 8))
    assert crop.shape == (8, 9, 10)
    np.testing.assert_allclose(crop.lps((2, 2, 2)), grid.lps((0, 0, 0)))
    np.testing.assert_allclose(crop.lps((7, 8, 9)), grid.lps((5, 6, 7)))


@pytest.mark.parametrize(("shift_mm", "close"), [(0.0, True), (0.009, True), (0.011, False), (-0.02, False)])
def test_grids_are_close_if_all_voxels_are(shift_mm: float, close: bool) -> None:
    grid = _grid()
    moved = _grid(origin_lps=(7.0, -8.0 + shift_mm, 9.0))
    assert grid.is_close(moved) is close
    assert moved.is_close(grid) is close
    assert grid.is_close(moved, tolerance_mm=0.1)


def test_a_small_difference_in_spacing_adds_up() -> None:
    wide = _grid(shape=(500, 5, 6))
    assert not wide.is_close(_grid(shape=(500, 5, 6), spacing_mm=(1.0001, 2.0, 0.5)))
    assert _grid().is_close(_grid(spacing_mm=(1.0001, 2.0, 0.5)))


def test_grids_of_other_shapes_are_never_close() -> None:
    assert not _grid().is_close(_grid(shape=(4, 5, 7)))


def test_masks_on_another_grid_are_named() -> None:
    with pytest.raises(GridMismatchError, match=r"vessels differs: 4x5x7 voxels .* Resample") as caught:
        _grid().require_same(_grid(shape=(4, 5, 7)), "vessels")
    assert "4x5x6 voxels of 1.000 x 2.000 x 0.500 mm, first at LPS (7.0, -8.0, 9.0)" in caught.value.expected
    _grid().require_same(_grid(), "vessels")


def test_volumes_fit_their_grid_and_cannot_be_written() -> None:
    grid = _grid()
    volume = Volume(grid=grid, array=np.zeros(grid.shape, order="C"))
    assert volume.array.flags.f_contiguous
    for array in (volume.array, grid.lps_from_ijk):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(GridMismatchError, match=r"\(6, 5, 4\) .* Index arrays as \[i, j, k\]"):
        Volume(grid=grid, array=np.zeros((6, 5, 4)))


def test_volumes_copy_only_what_is_not_in_order() -> None:
    grid = _grid()
    array = np.zeros(grid.shape, order="F")
    assert np.shares_memory(Volume(grid=grid, array=array).array, array)
    assert array.flags.writeable


def test_the_matrix_of_a_grid_is_its_own() -> None:
    matrix = np.eye(4)
    grid = Grid(shape=(2, 2, 2), lps_from_ijk=matrix)
    matrix[0, 3] = 100.0
    assert grid.lps((0, 0, 0))[0] == 0.0


def test_read_only_leaves_the_original_writable() -> None:
    array = np.zeros(3)
    assert not read_only(array).flags.writeable
    assert array.flags.writeable


def test_transform_points_takes_any_leading_shape() -> None:
    matrix = _matrix(entries={(0, 3): 1.0, (1, 3): 2.0, (2, 3): 3.0})
    assert transform_points(matrix, np.zeros(3)).tolist() == [1.0, 2.0, 3.0]
    assert transform_points(matrix, np.zeros((2, 5, 3))).shape == (2, 5, 3)


@pytest.mark.parametrize("shear", [1e-7, 9e-5])
def test_axes_that_a_header_rounded_are_made_perpendicular(shear: float) -> None:
    """Distances are computed as if they were."""
    matrix = np.diag([0.7, 0.8, 1.5, 1.0])
    matrix[0, 1] = shear * 0.8
    grid = Grid(shape=(300, 300, 200), lps_from_ijk=matrix)
    axes = grid.lps_from_ijk[:3, :3] / grid.spacing_mm
    assert np.abs(axes.T @ axes - np.eye(3)).max() < 1e-12
    assert np.abs(grid.lps_from_ijk - matrix).max() <= shear
    again = Grid(shape=grid.shape, lps_from_ijk=grid.lps_from_ijk)
    assert np.array_equal(again.lps_from_ijk, grid.lps_from_ijk)
    plain = np.diag([0.7, 0.8, 1.5, 1.0])
    assert np.array_equal(Grid(shape=(3, 3, 3), lps_from_ijk=plain).lps_from_ijk, plain)
