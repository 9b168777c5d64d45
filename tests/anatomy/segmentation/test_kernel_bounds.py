"""No kernel of the segmentation looks beyond its arrays, whatever border of the image the lumen touches.

Compiled kernels check no index.  So the growth of the airway, its edge, gaps, corners and wall run in pure
Python here, on arrays that refuse every index beyond either end, with lumens at all faces, edges and corners
of a small image.  The slow test compiles all kernels with numba's check of bounds, and segments a patient.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.segmentation.growing import Ground

SHAPE = (5, 6, 7)
PURE_PYTHON = """
import itertools
import numpy as np
from anatomy.segmentation import growing
from tests.anatomy.segmentation.test_kernel_bounds import SHAPE, Checked, ground

padded = growing._padded
growing._padded = lambda *given: padded(*given).view(Checked)
for end in itertools.product(*[(0, n // 2, n - 1) for n in SHAPE]):
    start = np.zeros(SHAPE, dtype=bool)
    start[end] = True
    grown = growing.grow(ground(end), start)
    assert grown.lumen[end] and grown.lumen.sum() > 1 and grown.wall.any(), end
"""
COMPILED = """
import sys
from pathlib import Path
from anatomy.phantom import make_phantom
from anatomy.segmentation.pipeline import segment
from anatomy.segmentation.request import SegmentationRequest

ct = make_phantom(seed=3, size="small").ct
parts = segment(SegmentationRequest(ct=ct, out=Path(sys.argv[1]), voxel_mm=1.25)).parts
assert parts.lobes.any() and parts.large_vessels.any() and parts.lumen.any()
"""


class Checked(np.ndarray):
    """An array that has no index below 0 nor beyond its end."""

    def _require(self, index: Any) -> None:
        if isinstance(index, int | np.integer) and not 0 <= index < len(self):
            raise IndexError(f"{index} of {len(self)}")

    def __getitem__(self, index: Any) -> Any:
        self._require(index)
        return super().__getitem__(index)

    def __setitem__(self, index: Any, value: Any) -> None:
        self._require(index)
        super().__setitem__(index, value)


def ground(end: tuple[int, ...]) -> Ground:
    """Return tissue with a tube of air from a voxel to the middle of the image and on to its other side."""
    hu = np.full(SHAPE, 40, dtype=np.int16)
    last = np.array(SHAPE) - 1
    for share in np.linspace(0.0, 1.0, 12):
        hu[tuple(np.rint(np.array(end) * (1.0 - share) + (last - end) * share).astype(int))] = -1000
    depth = np.where(hu < 0, 700, 0).astype(np.int16)
    return Ground(
        hu=hu,
        smooth=hu,
        depth=depth,
        lung=np.zeros(SHAPE, dtype=np.bool_),
        spacing_mm=np.full(3, 0.75),
        lung_hu=-850.0,
        dark_hu=-925.0,
        least_depth=20.0,
    )


def _run(code: str, *words: str, **settings: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code, *words], env=os.environ | settings, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.slow
def test_growth_keeps_within_its_arrays_at_every_border() -> None:
    _run(PURE_PYTHON, NUMBA_DISABLE_JIT="1")


@pytest.mark.slow
def test_all_kernels_keep_within_their_arrays(tmp_path: Path) -> None:
    cache = tmp_path / "compiled"
    _run(COMPILED, str(tmp_path / "patient"), NUMBA_BOUNDSCHECK="1", NUMBA_CACHE_DIR=str(cache))


def test_an_index_beyond_either_end_is_refused() -> None:
    values = np.zeros(4).view(Checked)
    for index in (-1, 4):
        with pytest.raises(IndexError):
            values[index]
