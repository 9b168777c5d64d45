"""Obstacles of a cost map stay obstacles in whatever reads the file."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from anatomy.grid import Grid, Volume
from anatomy.io.assembly import require_cost
from anatomy.io.images import read_volume, write_volume
from anatomy.io.voxels import COST_MAP_NOTE, OBSTACLE_COST, as_stored

GRID = Grid.from_spacing((5, 4, 3), (0.7, 0.8, 1.0), (3.0, -2.0, 7.0))


def by_simpleitk(path: Path) -> np.ndarray:
    import SimpleITK

    return np.asarray(SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))).T


def by_nibabel(path: Path) -> np.ndarray:
    nibabel = pytest.importorskip("nibabel", reason="a second reader of NIfTI, for this test alone")
    return np.asarray(nibabel.load(path).dataobj)


def by_the_standard(path: Path) -> np.ndarray:
    """Read the voxels as the NIfTI-1 standard says: from `vox_offset` on, column by column."""
    content = gzip.decompress(path.read_bytes())
    assert struct.unpack_from("<h", content, 70)[0] == 16  # float32
    start = int(struct.unpack_from("<f", content, 108)[0])
    return np.frombuffer(content, "<f4", offset=start).reshape(GRID.shape, order="F")


def by_us(path: Path) -> np.ndarray:
    return read_volume(path).array


@pytest.fixture
def cost() -> np.ndarray:
    made = np.random.default_rng(0).random(GRID.shape, dtype=np.float32)
    made[::2, 1:3] = np.inf
    return np.asfortranarray(made)


@pytest.mark.parametrize("reader", [by_simpleitk, by_nibabel, by_the_standard, by_us])
def test_every_reader_finds_the_obstacles(
    reader: Callable[[Path], np.ndarray], cost: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "cost.nii.gz"
    write_volume(path, Volume(grid=GRID, array=as_stored(cost)), note=COST_MAP_NOTE)
    found = reader(path)
    assert ((found == OBSTACLE_COST) == np.isinf(cost)).all()
    assert (found[np.isfinite(cost)] == cost[np.isfinite(cost)]).all()


def test_the_header_says_what_an_obstacle_is(cost: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "cost.nii.gz"
    write_volume(path, Volume(grid=GRID, array=as_stored(cost)), note=COST_MAP_NOTE)
    description = gzip.decompress(path.read_bytes())[148:228].rstrip(b"\0").decode()
    assert description == COST_MAP_NOTE and f"{OBSTACLE_COST:g} is an obstacle" in description


@pytest.mark.parametrize("stored", [as_stored, np.asfortranarray], ids=["finite", "infinite"])
def test_maps_with_finite_and_with_infinite_obstacles_are_read_alike(
    stored: Callable[[np.ndarray], np.ndarray], cost: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / "cost.nii.gz"
    write_volume(path, Volume(grid=GRID, array=stored(cost)))
    assert np.array_equal(require_cost(read_volume(path), GRID).array, cost)
