"""The cost of all that lies in tissue: what it is, and that the searches make it small."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.judging.checking import check
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.assemble import assemble
from lungaccess.plans.costs import obstacle_clearance_mm
from lungaccess.plans.curves import device_curves
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle import SHORTEST, Objective
from tests.lungaccess.planning.coupled.planning import SYSTEM, mapped, plans_of

TISSUE = Objective.of("tissue")


@pytest.fixture(scope="module", params=["plain", "mapped"])
def lung(request: pytest.FixtureRequest, small_lung: Lung) -> Lung:
    return small_lung if request.param == "plain" else mapped(small_lung)


@pytest.fixture(scope="module")
def arcs(lung: Lung, target: Target, atlas: la.Atlas) -> DirectArcs:
    return DirectArcs(Task(lung=lung, system=SYSTEM, target=target, objective=TISSUE), atlas)


@pytest.fixture(scope="module")
def plans(lung: Lung, target: Target, atlas: la.Atlas) -> list[Plan]:
    return plans_of(lung, target, replace(atlas, lung=lung), goal="tissue")


def sampled_tissue(plan: Plan, lung: Lung) -> float:
    """Return the cost by sums over dense samples of the curves that pictures show."""
    curves = device_curves(plan.scope, plan.tube, plan.needle, plan.system, 0.02)
    behind_mm = plan.tube.exit.arc_length_mm + plan.tube.exit.wall_run_mm
    total = 0.0
    for curve, begin_mm in ((curves.tubes, behind_mm), (curves.needle, 0.0)):
        points, at = curve.points_lps, curve.arc_length_mm
        clear = obstacle_clearance_mm(lung, points, with_fissures=plan.fissures_are_obstacles)
        rate = 1.0 / np.maximum(clear, 0.1)
        if lung.cost is not None:
            ijk = np.rint(lung.cost.grid.ijk(points)).astype(int)
            rate = rate + lung.cost.array[tuple(ijk.T)]
        steps = np.diff(at, prepend=0.0) * (at > begin_mm)
        total += float((2.0 * curve.radius_mm * rate * steps).sum())
    return total


def test_it_is_the_sum_over_tubes_and_needle(plans: list[Plan], lung: Lung) -> None:
    for plan in (plans[0], plans[-1]):
        assert plan.objective == "tissue" and plan.cost == plan.costs["tissue"]
        assert plan.costs["tissue"] == pytest.approx(sampled_tissue(plan, lung), rel=0.02)


def test_searches_make_it_small(plans: list[Plan], lung: Lung, target: Target, atlas: la.Atlas) -> None:
    """It falls, below what the plan of the least cost of the needle costs, whose tubes go farther."""
    costs = [plan.cost for plan in plans]
    assert costs == sorted(costs, reverse=True) and costs[-1] < costs[0]
    *_, old = plans_of(lung, target, replace(atlas, lung=lung), goal="default")
    assert costs[-1] < 0.9 * sampled_tissue(old, lung)
    tubes = [each.tube.inner_insertion_mm - each.tube.exit.arc_length_mm for each in (plans[-1], old)]
    assert tubes[0] < tubes[1] - 1.0


def test_direct_arcs_are_ranked_with_their_tubes(arcs: DirectArcs) -> None:
    near = arcs.in_workspace
    blockers, costs, best = arcs.evaluate(near, math.inf)
    clear = np.flatnonzero(blockers == 0)
    assert best == costs[clear].min()
    shares = []
    for n in clear[:: max(len(clear) // 25, 1)].tolist():
        found = arcs.proved(int(near[n]))
        if found is not None:
            shares.append(costs[n] / arcs.evaluator.cost(found))
    # Where a needle begins in the wall, steps of 0.5 mm overstate it, as under every objective.
    assert len(shares) > 5 and np.median(shares) == pytest.approx(1.0, abs=0.1) and min(shares) > 0.95
    of_needle = arcs.evaluator.needle_arrays.objective
    assert of_needle.inverse_clearance == SYSTEM.require_needle("The test").diameter_mm
    before = arcs.before(near)
    assert (before > 0.0).any() and (costs[clear] > before[clear]).all()


def test_bounds_with_the_tubes_are_below_costs(arcs: DirectArcs) -> None:
    ordered, bounds = arcs.by_bound
    blockers, costs, _best = arcs.evaluate(ordered, math.inf)
    clear = blockers == 0
    assert (bounds[ordered[clear]] <= costs[clear] * (1.0 + 1e-9)).all()
    assert (bounds[ordered] > 0.0).all()


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_the_check_recomputes_it(plans: list[Plan], lung: Lung, factor: float) -> None:
    plan = plans[-1]
    assert check(plan, lung).accepted
    wrong = replace(plan, costs={**plan.costs, "tissue": factor * plan.costs["tissue"]})
    assert [each.name for each in check(wrong, lung).refusals] == ["costs.tissue"]


def test_a_plan_of_another_objective_has_none(small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
    *_, old = plans_of(small_lung, target, atlas, iterations=2)
    assert "tissue" not in json.loads(old.to_json())["costs"] and check(old, small_lung).accepted
    assert Plan.from_json(old.to_json()).costs == old.costs
    claimed = replace(old, objective="tissue")
    assert "costs.objective" in [each.name for each in check(claimed, small_lung).refusals]


def test_tubes_do_not_enter_infinite_costs_where_these_count(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    """Other objectives forbid them to the needle alone; such a plan states no tissue cost."""
    *_, plan = plans_of(small_lung, target, atlas, iterations=0)
    tubes = device_curves(plan.scope, plan.tube, plan.needle, plan.system).tubes
    values = np.full(small_lung.grid.shape, 0.1, dtype=np.float32, order="F")
    behind_mm = plan.tube.exit.arc_length_mm + plan.tube.exit.wall_run_mm
    crossed = tubes.points_lps[
        np.searchsorted(tubes.arc_length_mm, 0.5 * (behind_mm + tubes.arc_length_mm[-1]))
    ]
    values[tuple(np.rint(small_lung.grid.ijk(crossed)).astype(int))] = np.inf
    lung = replace(small_lung, cost=Volume(grid=small_lung.grid, array=values))
    of_needle = DirectArcs(Task(lung=lung, system=SYSTEM, target=target, objective=SHORTEST), atlas)
    of_all = DirectArcs(Task(lung=lung, system=SYSTEM, target=target, objective=TISSUE), atlas)
    forbidden = 0
    _blockers, costs, _best = of_all.evaluate(of_all.in_workspace, math.inf)
    for entry in of_all.in_workspace[np.isinf(costs)].tolist():
        found = of_needle.proved(entry)
        if found is not None:
            forbidden += 1
            assert of_all.proved(entry) is None
            made = assemble(of_needle.task, found, iteration=0, timing={})
            assert "tissue" not in made.costs and check(made, lung).accepted
        if forbidden == 3:
            break
    assert forbidden


def test_tubes_alone_cost_what_they_cost(small_lung: Lung, atlas: la.Atlas) -> None:
    system = replace(SYSTEM, name="tubes", needle=None, fissures_allowed=True)
    made = la.build_atlas(small_lung, system, rotations=12, stop_spacing_mm=4.0)
    found: list[Any] = []
    for entry in np.linspace(0, made.deployments.count - 1, 12).astype(int):
        try:
            place = la.resolve_target(
                small_lung, f"lps:{','.join(map(str, made.deployments.positions[entry]))}"
            )
            *_, plan = la.plan(
                small_lung, system, place, goal="tissue", atlas=made, iterations=5, counterfactuals=False
            )
            found.append(plan)
        except la.LungaccessError:
            continue
    assert found
    for plan in found:
        assert check(plan, small_lung).accepted
        assert plan.cost == pytest.approx(sampled_tissue(plan, small_lung), rel=0.02, abs=0.02)
