"""The asymptotically optimal search, and the decision between a path and a proof."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.fields import CENTRES
from anatomy.margins import Margins
from anatomy.structures import OUTSIDE, VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels, needle_environment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import Query
from stages.needle.search.base import RestartingRRT, luby
from stages.needle.search.decision import Decision
from stages.needle.search.optimal import OptimalSearch
from tests.stages.needle.proved import assert_each_path_is_cheaper
from tests.stages.scenes import Canvas

BALL_MM = 6.0


def ball_environment(radius_mm: float = 60.0, **more: float) -> NeedleEnvironment:
    """A vessel ball between start and goal."""
    canvas = Canvas.empty([-32, -32, -42], [32, 32, 42], 1.0)
    canvas.add(canvas.ball([0, 0, 0], BALL_MM), VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / radius_mm)
    return needle_environment(canvas.lung(), needle, Margins(), with_fissures=False, **more)


def query(goal: tuple[float, float, float] = (0.0, 0.0, 38.0)) -> Query:
    frame = np.eye(4)
    frame[:3, 3] = 0.0, 0.0, -38.0
    return Query(lps_from_start=frame, target=np.array(goal))


def shortest_around_a_ball(radius_mm: float, keep_mm: float, half_mm: float) -> float:
    """Return the least length of plane paths from (0, -half) up to (0, half) around a ball at the origin.

    Arc away, straight, arc back, straight: turns and lengths on a grid, clearance at dense samples.
    """
    best = math.inf
    for turn in np.linspace(0.05, 0.6, 56):
        for straight in np.linspace(0.0, 30.0, 61):
            x, y, heading = radius_mm * (1 - math.cos(turn)), -half_mm + radius_mm * math.sin(turn), turn
            x, y = x + straight * math.sin(turn), y + straight * math.cos(turn)
            cx, cy = x - radius_mm * math.cos(heading), y + radius_mm * math.sin(heading)
            away = math.hypot(-cx, half_mm - cy)
            if away <= radius_mm:
                continue
            # The heading with which the circle is left: its tangent leads to the goal.
            leave = math.acos(radius_mm / away) - math.atan2(half_mm - cy, -cx)
            s = np.linspace(leave, heading, 200)
            arc = np.stack([cx + radius_mm * np.cos(s), cy - radius_mm * np.sin(s)], axis=1)
            s = np.linspace(0.0, turn, 100)
            first = np.stack([radius_mm * (1 - np.cos(s)), -half_mm + radius_mm * np.sin(s)], axis=1)
            ends = [first[-1] + w * (np.array([x, y]) - first[-1]) for w in np.linspace(0, 1, 100)]
            last = [arc[0] + w * (np.array([0.0, half_mm]) - arc[0]) for w in np.linspace(0, 1, 100)]
            points = np.concatenate([first, ends, arc, last])
            if leave > heading or np.hypot(*points.T).min() < keep_mm:
                continue
            rest = math.sqrt(away**2 - radius_mm**2)
            best = min(best, radius_mm * (turn + heading - leave) + straight + rest)
    return best


@pytest.mark.slow
def test_the_length_goes_to_that_of_the_shortest_path_around_a_ball() -> None:
    """The plane path is an upper bound of the optimum; voxels make the ball a little larger or smaller."""
    environment = ball_environment()
    search = OptimalSearch(environment, query(), seed=1)
    lengths = []
    for _ in range(150):
        if search.advance(400) and search.path is not None:
            lengths.append(search.path.length_mm)
    assert lengths == sorted(lengths, reverse=True)
    bound = shortest_around_a_ball(60.0, BALL_MM + 0.5 + 0.87 + environment.required_clearance_mm, 38.0)
    assert 76.0 < lengths[-1] <= bound
    rrt = RestartingRRT(environment, query(), seed=1)
    while rrt.iterations < search.iterations:
        rrt.advance(2000)
    assert rrt.path is not None
    assert lengths[-1] < rrt.path.length_mm - 0.05, "better than restarts"


@pytest.mark.parametrize(
    "objective", [SHORTEST, Objective(inverse_clearance=1.0), Objective(inverse_clearance=1.0, length=0.1)]
)
def test_paths_are_clear_and_within_the_limits(objective: Objective) -> None:
    environment = ball_environment()
    search = OptimalSearch(environment, query(), seed=3, objective=objective)
    assert_each_path_is_cheaper(environment, search, 20, query().target)


def test_a_path_that_ends_short_pays_for_it() -> None:
    exact, loose = (
        OptimalSearch(ball_environment(), query()),
        OptimalSearch(ball_environment(goal_tolerance_mm=1.0), query()),
    )
    for search in (exact, loose):
        for _ in range(60):
            search.advance(400)
    assert loose.path is not None
    missing = float(np.linalg.norm(loose.path.frames()[-1][:3, 3] - query().target))
    assert missing <= 1.0
    assert loose.cost == pytest.approx(loose.path.length_mm + missing)
    assert loose.cost == pytest.approx(exact.cost, rel=0.01)


def test_the_same_seed_repeats() -> None:
    def run(seed: int) -> np.ndarray:
        search = OptimalSearch(ball_environment(), query(), seed=seed)
        for _ in range(10):
            search.advance(250)
        assert search.path is not None
        return np.asarray(search.path.arcs)

    assert np.array_equal(run(5), run(5))
    assert run(5).shape != run(6).shape or not np.array_equal(run(5), run(6))


def test_luby() -> None:
    assert [luby(n) for n in range(1, 16)] == [1, 1, 2, 1, 1, 2, 4, 1, 1, 2, 1, 1, 2, 4, 8]


def test_a_decision_is_a_path_or_a_proof() -> None:
    open_way = Decision(ball_environment(), query())
    while open_way.outcome == "running":
        open_way.advance(500)
    assert open_way.outcome == "path" and open_way.path is not None and not open_way.finished

    canvas = Canvas.empty([-32, -32, -42], [32, 32, 42], 1.0)
    canvas.add(np.abs(canvas.points[..., 2]) < 2.0, OUTSIDE)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 60)
    walled = Decision(needle_environment(canvas.lung(), needle, Margins(), with_fissures=False), query())
    while walled.outcome == "running":
        walled.advance(500)
    assert walled.outcome == "no path" and walled.finished and walled.path is None
    assert not walled.advance(100)


def test_a_blocked_start_is_decided_in_the_first_iterations() -> None:
    canvas = Canvas.empty([-32, -32, -42], [32, 32, 42], 1.0)
    canvas.add(np.linalg.norm(canvas.points - query().lps_from_start[:3, 3], axis=-1) < 3.0, VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 60)
    blocked = Decision(needle_environment(canvas.lung(), needle, Margins(), with_fissures=False), query())
    blocked.advance(200)
    assert blocked.outcome == "no path" and blocked.iterations == 100


def test_a_decision_goes_on_to_better_paths_and_repeats() -> None:
    def run() -> tuple[list[float], np.ndarray]:
        decision = Decision(ball_environment(), query(), seed=3)
        costs = [decision.cost for _ in range(40) if decision.advance(250)]
        assert decision.path is not None and decision.path.length_mm == pytest.approx(costs[-1], abs=1e-3)
        return costs, np.asarray(decision.path.arcs)

    costs, arcs = run()
    assert costs == sorted(costs, reverse=True) and len(costs) > 1
    assert np.array_equal(arcs, run()[1])


def test_obstacles_as_centres_and_as_boxes() -> None:
    """Half a voxel beside a column of obstacle voxels, centres are farther away than boxes."""
    canvas = Canvas.empty([-16, -16, -16], [16, 16, 16], 1.0)
    canvas.add(canvas.points[..., 0] > 3.0, VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 60)
    frame = np.eye(4)
    frame[:3, 3] = 2.0, 0.0, -10.0
    straight = Query(lps_from_start=frame, target=np.array([2.0, 0.0, 10.0]))

    def solves(required: float, **how: float) -> bool:
        environment = environment_of_labels(
            canvas.labels, canvas.grid, needle, required_clearance_mm=required, **how
        )
        return RestartingRRT(environment, straight).advance(0)

    assert solves(0.9) and not solves(1.1), "the faces lie at x = 3"
    assert solves(1.4, obstacles_as=CENTRES) and not solves(1.6, obstacles_as=CENTRES), "centres at 3.5"
