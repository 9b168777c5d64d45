"""Which voxels a stroke means: against exact answers on a small grid of unequal voxels."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.grid import Grid
from anatomy.morphology import Window
from anatomy.strokes import LONGEST_GAP_MM, Stroke, meant_voxels

GRID = Grid.from_spacing((40, 30, 24), [1.0, 1.0, 2.0], [-20.0, -15.0, 5.0])
NOTHING = np.zeros(GRID.shape, dtype=np.bool_)
HU = np.full(GRID.shape, -850.0, dtype=np.float32)
HU[10:30, 12:18, 10:14] = 40.0
HU[28:30, 12:18, 10:14] = 300.0
HU[15, 20, 12] = 45.0


def hu_at(box: Window) -> np.ndarray:
    return np.asarray(HU[box])


def meant(stroke: Stroke, structure: np.ndarray = NOTHING) -> np.ndarray:
    """Return the voxels of a stroke on the whole grid."""
    box, mask = meant_voxels(stroke, GRID, structure, hu_at)
    found = NOTHING.copy()
    found[box] = mask
    return found


def away_mm(point: np.ndarray) -> np.ndarray:
    ijk = np.stack(np.meshgrid(*map(np.arange, GRID.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    return np.linalg.norm(GRID.lps(ijk) - point, axis=1).reshape(GRID.shape)


def test_a_point_is_a_ball_and_a_line_is_all_balls_along_it() -> None:
    one, other = GRID.lps([[12, 10, 12], [25, 18, 10]])
    assert np.array_equal(
        meant(Stroke(tool="paint", points_lps=one[None], radius_mm=4.0)), away_mm(one) <= 4.0
    )
    along = np.linspace(one, other, 2000)
    expected = np.min([away_mm(point) for point in along[::20]], axis=0) <= 4.0
    found = meant(Stroke(tool="paint", points_lps=np.stack([one, other]), radius_mm=4.0))
    assert not (expected & ~found).any()
    assert np.count_nonzero(found & ~expected) < 0.01 * np.count_nonzero(found)
    assert np.count_nonzero(meant(Stroke(tool="paint", points_lps=one[None], radius_mm=0.2))) == 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_stroke_of_one_slice_stays_in_its_voxels(axis: int) -> None:
    point = GRID.lps([20, 15, 12])
    stroke = Stroke(tool="paint", points_lps=point[None], radius_mm=5.0, normal_lps=np.eye(3)[axis])
    expected = NOTHING.copy()
    index = [slice(None)] * 3
    index[axis] = slice((20, 15, 12)[axis], (20, 15, 12)[axis] + 1)
    expected[tuple(index)] = True
    assert np.array_equal(meant(stroke), (away_mm(point) <= 5.0) & expected)


def test_erasing_takes_of_the_structure_alone() -> None:
    structure = NOTHING.copy()
    structure[10:30, 14:16, 12] = True
    point = GRID.lps([20, 15, 12])
    found = meant(Stroke(tool="erase", points_lps=point[None], radius_mm=3.0), structure)
    assert np.array_equal(found, structure & (away_mm(point) <= 3.0))


def test_a_fill_is_limited_by_level_connection_and_reach() -> None:
    point = GRID.lps([15, 15, 12])
    block = (HU == 40.0) & (away_mm(point) <= 9.0)
    assert np.array_equal(meant(Stroke(tool="fill", points_lps=point[None], radius_mm=9.0)), block)
    whole = meant(Stroke(tool="fill", points_lps=point[None], radius_mm=30.0))
    assert np.array_equal(whole, HU == 40.0), "neither the denser end, nor a voxel that touches nothing"
    more = meant(Stroke(tool="fill", points_lps=point[None], radius_mm=30.0, level_hu=261.0))
    assert np.array_equal(more, (HU == 40.0) | (HU == 300.0))


def test_a_cut_frees_what_hangs_on_it_and_nothing_that_hung_on_nothing() -> None:
    structure = NOTHING.copy()
    structure[2:30, 14:17, 12] = True
    structure[35:38, 14:17, 12] = True
    point = GRID.lps([20, 15, 12])
    found = meant(Stroke(tool="cut", points_lps=point[None], radius_mm=2.5), structure)
    assert found[21:30, 14:17, 12].all()
    assert not found[2:17].any(), "the larger part stays"
    assert not found[35:38].any(), "the crumb was not freed by this cut"


def test_a_bridge_follows_the_air() -> None:
    before = HU.copy()
    try:
        HU[:] = 0.0
        HU[5:16, 10, 12] = HU[15, 10:21, 12] = HU[15:31, 20, 12] = -1000.0
        ends = GRID.lps([[5, 10, 12], [30, 20, 12]])
        found = meant(Stroke(tool="join", points_lps=ends, radius_mm=0.4))
        assert found[5, 10, 12] and found[30, 20, 12]
        assert np.count_nonzero(found & (HU == 0.0)) <= 0.2 * np.count_nonzero(found)
    finally:
        HU[:] = before


def test_what_cannot_be_meant_is_refused_in_words() -> None:
    outside = Stroke(tool="paint", points_lps=np.array([[500.0, 0.0, 0.0]]), radius_mm=2.0)
    with pytest.raises(SettingsError, match="leaves the box"):
        meant(outside)
    far = Stroke(tool="join", points_lps=GRID.lps([[0, 0, 0], [39, 29, 23]]), radius_mm=1.0)
    with pytest.raises(SettingsError, match=f"at most {LONGEST_GAP_MM:.0f} mm"):
        meant(far)
