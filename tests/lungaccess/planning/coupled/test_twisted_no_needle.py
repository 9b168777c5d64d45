"""Tubes turned one against the other, without a needle: their tip is at the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.reach_scans import reach_scan
from lungaccess.planning.one_stage.replan import replan_from_scope
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import Deviations
from stages.needle import DIRECT
from stages.tube import shapes_of
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

pytestmark = pytest.mark.slow

OFF_MM = np.array([0.7, -0.9, 0.5])
"""So far from tips of the atlas lie the targets: not where the enumeration ends."""


@pytest.fixture(scope="module")
def system() -> System:
    return replace(two_curved_tubes(), needle=None, name="two curved tubes alone")


@pytest.fixture(scope="module")
def atlas(small_lung: Lung, system: System) -> la.Atlas:
    return la.build_atlas(small_lung, system, **COARSE)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System, atlas: la.Atlas) -> list[list[la.Plan]]:
    """The better and better plans to points near some tips of the atlas."""
    found = []
    for entry in np.linspace(0, atlas.deployments.count - 1, 24).astype(int):
        try:
            target = point_target(small_lung, atlas.deployments.positions[entry] + OFF_MM)
            found.append(
                list(
                    la.plan(
                        small_lung,
                        system,
                        target,
                        atlas=atlas,
                        iterations=5,
                        counterfactuals=False,
                        goal="default",
                    )
                )
            )
        except la.LungaccessError:
            continue
    return found


def test_the_tip_is_at_the_target_and_the_check_agrees(
    small_lung: Lung, system: System, plans: list[list[la.Plan]]
) -> None:
    assert len(plans) >= 4
    between = []
    for found in plans:
        plan, costs = found[-1], [each.cost for each in found]
        assert plan.needle is None and costs == sorted(costs, reverse=True)
        assert plan.tube.lps_from_tip[:3, 3] == pytest.approx(plan.target_lps, abs=1e-6)
        report = la.check(plan, small_lung, system=system)
        assert report.accepted, [str(each) for each in report.findings if not each.ok]
        grid = shapes_of(system.tubes).stop_mm
        between.append(abs(plan.tube.outer_insertion_mm / grid - round(plan.tube.outer_insertion_mm / grid)))
    assert max(between) > 0.01


def test_the_same_seed_gives_the_same_plan(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    target = point_target(small_lung, plans[0][-1].target_lps)
    again = list(la.plan(small_lung, system, target, atlas=atlas, iterations=5, goal="default"))
    assert [plan.digest for plan in again] == [plan.digest for plan in plans[0]]


def test_it_is_carried_out_reached_and_planned_again(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    plan = plans[-1][-1]
    assessor = RiskAssessor(plan, small_lung)
    outcomes = assessor.outcomes(Deviations(**assessor.no_deviations(2)))
    assert outcomes.miss_mm == pytest.approx(0.0, abs=1e-5) and assessor.succeeded(outcomes).all()
    reached = reach_scan(atlas).reach(plan.target_lps[None], np.zeros(1, dtype=np.uint64))
    assert reached.kinds[0] == DIRECT and reached.cost[0] > 0.0
    target = point_target(small_lung, plan.target_lps)
    found = replan_from_scope(small_lung, system, plan.scope.lps_from_scope_tip, target)
    assert found.tube.lps_from_tip[:3, 3] == pytest.approx(plan.target_lps, abs=1e-6)
