"""The atlas and the target of most tests of this folder."""

from __future__ import annotations

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.problem.target import Target
from tests.lungaccess.planning.coupled.planning import TARGET


@pytest.fixture(scope="session")
def atlas(small_atlas: la.Atlas) -> la.Atlas:
    return small_atlas


@pytest.fixture(scope="session")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung, TARGET)
