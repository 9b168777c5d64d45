"""The rest of a plan from a measured pose: proved, within all limits, the same from the same seed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lungaccess as la
from anatomy.base.errors import FrameError, TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import FISSURE, OUTSIDE, VESSEL
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.checking import check_needle_alone
from lungaccess.plans.parts import NeedlePath
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from stages.tube import DeploymentValidator, enumerate_deployments
from tests.stages.scenes import brute_clearance

SYSTEM = la.load_system("ultrathin")
TARGET = "lps:-45.6,47.0,-65.1"


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung, TARGET)


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas, target: Target) -> Plan:
    return list(la.plan(small_lung, SYSTEM, target, atlas=small_atlas, iterations=30, goal="default"))[-1]


def moved(pose: Float, seed: int, mm: float = 0.5, degrees: float = 2.0) -> Float:
    rng, out = np.random.default_rng(seed), pose.copy()
    out[:3, :3] = (
        Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal(3)).as_matrix() @ pose[:3, :3]
    )
    out[:3, 3] += mm * rng.standard_normal(3)
    return out


def end_of(needle: NeedlePath) -> Float:
    """Return where the arcs end, integrated anew."""
    frame = needle.lps_from_start.copy()
    for arc in needle.arcs:
        steps = 2000
        turn = Rotation.from_rotvec([0.0, arc.curvature_per_mm * arc.length_mm / steps, 0.0]).as_matrix()
        frame[:3, :3] = frame[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, arc.roll_rad]).as_matrix()
        for _ in range(steps):
            half = frame[:3, :3] @ Rotation.from_matrix(turn).__pow__(0.5).as_matrix()
            frame[:3, 3] += half[:, 2] * arc.length_mm / steps
            frame[:3, :3] = frame[:3, :3] @ turn
    return frame[:3, 3]


def test_from_where_the_scope_was_planned_to_be(small_lung: Lung, plan: Plan, target: Target) -> None:
    rest = la.replan_from_scope(small_lung, SYSTEM, plan.scope.lps_from_scope_tip, target)
    assert rest.tube is not None and rest.cost < 1.5 * plan.cost
    validator = DeploymentValidator(small_lung, SYSTEM.tubes, SYSTEM.margins, with_fissures=True)
    tube = rest.tube
    again = validator.validate(
        plan.scope.lps_from_scope_tip, tube.rotation_rad, tube.insertions_mm(SYSTEM.tubes)
    )
    assert not isinstance(again, str) and again.branch == tube.exit.branch == rest.branch
    assert np.allclose(rest.needle.lps_from_start, tube.lps_from_tip)
    assert np.allclose(end_of(rest.needle), target.lps_mm, atol=1e-2)


@pytest.mark.parametrize("seed", range(4))
def test_from_a_scope_that_is_elsewhere(small_lung: Lung, plan: Plan, target: Target, seed: int) -> None:
    measured = moved(plan.scope.lps_from_scope_tip, seed)
    try:
        rest = la.replan_from_scope(small_lung, SYSTEM, measured, target, seed=seed)
    except la.NoPlan as failure:
        assert failure.reasons and "as measured" in str(failure)
        return
    same = la.replan_from_scope(small_lung, SYSTEM, measured, target, seed=seed)
    assert json.dumps(same.record()) == json.dumps(rest.record())
    assert np.allclose(rest.lps_from_measured, measured, atol=1e-9)
    least = min(
        brute_clearance(
            small_lung.labels, small_lung.grid, rest.needle.end_lps[None], VESSEL | OUTSIDE | FISSURE, 5.0
        )
    )
    assert least >= SYSTEM.needle.radius_mm + SYSTEM.margins.total_mm - 1e-9
    for name, kept in rest.clearance_mm["needle"].items():
        assert kept >= SYSTEM.needle.radius_mm + SYSTEM.margins.total_mm - 0.05, name


def test_a_roll_of_the_scope_turns_the_tubes_back(small_lung: Lung, plan: Plan, target: Target) -> None:
    """The same deployments exist, counted from another +x."""
    tips = []
    for roll in (0.0, np.pi / 12.0):
        frame = plan.scope.lps_from_scope_tip.copy()
        frame[:3, :3] = frame[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
        row = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])[None]
        found = enumerate_deployments(small_lung, SYSTEM.tubes, SYSTEM.margins, row, with_fissures=True)
        whole = np.isclose((found.rotation_rad / (np.pi / 12.0)) % 1.0, 0.0, atol=1e-6) | np.isclose(
            (found.rotation_rad / (np.pi / 12.0)) % 1.0, 1.0, atol=1e-6
        )
        tips.append({tuple(np.round(each, 6)) for each in found.positions[whole]})
    assert tips[0] and tips[0] == tips[1]


@pytest.mark.parametrize("seed", range(4))
def test_from_a_tube_that_is_elsewhere(small_lung: Lung, plan: Plan, target: Target, seed: int) -> None:
    measured = moved(plan.tube.lps_from_tip, seed, mm=0.2, degrees=0.5)
    try:
        rest = la.replan_from_tube(small_lung, SYSTEM, measured, target)
    except la.NoPlan as failure:
        assert failure.reasons and "as measured" in str(failure)
        return
    assert rest.tube is None
    arcs = np.array([[arc.length_mm, arc.roll_rad, arc.curvature_per_mm] for arc in rest.needle.arcs])
    branches = () if rest.branch < 0 else (rest.branch,)
    report = check_needle_alone(
        small_lung, SYSTEM, rest.lps_from_measured, arcs, target.lps_mm, branches=branches, at_wall=False
    )
    assert report.accepted, [str(each) for each in report.refusals]


def test_from_where_the_tubes_were_planned_to_end(small_lung: Lung, plan: Plan, target: Target) -> None:
    rest = la.replan_from_tube(small_lung, SYSTEM, plan.tube.lps_from_tip, target)
    assert rest.cost < 1.2 * plan.cost


def test_what_is_no_pose_is_refused(small_lung: Lung, plan: Plan, target: Target) -> None:
    mirrored, far = plan.scope.lps_from_scope_tip.copy(), plan.scope.lps_from_scope_tip.copy()
    mirrored[:3, 0] *= -1.0
    far[:3, 3] += 1000.0
    skewed = plan.scope.lps_from_scope_tip.copy()
    skewed[:3, 0] += 0.005
    for ask in (la.replan_from_scope, la.replan_from_tube):
        for wrong in (mirrored, np.eye(3), np.full((4, 4), np.nan)):
            with pytest.raises(FrameError, match="rigid pose"):
                ask(small_lung, SYSTEM, wrong, target)
        with pytest.raises(TargetError, match="outside the images"):
            ask(small_lung, SYSTEM, far, target)
    rest = la.replan_from_scope(small_lung, SYSTEM, skewed, target)
    turn = rest.lps_from_measured[:3, :3]
    assert np.allclose(turn.T @ turn, np.eye(3), atol=1e-12)


def test_a_target_out_of_reach_is_a_no_plan_with_reasons(small_lung: Lung, plan: Plan) -> None:
    far = la.resolve_target(small_lung, nodule=3)
    with pytest.raises(la.NoPlan, match="outside the needle's workspace") as failure:
        la.replan_from_scope(small_lung, SYSTEM, plan.scope.lps_from_scope_tip, far)
    assert sum(failure.value.reasons.values()) > 0
    with pytest.raises(la.NoPlan, match="out of reach"):
        la.replan_from_tube(small_lung, SYSTEM, plan.tube.lps_from_tip, far)


def test_the_command_needs_one_pose(tmp_path: Path) -> None:
    assert cli.main(["replan", str(tmp_path), "--nodule"]) == ExitCode.BAD_INPUT
