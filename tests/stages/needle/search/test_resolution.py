"""The search that ends, on problems with known answers."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from stages.needle.path import ArcPath, Query
from stages.needle.search.resolution import Cells, Outcome, Resolution, ResolutionSearch
from tests.stages.needle import mazes
from tests.stages.needle.mazes import CLEARANCE_MM, in_box, winding_maze
from tests.stages.needle.search.judged import COARSE, MIDDLE, judge, run, shortest_mm


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
