"""The search that ends, on problems with known answers and against an enumeration of all words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.errors import SettingsError
from anatomy.grid import Volume
from anatomy.kernels.arcs import pose_on_arc
from anatomy.structures import OBSTACLES
from anatomy.typed import Float
from stages.needle.environment import NeedleEnvironment, workspace_lengths
from stages.needle.kernels.limits import Limits
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, blocker_on_path
from stages.needle.query import Query
from stages.needle.search.kernels import goal_ball, rank_queue
from stages.needle.search.kernels import resolution_nodes as node_kernel
from stages.needle.search.resolution import Cells, Outcome, Resolution, ResolutionSearch
from tests.stages.needle import mazes
from tests.stages.needle.mazes import CLEARANCE_MM, Maze, in_box, winding_maze
from tests.stages.scenes import brute_clearance

COARSE = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=4)
MIDDLE = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=8)


def run(
    maze: Maze, resolution: Resolution, environment: NeedleEnvironment | None = None, **more: Any
) -> ResolutionSearch:
    """Search until the end, and judge every path on the way."""
    search = ResolutionSearch(environment or maze.environment(), maze.query, resolution=resolution, **more)
    best = math.inf
    while not search.finished:
        if search.advance(10**9):
            assert search.path is not None
            assert search.cost < best
            best = search.cost
            judge(search.environment, maze, search.path)
    assert search.outcome == (Outcome.NONE if search.path is None else Outcome.BEST)
    return search


def judge(environment: NeedleEnvironment, maze: Maze, path: ArcPath) -> None:
    """Walk a path in steps of 0.02 mm."""
    points, _ = path.sample(0.02)
    clearance = brute_clearance(
        environment.obstacles.labels, environment.grid, points, OBSTACLES, CLEARANCE_MM + 1.0
    )
    assert clearance.min() >= CLEARANCE_MM - 1e-9
    assert blocker_on_path(environment, path, -1) == 0
    assert np.array_equal(path.lps_from_start, maze.start)
    assert np.linalg.norm(points[-1] - maze.target) <= maze.goal_tolerance_mm + 1e-6
    needle = maze.needle
    assert path.arcs[:, 2].max(initial=0.0) <= needle.max_curvature_per_mm * (1.0 + 1e-9)
    assert path.length_mm <= needle.max_length_mm + 1e-6
    assert path.accumulated_turn_rad <= math.radians(needle.max_accumulated_turn_deg) + 1e-6
    assert path.max_angle_from_start_rad() <= math.radians(needle.max_angle_from_start_deg) + 1e-6


def shortest_mm(maze: Maze) -> float:
    """Length of the shortest path without obstacles."""
    start = maze.start
    return float(
        workspace_lengths(maze.environment(), start[None, :3, 3], start[None, :3, 2], maze.target)[0]
    )


class TestResolution:
    """The words."""

    @pytest.mark.parametrize(
        "wrong",
        [
            {"fine_mm": 0.0},
            {"fine_mm": 32.0},
            {"fine_mm": 3.0},
            {"fine_mm": math.nan},
            {"coarse_mm": math.inf},
            {"fine_mm": 0.0625},
            {"coarse_rolls": 0},
            {"fine_rolls": 12},
            {"coarse_rolls": 8, "fine_rolls": 4},
            {"fine_rolls": 128},
        ],
    )
    def test_impossible_ones(self, wrong: dict[str, Any]) -> None:
        with pytest.raises(SettingsError, match=r"resolution|factor|rolls"):
            Resolution(**wrong)

    def test_every_primitive_has_one_level_that_counts_its_halvings(self) -> None:
        resolution = Resolution(coarse_mm=8.0, fine_mm=2.0, coarse_rolls=3, fine_rolls=12)
        primitives, first = resolution.primitives()
        levels = [{tuple(p) for p in primitives[a:b]} for a, b in zip(first, first[1:], strict=False)]
        assert sum(map(len, levels)) == len(primitives) == 13 * 4
        by_length = [{4}, {2}, {1, 3}]
        by_roll = [{12, 0, 4, 8}, {2, 6, 10}, {1, 3, 5, 7, 9, 11}]
        for level, found in enumerate(levels):
            assert found == {
                (d, k)
                for roll, directions in enumerate(by_roll)
                for length, steps in enumerate(by_length)
                if roll + length == level
                for d in directions
                for k in steps
            }

    @pytest.mark.parametrize("wrong", [{"position_mm": 0.0}, {"angle_deg": -1.0}, {"angle_deg": math.nan}])
    def test_impossible_cells(self, wrong: dict[str, float]) -> None:
        with pytest.raises(SettingsError, match="size"):
            Cells(**wrong)

    def test_no_search_where_nothing_is_proved(self) -> None:
        maze = in_box([])
        environment = maze.environment()
        limits = environment.limits._replace(lookup_step_mm=0.5)
        with pytest.raises(SettingsError, match="proved"):
            ResolutionSearch(replace(environment, limits=limits), maze.query)


class TestGoalBall:
    """Shortest paths into the ball about the goal."""

    RADIUS = 30.0

    @classmethod
    def limits(cls, tolerance: float, max_angle_deg: float) -> Limits:
        values = dict.fromkeys(Limits._fields, 0.0) | {"kappa": 1.0 / cls.RADIUS}
        return Limits(
            **values | {"goal_tolerance_mm": tolerance, "max_angle_rad": math.radians(max_angle_deg)}
        )

    @given(
        rho=st.floats(0.0, 60.0),
        h=st.floats(-10.0, 60.0),
        tolerance=st.sampled_from([0.0, 0.5, 2.0]),
        max_angle_deg=st.sampled_from([30.0, 60.0, 90.0]),
    )
    @settings(max_examples=300)
    def test_the_bound_is_the_shortest_of_a_dense_family(
        self, rho: float, h: float, tolerance: float, max_angle_deg: float
    ) -> None:
        """The limit of the angle decides whether there is one, but not how short it may be."""
        found = goal_ball.least_length(rho, h, self.limits(tolerance, max_angle_deg), 1.0, math.pi)
        expected = self.dense(rho, h, tolerance, math.radians(max_angle_deg))
        if math.isfinite(found) == math.isfinite(expected):
            if math.isfinite(found):
                assert found == pytest.approx(self.dense(rho, h, tolerance, math.pi), abs=0.02)
        else:
            around = [
                math.isfinite(self.dense(abs(rho + dx), h + dz, tolerance, math.radians(max_angle_deg)))
                for dx in (-0.01, 0.0, 0.01)
                for dz in (-0.01, 0.0, 0.01)
            ]
            assert any(around) and not all(around), "only at the edge of what is reached"

    @classmethod
    def dense(cls, rho: float, h: float, tolerance: float, max_angle: float) -> float:
        """Return the least length at which a path CS of a dense family is in the ball."""
        angle = np.linspace(0.0, max_angle, 40001)
        x, z = rho - cls.RADIUS * (1.0 - np.cos(angle)), h - cls.RADIUS * np.sin(angle)
        along = x * np.sin(angle) + z * np.cos(angle)
        reach = max(tolerance, 5e-3)
        spare2 = reach**2 - (x * x + z * z - along**2)
        half = np.sqrt(np.maximum(spare2, 0.0))
        hit = (spare2 >= 0.0) & (along + half >= 0.0)
        length = cls.RADIUS * angle + np.maximum(along - half, 0.0)
        return float(np.min(length[hit], initial=math.inf))

    @given(
        goal=st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-10.0, 60.0)),
        tolerance=st.sampled_from([0.0, 0.5, 2.0]),
    )
    def test_paths_end_where_they_first_are_in_the_ball(
        self, goal: tuple[float, float, float], tolerance: float
    ) -> None:
        limits = self.limits(tolerance, 180.0)
        start = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        bound = goal_ball.least_length(math.hypot(goal[0], goal[1]), goal[2], limits, 1.0, math.pi)
        left = min(tolerance, math.hypot(*goal))
        first, first_length, second, second_length, ahead = goal_ball.shortest_into_ball(start, goal, limits)
        legs = [(first, first_length), (second, second_length)]
        if math.isfinite(bound):
            assert first_length + second_length == pytest.approx(bound, abs=1e-5)
            assert math.dist(end_of(start, legs)[:3], goal) == pytest.approx(left, abs=1e-5)
        if ahead > 0.0:
            assert math.dist(end_of(start, [*legs, (second, ahead)])[:3], goal) < 1e-6
        bend, length = goal_ball.single_into_ball(start, goal, limits)
        if length > 0.0:
            assert bend[0] <= limits.kappa * (1.0 + 1e-9)
            assert math.dist(end_of(start, [(bend, length)])[:3], goal) == pytest.approx(left, abs=1e-5)


def end_of(pose: Any, legs: list[Any]) -> Any:
    """Return the pose after some legs."""
    for bend, length in legs:
        pose = pose_on_arc(pose, bend, length)
    return pose


class TestQueue:
    """The order in which entries are taken."""

    def test_smallest_bound_among_the_lowest_rank_and_the_next_three(self) -> None:
        rng = np.random.default_rng(7)
        size = 600
        lists = np.zeros((80, 2), dtype=np.int32)
        lists[:, rank_queue.HEAD] = -1
        entries = np.zeros((size, rank_queue.ENTRY_COLUMNS), dtype=np.int32)
        queue = np.zeros(size), entries, np.zeros(size), np.zeros(size, dtype=np.int32), lists
        state = np.zeros(rank_queue.STATE_SIZE, dtype=np.int64)
        state[rank_queue.FREE] = -1
        waiting: dict[int, tuple[float, int]] = {}
        lowest = pushed = most = 0
        while pushed < 3000 or waiting:
            if pushed < 3000 and len(waiting) < size and (not waiting or rng.uniform() < 0.6):
                f, rank = float(rng.uniform()), min(lowest + int(rng.integers(0, 12)), 70)
                rank_queue.push(queue, state, f, pushed, -pushed, rank)
                waiting[pushed] = f, rank
                pushed += 1
                most = max(most, len(waiting))
                continue
            lowest = min(rank for _f, rank in waiting.values())
            ahead = {n: f for n, (f, rank) in waiting.items() if rank <= lowest + 3}
            f, first, second, rank = rank_queue.pop(queue, state)
            assert first == min(ahead, key=ahead.__getitem__)
            assert second == -first and (f, rank) == waiting.pop(first)
            assert state[rank_queue.WAITING] == len(waiting)
        assert most > 400


class TestKnownAnswers:
    """Problems of which one knows how they end."""

    @pytest.mark.parametrize("tolerance_mm", [0.0, 1.0])
    @pytest.mark.parametrize("target", [(0.0, 0.0, 25.0), (3.0, -4.0, 20.0)])
    def test_free_space(self, target: tuple[float, ...], tolerance_mm: float) -> None:
        """The shortest path is the first one tried, and nothing can beat it."""
        maze = replace(in_box([]), target=np.array(target), goal_tolerance_mm=tolerance_mm)
        search = ResolutionSearch(maze.environment(), maze.query)
        assert search.advance(1) and search.finished and search.outcome == Outcome.BEST
        assert search.path is not None
        judge(search.environment, maze, search.path)
        assert search.cost == pytest.approx(shortest_mm(maze), abs=1e-9)
        end = search.path.frames()[-1][:3, 3]
        assert np.linalg.norm(end - target) < 1e-6, "ending short would not be cheaper"

    @pytest.mark.parametrize("z_mm", [-12.0, 12.0])
    @pytest.mark.parametrize("duplicates", [None, Cells()])
    def test_a_closed_box(self, z_mm: float, duplicates: Cells | None) -> None:
        maze = in_box(mazes.wall(z_mm), max_length_mm=56.0)
        search = run(maze, COARSE, duplicates=duplicates)
        assert search.outcome == Outcome.NONE
        assert search.counts.refused > 10

    def test_a_target_behind_and_a_start_in_an_obstacle(self) -> None:
        behind = replace(in_box([]), target=np.array([0.0, 0.0, -29.0]))
        blocked = in_box([[[-1.0, -1.0, -26.0], [1.0, 1.0, -24.0]]])
        for maze in (behind, blocked):
            search = run(maze, Resolution())
            assert search.outcome == Outcome.NONE
            assert search.counts.nodes == 1

    def test_a_start_at_the_target(self) -> None:
        maze = replace(in_box([]), target=np.array([0.0, 0.4, -25.0]), goal_tolerance_mm=0.5)
        search = run(maze, Resolution())
        assert search.path is not None and len(search.path.arcs) == 0
        assert search.cost == pytest.approx(0.4)

    @pytest.mark.parametrize("aside_mm", [0.0, 3.0])
    @pytest.mark.parametrize("half_width_mm", [0.5, 1.0, 1.5, 2.5])
    def test_a_slot_is_passable_if_it_is_wider_than_twice_the_clearance(
        self, half_width_mm: float, aside_mm: float
    ) -> None:
        maze = in_box(mazes.wall(0.0, (aside_mm - half_width_mm, aside_mm + half_width_mm, -12.0, 12.0)))
        search = run(maze, MIDDLE, duplicates=Cells())
        assert (search.path is not None) == (half_width_mm > CLEARANCE_MM)
        if search.path is not None and aside_mm == 0.0:
            assert search.cost == pytest.approx(50.0)

    def test_a_wall_with_one_hole(self) -> None:
        """The path is longer than two straight lines past the hole's edge, and goes through."""
        hole = (2.0, 6.0, -2.0, 2.0)
        search = run(in_box(mazes.wall(0.0, hole)), MIDDLE, duplicates=Cells())
        assert search.path is not None
        assert 2.0 * math.hypot(25.0, 3.0) < search.cost < 2.0 * math.hypot(25.0, 3.0) + 2.0
        assert goes_through(search.path, 0.0, hole)

    @pytest.mark.parametrize("duplicates", [None, Cells()])
    def test_a_maze_with_one_way(self, duplicates: Cells | None) -> None:
        maze, walls = winding_maze()
        search = run(maze, COARSE, duplicates=duplicates)
        assert search.path is not None
        for z, hole in walls:
            assert goes_through(search.path, z, hole)
        assert shortest_mm(maze) < search.cost <= sum(length for _roll, length in mazes.WAY) + 6.0 + 1e-9
        for closed in range(len(walls)):
            assert run(winding_maze(closed)[0], COARSE, duplicates=duplicates).outcome == Outcome.NONE


def goes_through(path: ArcPath, z: float, hole: tuple[float, ...]) -> bool:
    """Tell whether a path crosses a wall of 2 mm at the height `z` inside its hole."""
    points, _ = path.sample(0.05)
    x, y, _ = points[np.abs(points[:, 2] - z) <= 1.0].T
    inside = (x > hole[0]) & (x < hole[1]) & (y > hole[2]) & (y < hole[3])
    return len(x) > 0 and bool(inside.all())


@st.composite
def crowded_mazes(draw: Any) -> Maze:
    """A few blocks in the way, a target ahead, and limits that allow five steps of 8 mm at most."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    half = np.array([12.0, 12.0, 22.0])
    low = np.round(rng.uniform([-9.0, -9.0, -17.0], [6.0, 6.0, 10.0], (draw(st.integers(1, 9)), 3)))
    high = np.minimum(low + rng.integers(2, 9, low.shape), half)
    return Maze(
        low=-half,
        high=half,
        blocks=np.stack([low, high], axis=1),
        needle=mazes.needle(
            draw(st.sampled_from([15.0, 25.0, 40.0])),
            max_length_mm=draw(st.sampled_from([39.0, 47.0])),
            max_angle_from_start_deg=draw(st.sampled_from([60.0, 90.0, 170.0])),
            max_accumulated_turn_deg=draw(st.sampled_from([90.0, 180.0, 300.0])),
        ),
        start=mazes.pose_at(0.0, 0.0, -20.0),
        target=rng.uniform([-6.0, -6.0, 8.0], [6.0, 6.0, 14.0]),
        goal_tolerance_mm=draw(st.sampled_from([0.0, 0.0, 1.0])),
    )


EIGHTS = [
    Resolution(coarse_mm=coarse_mm, fine_mm=8.0, coarse_rolls=coarse_rolls, fine_rolls=4)
    for coarse_mm in (8.0, 16.0, 32.0)
    for coarse_rolls in (1, 2, 4)
]


class TestAgainstEnumeration:
    """All words of up to five steps are tried by code that shares nothing with the search."""

    @staticmethod
    def compare(maze: Maze, resolution: Resolution) -> None:
        steps = int(maze.needle.max_length_mm / resolution.fine_mm)
        expected = mazes.enumerate_words(maze, resolution.fine_mm, resolution.fine_rolls, steps)
        found = run(maze, resolution).cost
        assert expected.possible - 0.01 <= found <= expected.sure + 0.01

    @given(maze=crowded_mazes(), resolution=st.sampled_from(EIGHTS))
    @settings(max_examples=10)
    def test_the_same_least_cost_or_none(self, maze: Maze, resolution: Resolution) -> None:
        self.compare(maze, resolution)

    @pytest.mark.slow
    @given(maze=crowded_mazes(), resolution=st.sampled_from(EIGHTS))
    @settings(max_examples=150)
    def test_the_same_least_cost_or_none_in_many_mazes(self, maze: Maze, resolution: Resolution) -> None:
        self.compare(maze, resolution)

    @given(maze=crowded_mazes())
    @settings(max_examples=10)
    def test_with_more_directions(self, maze: Maze) -> None:
        maze = replace(maze, needle=replace(maze.needle, max_length_mm=41.0))
        self.compare(maze, Resolution(coarse_mm=12.0, fine_mm=12.0, coarse_rolls=2, fine_rolls=8))

    @given(maze=crowded_mazes(), seed=st.integers(0, 2**32 - 1))
    @settings(max_examples=10)
    def test_the_same_least_cost_of_a_map(self, maze: Maze, seed: int) -> None:
        """Blocks of 16 voxels of costly and cheap tissue, so that few faces blur the sampled costs.

        They begin 3 voxels early: words from the start may lie in the planes x = 0 and y = 0, where a face
        between costly and cheap would leave their cost open.
        """
        rng = np.random.default_rng(seed)
        environment = maze.environment()
        few = rng.choice(
            np.array([1.0, 4.0], dtype=np.float32), [-(-(n + 3) // 16) for n in environment.grid.shape]
        )
        costs = np.kron(few, np.ones((16, 16, 16), dtype=np.float32))
        costs = np.asfortranarray(costs[tuple(slice(3, 3 + n) for n in environment.grid.shape)])
        environment = replace(environment, cost_map=Volume(grid=environment.grid, array=costs))

        def cost_at(points: Float) -> Float:
            ijk = np.clip(np.rint(environment.grid.ijk(points)).astype(int), 0, np.array(costs.shape) - 1)
            return np.asarray(costs[tuple(np.moveaxis(ijk, -1, 0))], dtype=np.float64)

        least = float(costs.min())
        expected = mazes.enumerate_words(maze, 8.0, 4, 4, cost_at, least)
        maze = replace(maze, needle=replace(maze.needle, max_length_mm=39.0))
        environment = replace(environment, limits=maze.environment().limits)
        resolution = Resolution(coarse_mm=8.0, fine_mm=8.0, coarse_rolls=2, fine_rolls=4)
        found = run(maze, resolution, environment, objective=Objective(cost_map=1.0)).cost
        assert expected.possible - 0.5 <= found <= expected.sure + 0.5

    @given(maze=crowded_mazes())
    @settings(max_examples=10)
    def test_cells_lose_paths_but_invent_none(self, maze: Maze) -> None:
        resolution = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=4)
        exact = run(maze, resolution)
        merged = run(maze, resolution, duplicates=Cells(position_mm=2.0, angle_deg=10.0))
        assert merged.cost >= exact.cost - 1e-6
        assert merged.counts.nodes <= exact.counts.nodes


class TestDuplicates:
    """Words that end in one pose."""

    @staticmethod
    def lattice() -> Maze:
        """Quarter circles, whose ends lie on a lattice, and a target that cannot be reached."""
        return Maze(
            low=np.full(3, -60.0),
            high=np.full(3, 60.0),
            blocks=np.array([[[8.0, 8.0, 8.0], [12.0, 12.0, 12.0]]]),
            needle=mazes.needle(
                10.0, max_length_mm=125.0, max_angle_from_start_deg=180.0, max_accumulated_turn_deg=1000.0
            ),
            start=mazes.pose_at(0.0, 0.0, 0.0),
            target=np.full(3, 10.0),
            voxel_mm=2.0,
        )

    def test_equal_poses_are_followed_once(self) -> None:
        piece = 0.5 * math.pi * 10.0
        search = run(self.lattice(), Resolution(coarse_mm=piece, fine_mm=piece, coarse_rolls=4, fine_rolls=4))
        assert search.counts.duplicates > 100
        nodes = search._store[0][: search.counts.nodes]
        kinds: dict[tuple[float, ...], list[Float]] = {}
        for node in nodes:
            pose = tuple(np.round(node[:6], 3) + 0.0)
            kinds.setdefault(pose, []).append(node[node_kernel.PATH_LENGTH : node_kernel.NODE_COLUMNS])
        for same in kinds.values():
            for number, earlier in enumerate(same):
                for later in same[number + 1 :]:
                    assert (later < earlier - 1e-6).any(), "longer, costlier and more turned, but followed"
        ends = [self.lattice().start[None]]
        for _ in range(2):
            turns = [(0.25 * n, 0.1) for n in range(4)] + [(0.0, 0.0)]
            ends.append(
                np.concatenate(
                    [
                        mazes.arcs(
                            ends[-1],
                            np.full(len(ends[-1]), 2.0 * math.pi * roll),
                            np.full(len(ends[-1]), kappa),
                            np.full(len(ends[-1]), piece),
                        ).frames
                        for roll, kappa in turns
                    ]
                )
            )
        for frame in np.concatenate(ends):
            assert tuple(np.round([*frame[:3, 3], *frame[:3, 2]], 3) + 0.0) in kinds

    @pytest.mark.parametrize("cells", [Cells(), Cells(position_mm=2.0, angle_deg=10.0)])
    def test_a_cell_is_entered_again_only_by_what_is_cheaper(self, cells: Cells) -> None:
        maze, _walls = winding_maze(2)
        search = run(maze, MIDDLE, duplicates=cells)
        assert search.counts.duplicates > 100
        cheapest: dict[tuple[int, ...], float] = {}
        for node in search._store[0][: search.counts.nodes]:
            sizes = np.repeat([cells.position_mm, math.radians(cells.angle_deg)], 3)
            cell = tuple(np.floor(node[:6] / sizes).astype(int))
            assert node[node_kernel.PATH_COST] < cheapest.get(cell, math.inf)
            cheapest[cell] = node[node_kernel.PATH_COST]

    def test_of_equal_poses_one_may_be_dearer_but_turned_less(self) -> None:
        """Then both are kept, because a limit could stop either."""
        nodes, seen = np.zeros((4, node_kernel.NODE_COLUMNS)), np.zeros(16, dtype=np.int32)
        nodes[:, :6] = 1.0, 2.0, 3.0, 0.0, 0.0, 1.0
        nodes[:, node_kernel.NORMAL] = 1.0
        values = [(20.0, 1.0, 20.0), (19.0, 1.1, 19.0), (19.0, 0.9, 20.0), (20.0, 1.0, 20.0)]
        nodes[:, node_kernel.PATH_LENGTH :] = values
        merge = (1e-3, 1e-3, False)
        slots = []
        for row, superfluous in enumerate((False, False, False, True)):
            slot, found = node_kernel.find_duplicate(nodes, seen, merge, 4, row)
            assert found == superfluous
            slots.append(slot)
            if not found:
                seen[slot] = row + 1
        assert slots[1] != slots[0], "neither is better"
        assert slots[2] == slots[0], "this one is better in all, and takes the other's place"

    def test_equal_poses_on_both_sides_of_a_face_between_cells(self) -> None:
        nodes, seen = np.zeros((3, node_kernel.NODE_COLUMNS)), np.zeros(16, dtype=np.int32)
        nodes[:, 5] = 1.0
        nodes[:, node_kernel.NORMAL] = 1.0
        nodes[1, [0, 1, 4]] = 1e-12, -1e-12, -1e-12
        nodes[2, 0] = 1e-3 - 1e-12
        merge = (1e-3, 1e-3, False)
        seen[node_kernel.find_duplicate(nodes, seen, merge, 4, 0)[0]] = 1
        assert node_kernel.find_duplicate(nodes, seen, merge, 4, 1)[1]
        assert not node_kernel.find_duplicate(nodes, seen, merge, 4, 2)[1], "in the same cell, but not equal"

    @pytest.mark.parametrize(("roll", "equal"), [(0.0, True), (0.25, True), (0.1, False)])
    def test_equal_poses_with_other_directions_of_bending_are_not_equal(
        self, roll: float, equal: bool
    ) -> None:
        nodes, seen = np.zeros((2, node_kernel.NODE_COLUMNS)), np.zeros(16, dtype=np.int32)
        nodes[:, 5] = 1.0
        angle = 2.0 * math.pi * roll
        nodes[:, node_kernel.NORMAL : node_kernel.NORMAL + 2] = (1.0, 0.0), (math.cos(angle), math.sin(angle))
        slot, _found = node_kernel.find_duplicate(nodes, seen, (1e-3, 1e-3, False), 4, 0)
        seen[slot] = 1
        assert node_kernel.find_duplicate(nodes, seen, (1e-3, 1e-3, False), 4, 1)[1] == equal


class TestRunning:
    """How a search is advanced."""

    def test_slices_do_what_one_run_does_and_a_second_run_repeats_it(self) -> None:
        maze, _walls = winding_maze()
        runs = []
        for pops in (10**9, 10**9, 7):
            search = ResolutionSearch(maze.environment(), maze.query, resolution=MIDDLE)
            costs = []
            while not search.finished:
                before = search.counts.pops
                if search.advance(pops):
                    costs.append(search.cost)
                assert search.counts.pops - before <= pops
            assert search.path is not None
            runs.append((costs, search.counts, search.path.arcs, search._store[0][: search.counts.nodes]))
        for other in runs[1:]:
            assert other[:2] == runs[0][:2]
            assert np.array_equal(other[2], runs[0][2])
            assert np.array_equal(other[3], runs[0][3])
        assert len(runs[0][0]) > 1
        assert runs[0][1].nodes > 1024, "arrays have grown on the way"

    def test_out_of_memory_is_no_claim(self) -> None:
        maze, _walls = winding_maze(2)
        needed = run(maze, MIDDLE, duplicates=Cells()).memory_mb
        search = ResolutionSearch(
            maze.environment(), maze.query, resolution=MIDDLE, duplicates=Cells(), max_memory_mb=0.5 * needed
        )
        while not search.finished:
            assert not search.advance(1000)
        assert search.outcome == Outcome.OUT_OF_MEMORY and search.path is None
        assert search.memory_mb <= 0.5 * needed
        assert not search.advance(1000)

    def test_a_needle_on_its_way(self) -> None:
        """What lies behind the start counts for every limit."""
        maze = replace(in_box([]), target=np.array([0.0, 4.0, 20.0]))
        start = maze.start
        needed = shortest_mm(maze)
        turn = ResolutionSearch(maze.environment(), maze.query)
        turn.advance(1)
        assert turn.path is not None
        turned = turn.path.accumulated_turn_rad
        tilt = np.array([0.0, -math.sin(1.5), math.cos(1.5)])
        for more, possible in (
            ({"inserted_mm": 150.0 - needed - 1e-3}, True),
            ({"inserted_mm": 150.0 - needed + 1e-3}, False),
            ({"turned_rad": math.pi - turned - 1e-3}, True),
            ({"turned_rad": math.pi - turned + 1e-3}, False),
            ({"reference": np.array([0.0, -math.sin(1.0), math.cos(1.0)])}, True),
            ({"reference": tilt}, False),
        ):
            query = Query(lps_from_start=start, target=maze.target, **more)
            search = ResolutionSearch(maze.environment(), query, resolution=COARSE)
            search.advance(10**9)
            while not search.finished:
                search.advance(10**9)
            assert (search.path is not None) == possible, more
