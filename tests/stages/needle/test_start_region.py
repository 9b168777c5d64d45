"""The safe start region: its bound and its proof under attack, and what is told of poses that are tried."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from anatomy.kernels.arcs import arc_to_point, point_on_arc
from anatomy.poses import pose
from anatomy.structures import OBSTACLES, VESSEL
from stages.needle import (
    ArcPath,
    Needle,
    NeedleEnvironment,
    Query,
    StartRegion,
    begun_at_wall,
    direct_path,
    environment_of_labels,
    prove_starts,
    proved_factor,
    try_starts,
    violation,
    workspace_lengths,
)
from stages.needle.kernels import start_trial as kinds
from stages.needle.kernels.start_region import displacement
from stages.needle.path import arc_transform
from tests.stages.scenes import Canvas, brute_clearance

NEEDLE = Needle(diameter_mm=0.8, max_curvature_per_mm=0.02, exit_exemption_mm=3.0)
START = pose([0.0, 0.0, -12.0], [0.1, 0.0, 1.0])
TARGET = np.array([2.0, 1.0, 14.0])
REQUIRED_MM = 0.7
PLACES = 400


def deviated(frame: Float, offset: Float, tilt: float, around: float) -> Float:
    """Return a pose moved by an offset and tilted in a direction about its axis."""
    forward = math.cos(tilt) * frame[:3, 2] + math.sin(tilt) * (
        math.cos(around) * frame[:3, 0] + math.sin(around) * frame[:3, 1]
    )
    return pose(frame[:3, 3] + offset, forward)


def random_offset(rng: np.random.Generator, length: float) -> Float:
    direction = rng.normal(size=3)
    return np.asarray(length * direction / np.linalg.norm(direction))


def arc_points(frame: Float, goal: Float, shares: Float) -> Float:
    start = tuple(float(v) for v in (*frame[:3, 3], *frame[:3, 2]))
    length, bend, _turn = arc_to_point(start, tuple(float(v) for v in goal))
    return np.array([point_on_arc(start, bend, share * length) for share in shares])


@given(
    st.floats(5.0, 120.0),
    st.floats(0.0, 1.2),
    st.floats(0.0, 0.3),
    st.floats(0.0, 0.3),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=200)
def test_no_place_of_an_arc_moves_farther_than_the_bound(
    chord: float, half_turn: float, offset_share: float, tilt: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    offset = offset_share * chord
    turned = math.asin(offset_share)
    error = min(tilt, 0.5 * math.pi - half_turn - turned) + turned
    if error < turned:
        return
    goal = chord * np.array([math.sin(half_turn), 0.0, math.cos(half_turn)])
    ends = np.sort(rng.uniform(0.0, 1.0, 2))
    shares = np.linspace(*ends, 20)
    planned = arc_points(np.eye(4), goal, shares)
    bound = displacement(chord, half_turn, *ends, offset, error)
    for _ in range(20):
        moved = deviated(
            np.eye(4), random_offset(rng, offset), error - turned, rng.uniform(0.0, 2.0 * math.pi)
        )
        away = np.linalg.norm(arc_points(moved, goal, shares) - planned, axis=1)
        assert away.max() <= bound * (1.0 + 1e-9) + 1e-9


def test_the_bound_is_reached_by_a_straight_needle() -> None:
    """A start that is moved aside bends the path to a parabola: `offset (1 - t^2)`, to first order."""
    goal, aside, share = np.array([0.0, 0.0, 50.0]), 0.05, 0.4
    moved = deviated(np.eye(4), np.array([aside, 0.0, 0.0]), 0.0, 0.0)
    truth = np.linalg.norm(arc_points(moved, goal, np.array([share]))[0] - share * goal)
    bound = displacement(50.0, 0.0, share, share, aside, math.asin(aside / 50.0))
    assert truth == pytest.approx(aside * (1.0 - share**2), rel=1e-3)
    assert truth <= bound <= 1.01 * truth


def scene(rng: np.random.Generator, vessels: int) -> Canvas:
    """A box of tissue with an airway behind the start and vessels beside the way."""
    canvas = Canvas.empty([-18.0, -18.0, -22.0], [18.0, 18.0, 22.0], 0.6)
    for _ in range(vessels):
        away = rng.uniform(3.5, 9.0)
        around, height = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-8.0, 14.0)
        centre = np.array([away * math.cos(around), away * math.sin(around), height])
        canvas.add(canvas.ball(centre, rng.uniform(0.7, 1.6)), VESSEL)
    line = ([-18.0, 0.0, -16.0], [18.0, 0.0, -16.0])
    canvas.airway(canvas.capsule(*line, 1.8), canvas.capsule(*line, 3.2), branch=0)
    return canvas


def planned_path(rng: np.random.Generator, arcs: int) -> ArcPath:
    """Return a path of single arcs from START to TARGET, through a point beside the way if they are two."""
    way, frame = [], START
    points = [np.array([*rng.uniform(-2.0, 2.0, 2), 2.0]), TARGET][2 - arcs :]
    for point in points:
        way.append(direct_path(frame, point).arcs[0])
        frame = frame @ arc_transform(*way[-1])
    return ArcPath(lps_from_start=START, arcs=np.array(way))


def region_of(environment: NeedleEnvironment, query: Query, path: ArcPath, **tried: Any) -> StartRegion:
    chosen: dict[str, Any] = {"offset_mm": 3.0, "tilt_rad": 0.3, "poses": 25, "iterations": 0, "seed": 0}
    return StartRegion(
        lps_from_start=query.lps_from_start,
        target=query.target,
        radius_mm=environment.goal_tolerance_mm,
        max_curvature_per_mm=NEEDLE.max_curvature_per_mm,
        proved=prove_starts(environment, query, path),
        tried=try_starts(environment, query, path, **(chosen | tried)),
    )


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))]
)
@pytest.mark.parametrize(
    ("arcs", "tolerance", "at_wall"), [(1, 0.0, False), (2, 0.0, False), (1, 1.5, False), (1, 0.0, True)]
)
def test_every_pose_of_the_proved_part_has_a_clear_path(
    seed: int, arcs: int, tolerance: float, at_wall: bool
) -> None:
    rng = np.random.default_rng(seed)
    canvas = scene(rng, vessels=8)
    environment = environment_of_labels(
        canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM, goal_tolerance_mm=tolerance
    )
    if at_wall:
        environment = begun_at_wall(environment, START[:3, 3], (0,))
    query = Query(lps_from_start=START, target=TARGET, branch=0)
    path = planned_path(rng, arcs)
    region = region_of(environment, query, path)
    proved = region.proved
    if violation(environment, query, path):
        return
    assert (np.diff(proved.tilts_rad) <= 0.0).all()
    assert (np.diff(proved.offsets_mm) > 0.0).all()
    for n in rng.integers(0, len(proved.offsets_mm), PLACES):
        offset = random_offset(rng, proved.offsets_mm[n] * rng.choice([0.5, 1.0 - 1e-9]))
        tilt = proved.tilts_rad[n] * rng.choice([0.5, 1.0]) - 1e-9
        moved = deviated(START, offset, max(tilt, 0.0), rng.uniform(0.0, 2.0 * math.pi))
        found = region.path_from(moved)
        assert found is not None
        asked = Query(lps_from_start=moved, target=TARGET, branch=0)
        assert violation(environment, asked, found) == ""
        points, lengths = found.sample(0.1)
        beyond = points[lengths >= NEEDLE.exit_exemption_mm]
        gap = brute_clearance(canvas.labels, canvas.grid, beyond, OBSTACLES, 2.0)
        assert gap.min() >= REQUIRED_MM - 1e-9


def test_the_factor_of_a_deviation_agrees_with_the_pairs() -> None:
    rng = np.random.default_rng(1)
    canvas = scene(rng, vessels=8)
    environment = environment_of_labels(canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    query, path = Query(lps_from_start=START, target=TARGET, branch=0), planned_path(rng, 1)
    proved = prove_starts(environment, query, path)
    n = proved.best
    for times in (0.5, 1.5, 4.0):
        offset, tilt = times * proved.offsets_mm[n], times * proved.tilts_rad[n]
        found = proved_factor(environment, query, path, offset_mm=offset, tilt_rad=tilt)
        assert found == pytest.approx(min(1.0 / times, 1.0), abs=2e-3)


def test_the_attack_has_something_to_attack() -> None:
    """Of the scenes above, half or more have a part of a tenth of a millimetre and a degree."""
    large = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        canvas = scene(rng, vessels=8)
        environment = environment_of_labels(
            canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM
        )
        query = Query(lps_from_start=START, target=TARGET, branch=0)
        proved = prove_starts(environment, query, planned_path(rng, 1))
        large += proved.offset_mm > 0.1 and proved.tilt_rad > math.radians(1.0)
    assert large >= 3


def test_beside_a_wall_the_proved_offset_is_nearly_the_true_one() -> None:
    """Beside a plane of vessel the start of a straight needle may come as near as the clearance allows."""
    canvas = Canvas.empty([-18.0, -18.0, -22.0], [18.0, 18.0, 22.0], 0.6)
    canvas.add(canvas.points[..., 0] > 3.0, VESSEL)
    environment = environment_of_labels(canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    start, goal = pose([0.0, 0.0, -12.0], [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 14.0])
    path = direct_path(start, goal)
    proved = prove_starts(environment, Query(lps_from_start=start, target=goal), path)
    spare = brute_clearance(canvas.labels, canvas.grid, start[None, :3, 3], OBSTACLES, 5.0)[0] - REQUIRED_MM
    assert 0.9 * spare <= proved.offsets_mm[-1] <= spare


def test_a_needle_at_its_limit_has_a_proved_part_only_where_it_may_miss() -> None:
    canvas = Canvas.empty([-18.0, -18.0, -22.0], [18.0, 18.0, 22.0], 0.6)
    frame = pose([0.0, 0.0, -12.0], [0.0, 0.0, 1.0])
    path = ArcPath(lps_from_start=frame, arcs=np.array([[24.0, 0.0, NEEDLE.max_curvature_per_mm]]))
    query = Query(lps_from_start=frame, target=path.frames()[-1][:3, 3])
    offsets = []
    for tolerance in (0.0, 1.0, 2.0):
        environment = environment_of_labels(
            canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM, goal_tolerance_mm=tolerance
        )
        offsets.append(prove_starts(environment, query, path).offset_mm)
    assert offsets[0] < 1e-3
    assert 0.1 < offsets[1] < offsets[2]


def test_what_is_told_of_tried_poses_is_true() -> None:
    rng = np.random.default_rng(1)
    canvas = scene(rng, vessels=40)
    environment = environment_of_labels(canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    query = Query(lps_from_start=START, target=TARGET, branch=0)
    region = region_of(environment, query, planned_path(rng, 1), poses=1000, iterations=30)
    tried = region.tried
    assert tried.offsets_mm.max() <= 3.0
    assert tried.tilts_rad.max() <= 0.3
    for p, d in np.ndindex(tried.kinds.shape):
        frame, kind = pose(tried.positions[p], tried.tangents[p, d]), tried.kinds[p, d]
        asked = Query(lps_from_start=frame, target=TARGET, branch=0)
        arc = violation(environment, asked, direct_path(frame, TARGET))
        reached = workspace_lengths(environment, frame[None, :3, 3], frame[None, :3, 2], TARGET)[0]
        assert (kind == kinds.DIRECT) == (arc == "")
        if kind in (kinds.VIA, kinds.SEARCHED, kinds.DIRECT):
            assert np.isfinite(reached)
        if kind == kinds.OUT_OF_REACH:
            assert reached == np.inf
    counts = tried.counts
    assert counts["one arc"] and counts["two or three arcs"] and counts["start too near to an obstacle"]
    assert sum(counts.values()) == tried.kinds.size
    assert 0.0 < tried.share() < tried.share(1.0, 0.1)
    again = region_of(
        environment, query, planned_path(np.random.default_rng(0), 1), poses=1000, iterations=30
    )
    assert np.array_equal(again.tried.kinds, tried.kinds)


def test_poses_cover_the_ball_and_the_cone_evenly() -> None:
    canvas = Canvas.empty([-18.0, -18.0, -22.0], [18.0, 18.0, 22.0], 0.6)
    environment = environment_of_labels(canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    query = Query(lps_from_start=START, target=TARGET)
    tried = try_starts(
        environment, query, direct_path(START, TARGET),
        offset_mm=3.0, tilt_rad=0.3, poses=20_000, iterations=0, seed=0,
    )  # fmt: skip
    assert tried.kinds.size == pytest.approx(20_000, rel=0.05)
    assert (tried.offsets_mm <= 1.5).mean() == pytest.approx(1 / 8, rel=0.1)
    half = (1.0 - math.cos(0.15)) / (1.0 - math.cos(0.3))
    assert (tried.tilts_rad <= 0.15).mean() == pytest.approx(half, rel=0.02)
    assert (
        np.abs(tried.tangents.mean(axis=(0, 1)) - START[:3, 2] * np.cos(tried.tilts_rad).mean()).max() < 1e-3
    )


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"offset_mm": 0.0}, "mm away"),
        ({"offset_mm": 30.0}, "mm away"),
        ({"tilt_rad": math.nan}, "tilted by"),
        ({"poses": 3}, "3 start poses"),
        ({"iterations": -1}, "-1 iterations"),
    ],
)
def test_wrong_numbers_are_refused(wrong: dict[str, Any], said: str) -> None:
    canvas = Canvas.empty([-18.0, -18.0, -22.0], [18.0, 18.0, 22.0], 1.2)
    environment = environment_of_labels(canvas.labels, canvas.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    with pytest.raises(SettingsError, match=said):
        region_of(
            environment, Query(lps_from_start=START, target=TARGET), direct_path(START, TARGET), **wrong
        )
