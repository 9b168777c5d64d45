"""A disk that is full while an image is written: the old file stays, or none; never half of one."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.io.images import read_volume, write_volume
from anatomy.io.motion_files import write_vectors

GRID = Grid.from_spacing((40, 30, 20), [1.0, 1.0, 2.0], [-20.0, -15.0, 0.0])
NOISE = Volume(grid=GRID, array=np.random.default_rng(0).integers(0, 30, GRID.shape).astype(np.int16))


@contextmanager
def room_for(most_bytes: int) -> Iterator[None]:
    """Let no file grow further: the system refuses to write on, as it does where the disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nii", "a.nrrd"])
def test_an_image_is_written_whole_or_not_at_all(tmp_path: Path, name: str) -> None:
    write_volume(tmp_path / name, NOISE)
    size = (tmp_path / name).stat().st_size
    other = Volume(grid=GRID, array=NOISE.array[::-1])
    for most_bytes in (0, 352, 2000, size // 2, size - 40):
        with room_for(most_bytes), pytest.raises(FileError, match="Make room on the disk|cannot be written"):
            write_volume(tmp_path / name, other)
        assert [path.name for path in tmp_path.iterdir()] == [name]
        assert (read_volume(tmp_path / name).array == NOISE.array).all(), "the old one is still there"
    write_volume(tmp_path / name, other)


def test_a_field_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with room_for(1000), pytest.raises(FileError, match="cannot be written"):
        write_vectors(tmp_path / "v.nrrd", GRID, np.random.default_rng(1).normal(size=(*GRID.shape, 3)))
    assert not list(tmp_path.iterdir())
