"""The septum: between lungs that touch, nowhere else, and without a leak."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.sides import border_of, coarse_sides

LEFT, RIGHT = (32.0, 0.0, 0.0), (-32.0, 0.0, 0.0)


class Chest:
    """Ellipsoids and boxes on a grid around LPS 0, 0, 0."""

    def __init__(self, spacing_mm: Sequence[float], size_mm: Sequence[float] = (140.0, 90.0, 110.0)) -> None:
        spacing, size = np.asarray(spacing_mm), np.asarray(size_mm)
        shape = np.ceil(size / spacing).astype(int)
        self.grid = Grid.from_spacing(shape, spacing, -spacing * (shape - 1) / 2)
        self.points: Float = self.grid.lps(np.stack(np.indices(self.grid.shape), axis=-1))
        self.lung = np.zeros(self.grid.shape, dtype=bool, order="F")
        self.airway = np.zeros(self.grid.shape, dtype=bool, order="F")

    def ellipsoid(self, centre: Sequence[float], radii: Sequence[float]) -> Chest:
        """Add an ellipsoid of lung."""
        self.lung |= (((self.points - centre) / np.asarray(radii)) ** 2).sum(axis=-1) <= 1.0
        return self

    def box(self, low: Sequence[float], high: Sequence[float]) -> Chest:
        """Add the voxels whose centres lie in a box to the lung."""
        self.lung |= self._box(low, high)
        return self

    def bronchus(self, low: Sequence[float], high: Sequence[float]) -> Chest:
        """Add a box to the airway, within the lung mask as filled masks have it."""
        self.airway |= self._box(low, high)
        self.lung |= self.airway
        return self

    def _box(self, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
        return np.asarray(((self.points >= low) & (self.points <= high)).all(axis=-1))

    def septum(self) -> np.ndarray | None:
        return _septum(self.lung, self.airway, self.grid)

    def parts_at(self, border: np.ndarray | None, *points: Sequence[float]) -> list[int]:
        """Return in which part of the lung, without airway and border, points lie; faces connect."""
        open_space = self.lung & ~self.airway
        if border is not None:
            open_space &= ~border
        parts, _count = ndimage.label(open_space)
        return [int(parts[tuple(np.rint(self.grid.ijk(point)).astype(int))]) for point in points]


def _septum(lung: np.ndarray, airway: np.ndarray, grid: Grid) -> np.ndarray | None:
    found = coarse_sides(lung & ~airway, grid)
    return None if found is None else border_of(*found, lung & ~airway)


def _touching(spacing_mm: Sequence[float]) -> Chest:
    return Chest(spacing_mm).ellipsoid(LEFT, (35, 38, 48)).ellipsoid(RIGHT, (35, 38, 48))


@pytest.mark.parametrize("spacing", [(1.6, 1.6, 1.6), (0.75, 0.75, 1.0), (1.1, 1.1, 2.5), (3.0, 3.0, 3.0)])
def test_touching_lungs_get_a_septum_where_they_meet(spacing: tuple[float, ...]) -> None:
    chest = _touching(spacing)
    assert len(set(chest.parts_at(None, LEFT, RIGHT))) == 1
    border = chest.septum()
    assert border is not None
    left, right = chest.parts_at(border, LEFT, RIGHT)
    assert left and right and left != right
    assert not (border & ~chest.lung).any()
    # The ellipsoids meet in the plane x = 0; the septum is one layer of voxels on either side of it.
    coarse_mm = max(spacing) + 1.6
    assert np.abs(chest.points[border][:, 0]).max() <= coarse_mm
    lines = border.sum(axis=0)[chest.lung[len(chest.lung) // 2]]
    assert 1 <= np.median(lines) <= 3


def test_a_septum_costs_little_tissue() -> None:
    chest = _touching((1.6, 1.6, 1.6))
    border = chest.septum()
    assert border is not None
    assert border.sum() < 0.02 * chest.lung.sum()


def test_separate_lungs_get_none() -> None:
    chest = Chest((1.5, 1.5, 1.5)).ellipsoid(LEFT, (26, 38, 48)).ellipsoid(RIGHT, (26, 38, 48))
    border = chest.septum()
    assert border is not None
    assert not border.any()


def test_a_slit_thinner_than_a_coarse_voxel_keeps_lungs_apart() -> None:
    """At 0.7 mm two voxels are looked at as one, and the slit of one voxel disappears there."""
    chest = Chest((0.7, 0.7, 0.7), (100.0, 50.0, 50.0))
    chest.box((-45, -20, -20), (-0.1, 20, 20)).box((0.8, -20, -20), (45, 20, 20))
    assert chest.parts_at(None, (20, 0, 0), (-20, 0, 0)) == [2, 1]
    border = chest.septum()
    assert border is not None
    assert not border.any()


def test_lungs_joined_by_the_airway_alone_get_none() -> None:
    chest = Chest((1.5, 1.5, 1.5)).ellipsoid(LEFT, (26, 38, 48)).ellipsoid(RIGHT, (26, 38, 48))
    chest.bronchus((-20, -6, -6), (20, 6, 6))
    assert chest.parts_at(None, LEFT, RIGHT)[0] != chest.parts_at(None, LEFT, RIGHT)[1]
    border = chest.septum()
    assert border is not None
    assert not border.any()


@pytest.mark.parametrize("half_width_mm", [3.0, 8.0, 14.0])
def test_a_thick_bridge_is_cut(half_width_mm: float) -> None:
    chest = Chest((1.5, 1.5, 1.5)).ellipsoid(LEFT, (26, 38, 48)).ellipsoid(RIGHT, (26, 38, 48))
    chest.box((-20, -half_width_mm, -half_width_mm), (20, half_width_mm, half_width_mm))
    border = chest.septum()
    assert border is not None
    left, right = chest.parts_at(border, LEFT, RIGHT)
    assert left and right and left != right
    # It is cut across, not along.
    assert np.ptp(chest.points[border][:, 0]) < 12.0
    assert border.sum() <= 3 * (2 * half_width_mm / 1.5 + 1) ** 2


@pytest.mark.slow
@settings(max_examples=25)
@given(
    spacing=st.tuples(*[st.sampled_from([0.5, 0.7, 0.8, 1.0, 1.7])] * 3),
    threads=st.lists(
        st.tuples(st.floats(-14, 14), st.floats(-14, 14), st.sampled_from([0.0, 0.6, 2.0])),
        min_size=1,
        max_size=4,
    ),
)
def test_no_thread_leaks_from_lung_to_lung(
    spacing: tuple[float, ...], threads: list[tuple[float, float, float]]
) -> None:
    """Threads as thin as a voxel join the lungs anywhere, on voxels that coarse sampling would miss."""
    chest = Chest(spacing, (70.0, 40.0, 40.0))
    chest.box((-32, -17, -17), (-4, 17, 17)).box((4, -17, -17), (32, 17, 17))
    step = chest.grid.spacing_mm
    for y, z, half_width in threads:
        # Snapped to a voxel, so that every thread has at least one.
        centre = chest.grid.lps(np.rint(chest.grid.ijk((0.0, y, z))))
        half = half_width + 0.1 * step
        chest.box((-6, *(centre - half)[1:]), (6, *(centre + half)[1:]))
    right, left = (-20.0, 0.0, 0.0), (20.0, 0.0, 0.0)
    assert len(set(chest.parts_at(None, left, right))) == 1
    border = chest.septum()
    assert border is not None
    parts = chest.parts_at(border, left, right)
    assert 0 not in parts and len(set(parts)) == 2


@pytest.mark.parametrize("axes", [(1, 2, 0), (2, 0, 1)])
def test_any_order_of_axes_gives_the_same_sides(axes: tuple[int, int, int]) -> None:
    chest = _touching((1.6, 1.6, 1.6))
    matrix = chest.grid.lps_from_ijk.copy()
    matrix[:3, :3] = matrix[:3, list(axes)]
    turned = Grid(shape=tuple(np.take(chest.grid.shape, axes)), lps_from_ijk=matrix)
    lung, airway = (np.asfortranarray(np.transpose(m, axes)) for m in (chest.lung, chest.airway))
    border = _septum(lung, airway, turned)
    assert border is not None
    parts, _count = ndimage.label(lung & ~border)
    left, right = (parts[tuple(np.rint(turned.ijk(p)).astype(int))] for p in (LEFT, RIGHT))
    assert left and right and left != right


def test_one_lung_is_not_split() -> None:
    assert Chest((2.0, 2.0, 2.0)).ellipsoid((0, 0, 0), (35, 38, 48)).septum() is None


def test_a_lung_and_a_crumb_are_not_two_lungs() -> None:
    chest = Chest((2.0, 2.0, 2.0)).ellipsoid(LEFT, (26, 38, 48)).ellipsoid(RIGHT, (8, 8, 8))
    assert chest.septum() is None


def test_parts_one_above_the_other_are_not_two_lungs() -> None:
    chest = Chest((2.0, 2.0, 2.0)).ellipsoid((0, 0, 28), (30, 30, 24)).ellipsoid((5, 0, -28), (30, 30, 24))
    assert chest.septum() is None


def test_no_tissue_is_no_lung() -> None:
    chest = Chest((2.0, 2.0, 2.0)).bronchus((-20, -6, -6), (20, 6, 6))
    assert chest.septum() is None
