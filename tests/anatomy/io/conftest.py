"""Small images whose left, front and top are known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from anatomy.grid import Grid, Volume
from anatomy.io import write_volume

SHAPE = (12, 10, 8)
LANDMARK_LPS = np.array([20.0, -12.0, 35.0])  # the patient's left, front, top


@pytest.fixture
def grid() -> Grid:
    """A grid centred on LPS (0, 0, 30), voxels of 5 x 4 x 2 mm."""
    spacing = np.array([5.0, 4.0, 2.0])
    first = np.array([0.0, 0.0, 30.0]) - spacing * (np.array(SHAPE) - 1) / 2
    return Grid.from_spacing(SHAPE, spacing, first)


@pytest.fixture
def landmark(grid: Grid) -> Volume:
    """One voxel marked near LANDMARK_LPS."""
    array = np.zeros(SHAPE, dtype=np.int16)
    array[tuple(np.rint(grid.ijk(LANDMARK_LPS)).astype(int))] = 700
    return Volume(grid=grid, array=array)


@pytest.fixture
def require_landmark(grid: Grid) -> Callable[[Volume], None]:
    """A check that the only marked voxel of a volume lies at LANDMARK_LPS, left, front and top."""

    def check(volume: Volume) -> None:
        marked = np.argwhere(volume.array == volume.array.max())
        assert len(marked) == 1
        found = volume.grid.lps(marked[0])
        assert np.abs(found - LANDMARK_LPS).max() <= grid.spacing_mm.max() / 2 + 1e-4
        assert found[0] > 0, "the patient's left is LPS x > 0"

    return check


def mask(grid: Grid, start: tuple[int, int, int], stop: tuple[int, int, int]) -> Volume:
    """A box of voxels."""
    array = np.zeros(grid.shape, dtype=np.bool_)
    array[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))] = True
    return Volume(grid=grid, array=array)


@pytest.fixture
def masks(grid: Grid) -> dict[str, Volume]:
    """Lumen, wall, vessels, lung, fissure and nodule that can be told apart."""
    return {
        "lumen": mask(grid, (5, 4, 3), (7, 5, 8)),
        "wall": mask(grid, (5, 5, 3), (7, 6, 8)),
        "arteries": mask(grid, (2, 2, 2), (3, 3, 6)),
        "veins": mask(grid, (9, 2, 2), (10, 3, 6)),
        "lung_left": mask(grid, (7, 1, 1), (11, 9, 7)),
        "lung_right": mask(grid, (1, 1, 1), (5, 9, 7)),
        "fissures": mask(grid, (8, 5, 1), (11, 6, 2)),
        "nodule": mask(grid, (9, 6, 4), (10, 7, 5)),
    }


@pytest.fixture
def med_rad_folder(tmp_path: Path, masks: dict[str, Volume], grid: Grid) -> Path:
    """A Med-RAD folder with one start and one target, in RAS."""
    lung = Volume(grid=grid, array=masks["lung_left"].array | masks["lung_right"].array)
    files = {
        "bronchialTree": masks["lumen"],
        "vessels": masks["arteries"],
        "pleuralBoundary": lung,
        "fissures": masks["fissures"],
        "nodule": masks["nodule"],
    }
    folder = tmp_path / "Patient7"
    folder.mkdir()
    for name, volume in files.items():
        write_volume(folder / f"{name}.nii.gz", volume)
    (folder / "start1.txt").write_text("1 0 0 -5\n0 -1 0 2\n0 0 -1 31\n0 0 0 1\n")
    (folder / "target.txt").write_text("-17.5\n-6\n31\n")
    return folder
