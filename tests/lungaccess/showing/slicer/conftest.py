"""A plan for a patient that breathes, exported once for all tests of a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer import export_slicer


@pytest.fixture(scope="session")
def exported(small_plan: Plan, breathing_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder for 3D Slicer."""
    folder = tmp_path_factory.mktemp("exported") / "out"
    assert export_slicer(small_plan, breathing_lung, folder).report.accepted
    return folder
