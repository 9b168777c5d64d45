"""The feasible exits of a target: all clear arcs of the atlas, by their place of exit."""

from __future__ import annotations

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from anatomy.structures import FISSURE, OBSTACLES
from lungaccess.planning.coupled import DirectArcs
from lungaccess.planning.coupled.atlas import atlas_part
from lungaccess.planning.coupled.exits import PLACE_MM
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.tube import exit_points
from tests.lungaccess.planning.coupled.planning import SYSTEM


@pytest.fixture(scope="module")
def answers(small_lung: Lung, atlas: la.Atlas, target: Target) -> list[la.FeasibleExits]:
    return list(la.feasible_exits(small_lung, SYSTEM, target, atlas=atlas))


@pytest.fixture(scope="module")
def arcs(small_lung: Lung, atlas: la.Atlas, target: Target) -> DirectArcs:
    return DirectArcs(Task(lung=small_lung, system=SYSTEM, target=target), atlas)


def test_every_clear_arc_belongs_to_one_place(answers: list[la.FeasibleExits], arcs: DirectArcs) -> None:
    last = answers[-1]
    assert last.is_complete and last.tried == last.in_workspace == len(arcs.in_workspace)
    assert sorted(last.entries.tolist()) == sorted(arcs.clear().tolist())
    assert last.sizes.sum() == len(last.entries) and (last.sizes > 0).all()
    assert sum(last.blocked.values()) == last.in_workspace and last.blocked["nothing"] == len(last.entries)


def test_an_early_answer_is_a_part_of_the_last(answers: list[la.FeasibleExits]) -> None:
    for before, after in zip(answers, answers[1:], strict=False):
        assert set(before.entries.tolist()) <= set(after.entries.tolist()) and before.tried < after.tried


def test_places_are_in_order_of_their_least_cost(answers: list[la.FeasibleExits]) -> None:
    last = answers[-1]
    best = last.cost[last.best]
    assert (np.diff(best) >= 0).all() and (np.diff(last.place) >= 0).all()
    for place in range(last.count):
        costs = last.cost[last.place == place]
        assert (np.diff(costs) >= 0).all() and costs[0] == best[place]


def test_points_of_exit_are_those_of_the_deployments(
    answers: list[la.FeasibleExits], arcs: DirectArcs, atlas: la.Atlas
) -> None:
    last = answers[-1]
    for entry, place in zip(last.entries[::7].tolist(), last.place[::7].tolist(), strict=True):
        candidate = arcs.candidate(entry)
        assert candidate is not None
        tip, deployment = candidate.tip.lps_from_scope_tip, candidate.deployment
        point = deployment.points(tip, [deployment.exit_mm])[0]
        assert np.abs(point - last.exit_lps[place]).max() <= PLACE_MM + 1e-3
        found = exit_points(SYSTEM.tubes, atlas.motions.tips, atlas.deployments, np.array([entry]))[0]
        np.testing.assert_allclose(found, point, atol=1e-4)


def test_the_clearance_is_a_lower_bound(
    answers: list[la.FeasibleExits], arcs: DirectArcs, small_lung: Lung
) -> None:
    last = answers[-1]
    exempt_mm = SYSTEM.needle.exit_exemption_mm
    for place in range(min(last.count, 8)):
        points = arcs.lines(last.entries[last.best[place : place + 1]], 4000)[0]
        along = np.linspace(0.0, last.length_mm[last.best[place]], len(points))
        beyond = points[along >= exempt_mm]
        exact = small_lung.exact_clearance_mm(beyond, OBSTACLES | FISSURE, cap_mm=12.0)
        assert last.clearance_mm[place] <= exact.min() + 1e-6


def test_only_the_exits_of_a_tip(
    answers: list[la.FeasibleExits], small_lung: Lung, atlas: la.Atlas, target: Target
) -> None:
    site = int(atlas.deployments.site[answers[-1].entries[0]])
    *_, found = la.feasible_exits(small_lung, SYSTEM, target, atlas=atlas, scope_tips=np.array([site]))
    assert set(found.entries.tolist()) == {
        entry for entry in answers[-1].entries.tolist() if atlas.deployments.site[entry] == site
    }


def test_a_part_of_the_atlas_plans_from_it_alone(
    answers: list[la.FeasibleExits], small_lung: Lung, atlas: la.Atlas, target: Target
) -> None:
    entry = int(answers[-1].entries[-1])
    part = atlas_part(atlas, np.array([entry]))
    *_, plan = la.plan(small_lung, SYSTEM, target, atlas=part, iterations=0, goal="default")
    assert plan.tube.rotation_rad == pytest.approx(float(atlas.deployments.rotation_rad[entry]))
    assert la.check(plan, small_lung).accepted


def test_a_place_says_what_is_there(small_lung: Lung, target: Target) -> None:
    place = la.describe_place(small_lung, target.lps_mm)
    assert place.may_be_target and place.tissue in ("lung tissue", "nodule")
    assert place.generation >= 2 and all(mm > 0 for mm in place.distance_mm.values())
    carina = la.describe_place(small_lung, small_lung.tree.carina_lps)
    assert (
        carina.tissue == "airway lumen" and not carina.may_be_target and carina.distance_mm["airway"] == 0.0
    )
    outside = la.describe_place(small_lung, [1e4, 0.0, 0.0])
    assert outside.tissue == "outside the lung" and not outside.may_be_target
    with pytest.raises(la.LungaccessError):
        la.describe_place(small_lung, [np.nan, 0.0, 0.0])
