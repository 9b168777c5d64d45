"""Guide paths on state lattices: against all sequences of moves, and against what a needle can follow."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from anatomy.base.typed import Float
from anatomy.grid import Volume
from anatomy.margins import Margins
from anatomy.structures import VESSEL
from stages.needle.costs import map_integral
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath, Query
from stages.needle.search import guide_paths
from stages.needle.search.guide_paths import (
    ARCS_PER_ITERATION,
    CELLS,
    CURVATURE_SHARE,
    LAYERS,
    LEAST_GAIN,
    SKEWS,
    GuidePathFinder,
    StateLatticeSearch,
    via_points,
)
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.portfolio import PortfolioSearch
from tests.stages.needle.proved import assert_proved
from tests.stages.scenes import Canvas

MAP = Objective(cost_map=1.0)
RADIUS_MM = 60.0


def environment_with(costs: np.ndarray | None = None, *balls: tuple[list[float], float]) -> NeedleEnvironment:
    """A box of tissue of 50 x 50 x 84 mm with vessel balls, and costs at its voxels."""
    canvas = Canvas.empty([-25, -25, -42], [25, 25, 42], 1.0)
    for centre, radius in balls:
        canvas.add(canvas.ball(centre, radius), VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / RADIUS_MM)
    environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
    if costs is None:
        return environment
    return replace(
        environment, cost_map=Volume(grid=environment.grid, array=np.asfortranarray(costs, dtype=np.float32))
    )


def random_costs(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 1.0, (50, 50, 84))


def wall_with_a_hole(aside_mm: float = 4.0, radius_mm: float = 0.8) -> np.ndarray:
    """A thick wall of cost with a hole aside of the straight line; elsewhere tissue costs little."""
    x, y = np.meshgrid(np.arange(50) - 24.5, np.arange(50) - 24.5, indexing="ij")
    costs = np.full((50, 50, 84), 0.01)
    costs[:, :, 30:54] = np.where(np.hypot(x - aside_mm, y) < radius_mm, 0.01, 10.0)[..., None]
    return costs


def query(tilt_deg: float = 0.0, goal: tuple[float, float, float] = (0.0, 0.0, 38.0)) -> Query:
    """From the bottom of the box to its top; the start leans towards +x."""
    c, s = math.cos(math.radians(tilt_deg)), math.sin(math.radians(tilt_deg))
    frame = np.eye(4)
    frame[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    frame[:3, 3] = 0.0, 0.0, -38.0
    return Query(lps_from_start=frame, target=np.array(goal))


def straight(p: Float, q: Float) -> ArcPath:
    """Return the straight path from a point to another."""
    z = (q - p) / np.linalg.norm(q - p)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, p
    return ArcPath(lps_from_start=frame, arcs=np.array([[np.linalg.norm(q - p), 0.0, 0.0]]))


def arcs_along(controls: Float) -> list[ArcPath]:
    """Return the arcs from the middle of each piece to that of the next; those at the ends are half ones."""
    pieces = np.diff(controls, axis=0)
    knots = np.concatenate([controls[:1], 0.5 * (controls[1:-2] + controls[2:-1]), controls[-1:]])
    arcs = []
    for p, along, q in zip(knots[:-1], pieces[:-1], knots[1:], strict=True):
        t = along / np.linalg.norm(along)
        chord = q - p
        aside = chord - (chord @ t) * t
        bend = 2.0 * float(np.linalg.norm(aside)) / float(chord @ chord)
        x = aside if bend > 1e-9 else np.cross([0.0, 1.0, 0.0], t)
        x = x / np.linalg.norm(x)
        frame = np.eye(4)
        frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(t, x), t, p
        turn = 2.0 * math.atan2(float(np.linalg.norm(aside)), float(chord @ t))
        length = turn / bend if bend > 1e-9 else float(chord @ t)
        arcs.append(
            ArcPath(lps_from_start=frame, arcs=np.array([[length, 0.0, bend if bend > 1e-9 else 0.0]]))
        )
        assert np.allclose(arcs[-1].frames()[-1, :3, 3], q, atol=1e-6)
    return arcs


def map_cost(environment: NeedleEnvironment, controls: Float) -> float:
    """Return the line integral of the cost map along the arcs of a guide path."""
    return sum(map_integral(environment.cost_map, each) for each in arcs_along(controls))


def bending(controls: Float) -> Float:
    """Return the curvature of the arcs from the middle of each piece to that of the next."""
    return np.array([each.arcs[0, 2] for each in arcs_along(controls)])


def assert_followed(
    environment: NeedleEnvironment, asked: Query, controls: Float, objective: Objective = MAP
) -> float:
    """Fail unless a needle can follow a guide path; return what that costs."""
    search = OptimalSearch(environment, asked, objective=objective)
    assert search.follow(via_points(controls))
    assert search.path is not None
    assert_proved(environment, search.path, asked.target)
    return search.cost


@pytest.mark.parametrize(("tilt_deg", "skew"), [(0.0, 0), (7.0, 0), (7.0, 1), (-10.0, 2)])
def test_the_cheapest_guide_path_is_that_of_all_sequences_of_moves(tilt_deg: float, skew: int) -> None:
    """All 7^5 sequences of moves are tried; those that end at the target are rated piece by piece."""
    layers, asked = 5, query(tilt_deg)
    environment = environment_with(random_costs(1))
    lattices = StateLatticeSearch(environment, asked, MAP)
    base, axes, goal_cells = lattices._straight(layers, skew)
    guide = lattices.everywhere(layers, skew=skew)
    units = np.array([[0, 0], [1, 0], [0, 1], [-1, 1], [-1, 0], [0, -1], [1, -1]])
    moves = units[np.array(list(product(range(7), repeat=layers)))]
    steps = np.cumsum(moves, axis=1)
    cells = np.concatenate([np.zeros((len(steps), 1, 2), int), np.cumsum(steps, axis=1)[:, :-1]], axis=1)
    ends = 2 * cells[:, -1] + steps[:, -1]
    cells = cells[(ends == goal_cells).all(axis=1)]
    assert len(cells) > 20
    costs = []
    for each in cells:
        inner = base[1:-1] + each @ axes
        controls = np.concatenate([base[:1], inner, asked.target[None]])
        if bending(controls).max() <= CURVATURE_SHARE / RADIUS_MM:
            costs.append(map_cost(environment, controls))
    assert len(costs) > 10
    assert guide.is_whole and guide.controls is not None
    assert guide.cost == pytest.approx(min(costs), rel=1e-6)
    assert map_cost(environment, guide.controls) == pytest.approx(min(costs), rel=1e-6)


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0, -15.0])
def test_a_needle_can_follow_the_guide_paths_around_a_ball(tilt_deg: float) -> None:
    asked, objective = query(tilt_deg), Objective(length=1.0, inverse_clearance=1.0)
    environment = environment_with(None, ([0.0, 0.0, 0.0], 3.0))
    lattices = StateLatticeSearch(environment, asked, objective)
    middles = []
    for skew in range(SKEWS):
        guide = lattices.everywhere(12, skew=skew)
        assert guide.controls is not None
        assert bending(guide.controls).max() <= CURVATURE_SHARE / RADIUS_MM * (1 + 1e-9)
        assert guide.controls[-1] == pytest.approx(asked.target, abs=1e-9)
        assert assert_followed(environment, asked, guide.controls, objective) == pytest.approx(
            guide.cost, rel=0.002
        )
        middles.append(guide.controls[6])
    assert max(np.linalg.norm(each - middles[0]) for each in middles) > 0.05


@pytest.mark.parametrize("tilt_deg", [4.0, 8.0, -6.0])
def test_a_needle_can_follow_guide_paths_that_touch_what_they_pass(tilt_deg: float) -> None:
    """The shortest path bends around the ball: the arcs lie nearer to it than the vertices."""
    asked = query(tilt_deg)
    environment = environment_with(None, ([1.0, 0.0, 0.0], 5.0))
    lattices = StateLatticeSearch(environment, asked, SHORTEST)
    guide = lattices.everywhere(10)
    for cells, turn_rad in ((1 / 3, 0.1), (1 / 6, 0.4), (1 / 6, 0.8), (1 / 12, 0.2)):
        assert guide.controls is not None
        assert assert_followed(environment, asked, guide.controls, SHORTEST) == pytest.approx(
            guide.cost, rel=1e-4
        )
        guide = lattices.around(guide.controls, cells, turn_rad, guide.cost * (1 + 1e-9))


def test_guide_paths_around_another_are_cheaper_and_meet_the_target() -> None:
    environment, asked = environment_with(random_costs(2)), query(10.0)
    lattices = StateLatticeSearch(environment, asked, MAP)
    guide = lattices.everywhere(10)
    costs = [guide.cost]
    for cells in (0.5, 0.25, 0.125):
        assert guide.controls is not None
        guide = lattices.around(guide.controls, cells, 0.3, costs[-1] * (1 + 1e-9))
        costs.append(guide.cost)
        assert guide.controls is not None
        assert bending(guide.controls).max() <= CURVATURE_SHARE / RADIUS_MM * (1 + 1e-9)
        assert guide.controls[-1] == pytest.approx(asked.target, abs=1e-9)
        assert map_cost(environment, guide.controls) == pytest.approx(guide.cost, rel=1e-9)
    assert (np.diff(costs) <= 1e-9).all()
    assert costs[-1] < 0.97 * costs[0]
    costlier = lattices.around(guide.controls, 0.125, 0.3, 0.5 * costs[-1])
    assert costlier.controls is None and costlier.cost == math.inf


def test_controls_of_a_path_lead_along_it() -> None:
    environment, asked = environment_with(random_costs(3)), query(10.0)
    lattices = StateLatticeSearch(environment, asked, MAP)
    controls = lattices.everywhere(12).controls
    assert controls is not None
    search = OptimalSearch(environment, asked, objective=MAP)
    assert search.follow(via_points(controls)) and search.path is not None
    again = lattices.controls_of(search.path, 12)
    assert again is not None
    assert np.abs(again - controls).max() < 0.05


def test_a_path_that_turns_back_has_no_controls() -> None:
    frame = query().lps_from_start
    back = ArcPath(lps_from_start=frame, arcs=np.array([[120.0, 0.0, 1 / RADIUS_MM]]))
    assert StateLatticeSearch(environment_with(random_costs(1)), query(), MAP).controls_of(back, 12) is None


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        (query(80.0), "steep"),
        (query(0.0, (0.0, 0.0, -38.0)), "at the start"),
        (query(70.0, (-6.0, 0.0, -28.0)), "out of the workspace"),
    ],
)
def test_there_are_no_guide_paths_where_none_can_be(asked: Query, why: str) -> None:
    environment = environment_with(random_costs(1))
    assert not StateLatticeSearch(environment, asked, MAP).is_possible, why
    finder = GuidePathFinder(environment, asked, seed=1, objective=MAP)
    search = OptimalSearch(environment, asked, objective=MAP)
    assert not finder.has_guide_paths
    assert not list(finder.begin(search, math.inf)) and search.path is None


def test_a_lattice_with_too_many_states_has_no_guide_path() -> None:
    guide = StateLatticeSearch(environment_with(random_costs(1)), query(10.0), MAP).everywhere(40)
    assert not guide.is_whole and guide.controls is None


def test_a_blocked_start_has_no_guide_path() -> None:
    environment = environment_with(random_costs(1), ([0.0, 0.0, -36.0], 3.0))
    assert StateLatticeSearch(environment, query(), MAP).everywhere(10).controls is None


def test_searches_follow_only_what_is_cheaper_and_can_be_followed() -> None:
    environment, asked = environment_with(random_costs(1)), query()
    controls = StateLatticeSearch(environment, asked, MAP).everywhere(10).controls
    assert controls is not None
    search = OptimalSearch(environment, asked, objective=MAP)
    assert not search.follow(np.array([[15.0, 0.0, -30.0], asked.target])), "bends too much"
    assert not search.follow(np.array([[0.0, 0.0, 0.0]])), "does not reach the target"
    assert not search.follow(np.repeat(asked.target[None], 99, axis=0)), "too many points"
    assert search.path is None
    assert search.follow(via_points(controls))
    cost = search.cost
    assert not search.follow(via_points(controls)), "is no cheaper"
    while search.iterations < 3000:
        search.advance(500)
    assert search.cost < cost


def test_a_lattice_holds_the_path_through_a_hole_in_a_wall_of_cost() -> None:
    """Searches led by guide paths alone go through the hole: they are not refined, and no tree grows."""
    environment, asked = environment_with(wall_with_a_hole()), query()
    assert StateLatticeSearch(environment, asked, MAP).everywhere(10).cost < 1.0
    search = OptimalSearch(environment, asked, objective=MAP)
    work = list(GuidePathFinder(environment, asked, seed=1, objective=MAP).begin(search, math.inf))
    assert search.cost < 1.0
    assert search.iterations == 0 < sum(iterations for iterations, _ in work) < 20_000
    assert map_integral(environment.cost_map, straight(asked.lps_from_start[:3, 3], asked.target)) > 200.0
    portfolio = PortfolioSearch(environment, asked, seed=3, objective=MAP)
    while portfolio.iterations < 6_000:
        portfolio.advance(500)
    assert portfolio.cost < 1.0


@pytest.mark.parametrize("look_arcs", [1, 1 << 30])
def test_searches_begin_with_the_cheapest_guide_paths(
    monkeypatch: pytest.MonkeyPatch, look_arcs: int
) -> None:
    """Of one more lattice each time, or of all from the second on; no lattice is looked at twice."""
    monkeypatch.setattr(guide_paths, "ARCS_PER_BEGINNING", look_arcs)
    monkeypatch.setattr(guide_paths, "LAYERS", (8, 10))
    monkeypatch.setattr(guide_paths, "CELLS", ())
    environment, asked = environment_with(random_costs(5)), query(5.0)
    lattices = StateLatticeSearch(environment, asked, MAP)
    every = [lattices.everywhere(layers, skew=skew) for skew in range(SKEWS) for layers in (8, 10)]
    finder = GuidePathFinder(environment, asked, seed=1, objective=MAP)
    unseen, seen, begun = list(every), [], []
    for _ in range(len(every) + 2):
        search = OptimalSearch(environment, asked, objective=MAP)
        work = list(finder.begin(search, math.inf))
        looks = 1 if look_arcs == 1 or not begun else len(unseen)
        looked, unseen = unseen[:looks], unseen[looks:]
        assert [done for done, _ in work] == [1 + guide.arcs // ARCS_PER_ITERATION for guide in looked]
        seen += looked
        if not seen:
            seen, begun = begun, []
        seen.sort(key=lambda guide: guide.cost)
        begun.append(seen.pop(0))
        expected = OptimalSearch(environment, asked, objective=MAP)
        assert begun[-1].controls is not None and expected.follow(via_points(begun[-1].controls))
        assert search.cost == expected.cost
    assert len(begun) == 2 and finder.has_guide_paths


def test_layers_of_which_there_are_too_many_states_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guide_paths, "LAYERS", (8, 40))
    environment, asked = environment_with(random_costs(5)), query(5.0)
    finder = GuidePathFinder(environment, asked, seed=1, objective=MAP)
    search = OptimalSearch(environment, asked, objective=MAP)
    list(finder.begin(search, math.inf))
    assert search.path is not None and finder.has_guide_paths
    list(finder.begin(OptimalSearch(environment, asked, objective=MAP), math.inf))
    assert finder._layers == (8,)
    cost = search.cost
    for _ in range(3):
        list(finder.improve(search, search.cost))
    assert search.cost < cost


def test_a_guide_path_is_refined_as_long_as_that_gains() -> None:
    environment, asked = environment_with(random_costs(2)), query(10.0)
    finder = GuidePathFinder(environment, asked, seed=1, objective=MAP)
    search, costs = OptimalSearch(environment, asked, objective=MAP), []
    for _ in finder.begin(search, math.inf):
        if search.path is not None:
            costs.append(search.cost)
    passes = costs[len(CELLS) - 1 :: len(CELLS)]
    assert len(costs) == len(CELLS) * len(passes) > len(CELLS)
    gains = -np.diff(np.log(passes))
    assert (gains[:-1] > 0.9 * LEAST_GAIN).all() and gains[-1] < 1.1 * LEAST_GAIN


def test_where_no_lattice_has_a_guide_path_all_time_goes_to_free_searches() -> None:
    """The target takes more than the share of the curvature that guide paths take."""
    environment, asked = environment_with(random_costs(1)), query(0.0, (15.0, 0.0, 2.0))
    lattices = StateLatticeSearch(environment, asked, MAP)
    assert lattices.is_possible
    assert all(lattices.everywhere(layers).controls is None for layers in LAYERS)
    portfolio = PortfolioSearch(environment, asked, objective=MAP)
    spent = []
    for iterations in (3_000, 10_000):
        while portfolio.path is None or portfolio.iterations < iterations:
            portfolio.advance(100)
        assert portfolio._guided is not None
        spent.append(portfolio._guided[1].spent)
    assert spent[0] == spent[1] < 1000


def test_the_same_iterations_give_the_same_path() -> None:
    def run(seed: int) -> np.ndarray:
        search = PortfolioSearch(environment_with(random_costs(1)), query(5.0), seed=seed, objective=MAP)
        while search.iterations < 20_000:
            before = search.iterations
            assert search.advance(250) or search.iterations - before == 250
        assert search.path is not None
        return np.asarray(search.path.arcs)

    assert np.array_equal(run(1), run(1))
    assert run(1).shape != run(2).shape or not np.array_equal(run(1), run(2))


def test_the_target_may_lie_straight_ahead() -> None:
    lattices = StateLatticeSearch(environment_with(random_costs(4)), query(), MAP)
    controls = lattices.everywhere(10).controls
    assert controls is not None
    assert controls[-1] == pytest.approx(query().target, abs=1e-12)
    assert_followed(environment_with(random_costs(4)), query(), controls)


def test_pure_length_needs_no_guide_paths() -> None:
    """Of pure length, no search of a portfolio is guided."""
    assert SHORTEST.is_length and Objective(length=2.0).is_length
    assert not MAP.is_length and not Objective(length=1.0, inverse_clearance=0.1).is_length
    guided = []
    for objective in (SHORTEST, MAP):
        search = PortfolioSearch(environment_with(random_costs(1)), query(5.0), objective=objective)
        while search.iterations < 2000:
            search.advance(500)
        guided.append(search._guided is not None)
    assert guided == [False, True]
