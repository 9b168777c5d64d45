"""Degenerate geometry in every stage: a right answer or a typed error, and no number that is none."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import LungaccessError
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.tree.build import tree_from_graph
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.path import Query, violation
from stages.needle.search.planners import searches
from stages.scope.motion_proof import prove_motion
from stages.scope.motions import ScopeMotions, find_motions
from stages.scope.route.centreline import from_graph, from_tree
from stages.scope.route.planner import plan_route
from stages.scope.route.proof import RouteLimits
from stages.scope.tour.itinerary import shortest_tour
from stages.scope.tour.subtree import find_exits, subtree_to
from stages.tube.device import BentPiece, Tube
from stages.tube.mechanics import TubeMechanics
from tests.fuzz.run import not_finite
from tests.stages.scenes import Canvas
from tests.stages.scope.airways import forked_lung
from tests.stages.scope.sampled_motion import SCOPE


def answer(of: Callable[[], Any]) -> Any:
    """Return what a call returns, all of whose numbers are numbers, or None for a typed error."""
    try:
        found = of()
    except LungaccessError:
        return None
    assert not list(not_finite(found))
    return found


places = st.sampled_from((0.0, 1e-320, 1e-9, 5e-4, 0.5, 1.0, 20.0, -1e-9, -0.5, 1e7))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(places, places, places), min_size=1, max_size=9),
    st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=1, max_size=12),
    st.lists(st.sampled_from((0.0, 1e-320, 0.4, 3.0, 9.0)), min_size=9, max_size=9),
)
def test_graphs_of_doubled_and_collinear_points(
    points: list[tuple[float, ...]], edges: list[tuple[int, int]], radius: list[float]
) -> None:
    pairs = [(a % len(points), b % len(points)) for a, b in edges]
    for read in (tree_from_graph, from_graph):
        answer(lambda read=read: read(points, radius[: len(points)], pairs))


FEW = 400
TARGETS = ((0, 0, 0), (1e-12, 0, 0), (0, 0, 20), (1e-9, 0, 20), (0, 0, -10))
LENGTHS = (0.0, 5e-324, 1e-12, 1e-9, 1e-6, 10.0, 40.0)
CURVATURES = (0.0, 5e-324, 1e-300, 1e-12, 1e-9, 0.008)
ANGLES = (0.0, 5e-324, 1e-12, math.pi, -math.pi, 2.0 * math.pi, 1.0)


def tube(number: int, curvature: float, curved_mm: float, pieces: int) -> Tube:
    outer, inner, length = ((1.1, 0.95, 100.0), (1.5, 1.3, 90.0), (1.9, 1.65, 90.0))[number]
    bent: dict[str, Any] = {"curved_length_mm": curved_mm, "precurvature_per_mm": curvature}
    if pieces:
        piece = BentPiece(length_mm=curved_mm / pieces, precurvature_per_mm=curvature)
        bent = {"bent_pieces": (piece,) * pieces}
    return Tube(outer_diameter_mm=outer, inner_diameter_mm=inner, length_mm=length, **bent)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_tubes_of_no_length_no_curvature_no_overlap_and_equal_angles(data: st.DataObject) -> None:
    drawn = [
        answer(
            lambda n=n: tube(n, *(data.draw(st.sampled_from(k)) for k in (CURVATURES, LENGTHS, (0, 1, 3))))
        )
        for n in range(data.draw(st.sampled_from((1, 2, 3))))
    ]
    tubes = [each for each in drawn if each is not None]
    ahead = np.sort([data.draw(st.sampled_from(LENGTHS)) for _ in tubes])[::-1]
    angles = [data.draw(st.sampled_from(ANGLES)) for _ in tubes]
    mechanics = answer(lambda: TubeMechanics(tubes))
    if mechanics is None:
        return
    beta = ahead - mechanics.lengths_mm
    found = answer(lambda: mechanics.given_base_angles(angles, beta))
    if found is None:
        return
    backbone = found.backbone(np.linspace(0.0, ahead[0], 5))
    tip = found.base_from_tip
    assert np.isfinite(backbone).all() and np.isfinite(tip).all()
    assert np.allclose(tip[:3, :3] @ tip[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.norm(tip[:3, 3]) <= ahead[0] + 1e-9
    if all(each.max_precurvature_per_mm < 1e-8 for each in tubes):
        assert np.allclose(tip[:3, 3], [0.0, 0.0, ahead[0]], atol=1e-4)


@pytest.mark.parametrize("planner", ["rrt", "optimal", "resolution", "decide"])
def test_needles_to_the_start_straight_ahead_and_behind(planner: str) -> None:
    """A path of no length, if any, leads to the start; none leads behind it; a thin arc is a straight one."""
    for curvature, target in itertools.product((1e-12, 0.02), TARGETS):
        environment = free(curvature)
        asked = Query(lps_from_start=np.eye(4), target=np.array(target, dtype=float))
        search = searches()[planner](environment, asked, 1)
        search.advance(FEW)
        if search.path is not None:
            assert math.isfinite(search.cost) and not list(not_finite(search.path))
            assert violation(environment, asked, search.path) == ""
            assert target[2] >= 0.0
        else:
            assert target[2] < 1.0, (curvature, target)


def test_no_proof_denies_a_target_at_the_start_or_straight_ahead() -> None:
    for curvature, target in itertools.product((1e-12, 0.02), TARGETS):
        asked = Query(lps_from_start=np.eye(4), target=np.array(target, dtype=float))
        proof = NoPathProof(free(curvature), asked, max_bytes=1 << 22)
        assert proof.run() != "no path" or target[2] < 0.0


def free(curvature: float) -> NeedleEnvironment:
    canvas = Canvas.empty([-15, -15, -15], [15, 15, 35], 1.0)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=curvature)
    return needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)


def doubled(tree: AirwayTree) -> AirwayTree:
    """Return the tree with every point twice."""
    first = 2 * np.maximum(tree.parent_point, 0) + 1
    parents = np.stack([np.where(tree.parent_point < 0, -1, first), 2 * np.arange(tree.n_points)], axis=1)
    twice = ("points_lps", "radius_mm", "branch_of_point", "distance_from_root_mm", "tangents")
    return replace(
        tree,
        **{name: np.repeat(getattr(tree, name), 2, axis=0) for name in twice},
        parent_point=parents.ravel(),
        branch_start=2 * tree.branch_start,
    )


def with_a_branch_of_no_length(tree: AirwayTree) -> AirwayTree:
    """Return the tree with a branch more, which is a single point at the end of the last one."""
    last = tree.n_points - 1
    same = ("points_lps", "radius_mm", "distance_from_root_mm", "tangents")
    branch = tree.n_branches - 1
    return replace(
        tree,
        **{name: np.concatenate([getattr(tree, name), getattr(tree, name)[-1:]]) for name in same},
        parent_point=np.append(tree.parent_point, last),
        branch_of_point=np.append(tree.branch_of_point, branch + 1),
        branch_start=np.append(tree.branch_start, last + 2),
        branch_parent=np.append(tree.branch_parent, branch),
        generation=np.append(tree.generation, tree.generation[-1] + 1),
    )


def closed(tree: AirwayTree) -> AirwayTree:
    """Return the tree with a radius of 0 in the middle of its second branch."""
    radius = tree.radius_mm.copy()
    radius[int(tree.branch_points(1).mean())] = 0.0
    return replace(tree, radius_mm=radius)


@pytest.fixture(scope="module")
def lung() -> Lung:
    return forked_lung()


@pytest.fixture(scope="module")
def whole(lung: Lung) -> ScopeMotions:
    return find_motions(lung, SCOPE, reach_mm=60.0)


@pytest.mark.parametrize("change", [doubled, with_a_branch_of_no_length, closed])
def test_scopes_in_trees_of_doubled_points_no_length_and_no_width(
    change: Callable[[AirwayTree], AirwayTree], lung: Lung, whole: ScopeMotions
) -> None:
    changed = replace(lung, tree=change(lung.tree))
    found = find_motions(changed, SCOPE, reach_mm=60.0)
    assert not list(not_finite(found))
    assert found.count < 0.9 * whole.count if change is closed else found.count > 0.9 * whole.count
    for tip in range(0, found.count, max(found.count // 5, 1)):
        assert isinstance(prove_motion(lung, SCOPE, found.motion(tip)), float)
    goals = [lung.tree.points_lps[lung.tree.branch_start[b + 1] - 1] for b in (2, 3)]
    exits = find_exits(changed.tree, np.array(goals))
    tour, same = (
        shortest_tour(subtree_to(t, find_exits(t, np.array(goals)))) for t in (changed.tree, lung.tree)
    )
    assert len(exits) == 2 and not list(not_finite(tour))
    assert tour.length_mm == pytest.approx(same.length_mm)
    limits = RouteLimits(max_curvature_per_mm=0.5)
    begin = lung.tree.points_lps[8]
    for goal in (goals[0], begin, begin + [0.0, 0.0, 1e-9]):
        route = answer(lambda goal=goal: plan_route(from_tree(changed.tree), begin, goal, limits))
        assert route is None or np.linalg.norm(route.curve.at(route.curve.breaks[-1:])[0] - goal) <= 1.0
