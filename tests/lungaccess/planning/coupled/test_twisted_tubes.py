"""Systems whose tubes are turned one against the other: atlas, plan, check, risk and what is refused."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from experiments.support.mutants import twisted
from experiments.support.mutants.mutant import Case
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.local_search import LocalSearch
from lungaccess.planning.coupled.search.needle_planner import random_placements
from lungaccess.planning.one_stage.replan import replan_from_scope
from lungaccess.planning.reachability import UnreachableProof
from lungaccess.planning.refinement import refine
from lungaccess.planning.refinement.layout import ShapeModel, joints_of, terms
from lungaccess.plans.assemble import assemble
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from lungaccess.showing.report.html.deployment import packed_plan
from lungaccess.showing.report.pack import unpack
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import Deviations
from stages.tube import DeploymentValidator, design_arrays, points_on_arcs, shapes_of
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def system() -> System:
    return two_curved_tubes()


@pytest.fixture(scope="module")
def atlas(small_lung: Lung, system: System) -> la.Atlas:
    return la.build_atlas(small_lung, system, **COARSE)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System, atlas: la.Atlas) -> list[la.Plan]:
    """Plans from deployments whose tubes are turned against each other."""
    entries, shapes = atlas.deployments, shapes_of(system.tubes)
    turned = np.flatnonzero(
        (np.abs(np.sin(shapes.rotations_rad[entries.shape, 1])) > 0.4)
        & (shapes.insertions_mm[entries.shape, 1] > 6.0)
    )
    found = []
    for entry in turned[np.linspace(0, len(turned) - 1, 12).astype(int)].tolist():
        point = entries.positions[entry] + 20.0 * entries.tangents[entry]
        try:
            target = point_target(small_lung, point)
            found += list(
                la.plan(small_lung, system, target, atlas=atlas, seed=0, iterations=3, goal="default")
            )[-1:]
        except la.LungaccessError:
            continue
    return [plan for plan in found if plan.tube.outer_insertion_mm > 0.0]


@pytest.fixture(scope="module")
def case(small_lung: Lung, system: System, plans: list[la.Plan]) -> Case:
    plan = max(plans, key=lambda each: abs(np.sin(each.tube.shape.relative_rotations_rad["outer"])))
    return Case(lung=small_lung, plan=plan, report=la.check(plan, small_lung, system=system), other=plans[0])


def test_plans_state_each_tube_and_are_accepted(
    small_lung: Lung, system: System, plans: list[la.Plan]
) -> None:
    assert len(plans) >= 3
    for plan in plans:
        report = la.check(plan, small_lung, system=system)
        assert report.accepted, report
        assert {"tube.stable", "tube.arcs"} <= {finding.name for finding in report.findings}
        assert plan.tube.shape.least_determinant > 0.0
        turned = plan.tube.shape.relative_rotations_rad["outer"] != 0.0
        assert plan.rotations.startswith("turn the outer tube to" if turned else "turn to")
    assert sum(plan.tube.shape.relative_rotations_rad["outer"] != 0.0 for plan in plans) >= 3


def test_a_plan_is_the_same_after_it_was_saved(tmp_path: Path, plans: list[la.Plan]) -> None:
    plans[0].save(tmp_path / "plan.json")
    loaded = la.Plan.load(tmp_path / "plan.json")
    assert loaded.digest == plans[0].digest
    np.testing.assert_array_equal(loaded.tube.shape.arcs, plans[0].tube.shape.arcs)


def test_the_atlas_holds_what_the_validator_accepts(
    small_lung: Lung, system: System, atlas: la.Atlas
) -> None:
    entries = atlas.deployments
    validator = DeploymentValidator(small_lung, system.tubes, system.margins, with_fissures=False)
    refused = 0
    for entry in np.linspace(0, entries.count - 1, 200).astype(int).tolist():
        frame = atlas.motions.tip(int(entries.site[entry])).lps_from_scope_tip
        found = validator.choose(frame, *entries.choice(entry))
        if isinstance(found, str):
            refused += 1
            continue
        assert found.lps_from_tip[:3, 3] == pytest.approx(entries.positions[entry], abs=0.02)
    # The exit and its corner are those of a shape within 0.1 mm; clearances are larger by that.
    assert refused <= 6
    assert (shapes_of(atlas.system.tubes).least_determinant[entries.shape] > 0.0).all()


@pytest.mark.parametrize("mutation", twisted.MUTATIONS, ids=lambda mutation: mutation.__name__)
def test_joint_values_and_shapes_that_do_not_belong_together_are_refused(
    case: Case, small_lung: Lung, mutation: twisted.Mutation
) -> None:
    assert case.report.accepted
    rng, tried = np.random.default_rng(7), 0
    while tried < 4:
        mutant = mutation(case, rng)
        if mutant is not None:
            assert not la.check(mutant.plan, small_lung).accepted, mutant.plan.tube
            tried += 1


def test_the_search_turns_and_inserts_each_tube(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[la.Plan]
) -> None:
    turned = []
    for plan in plans:
        task = Task(lung=small_lung, system=system, target=point_target(small_lung, plan.target_lps))
        search = AtlasSearch(task, atlas)
        begun = next(step.candidate for step in search.steps() if step.candidate is not None)
        local_search, before = LocalSearch(search.evaluator, np.random.default_rng(0)), begun.deployment
        run = local_search.begin(begun)
        assert run is not None
        for _ in range(6):
            local_search.advance(run, 50)
        found = local_search.candidate(run)
        assert found is not None
        assert search.evaluator.evaluate(found) < search.evaluator.evaluate(begun)
        assert la.check(assemble(task, found, iteration=1, timing={}), small_lung).accepted
        turned.append(np.ptp(found.deployment.shape.rotations_rad - before.shape.rotations_rad))
    assert max(turned) > 0.01


def test_refinement_moves_all_joints_and_is_proved(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[la.Plan]
) -> None:
    ratios, moved = [], []
    for plan in plans:
        task = Task(lung=small_lung, system=system, target=point_target(small_lung, plan.target_lps))
        search = AtlasSearch(task, atlas)
        begun = next(step.candidate for step in search.steps() if step.candidate is not None)
        found, again = refine(task, begun), refine(task, begun)
        if found is None:
            continue
        assert again is not None and again.path.arcs.tobytes() == found.path.arcs.tobytes()
        ratios.append(search.evaluator.evaluate(found) / search.evaluator.evaluate(begun))
        assert la.check(assemble(task, found, iteration=1, timing={}), small_lung).accepted
        one, other = found.deployment.shape, begun.deployment.shape
        moved.append(np.abs(one.insertions_mm - other.insertions_mm).max())
        moved.append(np.ptp(one.rotations_rad - other.rotations_rad))
    assert len(ratios) >= 2 and max(ratios) < 1.0 and min(ratios) < 0.97
    assert max(moved[::2]) > 0.1 and max(moved[1::2]) > 0.01


def test_the_model_of_shapes_is_that_of_the_mechanics(system: System) -> None:
    design, shapes = design_arrays(system.tubes), shapes_of(system.tubes)
    rng, off = np.random.default_rng(1), []
    for number in rng.choice(np.flatnonzero(shapes.insertions_mm[:, 1] > 6.0), 6):
        model = ShapeModel(design, shapes.member(int(number)), system.tubes.max_extension_mm)
        for share in rng.uniform(-0.5, 0.5, (8, len(model.centre))):
            made = model.shape_at(model.centre + share * (model.upper - model.centre))
            if made is not None:
                stated = model.matrix @ terms(joints_of(design, made) - model.centre)
                tip = points_on_arcs(made.arcs, np.eye(4), 0.0, made.insertions_mm[:1])[0]
                off.append(np.linalg.norm(stated[-10:-7] - tip))
    assert len(off) > 30 and np.median(off) < 0.03 and max(off) < 0.3


def test_without_errors_the_plan_is_carried_out(case: Case) -> None:
    assessor = RiskAssessor(case.plan, case.lung)
    outcomes = assessor.outcomes(Deviations(**assessor.no_deviations(2)))
    assert outcomes.miss_mm == pytest.approx(0.0, abs=1e-6)
    assert assessor.succeeded(outcomes).all()
    turned = assessor.no_deviations(2)
    turned["relative_rad"] = np.array([[0.3, 0.0], [0.0, 0.3]])
    misses = assessor.outcomes(Deviations(**turned)).miss_mm
    assert (misses > 0.1).all() and abs(misses[0] - misses[1]) > 1e-3
    turned["relative_rad"] = np.full((2, 2), 0.3)
    common = assessor.no_deviations(2)
    common["rotation_rad"] = np.full(2, 0.3)
    together = [assessor.outcomes(Deviations(**each)).miss_mm for each in (turned, common)]
    assert together[0] == pytest.approx(together[1], abs=0.02)


def test_the_page_shows_the_tubes_where_they_end(case: Case) -> None:
    packed = packed_plan(case.plan, case.lung, "plan")
    curve = case.plan.curves().tubes
    assert unpack(packed["tubes"]["points"])[-1, -1] == pytest.approx(curve.points_lps[-1], abs=0.02)
    assert curve.points_lps[-1] == pytest.approx(case.plan.tube.lps_from_tip[:3, 3], abs=1e-6)
    assert set(np.unique(curve.radius_mm)) == {0.475, 0.6}


def test_the_rest_is_planned_from_a_measured_pose(case: Case, system: System) -> None:
    target = point_target(case.lung, case.plan.target_lps)
    found = replan_from_scope(case.lung, system, case.plan.scope.lps_from_scope_tip, target)
    assert found.tube is not None
    assert found.cost <= case.plan.cost * 1.5


def test_the_modes_of_the_paper_draw_each_tube(case: Case, system: System, atlas: la.Atlas) -> None:
    target = point_target(case.lung, case.plan.target_lps)
    task = Task(lung=case.lung, system=system, target=target)
    drawn = list(islice(random_placements(task, atlas), 20))
    assert all((np.diff(each.insertions_mm) >= 0.0).all() for each in drawn)
    turned = np.array([each.rotations_rad for each in drawn])
    assert (np.ptp(turned, axis=0) > 1.0).sum() == 1


def test_what_needs_a_closed_form_says_so(small_lung: Lung, system: System) -> None:
    with pytest.raises(SettingsError, match="closed form"):
        UnreachableProof(small_lung, system, with_fissures=False)
