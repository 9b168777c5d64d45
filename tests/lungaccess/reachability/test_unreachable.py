"""The proof that a target is unreachable: its bounds hold, and what a plan reaches is never ruled out."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import lungaccess as la
from anatomy.errors import TargetError
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import bending_directions
from anatomy.typed import Float
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import point_target
from lungaccess.reachability.kernels import blocked
from lungaccess.reachability.kernels import deployment_boxes as boxes
from lungaccess.reachability.kernels import unreachable as kernel
from lungaccess.reachability.tip_places import PlacePiece
from lungaccess.reachability.unreachable import UnreachableProof, _may_be_left
from stages.scope import MAX_OFF_AXIS_MM, find_motions, in_tip_region
from stages.tube import tube_constants, tube_environment
from stages.tube.kernels import (
    ACCEPTED,
    CURVED_LENGTH,
    MAX_SWEEP,
    N_TRACE,
    NEAR_VESSEL,
    lateral_sweep,
    planar_point,
    validate_deployment,
)

KAPPA = 1.0 / 50.0


@numba.njit
def seen_from_middle(tubes, kappa, target, frame, box, sums, costs):  # type: ignore[no-untyped-def]
    return boxes.target_seen(tubes, kappa, (target[0], target[1], target[2]), frame, box, sums, costs)


@numba.njit
def sampled(tubes, frame, box, s):  # type: ignore[no-untyped-def]
    return boxes.sample_of(tubes, boxes.tubes_of(tubes, frame, box), s)


@numba.njit
def not_ruled_out(environment, tubes, insertions, limits, target, frame, cones, box):  # type: ignore[no-untyped-def]
    sums, costs = np.zeros(3), np.zeros(boxes.SIDES)
    return kernel.may_reach(
        environment,
        tubes,
        insertions,
        limits,
        (target[0], target[1], target[2]),
        frame,
        cones,
        box,
        sums,
        costs,
    )[0]


@numba.njit
def all_blocked(environment, tubes, frame, box):  # type: ignore[no-untyped-def]
    return blocked.tubes_blocked(environment, tubes, boxes.tubes_of(tubes, frame, box), box)


@numba.njit
def tips_may_be(environment, frame, cones, box):  # type: ignore[no-untyped-def]
    return kernel.tips_may_be(environment, frame, cones, box)


@pytest.fixture(scope="module")
def system() -> System:
    """A thin scope, and a needle of 50 mm radius."""
    loaded = load_system("ultrathin")
    scope = replace(loaded.scope, outer_diameter_mm=2.0, channel_diameter_mm=1.7)
    needle = replace(loaded.needle, max_curvature_per_mm=KAPPA)
    return replace(loaded, name="test", scope=scope, needle=needle, fissures_allowed=True)


@pytest.fixture(scope="module")
def tubes(system: System) -> Float:
    return tube_constants(system.tubes, system.margins)


def tip_frame(tubes: Float, frame: Float, place: Float, values: Float) -> Float:
    """Return the pose (4, 4) of the tubes' tip: x towards the bend, z ahead."""
    east, north, rotation, outer, inner = values
    base = Rotation.from_rotvec(east * frame[0] + north * frame[1]).as_matrix()
    base = base @ frame.T @ Rotation.from_euler("z", rotation).as_matrix()
    x, z = planar_point(tubes, outer, inner, inner)
    step = 1e-5
    x0, z0 = planar_point(tubes, outer, inner, inner - step)
    heading = math.atan2(x - x0, z - z0)
    pose = np.eye(4)
    pose[:3, :3] = base @ Rotation.from_euler("y", heading).as_matrix()
    pose[:3, 3] = place + base @ [x, 0.0, z]
    return pose


def random_case(rng: np.random.Generator) -> tuple[Float, Float, Float]:
    """Return frame, a box of any size, and a target."""
    frame = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    scale = 10.0 ** rng.uniform(-3.0, 0.0)
    inner = rng.uniform(2.0, 50.0)
    angles = [*rng.uniform(-0.7, 0.7, 2), rng.uniform(-3.0, 3.0)]
    middles = np.array([*angles, rng.uniform(0.0, inner), inner, *rng.normal(0.0, 3.0, 3)])
    halves = scale * np.array([0.5, 0.5, 1.0, 10.0, 10.0, 2.0, 2.0, 3.0]) * rng.uniform(0.0, 1.0, 8)
    halves[3:5] = np.minimum(halves[3:5], middles[3:5])
    return frame, np.concatenate([middles, halves]), rng.normal(0.0, 40.0, 3)


def draw(rng: np.random.Generator, frame: Float, box: Float) -> tuple[Float, Float]:
    """Return a place and numbers of a deployment of a box that can be, often at its corners."""
    while True:
        share = np.clip(rng.uniform(-1.6, 1.6, 8), -1.0, 1.0)
        values = box[:8] + share * box[8:]
        if 0.0 <= values[3] <= values[4] and values[4] > 0.01:
            return values[5:] @ frame, values[:5]


@pytest.mark.parametrize("seed", range(4))
def test_no_deployment_of_a_box_sees_the_target_farther_off_than_its_bounds(tubes: Float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tight = 0
    for _ in range(300):
        frame, box, target = random_case(rng)
        if box[3] - box[11] > box[4] + box[12] - 0.02:
            continue
        sums, costs = np.zeros(3), np.zeros(boxes.SIDES)
        pose, rho, ahead, size, moved, second = seen_from_middle(
            tubes, KAPPA, target, frame, box, sums, costs
        )
        middle = tip_frame(tubes, frame, box[5:8] @ frame, box[:5]) if box[3] <= box[4] else None
        for _ in range(40):
            place, values = draw(rng, frame, box)
            there = tip_frame(tubes, frame, place, values)
            seen = there[:3, :3].T @ (target - there[:3, 3])
            if middle is None:
                continue
            first = middle[:3, :3].T @ (target - middle[:3, 3])
            assert math.hypot(first[0], first[1]) == pytest.approx(rho, abs=1e-3)
            assert first[2] == pytest.approx(ahead, abs=1e-3)
            assert pose[:3] == pytest.approx(middle[:3, 3], abs=1e-6)
            displaced = float(np.linalg.norm(seen - first))
            assert displaced <= moved + 2e-3
            towards = first[:2] / max(np.hypot(*first[:2]), 1e-9)
            ring = np.array([*(towards / KAPPA), 0.0])
            assert np.linalg.norm(first - ring) == pytest.approx(size, abs=1e-2)
            assert np.linalg.norm(seen - ring) <= math.hypot(size + sums[0], sums[1]) + second + 2e-3
            assert seen[2] <= ahead + sums[2] + second + 2e-3
            tight += displaced > 0.5 * moved
    assert tight > 20


@pytest.mark.parametrize("seed", range(2))
def test_no_tube_of_a_box_is_farther_from_its_samples_than_they_say(tubes: Float, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    for _ in range(200):
        frame, box, _target = random_case(rng)
        if box[3] - box[11] > box[4] + box[12] - 0.02:
            continue
        for _ in range(20):
            place, values = draw(rng, frame, box)
            s = rng.uniform(0.0, values[4])
            point, away = sampled(tubes, frame, box, s)
            x, z = planar_point(tubes, values[3], values[4], s)
            turned = Rotation.from_rotvec(values[0] * frame[0] + values[1] * frame[1]).as_matrix()
            turned = turned @ frame.T @ Rotation.from_euler("z", values[2]).as_matrix()
            assert np.linalg.norm(place + turned @ [x, 0.0, z] - point) <= away + 1e-6


def test_insertions_that_sweep_little_are_in_the_table(tubes: Float) -> None:
    table = np.zeros(121)
    kernel.greatest_insertions(tubes, 60.0, 0.02, table)
    assert table.max() < 60.0
    rng = np.random.default_rng(3)
    near = 0
    for outer, inner in rng.uniform(0.0, 60.0, (20_000, 2)):
        if outer <= inner and lateral_sweep(tubes, outer, inner) <= tubes[MAX_SWEEP]:
            limit = table[int(outer / kernel.INSERTION_STEP_MM)]
            assert inner <= limit
            near += inner > max(limit - 0.5, tubes[CURVED_LENGTH])
    assert near > 20


def test_the_sweep_changes_no_faster_than_stated(tubes: Float) -> None:
    rng = np.random.default_rng(4)
    bend = float(np.abs(tubes[:2]).max() * tubes[CURVED_LENGTH])
    slope = 2.0 + 3.0 * bend
    assert blocked.sweep_slope.py_func(bend) == slope
    for outer, inner in rng.uniform(0.0, 60.0, (3000, 2)):
        step = rng.normal(0.0, 0.05, 2)
        other = np.maximum([outer, inner] + step, 0.0)
        if outer <= inner and other[0] <= other[1]:
            change = lateral_sweep(tubes, *other) - lateral_sweep(tubes, outer, inner)
            assert abs(change) <= slope * np.abs(step).sum() + 1e-9


@pytest.fixture(scope="module")
def proof(small_lung: Lung, system: System) -> UnreachableProof:
    return UnreachableProof(small_lung, system, with_fissures=False)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System) -> list[la.Plan]:
    """Plans to points of the lung."""
    atlas = la.build_atlas(small_lung, system)
    rng = np.random.default_rng(0)
    inside = np.argwhere(small_lung.labels == 0)
    found = []
    for point in small_lung.grid.lps(inside[rng.choice(len(inside), 20, replace=False)]):
        try:
            target = point_target(small_lung, point)
            found.append(next(la.plan(small_lung, system, target, atlas=atlas, seed=0, iterations=20)))
        except la.LungaccessError:
            continue
    return found


HALVES = np.array([0.7, 0.7, 3.0, 20.0, 20.0, 2.0, 2.0, 2.0])
"""Half widths of a large box, rad and mm."""


def random_tips(proof: UnreachableProof, rng: np.random.Generator, n: int) -> list[tuple[PlacePiece, Float]]:
    """Draw places of the scope tip, with their pieces; some are not in the lumen."""
    chosen = [proof._pieces[m] for m in rng.integers(len(proof._pieces), size=n)]
    return [(piece, rng.uniform(*piece.places) @ piece.frame) for piece in chosen]


def pieces_of(proof: UnreachableProof, lung: Lung, place: Float) -> list[PlacePiece]:
    """Return the pieces that hold the tree point nearest to a place."""
    nearest = lung.tree.points_lps[np.linalg.norm(lung.tree.points_lps - place, axis=1).argmin()]
    return [
        piece
        for piece in proof._pieces
        if ((piece.cones[:, :3] == nearest).all(axis=1) & (piece.cones[:, 6] > 0.0)).any()
    ]


def rotation_vector(frame: Float, forward: Float) -> tuple[float, float]:
    """Return the vector, which lies across, that turns the frame's axis towards a direction."""
    seen = frame @ forward
    angle = math.acos(min(max(float(seen[2]), -1.0), 1.0))
    aside = math.hypot(seen[0], seen[1])
    return (-seen[1] / aside * angle, seen[0] / aside * angle) if aside > 1e-12 else (0.0, 0.0)


def deployment_of(frame: Float, plan: la.Plan) -> Float:
    """Return direction, rotation and insertions of a plan as the middles of a box."""
    pose, tube = plan.scope.lps_from_scope_tip, plan.tube
    east, north = rotation_vector(frame, pose[:3, 2])
    turned = Rotation.from_rotvec(east * frame[0] + north * frame[1]).as_matrix() @ frame.T
    normal = turned.T @ bending_directions(pose, tube.rotation_rad)[0]
    rotation = math.atan2(normal[1], normal[0])
    return np.array([east, north, rotation, tube.outer_insertion_mm, tube.inner_insertion_mm])


def test_no_box_with_a_deployment_that_can_be_is_blocked(
    small_lung: Lung, tubes: Float, proof: UnreachableProof, plans: list[la.Plan]
) -> None:
    """Deployments as near to a limit as it gets, between one that can be and one that cannot."""
    rng = np.random.default_rng(6)
    deploying = tube_environment(small_lung, with_fissures=False)
    environment = proof._environment(plans[0].target_lps)
    trace, tip = np.zeros(N_TRACE), np.zeros(9)
    at_limits: Counter[int] = Counter()
    n_blocked = 0

    def judged(frame: Float, place: Float, values: Float) -> int:
        turned = Rotation.from_rotvec(values[0] * frame[0] + values[1] * frame[1]).as_matrix()
        normal = turned @ (math.cos(values[2]) * frame[0] + math.sin(values[2]) * frame[1])
        base = np.concatenate([place, turned @ frame[2]])
        return int(validate_deployment(deploying, tubes, base, normal, values[3], values[4], trace, tip))

    def box_around(frame: Float, place: Float, values: Float) -> Float:
        scale = 10.0 ** rng.uniform(-5.0, -1.0)
        halves = scale * HALVES * rng.uniform(0.1, 1.0, 8)
        middles = np.concatenate([values, frame @ place])
        return np.concatenate([middles + rng.uniform(-1.0, 1.0, 8) * halves, halves])

    tips = random_tips(proof, rng, 20_000)
    for piece, place in tips:
        inner = rng.uniform(2.0, 46.0)
        values = np.array([*rng.normal(0.0, 0.4, 2), rng.uniform(-3.1, 3.1), rng.uniform(0.0, inner), inner])
        if judged(piece.frame, place, values) != ACCEPTED:
            n_blocked += all_blocked(environment, tubes, piece.frame, box_around(piece.frame, place, values))
            continue
        other = values + rng.normal(0.0, 1.0, 5) * [0.3, 0.3, 1.0, 5.0, 5.0]
        other[3:] = np.maximum(other[3:], 0.0)
        why = judged(piece.frame, place, other)
        for _ in range(25 if why != ACCEPTED else 0):
            middle = 0.5 * (values + other)
            reason = judged(piece.frame, place, middle)
            if reason == ACCEPTED:
                values = middle
            else:
                other, why = middle, reason
        at_limits[why] += 1
        for _ in range(8):
            box = box_around(piece.frame, place, values)
            assert not all_blocked(environment, tubes, piece.frame, box), (place, values, box, why)
    assert n_blocked > 3000
    assert sum(at_limits.values()) > 100
    assert at_limits[NEAR_VESSEL] > 30


def test_what_a_plan_reaches_is_never_ruled_out(
    small_lung: Lung, proof: UnreachableProof, plans: list[la.Plan]
) -> None:
    """Not as a whole, and no box that holds the plan's deployment, of whatever size."""
    rng = np.random.default_rng(5)
    assert len(plans) >= 6
    for plan in plans:
        target, pose = plan.target_lps, plan.scope.lps_from_scope_tip
        assert not proof.prove(target, most_boxes=3000).proved
        environment = proof._environment(target)
        tested = 0
        for piece in pieces_of(proof, small_lung, pose[:3, 3]):
            values = np.concatenate([deployment_of(piece.frame, plan), piece.frame @ pose[:3, 3]])
            for scale in (1e-4, 1e-3, 1e-2, 0.05, 0.2, 1.0):
                halves = scale * HALVES * rng.uniform(0.1, 1.0, 8)
                box = np.concatenate([values + rng.uniform(-1.0, 1.0, 8) * halves, halves])
                assert not_ruled_out(
                    environment, proof._tubes, proof._insertions, proof._limits, target,
                    piece.frame, piece.cones, box,
                ), (values, box)  # fmt: skip
                tested += 1
        assert tested >= 6


def holds(environment, piece: PlacePiece, tip: Float, rng: np.random.Generator) -> bool:  # type: ignore[no-untyped-def]
    """Tell whether a box around a tip may hold tips, and the piece's first box holds this one."""
    at = piece.frame @ tip[:3]
    values = np.array([*rotation_vector(piece.frame, tip[3:6]), 0.0, 10.0, 20.0, *at])
    halves = 10.0 ** rng.uniform(-4.0, 0.0) * HALVES * rng.uniform(0.0, 1.0, 8)
    box = np.concatenate([values + rng.uniform(-1.0, 1.0, 8) * halves, halves])
    inside = (at >= piece.places[0]).all() and (at <= piece.places[1]).all()
    looks = np.abs(values[:2]).max() <= piece.wide
    return bool(inside and looks and tips_may_be(environment, piece.frame, piece.cones, box))


def random_tips_of_the_region(lung: Lung, least_mm: float, rng: np.random.Generator, n: int) -> Float:
    """Draw tips `(S, 6)` near the axis, in a lumen so deep, that look ahead, as `in_tip_region` has it."""
    tree = lung.tree
    points = tree.points_lps[rng.integers(tree.n_points, size=n)]
    points = points + MAX_OFF_AXIS_MM * rng.uniform(-1.0, 1.0, (n, 3))
    points = points[lung.lumen_depth.lower_bound_mm(points) >= least_mm]
    forward = tree.tangents[in_tip_region(tree, np.hstack([points, points]))[0]]
    forward = forward + rng.normal(0.0, 0.5, forward.shape)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    tips = np.hstack([points, forward])
    return np.asarray(tips[in_tip_region(tree, tips)[1]])


def test_every_tip_of_the_region_is_in_a_box_of_its_piece(
    small_lung: Lung, system: System, proof: UnreachableProof
) -> None:
    """Tips of motions, and tips drawn at random wherever a scope fits that comes from the trachea."""
    rng = np.random.default_rng(7)
    tree, least = small_lung.tree, system.scope.radius_mm + system.scope.lumen_margin_mm
    exits = cKDTree(small_lung.grid.lps(np.argwhere(_may_be_left(small_lung))))
    environment = proof._environment(tree.points_lps[-1])
    motions = find_motions(small_lung, system.scope, reach_mm=float(proof._insertions.max())).tips[:, :6]
    drawn = random_tips_of_the_region(small_lung, least, rng, 20_000)
    counted = aside = 0
    for tip, moved in [*((tip, True) for tip in motions), *((tip, False) for tip in drawn)]:
        if exits.query(tip[:3])[0] > proof._insertions.max():
            continue
        pieces = pieces_of(proof, small_lung, tip[:3])
        assert all(holds(environment, piece, tip, rng) for piece in pieces)
        assert pieces or not moved
        counted += len(pieces)
        aside += bool(pieces) and np.linalg.norm(tree.points_lps - tip[:3], axis=1).min() > 1.0
    assert len(motions) > 100
    assert counted > 0.5 * len(drawn)
    assert aside > 30


def test_a_weak_system_is_proved_not_to_reach_what_it_does_not(small_lung: Lung, system: System) -> None:
    """A thicker scope, tubes that hardly leave it, and a short needle that hardly bends."""
    weak = replace(
        system,
        name="weak",
        scope=replace(system.scope, outer_diameter_mm=2.8),
        needle=replace(system.needle, max_curvature_per_mm=1.0 / 5000.0, max_length_mm=10.0),
        tubes=replace(system.tubes, max_extension_mm=4.0),
    )
    proof = UnreachableProof(small_lung, weak, with_fissures=False)
    atlas = la.build_atlas(small_lung, weak)
    inside = np.argwhere(small_lung.labels == 0)
    points = small_lung.grid.lps(inside[np.random.default_rng(1).choice(len(inside), 12, replace=False)])
    proved = 0
    for point in points:
        shares: list[float] = []
        verdict = proof.prove(point, most_boxes=200_000, progress=shares.append)
        assert verdict.boxes > 0
        assert (verdict.open_lps is None) == verdict.proved
        assert shares == sorted(shares)
        if verdict.proved:
            proved += 1
            assert shares[-1] == 1.0
            again = proof.prove(point, most_boxes=200_000)
            assert (again.proved, again.boxes) == (True, verdict.boxes)
            with pytest.raises(la.LungaccessError):
                next(la.plan(small_lung, weak, point_target(small_lung, point), atlas=atlas, iterations=50))
    assert proved >= 2


def test_a_target_outside_the_image_is_an_error(proof: UnreachableProof) -> None:
    for point in ([1e4, 0.0, 0.0], [math.nan, 0.0, 0.0]):
        with pytest.raises(TargetError, match="not in the image"):
            proof.prove(np.array(point))


def test_the_command(
    tmp_path: Path, small_phantom: Phantom, plans: list[la.Plan], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "patient"
    folder.mkdir()
    write_phantom(small_phantom, folder)
    target = ",".join(f"{value:.3f}" for value in plans[0].target_lps)
    words = ["certify", str(folder), "--system", "ultrathin", "--cache", str(tmp_path / "cache")]
    code = main([*words, "--target", f"lps:{target}", "--most-boxes", "1000", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert code == (0 if said["proved_unreachable"] else 1)
    assert said["boxes"] > 0
    main([*words, "--target", f"lps:{target}", "--most-boxes", "1000"])
    assert "proved" in capsys.readouterr().out
    assert main([*words, "--target", f"lps:{target}", "--most-boxes", "0"]) == ExitCode.BAD_INPUT
    assert main(words) == ExitCode.BAD_INPUT
