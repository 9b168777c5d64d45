"""The proof that a target is unreachable: what a plan reaches is never ruled out."""

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
from anatomy.base.errors import TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import bending_directions
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.reachability.deployment_space import PlacePiece
from lungaccess.planning.reachability.kernels import blocked
from lungaccess.planning.reachability.kernels import deployment_boxes as boxes
from lungaccess.planning.reachability.kernels import unreachable as kernel
from lungaccess.planning.reachability.kernels.blocked import ProofEnvironment
from lungaccess.planning.reachability.unreachable import UnreachableProof, _may_be_left
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from stages.needle.kernels.proof import Limits
from stages.scope import MAX_OFF_AXIS_MM, find_motions, in_tip_region
from stages.tube import deployed, design_arrays, tube_environment
from stages.tube.kernels import ACCEPTED, N_REASONS, N_TRACE, NEAR_VESSEL, SWEEP, validate_arcs


@numba.njit
def outside_workspace(limits, seen, sums):  # type: ignore[no-untyped-def]
    _tip, aside, ahead, size, moved, second = seen
    return kernel._outside_workspace(limits, aside, ahead, size, moved, second, sums, 0.1)


@pytest.mark.parametrize("max_turn_deg", [90.0, 180.0, 540.0])
@pytest.mark.parametrize("max_angle_deg", [60.0, 90.0, 120.0, 180.0])
def test_a_needle_that_may_turn_without_end_comes_to_every_point(
    max_angle_deg: float, max_turn_deg: float
) -> None:
    """A point in the tightest circle, and one behind: ruled out unless the needle can go round to it."""
    values = dict.fromkeys(Limits._fields, 0.0) | {"kappa": 1.0 / 50.0, "max_length_mm": 400.0}
    limits = Limits(
        **values | {"max_angle_rad": math.radians(max_angle_deg), "max_turn_rad": math.radians(max_turn_deg)}
    )
    pose = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    bounded = max_angle_deg <= 90.0 or max_turn_deg <= 180.0
    for rho, ahead in ((40.0, 5.0), (20.0, -10.0)):
        seen = (pose, rho, ahead, math.hypot(rho - 50.0, ahead), 0.1, 0.01)
        assert outside_workspace(limits, seen, np.full(3, 0.1)) == bounded
    assert outside_workspace(limits, (pose, 0.0, 401.0, 500.0, 0.1, 0.01), np.full(3, 0.1))


@numba.njit
def all_blocked(environment, tubes, frame, box):  # type: ignore[no-untyped-def]
    return blocked.tubes_blocked(environment, tubes, boxes.box_tubes(tubes, frame, box), box)


@numba.njit
def tips_may_be(environment, frame, cones, box):  # type: ignore[no-untyped-def]
    return kernel.tips_may_be(environment, frame, cones, box)


@pytest.fixture(scope="module")
def proof(small_lung: Lung, system: System) -> UnreachableProof:
    return UnreachableProof(small_lung, system, with_fissures=False)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System) -> list[la.Plan]:
    """Plans to points of the lung."""
    atlas = la.build_atlas(small_lung, system, rotations=12, stop_spacing_mm=4.0)
    rng = np.random.default_rng(0)
    inside = np.argwhere(small_lung.labels == 0)
    found: list[la.Plan] = []
    options: dict[str, object] = {"atlas": atlas, "seed": 0, "iterations": 20, "counterfactuals": False}
    for point in small_lung.grid.lps(inside[rng.choice(len(inside), 14, replace=False)]):
        if len(found) == 4:
            break
        try:
            target = point_target(small_lung, point)
            found.append(next(la.plan(small_lung, system, target, **options, goal="default")))
        except la.LungaccessError:
            continue
    return found


HALVES = np.array([0.7, 0.7, 3.0, 20.0, 20.0, 2.0, 2.0, 2.0])
"""Half widths of a large box, rad and mm."""


def random_tips(proof: UnreachableProof, rng: np.random.Generator, n: int) -> list[tuple[PlacePiece, Float]]:
    """Draw places of the scope tip, with their pieces; some are not in the lumen."""
    chosen = [proof.space.pieces[m] for m in rng.integers(len(proof.space.pieces), size=n)]
    return [(piece, rng.uniform(*piece.places) @ piece.frame) for piece in chosen]


def pieces_of(proof: UnreachableProof, lung: Lung, place: Float) -> list[int]:
    """Return the numbers of the pieces that hold the tree point nearest to a place."""
    nearest = lung.tree.points_lps[np.linalg.norm(lung.tree.points_lps - place, axis=1).argmin()]
    return [
        number
        for number, piece in enumerate(proof.space.pieces)
        if ((piece.cones[:, :3] == nearest).all(axis=1) & (piece.cones[:, 6] > 0.0)).any()
    ]


def rotation_vector(frame: Float, forward: Float) -> tuple[float, float]:
    """Return the vector, which lies across, that turns the frame's axis towards a direction."""
    seen = frame @ forward
    angle = math.acos(min(max(float(seen[2]), -1.0), 1.0))
    aside = math.hypot(seen[0], seen[1])
    return (-seen[1] / aside * angle, seen[0] / aside * angle) if aside > 1e-12 else (0.0, 0.0)


def middles_of(frame: Float, pose: Float, rotation_rad: float, outer_mm: float, inner_mm: float) -> Float:
    """Return the middles of a box that has a deployment from a pose of the scope tip in its middle."""
    east, north = rotation_vector(frame, pose[:3, 2])
    turned = Rotation.from_rotvec(east * frame[0] + north * frame[1]).as_matrix() @ frame.T
    normal = turned.T @ bending_directions(pose, rotation_rad)[0]
    rotation = math.atan2(normal[1], normal[0])
    return np.concatenate([[east, north, rotation, outer_mm, inner_mm], frame @ pose[:3, 3]])


def boxes_offered(
    proof: UnreachableProof,
    lung: Lung,
    target: Float,
    environment: ProofEnvironment,
    deployment: tuple[Float, float, float, float],
    rng: np.random.Generator,
) -> int:
    """Offer the proof boxes of all sizes about a deployment that reaches a target; return how many."""
    offered, owners = [], []
    for number in pieces_of(proof, lung, deployment[0][:3, 3]):
        values = middles_of(proof.space.pieces[number].frame, *deployment)
        for scale in (1e-4, 1e-3, 1e-2, 0.05, 0.2, 1.0):
            halves = scale * HALVES * rng.uniform(0.1, 1.0, 8)
            offered.append(np.concatenate([values + rng.uniform(-1.0, 1.0, 8) * halves, halves]))
            owners.append(number)
    count = len(offered)
    found = kernel.Found(
        outcome=np.full(count, kernel.TOO_MANY, dtype=np.uint8),
        share=np.zeros(count),
        looked=np.zeros(count, dtype=np.int64),
        left=np.zeros((count, boxes.BOX_COLUMNS)),
    )
    kernel.rule_out(
        environment, proof._tubes, proof._insertions, proof._limits, target, proof.space.arrays,
        np.array(offered), np.array(owners, dtype=np.int32), np.arange(count), 1, False, found,
    )  # fmt: skip
    assert (found.looked == 1).all()
    for outcome, box in zip(found.outcome, offered, strict=True):
        assert outcome != kernel.RULED_OUT, box
    return count


@pytest.mark.slow
def test_no_box_with_a_deployment_that_can_be_is_blocked(
    small_lung: Lung, tubes: Float, proof: UnreachableProof, plans: list[la.Plan]
) -> None:
    """Deployments as near to a limit as it gets, between one that can be and one that cannot."""
    rng = np.random.default_rng(6)
    deploying = tube_environment(small_lung, with_fissures=False)
    environment, design = proof._environment(plans[0].target_lps), design_arrays(plans[0].system.tubes)
    trace, tip = np.zeros(N_TRACE), np.zeros(9)
    at_limits: Counter[int] = Counter()
    n_blocked = 0

    def judged(frame: Float, place: Float, values: Float) -> int:
        turned = Rotation.from_rotvec(values[0] * frame[0] + values[1] * frame[1]).as_matrix()
        normal = turned @ (math.cos(values[2]) * frame[0] + math.sin(values[2]) * frame[1])
        base = np.concatenate([place, turned @ frame[2]])
        shape = deployed(design, values[4:2:-1], [0.0, 0.0])
        if shape is None:
            return N_REASONS
        arcs, beside = shape.arcs[: shape.number[0]], float(shape.result[SWEEP])
        return int(validate_arcs(deploying, tubes, base, normal, arcs, beside, trace, tip))

    def box_around(frame: Float, place: Float, values: Float) -> Float:
        scale = 10.0 ** rng.uniform(-5.0, -1.0)
        halves = scale * HALVES * rng.uniform(0.1, 1.0, 8)
        middles = np.concatenate([values, frame @ place])
        return np.concatenate([middles + rng.uniform(-1.0, 1.0, 8) * halves, halves])

    tips = random_tips(proof, rng, 6_000)
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
    assert n_blocked > 900
    assert sum(at_limits.values()) > 30
    assert at_limits[NEAR_VESSEL] > 9


def test_what_a_plan_reaches_is_never_ruled_out(
    small_lung: Lung, proof: UnreachableProof, plans: list[la.Plan]
) -> None:
    """Not as a whole, and no box that holds the plan's deployment, of whatever size."""
    rng = np.random.default_rng(5)
    assert len(plans) == 4
    for plan in plans:
        target, pose = plan.target_lps, plan.scope.lps_from_scope_tip
        assert not proof.prove(target, most_boxes=10_000).proved
        tube = plan.tube
        deployment = pose, tube.rotation_rad, tube.outer_insertion_mm, tube.inner_insertion_mm
        assert boxes_offered(proof, small_lung, target, proof._environment(target), deployment, rng) >= 6


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("radius_mm", [121.0, 50.0])
@pytest.mark.parametrize("patient", ["Patient1", "Patient2"])
def test_what_direct_arcs_of_a_real_lung_reach_is_never_ruled_out(
    data_dir: Path, patient: str, radius_mm: float
) -> None:
    """Each accepted arc from a deployment of the atlas to a peripheral target: 2,500 of each set."""
    lung = la.load_patient(data_dir / "med-rad" / patient)
    system = la.load_system("lung-default", fissures_allowed=True)
    needle = replace(system.require_needle("The test"), max_curvature_per_mm=1.0 / radius_mm)
    system = replace(system, name="lung-default and a needle", needle=needle)
    atlas, rng = la.build_atlas(lung, system), np.random.default_rng(3)
    real = UnreachableProof(lung, system, with_fissures=atlas.with_fissures)
    accepted = 0
    for point in rng.permutation(peripheral_targets(lung, 50, 0)):
        target = point_target(lung, point)
        arcs = DirectArcs(Task(lung=lung, system=system, target=target), atlas)
        if accepted >= 2500 or not len(arcs.in_workspace):
            continue
        environment = real._environment(target.lps_mm)
        for entry in rng.permutation(arcs.in_workspace)[:600]:
            tip = atlas.motions.tip(int(atlas.deployments.site[entry]))
            made = atlas.deployments
            rotation, outer, inner = made.rotation_rad[entry], made.outer_mm[entry], made.inner_mm[entry]
            candidate = arcs.evaluator.direct(tip, *made.choice(int(entry)))
            if candidate is None or not math.isfinite(arcs.evaluator.evaluate(candidate)):
                continue
            deployment = tip.lps_from_scope_tip, rotation, outer, inner
            assert boxes_offered(real, lung, target.lps_mm, environment, deployment, rng) >= 6
            accepted += 1
    assert accepted >= 2500


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


@pytest.mark.slow
def test_every_tip_of_the_region_is_in_a_box_of_its_piece(
    small_lung: Lung, system: System, proof: UnreachableProof
) -> None:
    """Tips of motions, and tips drawn at random wherever a scope fits that comes from the trachea."""
    rng = np.random.default_rng(7)
    tree, least = small_lung.tree, system.scope.radius_mm + system.scope.lumen_margin_mm
    exits = cKDTree(small_lung.grid.lps(np.argwhere(_may_be_left(small_lung))))
    environment = proof._environment(tree.points_lps[-1])
    motions = find_motions(small_lung, system.scope, reach_mm=float(proof._insertions.max())).tips[:, :6]
    drawn = random_tips_of_the_region(small_lung, least, rng, 6_000)
    counted = aside = 0
    for tip, moved in [*((tip, True) for tip in motions), *((tip, False) for tip in drawn)]:
        if exits.query(tip[:3])[0] > proof._insertions.max():
            continue
        pieces = [proof.space.pieces[number] for number in pieces_of(proof, small_lung, tip[:3])]
        assert all(holds(environment, piece, tip, rng) for piece in pieces)
        assert pieces or not moved
        counted += len(pieces)
        aside += bool(pieces) and np.linalg.norm(tree.points_lps - tip[:3], axis=1).min() > 1.0
    assert len(motions) > 100
    assert counted > 0.5 * len(drawn)
    assert aside > 9


@pytest.mark.slow
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
        verdict = proof.prove(point, most_boxes=300_000, progress=shares.append)
        assert verdict.boxes > 0
        assert (verdict.open_lps is None) == verdict.proved
        assert shares == sorted(shares)
        assert 0.0 <= verdict.share_ruled_out <= 1.0
        left = sum(place.share for place in verdict.open_places)
        assert verdict.share_ruled_out + left == pytest.approx(1.0)
        if verdict.proved:
            proved += 1
            assert shares[-1] == 1.0
            if proved == 1:
                again = proof.prove(point, most_boxes=300_000)
                assert (again.proved, again.boxes) == (True, verdict.boxes)
            with pytest.raises(la.LungaccessError):
                next(
                    la.plan(
                        small_lung,
                        weak,
                        point_target(small_lung, point),
                        atlas=atlas,
                        iterations=50,
                        goal="default",
                    )
                )
        if proved == 2:
            break
    assert proved == 2


def test_a_target_outside_the_image_is_an_error(proof: UnreachableProof) -> None:
    for point in ([1e4, 0.0, 0.0], [math.nan, 0.0, 0.0]):
        with pytest.raises(TargetError, match="not in the image"):
            proof.prove(np.array(point))


@pytest.fixture
def words(tmp_path: Path, small_phantom: Phantom) -> list[str]:
    """The command for a patient on disk, without its target."""
    folder = tmp_path / "patient"
    folder.mkdir()
    write_phantom(small_phantom, folder)
    return ["certify", str(folder), "--system", "ultrathin", "--cache", str(tmp_path / "cache")]


def target_of(plan: la.Plan) -> list[str]:
    return ["--target", "lps:" + ",".join(f"{value:.3f}" for value in plan.target_lps)]


@pytest.mark.slow
def test_the_command(words: list[str], plans: list[la.Plan], capsys: pytest.CaptureFixture[str]) -> None:
    target = target_of(plans[0])
    code = main([*words, *target, "--most-boxes", "1000", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert code == (0 if said["proved_unreachable"] else 1)
    assert said["boxes"] > 0
    assert said["share_ruled_out"] == pytest.approx(1.0 - sum(each["share"] for each in said["open_places"]))
    assert main([*words, *target, "--most-boxes", "0"]) == ExitCode.BAD_INPUT
    assert main(words) == ExitCode.BAD_INPUT


@pytest.mark.slow
def test_the_command_draws_what_is_open(
    words: list[str], plans: list[la.Plan], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main([*words, *target_of(plans[0]), "--most-boxes", "1000", "--out", str(tmp_path / "open.png")])
    assert "proved" in capsys.readouterr().out
    assert (tmp_path / "open.png").stat().st_size > 10_000
