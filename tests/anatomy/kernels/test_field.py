"""Exact local search and label lookup, against trying every voxel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from anatomy.base.typed import Float
from anatomy.fields import corner_geometry, distance_field
from anatomy.grid import Grid
from anatomy.kernels.field import distance_bound, exact_at, exact_distance, label_at, least_exact
from anatomy.kernels.labels import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL
from tests.anatomy.boxes import boxes_mm, edge_mm, in_grid_mm, rotated_grid

KINDS = np.array(
    [
        0,
        VESSEL,
        OUTSIDE,
        FISSURE,
        VESSEL | OUTSIDE,
        AIRWAY | 1 << BRANCH_SHIFT,
        AIRWAY | LUMEN | 1 << BRANCH_SHIFT,
        AIRWAY | 2 << BRANCH_SHIFT,
        AIRWAY | VESSEL | 2 << BRANCH_SHIFT,
        AIRWAY | LUMEN | 3 << BRANCH_SHIFT,
    ],
    dtype=np.uint16,
)
BITS = [
    AIRWAY,
    VESSEL,
    OUTSIDE,
    LUMEN,
    AIRWAY | VESSEL,
    AIRWAY | VESSEL | OUTSIDE,
    AIRWAY | VESSEL | OUTSIDE | FISSURE,
]


@dataclass(frozen=True, eq=False)
class Labelled:
    grid: Grid
    labels: np.ndarray
    points_lps: Float


@st.composite
def labelled(draw: st.DrawFn, *, beyond: float = 1.0) -> Labelled:
    """Draw label volumes on turned grids, with points up to `beyond` voxels off the grid."""
    shape = draw(st.tuples(*[st.integers(1, 5)] * 3))
    kinds = draw(arrays(np.uint8, shape, elements=st.integers(0, len(KINDS) - 1), fill=st.just(0)))
    spacing = np.array(draw(st.tuples(*[st.floats(0.3, 2.5)] * 3)))
    turn = np.array(draw(st.tuples(*[st.floats(-3.0, 3.0)] * 3)))
    grid = rotated_grid(shape, spacing, turn, np.array([-120.0, 35.0, 800.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ijk = rng.uniform(-0.5 - beyond, np.array(shape) - 0.5 + beyond, (40, 3))
    return Labelled(grid=grid, labels=np.asfortranarray(KINDS[kinds]), points_lps=grid.lps(ijk))


def _expected(scene: Labelled, bits: int, exempt: int, cap: float) -> Float:
    hit = scene.labels & bits
    spared = (hit == AIRWAY) & (scene.labels >> BRANCH_SHIFT == exempt + 1) & (exempt >= 0)
    distance = boxes_mm((hit != 0) & ~spared, scene.grid, scene.points_lps)
    if bits & OUTSIDE:
        distance = np.minimum(distance, edge_mm(scene.grid, scene.points_lps))
    return np.minimum(distance, cap)


@given(scene=labelled(), bits=st.sampled_from(BITS), exempt=st.integers(-1, 2), cap=st.floats(0.05, 8.0))
def test_exact_distance_is_that_of_trying_every_voxel(
    scene: Labelled, bits: int, exempt: int, cap: float
) -> None:
    found = np.zeros(len(scene.points_lps))
    exact_at(scene.labels, corner_geometry(scene.grid), scene.points_lps, bits, exempt, cap, found)
    np.testing.assert_allclose(found, _expected(scene, bits, exempt, cap), atol=1e-7)


@given(
    scene=labelled(),
    bits=st.sampled_from(BITS),
    exempt=st.integers(-1, 2),
    cap=st.floats(0.05, 8.0),
    tight=st.floats(0.0, 1.0),
)
def test_the_least_is_that_of_all_to_the_last_bit(
    scene: Labelled, bits: int, exempt: int, cap: float, tight: float
) -> None:
    geometry, points = corner_geometry(scene.grid), scene.points_lps
    all_of_them = np.zeros(len(points))
    exact_at(scene.labels, geometry, points, bits, exempt, cap, all_of_them)
    bounds = all_of_them * np.random.default_rng(0).uniform(tight, 1.0, len(points))
    order = np.argsort(bounds, kind="stable")
    found = least_exact(scene.labels, geometry, points, order, bounds, bits, exempt, cap)
    assert found == min(all_of_them.min(), cap)


@given(scene=labelled(), bits=st.sampled_from(BITS), exempt=st.integers(-1, 2))
def test_the_label_is_that_of_a_nearest_voxel(scene: Labelled, bits: int, exempt: int) -> None:
    geometry = corner_geometry(scene.grid)
    cap = 3.0
    for point in scene.points_lps[:10]:
        distance, label = exact_distance(scene.labels, geometry, *point, bits, exempt, cap)
        if label == 0:
            assert distance == cap
            continue
        assert label & bits
        same = boxes_mm(scene.labels == label, scene.grid, point[None])[0]
        at_edge = edge_mm(scene.grid, point[None])[0] if label == OUTSIDE else math.inf
        assert min(same, at_edge) == pytest.approx(distance, abs=1e-7)


@given(scene=labelled(beyond=0.0), bits=st.sampled_from(BITS))
def test_bound_of_a_field_is_never_above_the_exact_search(scene: Labelled, bits: int) -> None:
    border = np.ones(scene.labels.shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    labels = np.asfortranarray(np.where(border, scene.labels | OUTSIDE, scene.labels).astype(np.uint16))
    field = distance_field("test", (labels & bits) != 0, scene.grid)
    for point in scene.points_lps[:10]:
        exact, _label = exact_distance(labels, field.geometry, *point, bits, -1, 300.0)
        assert distance_bound(field.corners, field.geometry, *point) <= exact + 1e-9


@given(scene=labelled())
def test_label_at_is_the_label_of_the_voxel(scene: Labelled) -> None:
    voxel = np.floor(in_grid_mm(scene.grid, scene.points_lps) / scene.grid.spacing_mm).astype(int)
    inside = ((voxel >= 0) & (voxel < scene.grid.shape)).all(axis=1)
    geometry = corner_geometry(scene.grid)
    for point, index, held in zip(scene.points_lps, voxel, inside, strict=True):
        expected = scene.labels[tuple(index)] if held else OUTSIDE
        assert label_at(scene.labels, geometry, *point) == expected


def _unit_scene() -> tuple[np.ndarray, Float]:
    """Return 6 x 6 x 6 voxels of 1 mm from corner (0, 0, 0), with branch 4's wall at i = 1, and geometry."""
    grid = Grid.from_spacing((6, 6, 6), (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
    labels = np.zeros(grid.shape, dtype=np.uint16, order="F")
    labels[1] = AIRWAY | 5 << BRANCH_SHIFT
    return labels, corner_geometry(grid)


def test_an_exempt_wall_is_passed_over_but_not_what_else_lies_there() -> None:
    labels, geometry = _unit_scene()
    labels[1, 3, 3] |= VESSEL
    bits = AIRWAY | VESSEL
    assert exact_distance(labels, geometry, 4.0, 3.5, 3.5, bits, -1, 9.0)[0] == pytest.approx(2.0)
    assert exact_distance(labels, geometry, 4.0, 3.5, 3.5, bits, 3, 9.0)[0] == pytest.approx(2.0)
    distance, label = exact_distance(labels, geometry, 4.0, 0.5, 3.5, bits, 4, 9.0)
    assert distance == pytest.approx(math.hypot(2.0, 2.5))
    assert label == AIRWAY | VESSEL | 5 << BRANCH_SHIFT
    assert exact_distance(labels, geometry, 4.0, 0.5, 3.5, AIRWAY, 4, 9.0) == (9.0, 0)


def test_space_beyond_the_grid_is_outside() -> None:
    labels, geometry = _unit_scene()
    assert exact_distance(labels, geometry, 5.75, 3.0, 3.0, OUTSIDE, -1, 9.0) == (0.25, OUTSIDE)
    assert exact_distance(labels, geometry, 6.5, 3.0, 3.0, OUTSIDE, -1, 9.0) == (0.0, OUTSIDE)
    assert exact_distance(labels, geometry, math.nan, 3.0, 3.0, OUTSIDE, -1, 9.0) == (0.0, OUTSIDE)


def test_other_structures_are_found_from_beyond_the_grid() -> None:
    labels, geometry = _unit_scene()
    distance, label = exact_distance(labels, geometry, -0.5, 3.0, 3.0, AIRWAY, -1, 9.0)
    assert (distance, label >> BRANCH_SHIFT) == (1.5, 5)
    assert exact_distance(labels, geometry, 1e6, 3.0, 3.0, AIRWAY, -1, 9.0) == (9.0, 0)
    assert exact_distance(labels, geometry, math.nan, 3.0, 3.0, AIRWAY, -1, 9.0) == (9.0, 0)


def test_a_voxel_at_the_cap_is_too_far() -> None:
    labels, geometry = _unit_scene()
    assert exact_distance(labels, geometry, 4.0, 3.0, 3.0, AIRWAY, -1, 2.0) == (2.0, 0)
    assert exact_distance(labels, geometry, 4.0, 3.0, 3.0, AIRWAY, -1, 2.0 + 1e-9)[1] != 0


def test_labels_beyond_the_grid_and_of_no_place_are_outside() -> None:
    labels, geometry = _unit_scene()
    labels[:] = LUMEN
    for point in [(-1e-9, 3, 3), (6.0, 3, 3), (3, 1e300, 3), (3, 3, -math.inf), (math.nan, 3, 3)]:
        assert label_at(labels, geometry, *map(float, point)) == OUTSIDE
    for point in [(0.0, 0.0, 0.0), (5.999, 5.999, 5.999)]:
        assert label_at(labels, geometry, *point) == LUMEN
