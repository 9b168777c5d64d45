"""Routes: search, repairs, baselines, replanning."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import SettingsError, TargetError
from experiments.support.route.baselines import SamplingSettings, sampled_route
from stages.scope.route.centreline import Centreline, from_image
from stages.scope.route.exact import segments
from stages.scope.route.genetic import repair_genetic
from stages.scope.route.guide_path import NoRouteError, fewest_hops, nearest_links
from stages.scope.route.planner import Replanner, plan_route
from stages.scope.route.proof import Proof, RouteLimits, measure
from tests.stages.scope.route.tubes import chain, corner, fork, least_clearance_of_corner, straight

LIMITS = RouteLimits(max_curvature_per_mm=0.1)


def assert_kept(route: object, tube: Centreline, limits: RouteLimits) -> None:
    """Look again, with other means than the proof."""
    u = route.curve.parameters(300)
    assert route.curve.curvature_per_mm(u).max() <= limits.max_curvature_per_mm
    assert tube.depth_mm(route.curve.at(u)[0]).min() >= limits.needed_mm - 1e-9
    ends = route.curve.at(route.curve.breaks[[0, -1]])[0]
    off = np.linalg.norm(ends - route.guide.points_mm[[0, -1]], axis=1)
    assert off.max() <= limits.end_tolerance_mm + 1e-9


def test_a_straight_tube_needs_no_repair() -> None:
    tube = straight()
    route = plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS)
    assert route.curve is route.tentative
    assert route.curve.length_mm() == pytest.approx(60.0)


@pytest.mark.parametrize("angle", [30.0, 60.0, 90.0])
@pytest.mark.parametrize("curvature", [0.08, 0.2])
def test_a_corner_is_rounded_where_there_is_room(angle: float, curvature: float) -> None:
    """The arc tangent to both legs needs (1 / cos(angle / 2) - 1) / curvature of clearance to the corner."""
    clearance = least_clearance_of_corner(angle, curvature)
    tube = corner(angle, 1.15 * clearance + 0.3)
    limits = RouteLimits(max_curvature_per_mm=curvature, device_radius_mm=0.2)
    route = plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], limits)
    assert_kept(route, tube, limits)


def test_a_corner_without_room_is_refused_with_the_place() -> None:
    tube = corner(90.0, 0.4)
    with pytest.raises(NoRouteError, match="too curved|too near") as caught:
        plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS)
    assert "LPS" in str(caught.value)


def test_ends_stay_or_move_within_their_tolerance() -> None:
    tube = corner(60.0, 3.0)
    rng = np.random.default_rng(5)
    start, goal = tube.nodes_mm[0] + rng.normal(0, 0.5, 3), tube.nodes_mm[-1] + rng.normal(0, 0.5, 3)
    for tolerance in (0.0, 1.0):
        limits = RouteLimits(max_curvature_per_mm=0.1, end_tolerance_mm=tolerance)
        route = plan_route(tube, start, goal, limits)
        assert_kept(route, tube, limits)


def test_repair_changes_only_the_bend() -> None:
    """Far from the corner the curve is the tentative one, to the last bit."""
    tube = corner(50.0, 3.0, leg=120.0)
    route = plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS)
    same = (route.curve.control_mm == route.tentative.control_mm).all(axis=1)
    assert 0.3 < same.mean() < 1.0


def test_same_input_gives_the_same_bits_with_and_without_threads() -> None:
    tube = double_bend()
    ends = tube.nodes_mm[0], tube.nodes_mm[-1]
    first = plan_route(tube, *ends, LIMITS)
    with ThreadPoolExecutor(2) as threads:
        second = plan_route(tube, *ends, LIMITS, executor=threads)
    np.testing.assert_array_equal(first.curve.control_mm, second.curve.control_mm)


def double_bend() -> Centreline:
    """Two corners far apart: two segments."""
    t = np.linspace(0.0, 1.0, 161)
    corners = np.array([(0, 0, 0), (80, 0, 0), (160, 50, 0), (240, 50, 30)], dtype=float)
    legs = [a + (b - a) * t[:, None] for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return chain(np.vstack((legs[0], legs[1][1:], legs[2][1:])), 2.5)


def test_two_bends_are_two_segments() -> None:
    tube = double_bend()
    route = plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS, repair="none", require_proof=False)
    parts = segments(route.proof, len(route.curve.control_mm), 8, ends_free=False)
    assert len(parts) == 2
    assert parts[0][1] <= parts[1][0]


def test_segments_are_widened_merged_and_clipped() -> None:
    verdicts = np.zeros(40, dtype=np.int64)
    verdicts[[1, 12, 30]] = 1
    proof = Proof(verdicts=verdicts, points_mm=np.zeros((40, 3)), curvature_bound_per_mm=0, depth_bound_mm=0)
    assert segments(proof, 43, 3, ends_free=False) == [(1, 19), (27, 37)]
    assert segments(proof, 43, 0, ends_free=True) == [(1, 5), (12, 16), (30, 34)]


def test_search_takes_the_fewest_hops_and_does_not_jump_walls() -> None:
    """Two tubes run 2.5 mm apart; only their far ends are joined."""
    z = np.arange(0.0, 40.0, 0.5)
    left = np.stack((np.zeros_like(z), np.zeros_like(z), z), axis=1)
    right = left[::-1] + (2.5, 0.0, 0.0)
    bridge = np.array([(x, 0.0, 39.5) for x in (0.6, 1.2, 1.8)])
    tube = chain(np.vstack((left, bridge, right)), 1.0)
    links = nearest_links(tube, 8)
    path = fewest_hops(links, 0, tube.n_nodes - 1)
    assert tube.nodes_mm[path][:, 2].max() > 38.0
    assert len(path) <= -(-len(z) // 3) * 2 + 4
    gap = np.linalg.norm(np.diff(tube.nodes_mm[path], axis=0), axis=1)
    assert gap.max() <= 2.0 + 1e-9


def test_parts_that_are_not_joined_have_no_route() -> None:
    a, b = straight(), straight()
    both = Centreline(
        nodes_mm=np.vstack((a.nodes_mm, b.nodes_mm + (30.0, 0.0, 0.0))),
        radius_mm=np.concatenate((a.radius_mm, b.radius_mm)),
        edges=np.vstack((a.edges, b.edges + a.n_nodes)),
    )
    with pytest.raises(NoRouteError, match="does not join"):
        plan_route(both, both.nodes_mm[0], both.nodes_mm[-1], LIMITS)


def test_bad_requests() -> None:
    tube = straight()
    with pytest.raises(TargetError, match="goal"):
        plan_route(tube, tube.nodes_mm[0], (99.0, 0.0, 0.0), LIMITS)
    with pytest.raises(SettingsError, match="same point"):
        plan_route(tube, tube.nodes_mm[3], tube.nodes_mm[3], LIMITS)
    with pytest.raises(SettingsError, match="repair"):
        plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS, repair="magic")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="max_curvature"):
        RouteLimits(max_curvature_per_mm=0.0)


def test_a_route_in_a_drawing_stays_in_its_plane() -> None:
    y, x = np.mgrid[:160, :200]
    drawing = (
        (np.hypot(x - 20.0, y - 150.0) > 90) & (np.hypot(x - 20.0, y - 150.0) < 112) & (x > 20) & (y < 150)
    )
    tube = from_image(drawing, pixel_mm=0.68)
    ends = np.flatnonzero(np.bincount(tube.edges.ravel()) == 1)
    route = plan_route(
        tube, tube.nodes_mm[ends[0]], tube.nodes_mm[ends[-1]], RouteLimits(max_curvature_per_mm=0.08)
    )
    assert (route.curve.control_mm[:, 2] == 0.0).all()
    assert_kept(route, tube, route.limits)


def test_genetic_repair_repeats_from_a_seed_and_claims_no_more_than_it_tests() -> None:
    tube = corner(40.0, 5.0)
    limits = RouteLimits(max_curvature_per_mm=0.15)
    route = plan_route(
        tube, tube.nodes_mm[0], tube.nodes_mm[-1], limits, repair="ga", seed=4, require_proof=False
    )
    again, passed = repair_genetic(route.tentative, tube, limits, seed=4)
    np.testing.assert_array_equal(route.curve.control_mm, again.control_mm)
    assert route.claimed is passed is True
    assert (
        measure(route.curve, tube).largest_curvature_per_mm
        < measure(route.tentative, tube).largest_curvature_per_mm
    )


@pytest.mark.slow
@pytest.mark.parametrize("star", [False, True])
def test_baselines_connect_the_goal_inside_the_lumen(star: bool) -> None:
    tube = fork(radius=2.5)
    start, goal = tube.nodes_mm[0], tube.nodes_mm[-1]
    curve, _proved = sampled_route(tube, start, goal, LIMITS, star=star, seed=1, any_curve=True)
    np.testing.assert_allclose(curve.at(curve.breaks[[0, -1]])[0], (start, goal), atol=1e-9)
    again, _proved = sampled_route(tube, start, goal, LIMITS, star=star, seed=1, any_curve=True)
    np.testing.assert_array_equal(curve.control_mm, again.control_mm)


def test_more_samples_of_rrt_star_do_not_lengthen_the_way() -> None:
    tube = fork(radius=2.5)
    start, goal = tube.nodes_mm[0], tube.nodes_mm[-1]
    loose = RouteLimits(max_curvature_per_mm=10.0)
    lengths = {
        star: np.median([
            sampled_route(tube, start, goal, loose, star=star, seed=seed, any_curve=True)[0].length_mm()
            for seed in range(15)
        ])
        for star in (False, True)
    }  # fmt: skip
    assert lengths[True] <= lengths[False] + 1e-9


def test_a_baseline_that_runs_out_of_samples_says_so() -> None:
    tube = fork()
    with pytest.raises(NoRouteError, match="3 samples"):
        sampled_route(
            tube, tube.nodes_mm[0], tube.nodes_mm[-1], LIMITS, star=False, seed=0,
            settings=SamplingSettings(samples=3),
        )  # fmt: skip


def test_replanning_follows_the_anatomy() -> None:
    tube = corner(60.0, 3.0)
    limits = RouteLimits(max_curvature_per_mm=0.1, device_radius_mm=0.5)
    route = plan_route(tube, tube.nodes_mm[0], tube.nodes_mm[-1], limits)
    replanner = Replanner(tube, route)
    for phase in np.linspace(0.0, 2.0, 7):
        nodes = tube.nodes_mm + 6.0 * np.sin(phase + tube.nodes_mm / 30.0)
        new = replanner.replan(nodes)
        assert_kept(new, replace(tube, nodes_mm=nodes), limits)
    same = replanner.replan(tube.nodes_mm)
    np.testing.assert_allclose(same.curve.control_mm, route.curve.control_mm, atol=1e-6)
    with pytest.raises(SettingsError, match="all nodes"):
        replanner.replan(tube.nodes_mm[:-1])
