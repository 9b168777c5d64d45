"""The plan whose procedures are simulated."""

from __future__ import annotations

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan


@pytest.fixture(scope="session")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    target = la.resolve_target(small_lung)
    *_, best = la.plan(
        small_lung, small_atlas.system, target, atlas=small_atlas, iterations=100, goal="default"
    )
    return best
