"""Scopes whose tips are turned aside: the check accepts their plans, and refuses what was bent or turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.errors import TargetError
from anatomy.lung import Lung
from lungaccess.coupled import DirectArcs
from lungaccess.plans.assemble import assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from stages.needle import SHORTEST

SYSTEM = la.load_system("ultrathin")
COUNT = 12
AHEAD_MM = 25.0


@pytest.fixture(scope="module")
def plans(small_lung: Lung) -> list[Plan]:
    """Plans from turned tips all over the lung, to points straight ahead of the tube."""
    atlas = la.build_atlas(small_lung, SYSTEM)
    entries, found = atlas.deployments, []
    turned = np.flatnonzero(atlas.sites.turned[entries.site])
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
            found.append(assemble(task, atlas.sites, candidate, iteration=0, timing={}))
        if len(found) == COUNT:
            break
    return found


def refusals(plan: Plan, lung: Lung) -> set[str]:
    return {finding.name for finding in la.check(plan, lung).findings if not finding.ok}


def test_the_check_accepts_them(plans: list[Plan], small_lung: Lung) -> None:
    assert len(plans) == COUNT
    assert [refusals(plan, small_lung) for plan in plans] == [set()] * COUNT


def test_a_kink_beside_the_axis_is_refused(plans: list[Plan], small_lung: Lung) -> None:
    for plan in plans[:4]:
        points = plan.scope.points_lps.copy()
        aside = np.cross(plan.scope.lps_from_scope_tip[:3, 2], [0.36, 0.48, 0.8])
        points[-3] += aside / np.linalg.norm(aside)
        kinked = replace(plan, scope=replace(plan.scope, points_lps=points))
        assert {"scope.bend"} <= refusals(kinked, small_lung)


def test_a_tip_that_does_not_go_on_along_its_route_is_refused(plans: list[Plan], small_lung: Lung) -> None:
    cosine, sine = np.cos(0.1), np.sin(0.1)
    turn = np.array([[1.0, 0, 0, 0], [0, cosine, -sine, 0], [0, sine, cosine, 0], [0, 0, 0, 1.0]])
    for plan in plans[:4]:
        pose = plan.scope.lps_from_scope_tip @ turn
        wrong = replace(plan, scope=replace(plan.scope, lps_from_scope_tip=pose))
        assert "scope.tip.tangent" in refusals(wrong, small_lung)


def test_a_tip_beside_the_axis_is_refused(plans: list[Plan], small_lung: Lung) -> None:
    for plan in plans[:4]:
        points, pose = plan.scope.points_lps.copy(), plan.scope.lps_from_scope_tip.copy()
        away = 0.1 * pose[:3, 0]
        points[-2:] += away
        pose[:3, 3] += away
        wrong = replace(plan, scope=replace(plan.scope, points_lps=points, lps_from_scope_tip=pose))
        assert refusals(wrong, small_lung) & {"scope.site", "scope.site.on_axis"}
