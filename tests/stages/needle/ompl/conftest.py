"""The problem that most tests of this folder ask."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from anatomy.margins import Margins
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment

if TYPE_CHECKING:
    from stages.needle.ompl import NeedleProblem


@pytest.fixture(scope="module")
def environment() -> NeedleEnvironment:
    from tests.stages.needle.ompl.problems import scene

    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30)
    return needle_environment(scene(), needle, Margins(), with_fissures=False)


@pytest.fixture(scope="module")
def problem(environment: NeedleEnvironment) -> NeedleProblem:
    from stages.needle.ompl import NeedleProblem

    return NeedleProblem(environment)
