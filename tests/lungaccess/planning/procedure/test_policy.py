"""What a policy decides by: measurements weighed by their errors, foreseen chances, prepared replanning."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lungaccess as la
from anatomy import poses
from anatomy.base.errors import LungaccessError, PlanFileError, SettingsError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.one_stage import ScopeReplanner
from lungaccess.planning.procedure import simulated
from lungaccess.planning.procedure.spread import (
    as_measured,
    fused,
    fused_share,
    fused_size,
    scope_moves,
    sizes_of,
    tip_moves,
)
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import Procedure, ScopePlacing, load_procedure
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle import Objective
from stages.tube import SiteEnumerator, enumerate_deployments
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

SYSTEM = la.load_system("ultrathin")
ERRORS = load_errors("gated-ct")


def tip_row(plan: Plan) -> Float:
    frame = np.asarray(plan.scope.lps_from_scope_tip)
    return np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])


# Measurements ------------------------------------------------------------------------------------


def a_pose(seed: int = 0) -> Float:
    turn = Rotation.random(random_state=seed).as_matrix()
    return poses.pose(np.array([1.0, -2.0, 3.0]), turn[:, 2], turn[:, 0])


def test_a_measurement_is_weighed_by_its_errors() -> None:
    """Of 600 true poses and measurements, what is left of the errors is what theory says, not more."""
    expected, rng = a_pose(), np.random.default_rng(0)
    sizes, seen = (1.3, math.radians(2.0)), (0.7, 1.0)
    left = []
    for _ in range(600):
        a, b = sizes[1] * rng.standard_normal(2)
        true = expected @ poses.pose(np.zeros(3), np.array([a, b, 1.0]) / math.hypot(a, b, 1.0), np.eye(3)[0])
        true[:3, 3] += sizes[0] * rng.standard_normal(3)
        measured = as_measured(true, *seen, rng.standard_normal(5))
        likely = fused(expected, scope_moves(expected, *sizes), measured, seen[0], math.radians(seen[1]))
        across = expected[:3, :2].T @ (likely[:3, 2] - true[:3, 2])
        left.append([*(likely[:3, 3] - true[:3, 3]), *across])
    spread = np.std(left, axis=0)
    assert spread[:3] == pytest.approx(fused_size(1.3, 0.7), rel=0.12)
    assert spread[3:] == pytest.approx(fused_size(sizes[1], math.radians(1.0)), rel=0.12)


def test_an_exact_measurement_is_believed_and_a_needless_one_is_not() -> None:
    expected, measured = a_pose(), as_measured(a_pose(), 1.0, 3.0, np.array([1.0, -1.0, 0.5, 1.0, -2.0]))
    moves = scope_moves(expected, 1.3, 0.02)
    assert np.array_equal(fused(expected, moves, measured, 0.0, 0.0), measured)
    nearly = fused(expected, moves, measured, 1e-6, 1e-8)
    assert np.allclose(nearly, measured, atol=1e-6)
    sure = fused(expected, np.zeros_like(moves), measured, 0.7, 0.01)
    assert np.allclose(sure[:3, 3], expected[:3, 3]) and np.allclose(sure[:3, 2], expected[:3, 2])
    assert fused_share(np.array([0.0, 1.0]), 1.0).tolist() == [0.0, 0.5]
    assert (fused_size(0.0, 1.0), fused_size(3.0, 4.0)) == (0.0, pytest.approx(2.4))


def test_a_wrong_rotation_is_told_from_where_the_tip_is() -> None:
    """A tip that a turn of the tubes has moved is found along that turn, more exactly than it is measured."""
    scope, tip = np.eye(4), poses.pose(np.array([10.0, 0.0, 30.0]), [0.6, 0.0, 0.8], [0.8, 0.0, -0.6])
    left = sizes_of(SYSTEM, load_errors("gated-ct"), load_procedure("measured-tip"), 0.0)
    turned = left._replace(scope=0.0, scope_turn=0.0, insertion=0.0)
    moves = tip_moves(scope, tip, turned)
    assert np.linalg.matrix_rank(moves) == 1
    true = poses.pose(np.zeros(3), [0.0, 0.0, 1.0], [math.cos(0.05), math.sin(0.05), 0.0]) @ tip
    measured = as_measured(true, 0.7, 1.0, np.array([1.0, 1.0, 1.0, 0.0, 1.0]))
    likely = fused(tip, moves, measured, 0.7, math.radians(1.0))
    assert abs(likely[2, 3] - 30.0) < 1e-9
    assert np.linalg.norm(likely[:3, 3] - true[:3, 3]) < 0.5 * np.linalg.norm(measured[:3, 3] - true[:3, 3])


# Replanning from many poses ----------------------------------------------------------------------


def test_a_prepared_replan_is_that_of_the_public_function(plan: Plan, small_lung: Lung) -> None:
    target = Target(lps_mm=np.asarray(plan.target_lps), origin=plan.target_origin)
    objective = Objective.of("inverse_clearance")
    task = Task(lung=small_lung, system=SYSTEM, target=target, objective=objective, method="replan", seed=0)
    prepared, found = ScopeReplanner(task, tries=50, searches=2), 0
    for seed in range(4):
        noise = np.random.default_rng(seed).standard_normal(5)
        pose = as_measured(np.asarray(plan.scope.lps_from_scope_tip), 0.3, 1.0, noise)
        try:
            alone = la.replan_from_scope(small_lung, SYSTEM, pose, target, tries=50, searches=2)
        except NoPlan as failure:
            with pytest.raises(NoPlan) as again:
                prepared.replan(pose)
            assert again.value.reasons == failure.reasons
            continue
        rest, found = prepared.replan(alone.lps_from_measured), found + 1
        assert rest.record() == alone.record()
    assert found > 0


def test_fewer_rotations_are_some_of_all(plan: Plan, small_lung: Lung) -> None:
    row, target = tip_row(plan), np.asarray(plan.target_lps)

    def towards(positions: Float, _tangents: Float) -> np.ndarray:
        return np.linalg.norm(positions - target, axis=1) < 60.0

    options = {"with_fissures": True}
    every = enumerate_deployments(
        small_lung, SYSTEM.tubes, SYSTEM.margins, row[None], worthwhile=towards, **options
    )
    some = SiteEnumerator(
        small_lung, SYSTEM.tubes, SYSTEM.margins, enough=every.candidates // 3, **options
    ).deployments(row, towards)
    assert 0 < some.candidates <= every.candidates // 3 and 0 < some.count < every.count
    whole = {every.choice(n) for n in range(every.count)}
    assert {some.choice(n) for n in range(some.count)} <= whole


# Chances -----------------------------------------------------------------------------------------


def test_foreseen_chances_are_those_of_procedures(plan: Plan, small_lung: Lung) -> None:
    """The mean chance over placements is near the share of procedures that succeed with one placement."""
    procedure = Procedure(scope=ScopePlacing(measured=True, position_mm=0.7, direction_deg=1.0, placements=2))
    chosen = la.Policy(plan, small_lung, ERRORS, procedure, radius_mm=5.0)
    worth = chosen.worth
    assert worth[0] == 0.0 < worth[1] < 1.0
    once = Procedure(scope=ScopePlacing(measured=True, position_mm=0.7, direction_deg=1.0))
    counted = la.simulate_procedure(
        plan, small_lung, errors=ERRORS, procedure=once, samples=200, radius_mm=5.0
    )
    assert abs(worth[1] - counted.succeeds.value) < 0.2
    twice = simulated(chosen, 200, 0)
    assert twice.placements > 1.0 and twice.succeeds.count >= counted.succeeds.count


# The public policy -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def policy(plan: Plan, small_lung: Lung) -> la.Policy:
    return la.Policy(plan, small_lung, ERRORS, load_procedure("measured-tip"), radius_mm=5.0)


def measured_scopes(plan: Plan, count: int) -> Float:
    expected = np.tile(np.asarray(plan.scope.lps_from_scope_tip), (count, 1, 1))
    return as_measured(expected, 0.5, 1.0, np.random.default_rng(4).standard_normal((count, 5)))


def test_the_simulator_decides_as_the_public_policy(policy: la.Policy, plan: Plan) -> None:
    """What is decided for many poses at once is decided for each alone."""
    poses_seen = measured_scopes(plan, 12)
    together = policy.from_scopes(policy.scopes_measured(poses_seen))
    for number, pose in enumerate(poses_seen):
        decision = policy.decide(la.Measurements.of(scope=[pose], placements=3))
        assert decision.chance == pytest.approx(together.chances[number], abs=1e-12)
        assert decision.goes_on == policy.goes_on(together.chances, 0)[number]
        if decision.tube is not None:
            assert np.allclose(decision.tube.lps_from_tip, together.tips[number], atol=1e-6)


def test_going_on_as_planned_is_a_choice(policy: la.Policy, plan: Plan) -> None:
    """No choice is less likely than going on as planned, foreseen by the same kernels."""
    placed = policy.scopes_measured(measured_scopes(plan, 40))
    alone = policy._chosen(placed, policy._planned_choice)
    assert (policy.from_scopes(placed).chances >= alone.chances).all()


@pytest.mark.parametrize("name", ["measured-scope", "measured-tip", "closed-loop"])
@pytest.mark.parametrize("errors", ["gated-ct", "breath-hold"])
def test_measuring_never_makes_it_worse(plan: Plan, small_lung: Lung, name: str, errors: str) -> None:
    """The same patients succeed at least as often as in open loop, up to the error of the draws."""
    options = {"errors": load_errors(errors), "samples": 150, "radius_mm": 5.0}
    blind = la.simulate_procedure(plan, small_lung, **options)
    seen = la.simulate_procedure(plan, small_lung, procedure=load_procedure(name), **options)
    assert seen.succeeds.count >= blind.succeeds.count - 2.0 * math.sqrt(150 * 0.25)


def test_stages_follow_each_other(policy: la.Policy, plan: Plan) -> None:
    scope, tubes = np.asarray(plan.scope.lps_from_scope_tip), np.asarray(plan.tube.lps_from_tip)
    first = policy.decide(la.Measurements.of(scope=[scope, scope]))
    assert first.tube is not None and first.needle is not None and 0.0 < first.chance <= 1.0
    out = policy.decide(la.Measurements.of(scope=[scope], tubes=[np.asarray(first.tube.lps_from_tip)]))
    assert out.tube is None and out.needle is not None and out.goes_on
    path = out.needle
    start = np.asarray(path.lps_from_start)
    on_the_way = policy.decide(la.Measurements.of(scope=[scope], tubes=[tubes], needle=[start]))
    assert on_the_way.needle is not None
    with pytest.raises(SettingsError, match="The scope is not measured"):
        policy.decide(la.Measurements.of(tubes=[tubes]))


def test_a_record_is_played_again(policy: la.Policy, plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    record, path = la.ProcedureRecord(policy), tmp_path / "record.json"
    for pose in measured_scopes(plan, 3):
        record.decide(la.Measurements.of(scope=[pose]))
    record.save(path)
    again = la.ProcedureRecord.load(path, plan, small_lung)
    assert again.steps == record.steps
    stored = json.loads(path.read_text())
    stored["steps"][1]["decided"]["chance"] = 0.123
    path.write_text(json.dumps(stored))
    with pytest.raises(PlanFileError, match="Step 2"):
        la.ProcedureRecord.load(path, plan, small_lung)
    other = replace(plan, seed=plan.seed + 1)
    with pytest.raises(PlanFileError, match="another plan"):
        la.ProcedureRecord.load(path, other, small_lung)
    path.write_text("{}")
    with pytest.raises(PlanFileError, match="no record"):
        la.ProcedureRecord.load(path, plan, small_lung)


# Other systems -----------------------------------------------------------------------------------


def thin_tubes_only() -> la.System:
    loaded = la.load_system("tubes-only", fissures_allowed=True)
    return replace(loaded, name="thin", scope=replace(loaded.scope, outer_diameter_mm=2.0))


@pytest.mark.parametrize("system", [two_curved_tubes(), thin_tubes_only()], ids=["twisted", "tubes only"])
def test_twisted_tubes_and_none_behind_them(system: la.System, small_lung: Lung) -> None:
    """Measured procedures of any system succeed at least as often as open loop, up to the error of draws."""
    atlas = la.build_atlas(small_lung, system, **COARSE)
    entries, beyond_mm = atlas.deployments, 0.0 if system.needle is None else 14.0
    for entry in np.random.default_rng(0).permutation(entries.count):
        try:
            point = entries.positions[entry] + beyond_mm * entries.tangents[entry]
            plan = next(iter(la.plan(small_lung, system, la.point_target(small_lung, point), atlas=atlas)))
        except LungaccessError:
            continue
        break
    options = {"errors": ERRORS, "samples": 40, "radius_mm": 5.0}
    procedure = load_procedure("measured-tip")
    blind = la.simulate_procedure(plan, small_lung, **options)
    seen = la.simulate_procedure(plan, small_lung, procedure=procedure, **options)
    assert seen.succeeds.count >= blind.succeeds.count - 2.0 * math.sqrt(40 * 0.25)
    policy = la.Policy(plan, small_lung, ERRORS, procedure, radius_mm=5.0)
    decision = policy.decide(la.Measurements.of(scope=[plan.scope.lps_from_scope_tip]))
    assert decision.tube is not None and (decision.needle is None) == (system.needle is None)
