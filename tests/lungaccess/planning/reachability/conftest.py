"""A thin system for proofs of unreachability."""

from __future__ import annotations

from dataclasses import replace

import pytest

from anatomy.base.typed import Float
from lungaccess.problem.system import System, load_system
from stages.tube import tube_constants
from tests.lungaccess.planning.reachability.deployment_cases import KAPPA


@pytest.fixture(scope="module")
def system() -> System:
    """A thin scope, and a needle of 50 mm radius."""
    loaded = load_system("ultrathin")
    scope = replace(loaded.scope, outer_diameter_mm=2.0, channel_diameter_mm=1.7)
    needle = replace(loaded.needle, max_curvature_per_mm=KAPPA)
    return replace(loaded, name="test", scope=scope, needle=needle, fissures_allowed=True)


@pytest.fixture(scope="module")
def tubes(system: System) -> Float:
    return tube_constants(system.tubes, system.margins)
