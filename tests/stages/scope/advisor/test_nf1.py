"""The navigation field against Dijkstra's algorithm of other libraries, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from anatomy.base.errors import AnatomyError, TargetError
from anatomy.grid import Grid, Volume
from stages.scope.advisor.lumen import Lumen, lumen_of_mask
from stages.scope.advisor.nf1 import Kind, entering_costs, goal_at, navigation_field
from tests.stages.scope.airways import tube, wall_mm

SIDES = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))


@st.composite
def lumens(draw: st.DrawFn) -> Lumen:
    """Random caves: voxels of any size, open with a chance of a half to all, the piece around one of them."""
    seed = draw(st.integers(0, 2**32 - 1))
    shape = tuple(draw(st.integers(1, 9)) for _ in range(3))
    spacing = [draw(st.floats(0.2, 3.0)) for _ in range(3)]
    rng = np.random.default_rng(seed)
    mask = rng.random(shape) < draw(st.floats(0.5, 1.0))
    mask[tuple(rng.integers(0, shape))] = True
    grid = Grid.from_spacing(shape, spacing, rng.uniform(-50, 50, 3))
    voxels = np.argwhere(mask)
    return lumen_of_mask(Volume(grid=grid, array=mask), grid.lps(voxels[rng.integers(len(voxels))]))


def dijkstra_of(lumen: Lumen, steps: np.ndarray, weights: np.ndarray, goal: int) -> np.ndarray:
    """Solve the shortest-path problem from the voxels' indices alone."""
    number = {tuple(voxel): n for n, voxel in enumerate(lumen.voxels.tolist())}
    rows, columns, costs = [], [], []
    for voxel, n in number.items():
        for side in SIDES:
            other = number.get(tuple(int(a) + b for a, b in zip(voxel, side, strict=True)))
            if other is not None:
                rows.append(n)
                columns.append(other)
                costs.append(steps[np.flatnonzero(side)[0]] * weights[other])
    graph = csr_matrix((costs, (rows, columns)), shape=(lumen.count, lumen.count))
    return dijkstra(graph, indices=goal)


@pytest.mark.slow
@given(lumen=lumens(), data=st.data())
def test_the_field_is_dijkstras_to_the_last_bit(lumen: Lumen, data: st.DataObject) -> None:
    goal = data.draw(st.integers(0, lumen.count - 1))
    for metric, steps in (("mm", lumen.grid.spacing_mm), ("voxels", np.ones(3))):
        field = navigation_field(lumen, goal, metric=metric)
        costs = entering_costs(field.clearance, field.largest_clearance)
        np.testing.assert_array_equal(field.potential, dijkstra_of(lumen, steps, costs, goal))
        plain = navigation_field(lumen, goal, kind="plain", metric=metric)
        np.testing.assert_array_equal(plain.potential, dijkstra_of(lumen, steps, np.ones(lumen.count), goal))


@given(lumen=lumens(), data=st.data())
def test_only_the_goal_is_a_local_minimum(lumen: Lumen, data: st.DataObject) -> None:
    goal = data.draw(st.integers(0, lumen.count - 1))
    field = navigation_field(lumen, goal)
    assert np.isfinite(field.potential).all()
    neighbours = np.where(lumen.neighbours < 0, np.inf, field.potential[lumen.neighbours])
    lower = (neighbours < field.potential[:, None]).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(~lower), [goal])


@given(lumen=lumens())
def test_clearance_is_the_taxicab_distance(lumen: Lumen) -> None:
    inside = np.pad(lumen.index >= 0, 1)
    expected = ndimage.distance_transform_cdt(inside, metric="taxicab")[1:-1, 1:-1, 1:-1]
    np.testing.assert_array_equal(lumen.steps_to_wall, expected[tuple(lumen.voxels.T)])
    walls = np.argwhere(~inside) - 1
    spacing = lumen.grid.spacing_mm
    for n in range(0, lumen.count, 7):
        away = (np.abs(walls - lumen.voxels[n]) * spacing).sum(axis=1)
        assert lumen.clearance(spacing)[n] == pytest.approx(away.min(), abs=1e-9)


@given(lumen=lumens(), data=st.data())
def test_the_widest_way_is_where_thresholds_part_the_lumen(lumen: Lumen, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, lumen.count - 1))
    width = lumen.width_from(start)
    assert (width <= lumen.depth_mm + 1e-12).all()
    for level in np.unique(width):
        open_voxels = np.zeros(lumen.grid.shape, dtype=bool)
        wide = np.floor(lumen.depth_mm * 256.0) / 256.0 >= level
        open_voxels[tuple(lumen.voxels[wide].T)] = True
        parts, _ = ndimage.label(open_voxels)
        at = parts[tuple(lumen.voxels.T)]
        np.testing.assert_array_equal(width >= level, (at == at[start]) & (at > 0))


@given(lumen=lumens())
def test_depth_at_centres_is_exact_where_it_is_narrow(lumen: Lumen) -> None:
    true = wall_mm(lumen, lumen.centres())
    assert (lumen.depth_mm <= true + 1e-6).all()
    narrow = true < 1.4
    np.testing.assert_allclose(lumen.depth_mm[narrow], true[narrow], atol=1e-6)


def test_every_voxel_of_a_piece_is_numbered_in_raster_order() -> None:
    mask = np.zeros((4, 5, 6), dtype=bool)
    mask[1, 1:4, 2] = mask[1:3, 3, 2] = mask[3, 0, 5] = True
    lumen = lumen_of_mask(
        Volume(grid=Grid.from_spacing(mask.shape, [1, 2, 3], [0, 0, 0]), array=mask), [1, 2, 6]
    )
    assert lumen.count == 4
    assert lumen.voxels_dropped == 1
    assert lumen.voxels.tolist() == sorted(lumen.voxels.tolist())
    assert (lumen.index[tuple(lumen.voxels.T)] == np.arange(4)).all()
    assert [lumen.voxel_at(point) for point in lumen.centres()] == [0, 1, 2, 3]
    assert lumen.voxel_at([100.0, 0.0, 0.0]) == -1


def test_equation_2() -> None:
    """Below 0.9 C_max a step costs 1 - c / C_max, above 0.1, and so does the limit from below."""
    clearance = np.array([1.0, 4.0, 8.999, 9.0, 10.0, 20.0])
    np.testing.assert_allclose(entering_costs(clearance, 10.0), [0.9, 0.6, 0.1001, 0.1, 0.1, 0.1])


def test_clearance_leads_away_from_the_wall_where_nf1_grazes_it() -> None:
    """Fig. 4: round the corner of two wide corridors, so tall that floor and ceiling do not count."""
    flat = np.zeros((40, 40), dtype=bool)
    flat[2:13, 2:38] = flat[2:38, 27:38] = True
    tall = np.repeat(flat[:, :, None], 41, axis=2)
    grid = Grid.from_spacing(tall.shape, [1, 1, 1], [0, 0, 0])
    lumen = lumen_of_mask(Volume(grid=grid, array=tall), [5, 5, 20])
    to_wall = ndimage.distance_transform_cdt(flat, metric="taxicab")
    goal, start = lumen.voxel_at([36, 32, 20]), lumen.voxel_at([7, 3, 20])
    away: dict[Kind, list[int]] = {"plain": [], "clearance": []}
    for kind, list_of in away.items():
        field = navigation_field(lumen, goal, kind=kind, metric="voxels")
        route = lumen.grid.ijk(field.route(start)).round().astype(int)
        list_of += [int(to_wall[i, j]) for i, j, _ in route]
    assert min(away["clearance"][5:-5]) > min(away["plain"][5:-5])
    assert np.mean(away["clearance"]) > np.mean(away["plain"]) + 1.0


def test_the_goal_is_the_lumen_voxel_nearest_to_the_lesions_centre() -> None:
    lumen, _tree = tube(3.0, 20.0)
    inside = goal_at(lumen, [2.6, 0.1, -10.2], 2.0)
    away = np.linalg.norm(lumen.centres() - [2.6, 0.1, -10.2], axis=1)
    assert inside.voxel == int(np.argmin(away))
    assert inside.distance_mm == away.min()
    assert inside.in_lesion
    outside = goal_at(lumen, [9.0, 0.0, -10.2], 2.0)
    assert not outside.in_lesion, "the lesion touches no lumen: the nearest lumen point answers"
    assert 5.0 < outside.distance_mm < 7.0
    assert outside.centre_lps[0] == lumen.centres()[:, 0].max()


def test_voxels_of_the_lesion_where_a_scope_fits_come_first() -> None:
    lumen, _tree = tube(3.0, 20.0)
    lesion, radius = np.array([2.8, 0.0, -10.2]), 2.5
    roomy = lumen.width_from(int(np.argmax(lumen.depth_mm))) >= 1.5
    chosen = goal_at(lumen, lesion, radius, preferred=roomy)
    assert roomy[chosen.voxel]
    assert not roomy[goal_at(lumen, lesion, radius).voxel]
    away = np.linalg.norm(lumen.centres() - lesion, axis=1)
    assert chosen.distance_mm == away[roomy].min()
    too_small = goal_at(lumen, lesion, 0.5, preferred=roomy)
    assert too_small.voxel == goal_at(lumen, lesion, 0.5).voxel, "none of them lies in the lesion"


@pytest.mark.parametrize(("centre", "radius"), [([0, 0, np.nan], 1.0), ([0, 0, 0], -1.0), ([0, 0], 1.0)])
def test_a_lesion_that_is_no_sphere_is_refused(centre: list[float], radius: float) -> None:
    with pytest.raises(TargetError, match="no sphere"):
        goal_at(tube(3.0, 20.0)[0], centre, radius)


def test_bad_lumens_and_goals_are_refused() -> None:
    empty = Volume(grid=Grid.from_spacing((3, 3, 3), [1, 1, 1], [0, 0, 0]), array=np.zeros((3, 3, 3), bool))
    with pytest.raises(AnatomyError, match="empty"):
        lumen_of_mask(empty, [0, 0, 0])
    with pytest.raises(TargetError, match="no interior voxel"):
        navigation_field(tube(3.0, 20.0)[0], -1)
