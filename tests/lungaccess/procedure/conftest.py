"""The plan whose procedures are simulated."""

from __future__ import annotations

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan


@pytest.fixture(scope="session")
def plan(small_lung: Lung) -> Plan:
    system = la.load_system("ultrathin")
    *_, best = la.plan(small_lung, system, la.resolve_target(small_lung), iterations=100)
    return best
