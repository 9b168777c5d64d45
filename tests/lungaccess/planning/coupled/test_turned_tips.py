"""Scopes whose tips are turned aside: the check accepts their plans, and refuses another motion or frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import TargetError
from anatomy.lung import Lung
from lungaccess.planning.coupled import DirectArcs
from lungaccess.plans.assemble import assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from stages.needle import SHORTEST
from tests.lungaccess.planning.coupled.planning import SYSTEM

COUNT = 12
AHEAD_MM = 25.0


@pytest.fixture(scope="module")
def plans(small_lung: Lung, atlas: la.Atlas) -> list[Plan]:
    """Plans from turned tips all over the lung, to points straight ahead of the tube."""
    entries, found = atlas.deployments, []
    turned = np.flatnonzero(atlas.motions.turned[entries.site])
    for entry in np.random.default_rng(0).permutation(turned):
        point = entries.positions[entry] + AHEAD_MM * entries.tangents[entry]
        try:
            target = point_target(small_lung, point)
        except TargetError:
            continue
        task = Task(lung=small_lung, system=SYSTEM, target=target, objective=SHORTEST)
        arcs = DirectArcs(task, atlas)
        clear = arcs.blockers(np.array([entry]))[0] == 0
        candidate = arcs.proved(int(entry)) if clear else None
        if candidate is not None:
            found.append(assemble(task, candidate, iteration=0, timing={}))
        if len(found) == COUNT:
            break
    return found


def refusals(plan: Plan, lung: Lung) -> set[str]:
    return {finding.name for finding in la.check(plan, lung).findings if not finding.ok}


@pytest.mark.slow
def test_the_check_accepts_them(plans: list[Plan], small_lung: Lung) -> None:
    assert len(plans) == COUNT
    assert [refusals(plan, small_lung) for plan in plans] == [set()] * COUNT


def test_a_tip_frame_that_is_not_the_motions_is_refused(plans: list[Plan], small_lung: Lung) -> None:
    """A roll of half a degree would turn the tubes by as much."""
    cosine, sine = np.cos(0.0087), np.sin(0.0087)
    for roll in (True, False):
        turn = np.eye(4)
        turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
        for plan in plans[:4]:
            pose = plan.scope.lps_from_scope_tip @ (
                turn if roll else turn[np.ix_([2, 0, 1, 3], [2, 0, 1, 3])]
            )
            wrong = replace(plan, scope=replace(plan.scope, lps_from_scope_tip=pose))
            assert refusals(wrong, small_lung)


def test_a_motion_that_bends_elsewhere_is_refused(plans: list[Plan], small_lung: Lung) -> None:
    for plan in plans[:4]:
        states = plan.scope.states.copy()
        states[len(states) // 2 :, 2] += 0.3
        wrong = replace(plan, scope=replace(plan.scope, states=states))
        assert refusals(wrong, small_lung)
