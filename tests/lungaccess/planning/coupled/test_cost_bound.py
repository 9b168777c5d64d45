"""The lower bound of the cost: no plan is below it, and its parts are bounds."""

from __future__ import annotations

import math
from typing import Any, cast

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

import lungaccess as la
from anatomy.base.errors import SettingsError, TargetError
from anatomy.fields import distance_field
from anatomy.grid import Grid
from anatomy.kernels.field import most_distance
from anatomy.lung import Lung
from lungaccess.planning.coupled.cost_bound import QUEUES, CostBound, cost_to_go
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER, ROTATION
from lungaccess.planning.coupled.kernels.cost_bound import BoundEnvironment, between, bound_box
from lungaccess.planning.coupled.kernels.cost_to_go import cost_from
from lungaccess.planning.coupled.kernels.deployment_box import (
    ACROSS,
    BOX_COLUMNS,
    TIP,
    UP,
    TubeSurroundings,
    least_sweep,
    tubes_at,
    tubes_blocked,
)
from lungaccess.planning.coupled.layer_bound import GapGoal
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.target import Target, point_target
from lungaccess.problem.task import Task
from stages.needle import Objective, direct_path
from stages.needle.kernels import Limits
from stages.tube import tube_constants
from stages.tube.kernels import CURVED_LENGTH, MAX_EXTENSION, NEAR_PLEURA, NEAR_VESSEL, lateral_sweep
from stages.tube.kernels.wall_exit import LEAVING, PHASE
from stages.tube.validation import REASONS
from tests.lungaccess.planning.coupled.planning import SYSTEM, plans_of, same_run

Points = NDArray[np.float64]
SPACING_MM = (0.6, 0.8, 1.1)
SHAPE = (24, 20, 16)


@numba.njit
def _distances(field: Any, geometry: Any, points: Any, out: Any) -> None:
    for n in range(len(points)):
        out[n] = most_distance(field, geometry, points[n, 0], points[n, 1], points[n, 2])


@numba.njit
def _between(environment: Any, begin: Any, end: Any, begin_off: float, end_off: float) -> float:
    return float(between(environment, begin, end, begin_off, end_off))


@numba.njit
def _cost_from(togo: Any, x: float, y: float, z: float, around: float) -> float:
    return float(cost_from(togo, x, y, z, around, 0.0))


@numba.njit
def _least_sweep(tubes: Any, box: Any) -> float:
    return float(least_sweep(tubes, box))


def improved(bound: CostBound, cost: float, boxes: int) -> float:
    """Divide so many boxes, and return the bound."""
    bound.start(cost, boxes)
    return bound.value


def _boxes(rng: np.random.Generator, count: int) -> tuple[Grid, NDArray[np.bool_]]:
    mask = np.zeros(SHAPE, dtype=bool)
    mask[tuple(rng.integers(0, SHAPE, size=(count, 3)).T)] = True
    return Grid.from_spacing(SHAPE, SPACING_MM, (0.0, 0.0, 0.0)), mask


def _exact(mask: NDArray[np.bool_], points: Points) -> Points:
    centres, half = np.argwhere(mask) * np.array(SPACING_MM), 0.5 * np.array(SPACING_MM)
    gaps = np.maximum(np.abs(points[:, None] - centres) - half, 0.0)
    return np.asarray(np.sqrt((gaps**2).sum(axis=2)).min(axis=1))


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 5), (2, 60)])
def test_no_distance_exceeds_its_upper_bound(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    grid, mask = _boxes(rng, count)
    field = distance_field("obstacle", mask, grid)
    points = rng.uniform(1.5, np.array(SHAPE) - 2.5, size=(3000, 3)) * np.array(SPACING_MM)
    found = np.zeros(len(points))
    _distances(field.corners, field.geometry, points, found)
    over = found - _exact(mask, points)
    assert np.isfinite(found).all()
    assert over.min() > -1e-9
    assert np.median(over) < 0.15


def _limits(kappa: float) -> Limits:
    return Limits(
        kappa=kappa,
        max_length_mm=math.pi / kappa,
        max_angle_rad=math.pi,
        max_turn_rad=math.pi,
        required_mm=0.0,
        radius_mm=0.0,
        exempt_mm=0.0,
        max_step_mm=1.0,
        cost_step_mm=0.1,
        goal_tolerance_mm=0.0,
    )


def _environment(field: Any, kappa: float) -> BoundEnvironment:
    corners, geometry = field.corners, field.geometry
    unknown = cost_to_go(corners, geometry, _limits(kappa), (1.0, 0.1), (0.0, 0.0, 0.0), np.ones((1, 3)), 0.0)
    return BoundEnvironment(
        obstacles=corners,
        geometry=geometry,
        surroundings=TubeSurroundings(
            clearance=corners,
            labels=np.zeros((1, 1, 1), dtype=np.uint16),
            geometry=geometry,
            depth=corners,
            depth_geometry=geometry,
            bits=0,
            hazard_bits=0,
            mediastinal=np.zeros(1, dtype=np.bool_),
        ),
        kappa=kappa,
        max_length_mm=math.pi / kappa,
        goal_tolerance_mm=0.0,
        per_clearance=1.0,
        per_mm=0.1,
        required_mm=0.0,
        exempt_mm=0.0,
        togo=unknown,
    )


def _winding(rng: np.random.Generator, kappa: float, length_mm: float) -> Points:
    """Return a path (N, 3) of arcs of at most a curvature, their planes and bends at random."""
    steps, frame, points = 400, np.eye(3), [np.zeros(3)]
    bend = 0.0
    for n in range(steps):
        if n % 40 == 0:
            roll, bend = rng.uniform(0.0, 2.0 * math.pi), kappa * rng.choice([0.3, 1.0])
            c, s = math.cos(roll), math.sin(roll)
            frame = frame @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        angle = bend * length_mm / steps
        c, s = math.cos(angle), math.sin(angle)
        points.append(points[-1] + frame[:, 2] * length_mm / steps)
        frame = frame @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.array(points)


def test_no_winding_path_costs_less_than_its_bound() -> None:
    rng = np.random.default_rng(3)
    grid, mask = _boxes(rng, 25)
    field = distance_field("obstacle", mask, grid)
    tightest, looked_at = math.inf, 0
    middle = 0.5 * np.array(SHAPE) * np.array(SPACING_MM)
    while looked_at < 150:
        kappa = rng.choice([0.05, 0.15, 0.3])
        path = _winding(rng, kappa, float(rng.uniform(3.0, 8.0)))
        turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        path = (path - path[200]) @ turned.T + middle + rng.uniform(-2.0, 2.0, 3)
        if (path < 2.0).any() or (path > (np.array(SHAPE) - 3.0) * np.array(SPACING_MM)).any():
            continue
        looked_at += 1
        pieces = np.linalg.norm(np.diff(path, axis=0), axis=1)
        rates = 1.0 / np.maximum(_exact(mask, 0.5 * (path[1:] + path[:-1])), 0.1) + 0.1
        cost = float((rates * pieces).sum())
        begin_off, end_off = rng.uniform(0.0, 0.5, 2) * rng.integers(0, 2)
        begin = path[0] + _direction(rng) * begin_off
        end = path[-1] + _direction(rng) * end_off
        bound = _between(_environment(field, float(kappa)), tuple(begin), tuple(end), begin_off, end_off)
        assert bound <= cost * (1.0 + 1e-3)
        tightest = min(tightest, cost / bound)
    assert tightest < 1.3


def test_a_path_around_what_is_on_the_straight_line_costs_less() -> None:
    """An arc, and a row of obstacles along its chord."""
    radius, length = 30.0, 40.0
    s = np.linspace(-0.5 * length, 0.5 * length, 2001)
    along, beside = (
        radius * np.sin(s / radius),
        radius * (np.cos(s / radius) - math.cos(0.5 * length / radius)),
    )
    path = np.stack([along + 30.0, beside + 10.0, 0.0 * s + 10.0], axis=1)
    shape = (60, 40, 21)
    mask = np.zeros(shape, dtype=bool)
    mask[18:42, 10, 10] = True
    field = distance_field("obstacle", mask, Grid.from_spacing(shape, (1.0,) * 3, (0.0, 0.0, 0.0)))
    low, high = np.array([17.5, 9.5, 9.5]), np.array([41.5, 10.5, 10.5])
    clearance = np.linalg.norm(np.maximum(np.maximum(low - path, path - high), 0.0), axis=1)
    cost = float(np.trapezoid(1.0 / np.maximum(clearance, 0.1) + 0.1, s))
    x, y, z = path[-1].tolist()
    limits = _limits(1.0 / radius)
    togo = cost_to_go(field.corners, field.geometry, limits, (1.0, 0.1), (x, y, z), path[:1], 200.0)
    assert 0.4 * cost < _cost_from(togo, *path[0], 0.0) <= cost


def _attacked_costs(count: int, seed: int) -> float:
    """Return the greatest share of the cost of winding paths that is bounded from where they begin."""
    rng = np.random.default_rng(seed)
    grid, mask = _boxes(rng, 25)
    field = distance_field("obstacle", mask, grid)
    middle = 0.5 * np.array(SHAPE) * np.array(SPACING_MM)
    looked_at, highest = 0, 0.0
    while looked_at < count:
        kappa = float(rng.choice([0.05, 0.15, 0.3]))
        path = _winding(rng, kappa, float(rng.uniform(3.0, min(8.0, 1.7 / kappa))))
        turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        path = (path - path[200]) @ turned.T + middle + rng.uniform(-2.0, 2.0, 3)
        if (path < 2.0).any() or (path > (np.array(SHAPE) - 3.0) * np.array(SPACING_MM)).any():
            continue
        looked_at += 1
        x, y, z = path[-1].tolist()
        beside = path[:1] + rng.uniform(-2.0, 2.0, (1, 3))
        togo = cost_to_go(field.corners, field.geometry, _limits(kappa), (1.0, 0.1), (x, y, z), beside, 200.0)
        pieces = np.linalg.norm(np.diff(path, axis=0), axis=1)
        rates = 1.0 / np.maximum(_exact(mask, 0.5 * (path[1:] + path[:-1])), 0.1) + 0.1
        costs = np.append(np.cumsum((rates * pieces)[::-1])[::-1], 0.0)
        for n in (0, 100, 200):
            off = float(rng.uniform(0.0, 0.5) * rng.integers(0, 2))
            bound = _cost_from(togo, *(path[n] + off * _direction(rng)), off)
            highest = max(highest, bound / costs[n])
    return highest


def test_no_winding_path_costs_less_than_what_is_still_to_be_paid() -> None:
    assert 0.5 < _attacked_costs(40, 11) <= 1.0 + 1e-3


@pytest.mark.slow
def test_no_winding_path_of_many_costs_less_than_what_is_still_to_be_paid() -> None:
    assert 0.5 < _attacked_costs(5000, 12) <= 1.0 + 1e-3


@pytest.mark.slow
def test_no_deployment_of_a_box_sweeps_less_than_its_bound() -> None:
    tubes = tube_constants(SYSTEM.tubes, SYSTEM.margins)
    rng, slack = np.random.default_rng(0), []
    for _ in range(20_000):
        half = np.array([3.0, 1.5]) * 10.0 ** rng.uniform(-3.0, 0.0, 2)
        inner = float(rng.uniform(0.9 * tubes[CURVED_LENGTH], tubes[MAX_EXTENSION]))
        outer = float(rng.uniform(0.0, inner))
        box = np.zeros(BOX_COLUMNS)
        box[[OUTER, INNER, HALF + OUTER, HALF + INNER]] = outer, inner, *half
        other, longer = np.array([outer, inner]) + rng.choice([-1.0, 1.0, 0.3], 2) * half
        if 0.0 <= other <= longer:
            slack.append(lateral_sweep(tubes, other, longer) - _least_sweep(tubes, box))
    assert min(slack) >= 0.0
    assert np.median(slack) < 0.2


def test_from_farther_than_a_circle_is_wide_a_path_may_lie_anywhere() -> None:
    """An arc, then a straight line far beside the chord, along which there is a row of obstacles."""
    radius, turn, straight, side = 50.0, 1.4, 80.0, 1.0
    length = radius * turn + straight
    s = np.linspace(0.0, length, 2001)
    arc, line = np.minimum(s / radius, turn), np.maximum(s - radius * turn, 0.0)
    across = radius * (1.0 - np.cos(arc)) + line * math.sin(turn)
    along = radius * np.sin(arc) + line * math.cos(turn)
    end = np.array([across[-1], along[-1]])
    chord = end / np.linalg.norm(end)
    beside = np.abs(across * chord[1] - along * chord[0])
    path = np.stack([across * chord[0] + along * chord[1], beside, 0.0 * s], axis=1) + 10.0
    shape = (170, 60, 21)
    mask = np.zeros(shape, dtype=bool)
    mask[111:128, 10, 10] = True
    field = distance_field("obstacle", mask, Grid.from_spacing(shape, (side,) * 3, (0.0, 0.0, 0.0)))
    low, high = np.array([110.5, 9.5, 9.5]), np.array([127.5, 10.5, 10.5])
    clearance = np.linalg.norm(np.maximum(np.maximum(low - path, path - high), 0.0), axis=1)
    cost = float(np.trapezoid(1.0 / np.maximum(clearance, 0.1) + 0.1, s))
    bound = _between(_environment(field, 1.0 / radius), tuple(path[0]), tuple(path[-1]), 0.0, 0.0)
    assert 0.0 < bound <= cost


def test_a_slit_that_is_narrower_than_the_floor_is_not_dearer_than_it_is() -> None:
    side, shape = 0.4, (12, 12, 12)
    mask = np.zeros(shape, dtype=bool)
    mask[4] = mask[6] = True
    field = distance_field("obstacle", mask, Grid.from_spacing(shape, (side,) * 3, (0.0, 0.0, 0.0)))
    begin, end = (4.5 * side, 5.5 * side, 5.5 * side), (5.5 * side, 5.5 * side, 5.5 * side)
    at = np.linspace(0.0, side, 10_001)
    cost = side * float(np.mean(1.0 / np.maximum(np.minimum(at, side - at), 0.1) + 0.1))
    assert 0.0 < _between(_environment(field, 1.0 / 121.0), begin, end, 0.0, 0.0) <= cost


def _direction(rng: np.random.Generator) -> Points:
    away = rng.standard_normal(3)
    return np.asarray(away / np.linalg.norm(away))


@pytest.mark.parametrize("objective", ["inverse_clearance", "tissue"])
def test_no_deployment_costs_less_than_the_bound(
    small_lung: Lung, target: Target, atlas: la.Atlas, objective: str
) -> None:
    """Rotations and insertions beside those of the atlas, each with a single arc."""
    task = Task(lung=small_lung, system=SYSTEM, target=target, objective=Objective.of(objective))
    *_, best = plans_of(small_lung, target, atlas, iterations=20, goal=objective)
    bound = CostBound(task, atlas)
    values = [improved(bound, 2.0 * best.cost, 5000) for _ in range(4)]
    assert values == sorted(values)
    assert values[-1] > 0.0
    arcs, rng, accepted, least = DirectArcs(task, atlas), np.random.default_rng(5), 0, math.inf
    entries, evaluator = atlas.deployments, arcs.evaluator
    for entry in rng.choice(arcs.in_workspace, 300):
        tip = atlas.motions.tip(int(entries.site[entry]))
        outer, inner = entries.outer_mm[entry], entries.inner_mm[entry] + rng.uniform(-1.0, 1.0)
        rotation = entries.rotation_rad[entry] + rng.uniform(-0.2, 0.2)
        made = evaluator.tubes.validate(tip.lps_from_scope_tip, rotation, [min(outer, inner), inner])
        if isinstance(made, str):
            continue
        path = direct_path(made.lps_from_tip, target.lps_mm)
        cost = evaluator.evaluate(Candidate(tip=tip, deployment=made, path=path))
        accepted += math.isfinite(cost)
        least = min(least, cost)
    assert accepted > 10
    assert values[-1] <= least


@numba.njit
def _box_bound(environment: Any, tubes: Any, insertions: Any, tips: Any, target: Any, box: Any) -> float:
    return float(bound_box(environment, tubes, insertions, tips, target, math.inf, box, False))


def _attacked(
    lung: Lung, target: Target, atlas: la.Atlas, targets: int, each: int, seed: int
) -> tuple[int, float]:
    """Draw targets on arcs from deployments, accepted arcs to these, and boxes that hold their deployments.

    Returns how many boxes were looked at, and the greatest share of an arc's cost that a bound reached.
    """
    rng, looked_at, highest, done = np.random.default_rng(seed), 0, 0.0, 0
    entries, needle = atlas.deployments, SYSTEM.require_needle("The test")
    any_arcs = DirectArcs(Task(lung=lung, system=SYSTEM, target=target), atlas)
    while done < targets:
        entry = int(rng.integers(entries.count))
        base = atlas.motions.tip(int(entries.site[entry])).lps_from_scope_tip
        made = any_arcs.evaluator.tubes.choose(base, *entries.choice(entry))
        assert not isinstance(made, str)
        curvature, length = needle.max_curvature_per_mm * rng.uniform(0.1, 0.999), rng.uniform(8.0, 60.0)
        roll, aside = rng.uniform(0.0, 2.0 * math.pi), (1.0 - math.cos(curvature * length)) / curvature
        local = [
            aside * math.cos(roll),
            aside * math.sin(roll),
            math.sin(curvature * length) / curvature,
            1.0,
        ]
        end = (made.lps_from_tip @ np.array(local))[:3]
        try:
            task = Task(lung=lung, system=SYSTEM, target=point_target(lung, end))
        except TargetError:
            continue
        arcs, bound = DirectArcs(task, atlas), CostBound(task, atlas)
        if not len(arcs.in_workspace):
            continue
        improved(bound, 60.0, 1)
        done += 1
        for entry in rng.choice(arcs.in_workspace, each):
            found = _accepted_beside(arcs, atlas, int(entry), end, rng)
            if found is None:
                continue
            place, cost = found
            widths = np.array([0.4, 3.0, 3.0]) * 10.0 ** rng.uniform(-3.0, 0.0, 3)
            box = np.zeros(BOX_COLUMNS)
            queue, box[TIP] = bound.queues[entries.site[entry] % QUEUES], entries.site[entry] // QUEUES
            box[[ROTATION, OUTER, INNER]] = place + rng.uniform(-1.0, 1.0, 3) * widths
            box[[HALF + ROTATION, HALF + OUTER, HALF + INNER]] = widths
            box[[HALF + ACROSS, HALF + UP]] = -1.0
            environment, tubes, insertions, tips, goal = queue.about
            looked_at += 1
            highest = max(highest, _box_bound(environment, tubes, insertions, tips, goal, box) / cost)
    return looked_at, highest


def _accepted_beside(
    arcs: DirectArcs, atlas: la.Atlas, entry: int, end: Points, rng: np.random.Generator
) -> tuple[Points, float] | None:
    """Return rotation and insertions beside a deployment and the cost of the arc from there, if accepted."""
    entries, tip = atlas.deployments, atlas.motions.tip(int(atlas.deployments.site[entry]))
    inner = float(entries.inner_mm[entry] + rng.uniform(-1.0, 1.0))
    outer = float(np.clip(entries.outer_mm[entry] + rng.uniform(-1.0, 1.0), 0.0, inner))
    rotation = float(entries.rotation_rad[entry] + rng.uniform(-0.2, 0.2))
    made = arcs.evaluator.tubes.validate(tip.lps_from_scope_tip, rotation, [outer, inner])
    if isinstance(made, str):
        return None
    path = direct_path(made.lps_from_tip, end)
    cost = arcs.evaluator.evaluate(Candidate(tip=tip, deployment=made, path=path))
    return (np.array([rotation, outer, inner]), cost) if math.isfinite(cost) else None


@numba.njit
def _all_refused(surroundings: Any, tubes: Any, tips: Any, box: Any) -> bool:
    family = tubes_at(tubes, tips, box)
    return bool(tubes_blocked(surroundings, tubes, family, box, least_sweep(tubes, box)))


@pytest.mark.slow
def test_no_box_with_accepted_tubes_is_ruled_out_but_those_at_a_hazard_are(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    """Boxes about accepted tubes, at random and next to refused ones, and tubes refused at their exit."""
    task = Task(lung=small_lung, system=SYSTEM, target=target)
    bound = CostBound(task, atlas)
    improved(bound, 0.0, 1)
    surroundings, tubes = bound.queues[0].about[0].surroundings, bound.queues[0].about[1]
    tips = atlas.motions.tips
    validator = DirectArcs(task, atlas).evaluator.tubes
    entries, rng = atlas.deployments, np.random.default_rng(7)

    def why_refused(site: int, place: Points) -> str | None:
        rotation, outer, inner = place.tolist()
        base = atlas.motions.tip(site).lps_from_scope_tip
        made = validator.validate(base, rotation, [min(max(outer, 0.0), inner), inner])
        return made if isinstance(made, str) else None

    def ruled_out(site: int, place: Points, widths: Points) -> bool:
        box = np.zeros(BOX_COLUMNS)
        box[TIP] = site
        box[[ROTATION, OUTER, INNER]] = place + rng.uniform(-1.0, 1.0, 3) * widths
        box[[HALF + ROTATION, HALF + OUTER, HALF + INNER]] = widths
        return _all_refused(surroundings, tubes, tips, box)

    accepted, at_hazard = 0, []
    for entry in rng.integers(entries.count, size=4000):
        site = int(entries.site[entry])
        columns = entries.rotation_rad, entries.outer_mm, entries.inner_mm
        begin = np.array([column[entry] for column in columns])
        wide = 10.0 ** rng.uniform(-1.0, 1.0)
        place = begin + rng.normal(0.0, 1.0, 3) * np.array([0.1, 1.0, 1.0]) * wide
        place[1:] = np.clip(place[1], 0.0, max(place[2], 0.1)), max(place[2], 0.1)
        reason = why_refused(site, place)
        if reason is None:
            accepted += 1
            widths = np.array([0.4, 3.0, 3.0]) * 10.0 ** rng.uniform(-4.0, 0.0, 3)
            assert not ruled_out(site, place, widths), (site, place, widths)
            continue
        if validator._trace[PHASE] == LEAVING and reason in (REASONS[NEAR_VESSEL], REASONS[NEAR_PLEURA]):
            at_hazard.append(ruled_out(site, place, np.full(3, 1e-6)))
        good, bad = begin, place
        for _ in range(24):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if why_refused(site, middle) is None else (good, middle)
        assert not ruled_out(site, good, np.full(3, 1e-6)), (site, good)
    assert accepted > 1000
    assert len(at_hazard) > 20 and np.mean(at_hazard) > 0.5


@pytest.mark.slow
def test_no_box_costs_more_than_an_accepted_arc_from_it(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    looked_at, highest = _attacked(small_lung, target, atlas, 60, 1500, 1)
    assert looked_at > 5000
    assert 0.8 < highest <= 1.0 + 1e-3


@pytest.mark.slow
def test_a_plan_states_its_gap_and_the_same_run_states_the_same(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    plain = plans_of(small_lung, target, atlas, iterations=80)
    plans = plans_of(small_lung, target, atlas, iterations=80, gap=0.0)
    assert plans[-1].gap is not None
    assert 0.0 < plans[-1].cost_bound <= plans[-1].cost * (1.0 + 1e-9) or plans[-1].gap == 0.0
    assert plans[-1].cost == plans[-2].cost <= 1.01 * plain[-1].cost
    assert "at most" in plans[-1].gap_in_words
    assert la.Plan.from_json(plans[-1].to_json()).cost_bound == plans[-1].cost_bound
    assert same_run(plans) == same_run(plans_of(small_lung, target, atlas, iterations=80, gap=0.0))


@pytest.mark.slow
def test_a_wide_gap_ends_the_search_at_once(small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
    *_, last = plans_of(small_lung, target, atlas, iterations=1000, gap=20.0)
    assert last.iterations < 1000
    assert last.gap is not None and last.gap <= 20.0


@pytest.mark.parametrize("gap", [-0.1, math.nan, math.inf])
def test_a_gap_is_no_negative_number(gap: float) -> None:
    with pytest.raises(SettingsError, match="share of 0 or more"):
        GapGoal(cast(CostBound, None), gap)
