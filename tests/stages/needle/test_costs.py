"""Exact costs of paths: the voxels they cross against closed forms and dense samples, sums and integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float
from anatomy.fields import CENTRES, corner_geometry
from anatomy.grid import Grid, Volume
from anatomy.structures import VESSEL
from stages.needle.costs import (
    InTissue,
    _crossings,
    inverse_clearance,
    map_integral,
    obstacle_clearance_mm,
    path_costs,
    voxel_sum,
)
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.kernels import cost as kernel
from stages.needle.kernels import tree
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import RestartingRRT
from tests.stages.scenes import Canvas

UNIT = Grid.from_spacing((40, 40, 40), (1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
"""Voxel `i` spans `i <= x <= i + 1`, in mm."""

CURVATURES = st.sampled_from([0.0, 1e-7, 1 / 121, 0.05, 0.2])
ARCS = st.lists(
    st.tuples(st.floats(0.05, 25.0), st.floats(-math.pi, math.pi), CURVATURES), min_size=1, max_size=3
)


def start(position: list[float], direction: list[float]) -> Float:
    """A pose that looks along a direction."""
    z = np.array(direction) / np.linalg.norm(direction)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.align_vectors(z[None], np.array([[0.0, 0, 1]]))[0].as_matrix()
    frame[:3, 2] = z
    frame[:3, 3] = position
    return frame


def line(position: list[float], direction: list[float], length: float) -> ArcPath:
    return ArcPath(lps_from_start=start(position, direction), arcs=np.array([[length, 0.0, 0.0]]))


def voxels_crossed(grid: Grid, path: ArcPath) -> np.ndarray:
    """Return the indices `(V, 3)` of the voxels that hold more than 1e-9 mm of an arc or an end of one."""
    voxels = np.unique(_crossings(grid, path)[0])
    return np.stack(np.unravel_index(voxels[voxels != kernel.OFF_GRID], grid.shape, order="F"), axis=1)


def crossed(grid: Grid, path: ArcPath) -> set[tuple[int, ...]]:
    return {tuple(v) for v in voxels_crossed(grid, path).tolist()}


def tilted_grid(seed: int) -> Grid:
    """Unequal voxel sides, axes in any direction, the origin somewhere in the middle."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed).as_matrix() * rng.uniform(0.4, 3.0, 3)
    shape = np.array([60, 50, 70])
    matrix[:3, 3] = matrix[:3, :3] @ (-0.5 * shape + rng.uniform(-1, 1, 3))
    return Grid(shape=tuple(shape.tolist()), lps_from_ijk=matrix)


def a_map(grid: Grid, seed: int = 0) -> Volume:
    values = np.random.default_rng(seed).random(grid.shape).astype(np.float32)
    return Volume(grid=grid, array=values)


class TestClosedForms:
    """Where the voxels can be told by hand."""

    @pytest.mark.parametrize("axis", range(3))
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_along_an_axis(self, axis: int, sign: float) -> None:
        """From the middle of voxel 5 or 25 over 12 voxel sides to the middle of another."""
        position, direction = [7.5, 7.5, 7.5], [0.0, 0.0, 0.0]
        position[axis], direction[axis] = (5.5, 1.0) if sign > 0 else (25.5, -1.0)
        expected = set()
        for n in range(13):
            voxel = [7, 7, 7]
            voxel[axis] = 5 + n if sign > 0 else 25 - n
            expected.add(tuple(voxel))
        assert crossed(UNIT, line(position, direction, 12.0)) == expected

    def test_lengths_along_an_axis(self) -> None:
        voxels, lengths, pieces = kernel.voxels_on_arc(
            UNIT.shape, corner_geometry(UNIT), (3.25, 8.5, 9.5, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), 2.5
        )
        assert voxels.tolist() == [n + 40 * (8 + 40 * 9) for n in (3, 4, 5)]
        assert lengths.tolist() == [0.75, 1.0, 0.75] and pieces == 1

    @pytest.mark.parametrize("signs", [(1, 1, 1), (1, 1, -1), (-1, 1, 1), (1, -1, -1), (-1, -1, -1)])
    def test_along_the_diagonal_of_space(self, signs: tuple[int, ...]) -> None:
        """Through corners: the voxels that are touched there are not crossed."""
        path = line([20.5, 20.5, 20.5], list(signs), 8 * math.sqrt(3))
        assert crossed(UNIT, path) == {tuple(20 + s * n for s in signs) for n in range(9)}

    def test_along_the_diagonal_of_a_plane(self) -> None:
        path = line([20.5, 20.5, 3.2], [1.0, -1.0, 0.0], 6 * math.sqrt(2))
        assert crossed(UNIT, path) == {(20 + n, 20 - n, 3) for n in range(7)}

    def test_a_slope_of_one_half(self) -> None:
        """x from 0.5 to 4.5, y from 0.25 to 2.25: faces of y at x = 2 (where x has one too) and 4."""
        path = line([0.5, 0.25, 0.5], [2.0, 1.0, 0.0], math.hypot(4.0, 2.0))
        assert crossed(UNIT, path) == {(0, 0, 0), (1, 0, 0), (2, 1, 0), (3, 1, 0), (4, 2, 0)}

    def test_half_a_circle(self) -> None:
        """Of radius 3 about (20, 10) in the plane z = 5.5, from (20, 7) to (20, 13) through (23, 10)."""
        frame = np.eye(4)
        frame[:3, 0], frame[:3, 1], frame[:3, 2] = [0, 1, 0], [0, 0, 1], [1, 0, 0]
        frame[:3, 3] = [20.0, 7.0 + 1e-3, 5.5]
        radius = 3.0 - 1e-3
        path = ArcPath(lps_from_start=frame, arcs=np.array([[math.pi * radius, 0.0, 1 / radius]]))
        assert crossed(UNIT, path) == {
            (20, 7, 5), (21, 7, 5), (22, 7, 5), (22, 8, 5), (22, 9, 5), (22, 10, 5), (22, 11, 5),
            (22, 12, 5), (21, 12, 5), (20, 12, 5),
        }  # fmt: skip

    def test_a_bulge_through_a_face_comes_back_to_its_voxel(self) -> None:
        """A chord of 0.8 mm at y = 9.999, an arc of radius 5 over it: 0.016 mm high."""
        half, radius = 0.4, 5.0
        angle = math.asin(half / radius)
        frame = start([12.1, 9.999, 4.5], [math.cos(angle), math.sin(angle), 0.0])
        roll = _roll_towards(frame, [math.sin(angle), -math.cos(angle), 0.0])
        path = ArcPath(lps_from_start=frame, arcs=np.array([[2 * angle * radius, roll, 1 / radius]]))
        assert np.allclose(path.frames()[-1][:3, 3], [12.9, 9.999, 4.5])
        assert crossed(UNIT, path) == {(12, 9, 4), (12, 10, 4)}
        ones = Volume(grid=UNIT, array=np.ones(UNIT.shape, dtype=np.float32))
        assert voxel_sum(ones, path) == 2.0
        assert self._sum_of_arc(path, first=True) == 2.0
        assert self._sum_of_arc(path, first=False) == 1.0, "without the voxel it starts and ends in"

    @staticmethod
    def _sum_of_arc(path: ArcPath, *, first: bool) -> float:
        frame, (length, roll, kappa) = path.lps_from_start, path.arcs[0]
        bend = math.cos(roll) * frame[:3, 0] + math.sin(roll) * frame[:3, 1]
        ones = np.ones(UNIT.shape, dtype=np.float32, order="F")
        pose = tuple(float(v) for v in (*frame[:3, 3], *frame[:3, 2]))
        return float(
            kernel.map_costs_on_arc(
                ones, corner_geometry(UNIT), pose, (float(kappa), *map(float, bend)), float(length), first
            )[1]
        )

    def test_a_whole_circle_and_more_crosses_each_voxel_once(self) -> None:
        frame = np.eye(4)
        frame[:3, 3] = [20.2, 20.3, 20.4]
        once = ArcPath(lps_from_start=frame, arcs=np.array([[2 * math.pi * 6.0, 0.7, 1 / 6.0]]))
        more = ArcPath(lps_from_start=frame, arcs=np.array([[5 * math.pi * 6.0, 0.7, 1 / 6.0]]))
        assert crossed(UNIT, once) == crossed(UNIT, more)
        costs = a_map(UNIT)
        assert voxel_sum(costs, more) == pytest.approx(voxel_sum(costs, once))
        assert map_integral(costs, more) > 2.4 * map_integral(costs, once)

    def test_an_end_on_a_face_lies_in_the_voxel_above(self) -> None:
        assert crossed(UNIT, line([3.5, 3.5, 3.0], [0, 0, 1.0], 2.0)) == {(3, 3, 3), (3, 3, 4), (3, 3, 5)}
        assert crossed(UNIT, line([3.5, 3.5, 5.0], [0, 0, -1.0], 2.0)) == {(3, 3, 3), (3, 3, 4), (3, 3, 5)}

    def test_along_a_face(self) -> None:
        """The voxels of one side of it."""
        found = crossed(UNIT, line([3.0, 3.5, 3.5], [0, 0, 1.0], 4.0))
        assert found == {(3, 3, n) for n in range(3, 8)}


def _roll_towards(frame: Float, direction: list[float]) -> float:
    return math.atan2(float(frame[:3, 1] @ direction), float(frame[:3, 0] @ direction))


def depth_in(grid: Grid, points: Float, voxel: tuple[int, ...]) -> Float:
    """How deep points lie in a voxel, in voxels; negative outside."""
    return np.asarray((0.5 - np.abs(grid.ijk(points) - np.array(voxel))).min(axis=1))


def really_enters(grid: Grid, path: ArcPath, voxel: tuple[int, ...], middle: float) -> bool:
    """Tell whether the path is in a voxel near the arc length `middle`, in steps of 1e-8 mm."""
    frames, ends = path.frames(), np.concatenate([[0.0], np.cumsum(path.arcs[:, 0])])
    for frame, (length, roll, kappa), begin in zip(frames, path.arcs, ends, strict=False):
        low, high = max(middle - 2e-4 - begin, 0.0), min(middle + 2e-4 - begin, length)
        if low <= high:
            s = np.linspace(low, high, 40001)
            bend = math.cos(roll) * frame[:3, 0] + math.sin(roll) * frame[:3, 1]
            ahead = s * np.sinc(kappa * s / np.pi)
            aside = s * np.sin(0.5 * kappa * s) * np.sinc(0.5 * kappa * s / np.pi)
            near = frame[:3, 3] + ahead[:, None] * frame[:3, 2] + aside[:, None] * bend
            if depth_in(grid, near, voxel).max() >= -1e-9:
                return True
    return False


@given(arcs=ARCS, seed=st.integers(0, 10**6))
@settings(max_examples=40)
def test_the_voxels_are_those_of_dense_samples(arcs: list[tuple[float, float, float]], seed: int) -> None:
    """In steps of 1e-4 mm; what these miss is looked at again, and what the kernel misses lies on a face."""
    grid = tilted_grid(seed % 50)
    shorter = np.array(arcs) * [0.3, 1.0, 1.0]
    path = ArcPath(lps_from_start=start([0.1, 0.2, 0.3], _direction(seed)), arcs=shorter)
    assume(grid.contains(path.sample(0.1)[0]).all())
    points, lengths = path.sample(1e-4)
    cells = np.floor(grid.ijk(points) + 0.5).astype(int)
    entered = np.flatnonzero(np.diff(cells, axis=0, prepend=cells[:1] - 1).any(axis=1))
    found, sampled = crossed(grid, path), {tuple(v) for v in cells[entered].tolist()}
    for voxel in sampled - found:
        assert depth_in(grid, points, voxel).max() < 1e-8
    for voxel in found - sampled:
        nearest = int(np.argmax(depth_in(grid, points, voxel)))
        assert really_enters(grid, path, voxel, float(lengths[nearest]))


def _direction(seed: int) -> list[float]:
    return list(np.random.default_rng(seed).normal(size=3))


@given(arcs=ARCS, seed=st.integers(0, 10**6))
@settings(max_examples=60)
def test_lengths_in_voxels(arcs: list[tuple[float, float, float]], seed: int) -> None:
    """They add up to the length, and weighted by the map to an integral in steps of 1e-3 mm."""
    grid = tilted_grid(seed % 50)
    path = ArcPath(lps_from_start=start([0.1, 0.2, 0.3], _direction(seed)), arcs=np.array(arcs))
    points, lengths = path.sample(1e-3)
    assume(grid.contains(points).all())
    ones = Volume(grid=grid, array=np.ones(grid.shape, dtype=np.float32))
    assert map_integral(ones, path) == pytest.approx(path.length_mm, abs=1e-9)
    costs = a_map(grid, seed)
    at = np.floor(grid.ijk(0.5 * (points[1:] + points[:-1])) + 0.5).astype(int)
    sampled = float((costs.array[tuple(at.T)].astype(float) * np.diff(lengths)).sum())
    assert map_integral(costs, path) == pytest.approx(sampled, rel=2e-3, abs=2e-3)


@given(arcs=ARCS, seed=st.integers(0, 10**6))
@settings(max_examples=60)
def test_the_sum_is_that_over_the_set(arcs: list[tuple[float, float, float]], seed: int) -> None:
    grid = tilted_grid(seed % 50)
    path = ArcPath(lps_from_start=start([0.1, 0.2, 0.3], _direction(seed)), arcs=np.array(arcs))
    assume(grid.contains(path.sample(0.1)[0]).all())
    costs = a_map(grid, seed)
    voxels = voxels_crossed(grid, path)
    assert len({tuple(v) for v in voxels.tolist()}) == len(voxels)
    expected = costs.array[tuple(voxels.T)].astype(float).sum()
    assert voxel_sum(costs, path) == pytest.approx(expected, rel=1e-12)


@given(length=st.floats(0.5, 20.0), seed=st.integers(0, 10**6))
@settings(max_examples=60)
def test_two_parts_of_a_line_count_its_voxels_once(length: float, seed: int) -> None:
    """A straight line meets no voxel again, so that sums over its parts are the sum over the set."""
    grid = tilted_grid(seed % 50)
    direction = np.array(_direction(seed))
    path = line([0.1, 0.2, 0.3], list(direction), length)
    assume(grid.contains(path.sample(0.1)[0]).all())
    costs = a_map(grid, seed)
    cut = float(np.random.default_rng(seed).uniform(0.1, 0.9)) * length
    z = path.lps_from_start[:3, 2]
    total = 0.0
    for begin, piece, first in ((0.0, cut, True), (cut, length - cut, False)):
        pose = tuple(float(v) for v in (*(path.lps_from_start[:3, 3] + begin * z), *z))
        bend = (0.0, *map(float, path.lps_from_start[:3, 0]))
        total += kernel.map_costs_on_arc(costs.array, corner_geometry(grid), pose, bend, piece, first)[1]
    assert total == pytest.approx(voxel_sum(costs, path), rel=1e-9)


class TestInfinite:
    """Obstacles in the map, and beyond the grid."""

    def test_a_corner_cut_by_a_hair_counts(self) -> None:
        """0.01 mm of a line lie in the voxel: samples of 0.1 mm may miss it."""
        values = np.full(UNIT.shape, 0.5, dtype=np.float32)
        values[8, 9, 5] = math.inf
        depth = 0.01 / math.sqrt(2)
        away = [9.0 - depth - 3.0, 9.0 - 3.0, 5.5]
        through = line(away, [1.0, 1.0, 0.0], 9.0)
        assert (8, 9, 5) in crossed(UNIT, through)
        barred = Volume(grid=UNIT, array=values)
        assert voxel_sum(barred, through) == math.inf and map_integral(barred, through) == math.inf
        past = line([away[0] + 2 * depth, *away[1:]], [1.0, 1.0, 0.0], 9.0)
        assert math.isfinite(voxel_sum(barred, past)) and math.isfinite(map_integral(barred, past))

    def test_beyond_the_grid(self) -> None:
        costs = a_map(UNIT)
        out = line([20.5, 20.5, 35.5], [0.0, 0.0, 1.0], 5.0)
        assert voxel_sum(costs, out) == math.inf and map_integral(costs, out) == math.inf
        assert crossed(UNIT, out) == {(20, 20, n) for n in range(35, 40)}
        inside = line([20.5, 20.5, 35.5], [0.0, 0.0, 1.0], 4.4)
        assert math.isfinite(voxel_sum(costs, inside)) and math.isfinite(map_integral(costs, inside))

    def test_without_a_map_it_costs_nothing(self) -> None:
        path = line([5.5, 5.5, 5.5], [0, 0, 1.0], 3.0)
        assert voxel_sum(None, path) == 0.0 and map_integral(None, path) == 0.0


def scene(obstacles_as: float = 0.5, with_map: bool = True) -> NeedleEnvironment:
    """A vessel across the way, a map that is cheap on one side of it."""
    canvas = Canvas.empty([-20, -20, -5], [20, 20, 45], 1.0)
    canvas.add(canvas.capsule([-20, 0, 20], [20, 0, 20], 2.0), VESSEL)
    values = np.where(canvas.points[..., 1] > 0, 0.9, 0.2).astype(np.float32)
    return environment_of_labels(
        canvas.labels,
        canvas.grid,
        Needle(diameter_mm=1.0, max_curvature_per_mm=0.05),
        required_clearance_mm=1.0,
        obstacles_as=obstacles_as,
        cost_map=Volume(grid=canvas.grid, array=values) if with_map else None,
    )


class TestSpaces:
    """Costs of paths in a needle environment."""

    @pytest.mark.parametrize("obstacles_as", [0.5, CENTRES])
    def test_clearance_to_boxes_and_to_centres(self, obstacles_as: float) -> None:
        environment = scene(obstacles_as)
        points = np.random.default_rng(0).uniform([-15, -15, 0], [15, 15, 40], (300, 3))
        found = obstacle_clearance_mm(environment.obstacles, points)
        centres = environment.grid.lps(
            np.argwhere((environment.obstacles.labels & VESSEL) != 0).astype(float)
        )
        gaps = np.maximum(np.abs(points[:, None] - centres) - obstacles_as, 0.0)
        exact = np.linalg.norm(gaps, axis=2).min(axis=1)
        # The outermost voxels are obstacles, too.
        edge = np.minimum(points - [-20, -20, -5], [20, 20, 45] - points).min(axis=1) - 1.0
        near = exact < np.minimum(edge, 8.0)
        far = exact > 8.0
        assert near.sum() > 50 and far.sum() > 50
        assert np.allclose(found[near], exact[near], atol=1e-9)
        assert (found[far] <= exact[far]).all()
        inner = far & (edge > exact + 1.0)
        assert inner.sum() >= 20
        assert (found[inner] > 0.99 * exact[inner]).all()

    def test_every_cost_by_its_name(self) -> None:
        environment = scene()
        path = line([0.5, 8.5, 0.5], [0, 0, 1.0], 30.0)
        costs = path_costs(environment.obstacles, environment.cost_map, path, [InTissue(path, 0.5)])
        assert costs["length_mm"] == 30.0
        assert costs["cost_map"] == pytest.approx(0.9 * 30, rel=1e-6)
        assert costs["voxel_sum"] == pytest.approx(0.9 * 31, rel=1e-6)
        assert costs["inverse_clearance"] == inverse_clearance(environment.obstacles, path)
        assert costs["tissue"] == pytest.approx(0.5 * (costs["inverse_clearance"] + costs["cost_map"]))


class TestSearches:
    """What the searches add up is what the path costs."""

    QUERY = Query(lps_from_start=np.eye(4), target=np.array([0.0, 0.0, 40.0]))

    @pytest.mark.parametrize("objective", [Objective(voxel_sum=1.0), Objective(cost_map=1.0)])
    def test_the_cost_of_a_path_found(self, objective: Objective) -> None:
        environment = scene()
        search = RestartingRRT(environment, self.QUERY, seed=3, objective=objective)
        costs = []
        for _ in range(60):
            if search.advance(300):
                assert search.path is not None
                costs_of = path_costs(environment.obstacles, environment.cost_map, search.path, [])
                exact = objective.total(costs_of)
                assert search.cost == pytest.approx(exact, rel=1e-6) or (
                    objective.voxel_sum > 0.0 and exact < search.cost < 1.2 * exact
                )
                costs.append(exact)
        assert len(costs) >= 3
        assert costs[-1] < 0.7 * costs[0]
        points, _lengths = search.path.sample(0.1) if search.path else (np.zeros((0, 3)), None)
        assert np.median(points[:, 1]) < 0.0, "on the cheap side"

    def test_an_arc_into_a_barred_voxel_is_refused(self) -> None:
        """Whatever its clearance, if the objective weighs the map."""
        canvas = Canvas.empty([-20, -20, -5], [20, 20, 45], 1.0)
        values = np.full(canvas.grid.shape, 0.5, dtype=np.float32)
        values[:, :, 25] = math.inf
        environment = environment_of_labels(
            canvas.labels,
            canvas.grid,
            Needle(diameter_mm=1.0, max_curvature_per_mm=0.05),
            required_clearance_mm=1.0,
            cost_map=Volume(grid=canvas.grid, array=values),
        )
        for objective, found in ((Objective(voxel_sum=1.0), False), (Objective(length=1.0), True)):
            search = RestartingRRT(environment, self.QUERY, objective=objective)
            assert search.advance(500) is found

    def test_the_start_voxel_counts_once(self) -> None:
        """A tree of three arcs along a line, as the searches grow it."""
        environment = scene()
        arrays = environment.objective_arrays(Objective(voxel_sum=1.0))
        nodes, parents = np.zeros((5, tree.NODE_COLUMNS)), np.zeros(5, dtype=np.int64)
        nodes[0, :6] = [0.5, 8.5, 0.5, 0.0, 0.0, 1.0]
        goal = np.array([0.5, 8.5, 40.0])
        for n, length in enumerate([2.2, 3.3, 0.3], start=1):
            assert tree.add_arc(
                environment.obstacles, environment.limits, arrays, -1, nodes, parents, n, n - 1,
                (0.0, 1.0, 0.0, 0.0), length, goal, math.inf,
            )  # fmt: skip
        assert nodes[:4, tree.PATH_COST] == pytest.approx([0.0, 0.9 * 3, 0.9 * 7, 0.9 * 7])
