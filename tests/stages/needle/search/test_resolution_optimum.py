"""The best path of the search that ends, against an enumeration of all words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.typed import Float
from anatomy.grid import Volume
from stages.needle.objective import Objective
from stages.needle.search.kernels import resolution_nodes as node_kernel
from stages.needle.search.resolution import Cells, Resolution
from tests.stages.needle import mazes
from tests.stages.needle.mazes import Maze, winding_maze
from tests.stages.needle.search.judged import MIDDLE, run


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

    @pytest.mark.slow
    @given(maze=crowded_mazes())
    @settings(max_examples=10)
    def test_with_more_directions(self, maze: Maze) -> None:
        maze = replace(maze, needle=replace(maze.needle, max_length_mm=41.0))
        self.compare(maze, Resolution(coarse_mm=12.0, fine_mm=12.0, coarse_rolls=2, fine_rolls=8))

    @pytest.mark.slow
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
        if math.isinf(exact.cost):
            # Both have looked at all words; where one finds a path, the other may have to look longer for it.
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
