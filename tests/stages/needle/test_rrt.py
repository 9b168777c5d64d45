"""The direct arc and the RRT against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.typed import Float
from anatomy.margins import Margins
from anatomy.structures import OBSTACLES, OUTSIDE, VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, direct_arcs, needle_environment, workspace_lengths
from stages.needle.kernels import cost as cost_kernels
from stages.needle.kernels import rrt, tree
from stages.needle.objective import SHORTEST
from stages.needle.path import blocker_on_path, path_from_tree
from tests.stages.scenes import Canvas, brute_clearance


def ball_environment(**changes: float) -> NeedleEnvironment:
    """Free lung with a vessel ball in the middle of the way from (0, 0, -28) to (0, 0, 28)."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    values: dict[str, float] = {"diameter_mm": 1.0, "max_curvature_per_mm": 1 / 30, **changes}
    return needle_environment(canvas.lung(), Needle(**values), Margins(), with_fissures=False)


GOAL = np.array([0.0, 0.0, 28.0])
OBJECTIVE = SHORTEST.arrays(None, 1.0)
START = np.array([0.0, 0.0, -28.0, 0.0, 0.0, 1.0])


def grow(
    environment: NeedleEnvironment,
    seed: int = 5,
    goal: Float = GOAL,
    iterations: int = 20000,
    size: int = 20000,
) -> tuple[Float, np.ndarray, int, int, bool]:
    """Run the RRT from START."""
    nodes, parents = np.zeros((size, tree.NODE_COLUMNS)), np.zeros(size, dtype=np.int64)
    nodes[0, :6] = START
    state = np.array([seed], dtype=np.uint64)
    count, used, solved = rrt.grow_rrt(
        environment.obstacles,
        environment.limits,
        OBJECTIVE,
        -1,
        tuple(goal.tolist()),
        nodes,
        parents,
        1,
        iterations,
        0.5,
        state,
        math.inf,
    )
    return nodes[:count], parents[:count], count, used, solved


def start_frame() -> Float:
    frame = np.eye(4)
    frame[:3, 3] = START[:3]
    return frame


class TestDirectArcs:
    """Many starts at once."""

    def test_every_outcome(self) -> None:
        environment = ball_environment()
        positions = np.array([[0.0, 0, -28], [20, 0, -28], [0, 0, 20], [0, 0, 30], [0, 0, 28]])
        tangents = np.array([[0.0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 1]])
        blockers, lengths, cost = direct_arcs(environment, positions, tangents, np.full(5, -1), GOAL)
        assert blockers[0] == VESSEL
        assert blockers[1] == 0
        assert blockers[2] == blockers[3] == -1, "too tight; straight behind"
        assert blockers[4] == 0 and lengths[4] == 0.0
        chord = math.hypot(20, 56)
        half = math.atan2(20, 56)
        assert lengths[1] == pytest.approx(chord * half / math.sin(half))
        assert lengths[3] == math.inf
        assert 56 / 32 < cost[1] < 56 / 3

    def test_the_turning_limits_hold_for_single_arcs(self) -> None:
        half = math.atan2(20, 56)
        start = np.array([[20.0, 0, -28]])
        for name in ("max_angle_from_start_deg", "max_accumulated_turn_deg"):
            for over, outcome in ((0.1, 0), (-0.1, -1)):
                environment = ball_environment(**{name: math.degrees(2 * half) + over})
                found = direct_arcs(environment, start, np.array([[0.0, 0, 1]]), np.array([-1]), GOAL)[0]
                assert found[0] == outcome

    def test_where_an_arc_exists_the_workspace_holds_the_target(self) -> None:
        environment = ball_environment()
        rng = np.random.default_rng(0)
        positions = rng.uniform(-30, 30, (3000, 3))
        tangents = rng.normal(size=(3000, 3))
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        blockers, lengths, _ = direct_arcs(environment, positions, tangents, np.full(3000, -1), GOAL)
        shortest = workspace_lengths(environment, positions, tangents, GOAL)
        arc = blockers != -1
        assert arc.sum() > 100
        assert (shortest[arc] <= lengths[arc] + 1e-9).all()

    def test_the_estimated_cost_of_a_clear_arc_beside_a_wall(self) -> None:
        """Straight along a flat pleura at 5 mm for 20 mm: 20 / 5."""
        canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
        canvas.add(canvas.points[..., 0] < -5, OUTSIDE)
        environment = needle_environment(
            canvas.lung(), Needle(diameter_mm=1.0, max_curvature_per_mm=0.01), Margins(), with_fissures=False
        )
        cost = cost_kernels.inverse_clearance_on_arc(
            environment.obstacles, 0.5, (0.0, 0, -10, 0, 0, 1.0), (0.0, 1.0, 0, 0), 20.0
        )
        assert cost == pytest.approx(4.0, rel=5e-3)


class TestRrt:
    """The RRT goes around what blocks the direct arc."""

    def test_goes_around_the_ball(self) -> None:
        environment = ball_environment()
        blockers, _, _ = direct_arcs(environment, START[None, :3], START[None, 3:], np.array([-1]), GOAL)
        assert blockers[0] == VESSEL
        nodes, parents, count, used, solved = grow(environment)
        assert solved and used > 0
        path = path_from_tree(start_frame(), nodes, parents, count - 1)
        assert len(path.arcs) >= 2
        assert np.linalg.norm(path.frames()[-1][:3, 3] - GOAL) < 1e-6
        assert blocker_on_path(environment, path, -1) == 0
        points, _ = path.sample(0.02)
        gap = brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 2.0)
        assert gap.min() >= environment.required_clearance_mm - 1e-6

    @pytest.mark.parametrize(
        "changes",
        [
            {},
            {"max_angle_from_start_deg": 28.0},
            {"max_accumulated_turn_deg": 75.0},
            {"max_length_mm": 60.0},
            {"max_curvature_per_mm": 0.05, "max_angle_from_start_deg": 180.0},
        ],
    )
    def test_every_node_is_within_the_limits(self, changes: dict[str, float]) -> None:
        environment = ball_environment(**changes)
        needle = environment.needle
        solutions = 0
        for seed in range(3):
            nodes, parents, count, _, solved = grow(environment, seed)
            solutions += solved
            for last in range(1, count):
                path = path_from_tree(start_frame(), nodes, parents, last)
                end = path.frames()[-1]
                assert np.linalg.norm(end[:3, 3] - nodes[last, :3]) < 1e-9
                assert np.linalg.norm(end[:3, 2] - nodes[last, 3:6]) < 1e-9
                assert path.length_mm == pytest.approx(nodes[last, tree.PATH_LENGTH])
                assert path.accumulated_turn_rad == pytest.approx(nodes[last, tree.PATH_TURN])
                assert path.arcs[:, 2].max() <= needle.max_curvature_per_mm + 1e-12
                assert path.length_mm <= needle.max_length_mm + 1e-9
                assert path.accumulated_turn_rad <= math.radians(needle.max_accumulated_turn_deg) + 1e-9
                assert path.max_angle_from_start_rad() <= math.radians(needle.max_angle_from_start_deg) + 1e-7
        assert solutions > 0

    def test_the_same_seed_grows_the_same_tree(self) -> None:
        environment = ball_environment()
        first, again, other = (grow(environment, seed) for seed in (11, 11, 12))
        assert np.array_equal(first[0], again[0])
        assert np.array_equal(first[1], again[1])
        assert first[0].shape != other[0].shape or not np.array_equal(first[0], other[0])

    def test_slices_grow_the_same_tree_as_one_run(self) -> None:
        environment = ball_environment(max_length_mm=57.5)
        whole = grow(environment, 3, iterations=4000)
        nodes, parents = np.zeros((20000, tree.NODE_COLUMNS)), np.zeros(20000, dtype=np.int64)
        nodes[0, :6] = START
        state = np.array([3], dtype=np.uint64)
        count, used, solved = 1, 0, False
        while used < 4000 and not solved:
            count, spent, solved = rrt.grow_rrt(
                environment.obstacles,
                environment.limits,
                OBJECTIVE,
                -1,
                tuple(GOAL.tolist()),
                nodes,
                parents,
                count,
                min(77, 4000 - used),
                0.5,
                state,
                math.inf,
            )
            used += spent
        assert used == whole[3]
        assert count == whole[2]
        assert np.array_equal(nodes[:count], whole[0])

    def test_a_goal_that_cannot_be_reached(self) -> None:
        _, _, _, used, solved = grow(ball_environment(), goal=np.array([0.0, 0.0, -31.0]), iterations=500)
        assert used == 500 and not solved
        _, _, _, used, solved = grow(ball_environment(), goal=np.array([0.0, 0.0, 0.0]), iterations=500)
        assert used == 500 and not solved, "in the vessel"

    def test_a_goal_at_the_start_and_a_full_tree_end_the_search(self) -> None:
        _, _, count, used, solved = grow(ball_environment(), goal=START[:3].copy(), iterations=500)
        assert (count, used, solved) == (1, 0, False)
        _, _, count, used, solved = grow(ball_environment(max_length_mm=57.5), iterations=50000, size=6)
        assert count <= 6 and used < 50000 and not solved

    def test_goals_more_than_two_radii_away(self) -> None:
        """Where no arc of the tightest curvature joins start and goal."""
        canvas = Canvas.empty([-22, -22, -52], [22, 22, 52], 1.0)
        canvas.add(canvas.ball([0, 0, 0], 5.0), VESSEL)
        needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 40)
        environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
        nodes, parents = np.zeros((5000, tree.NODE_COLUMNS)), np.zeros(5000, dtype=np.int64)
        nodes[0, :6] = 0.0, 0.0, -46.0, 0.0, 0.0, 1.0
        _, _, solved = rrt.grow_rrt(
            environment.obstacles, environment.limits, OBJECTIVE, -1, (0.0, 0.0, 46.0), nodes,
            parents, 1, 20000, 0.5, np.array([1], dtype=np.uint64), math.inf,
        )  # fmt: skip
        assert solved
