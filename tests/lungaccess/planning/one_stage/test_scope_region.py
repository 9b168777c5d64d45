"""Poses of the scope's tip around a plan: what is told of them is what planning from them gives."""

from __future__ import annotations

import json

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from anatomy.poses import pose
from lungaccess.planning.one_stage.scope import WORDS
from lungaccess.plans.plan import Plan
from stages.needle import REACHING


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    target = la.resolve_target(small_lung)
    return next(
        la.plan(small_lung, small_atlas.system, target, atlas=small_atlas, iterations=1, goal="default")
    )


def test_what_is_told_of_a_tip_is_what_planning_gives(plan: Plan, small_lung: Lung) -> None:
    region = la.safe_scope_region(plan, small_lung, poses=60)
    tried, frame = region.tried, region.lps_from_scope_tip
    depth = small_lung.lumen_depth.lower_bound_mm(tried.positions)
    needed = min(plan.system.scope.radius_mm, float(depth[tried.offsets_mm == 0.0][0]))
    target = la.point_target(small_lung, plan.target_lps)
    for p, d in np.ndindex(tried.kinds.shape):
        fits = tried.kinds[p, d] != WORDS["start too near to an obstacle"]
        assert fits == (depth[p] >= needed)
        if tried.kinds[p, d] in REACHING:
            tip = pose(tried.positions[p], tried.tangents[p, d], frame[:3, 0])
            found = la.replan_from_scope(small_lung, plan.system, tip, target)
            assert np.linalg.norm(found.path.frames()[-1][:3, 3] - plan.target_lps) < 1e-6
    assert 0.0 < tried.share_of_free <= 1.0
    assert tried.share_of_free >= tried.share()
    record = json.loads(json.dumps(region.record(), allow_nan=False))
    assert record["words"] == region.words
    again = la.safe_scope_region(plan, small_lung, poses=60)
    assert np.array_equal(again.tried.kinds, tried.kinds)


def test_wrong_numbers_are_refused(plan: Plan, small_lung: Lung) -> None:
    with pytest.raises(SettingsError, match="mm away"):
        la.safe_scope_region(plan, small_lung, offset_mm=-1.0)
    with pytest.raises(SettingsError, match="2 start poses"):
        la.safe_scope_region(plan, small_lung, poses=2)
