"""Nodules from contours, and their removal from the vessels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import FileError, GridMismatchError
from anatomy.grid import Grid
from anatomy.io import read_volume
from anatomy.segmentation.nodules import RIM_MM, centre_of, nodule_from_contours, without_nodule

GRID = Grid.from_spacing((40, 50, 20), (0.8, 0.8, 1.0), (-10.0, 5.0, -100.0))
SQUARE = [[10, 20], [18, 20], [18, 30], [10, 30], [10, 20]]


def _file(folder: Path, *annotations: list[dict[str, Any]]) -> Path:
    path = folder / "contours.json"
    path.write_text(json.dumps({"annotations": [{"contours": contours} for contours in annotations]}))
    return path


def _contour(k: int, ij: list[list[int]], inclusion: bool = True) -> dict[str, Any]:
    return {"z_mm": float(GRID.lps((0, 0, k))[2]), "ij": ij, "inclusion": inclusion}


def test_the_inside_of_a_contour_leaves_out_the_contour(tmp_path: Path) -> None:
    nodule = nodule_from_contours(_file(tmp_path, [_contour(5, SQUARE)]), GRID)
    expected = np.zeros(GRID.shape, dtype=bool)
    expected[11:18, 21:30, 5] = True
    assert (nodule == expected).all()


def test_a_contour_too_small_to_have_an_inside_counts_itself(tmp_path: Path) -> None:
    nodule = nodule_from_contours(_file(tmp_path, [_contour(5, [[10, 20], [11, 20], [10, 20]])]), GRID)
    assert np.argwhere(nodule).tolist() == [[10, 20, 5], [11, 20, 5]]


def test_an_exclusion_cuts_a_hole(tmp_path: Path) -> None:
    hole = [[12, 22], [16, 22], [16, 28], [12, 28], [12, 22]]
    path = _file(tmp_path, [_contour(5, hole, inclusion=False), _contour(5, SQUARE)])
    nodule = nodule_from_contours(path, GRID)
    assert not nodule[14, 25, 5]
    assert nodule[11, 25, 5]


def test_half_of_those_who_outlined_a_nodule_decide(tmp_path: Path) -> None:
    wider = [[8, 18], [20, 18], [20, 32], [8, 32], [8, 18]]
    far = [[30, 5], [36, 5], [36, 11], [30, 11], [30, 5]]
    path = _file(
        tmp_path,
        [_contour(5, SQUARE)],
        [_contour(5, SQUARE)],
        [_contour(5, wider)],
        [_contour(12, far)],  # another nodule, which one reader alone saw
    )
    nodule = nodule_from_contours(path, GRID)
    assert nodule[11, 21, 5]
    assert not nodule[9, 19, 5]
    assert nodule[33, 8, 12]


@pytest.mark.parametrize("axis", [0, 1])
def test_columns_and_rows_count_along_lps_whichever_way_voxels_run(tmp_path: Path, axis: int) -> None:
    path = _file(tmp_path, [_contour(5, SQUARE)])
    matrix = np.diag([0.8, 0.8, 1.0, 1.0])
    matrix[:3, 3] = GRID.lps_from_ijk[:3, 3]
    matrix[:3, 3] = GRID.lps([GRID.shape[0] - 1, GRID.shape[1] - 1, 0])
    matrix[:3, :2] *= -1
    turned = Grid(shape=GRID.shape, lps_from_ijk=matrix)
    places = [
        np.sort(grid.lps(np.argwhere(nodule_from_contours(path, grid)))[:, axis]) for grid in (GRID, turned)
    ]
    assert places[0] == pytest.approx(places[1])


@pytest.mark.parametrize(
    "content",
    [
        "no json",
        "[]",
        '{"annotations": []}',
        '{"annotations": [{"contours": []}]}',
        '{"annotations": [{"contours": [{"z_mm": 1.0, "ij": [[1, 2, 3]]}]}]}',
        '{"annotations": [{"contours": [{"z_mm": 1.0, "ij": [["a", 2]]}]}]}',
        '{"annotations": [{"contours": [{"ij": [[1, 2]]}]}]}',
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "contours.json"
    path.write_text(content)
    with pytest.raises(FileError, match="annotations"):
        nodule_from_contours(path, GRID)


def test_contours_of_another_image_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GridMismatchError, match="outside the image"):
        nodule_from_contours(_file(tmp_path, [_contour(50, SQUARE)]), GRID)
    with pytest.raises(GridMismatchError, match="outside the image"):
        nodule_from_contours(_file(tmp_path, [_contour(5, [[1, 1], [60, 1], [1, 20]])]), GRID)
    sagittal = Grid(shape=(20, 40, 50), lps_from_ijk=GRID.lps_from_ijk[:, [2, 0, 1, 3]])
    with pytest.raises(GridMismatchError, match="not axial"):
        nodule_from_contours(_file(tmp_path, [_contour(5, SQUARE)]), sagittal)


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """A ball that was taken for vessel with a rim of 1.5 mm, and a vessel of 2 mm radius that enters it."""
    grid_mm = np.moveaxis(np.indices(GRID.shape), 0, -1) * GRID.spacing_mm
    centre = np.array([20, 25, 10]) * GRID.spacing_mm
    apart = np.linalg.norm(grid_mm - centre, axis=-1)
    nodule = apart <= 5.0
    vessel = (np.linalg.norm((grid_mm - centre)[..., 1:], axis=-1) <= 2.0) & (grid_mm[..., 0] > centre[0])
    return nodule, (apart <= 6.5) | vessel


def test_a_nodule_is_no_obstacle_but_the_vessel_that_feeds_it_is() -> None:
    nodule, vessels = _scene()
    cleared = without_nodule(vessels, nodule, GRID)
    assert not (cleared & nodule).any()
    assert not (cleared & ~vessels).any()
    # The rim is gone where no vessel runs on, and the vessel is whole beyond it.
    left = np.argwhere(cleared)
    assert left[:, 0].min() > 20
    beyond = np.argwhere(vessels & ~cleared) * GRID.spacing_mm - np.array([20, 25, 10]) * GRID.spacing_mm
    assert np.linalg.norm(beyond, axis=1).max() <= 5.0 + RIM_MM + 1e-6


def test_no_nodule_changes_nothing() -> None:
    _, vessels = _scene()
    assert (without_nodule(vessels, np.zeros_like(vessels), GRID) == vessels).all()


def test_the_centre_lies_in_the_largest_nodule() -> None:
    nodule, _ = _scene()
    nodule[0:2, 0:2, 0:2] = True
    assert np.abs(centre_of(nodule, GRID) - GRID.lps((20, 25, 10))).max() <= 1.0


@pytest.mark.data
def test_the_nodule_of_lidc_0314(data_dir: Path) -> None:
    folder = data_dir / "ct" / "lidc-0314"
    ct = read_volume(folder / "ct.nii.gz")
    nodule = nodule_from_contours(folder / "nodule_contours.json", ct.grid)
    extent = ct.grid.spacing_mm * (np.ptp(np.argwhere(nodule), axis=0) + 1)
    assert 14.0 < extent.max() < 23.0
    assert np.linalg.norm(centre_of(nodule, ct.grid) - (-57, 131, -520)) < 5.0
    # Solid, unlike the lung around: the contours are where the nodule is.
    assert np.median(ct.array[nodule]) > -50
