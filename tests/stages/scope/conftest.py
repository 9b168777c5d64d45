"""The forked airways, made once."""

from __future__ import annotations

import pytest

from anatomy.lung import Lung
from stages.scope.advisor.lumen import Lumen
from tests.stages.scope import airways


@pytest.fixture(scope="session")
def forked() -> tuple[Lung, Lumen]:
    """A lung with a forked airway, and its lumen."""
    return airways.lung_and_lumen()
