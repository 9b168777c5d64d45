"""A plan for a patient that breathes, exported once for all tests of a file."""

from __future__ import annotations

from pathlib import Path

import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.slicer import export_slicer


@pytest.fixture(scope="session")
def small_atlas(breathing_lung: Lung) -> la.Atlas:
    """What scope and tubes can do in the small phantom."""
    return la.build_atlas(breathing_lung, la.load_system("ultrathin"))


@pytest.fixture(scope="session")
def small_plan(small_atlas: la.Atlas) -> Plan:
    """A plan to the nodule of the small phantom, which the check accepts."""
    lung = small_atlas.lung
    *_, best = la.plan(lung, small_atlas.system, la.resolve_target(lung), atlas=small_atlas, iterations=20)
    return best


@pytest.fixture(scope="session")
def exported(small_plan: Plan, breathing_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder for 3D Slicer."""
    folder = tmp_path_factory.mktemp("exported") / "out"
    assert export_slicer(small_plan, breathing_lung, folder).report.accepted
    return folder
