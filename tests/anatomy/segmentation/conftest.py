"""The patient that segmentations are tried on."""

from __future__ import annotations

import pytest

from anatomy.phantom import Phantom


@pytest.fixture(scope="session")
def patient(small_phantom: Phantom) -> Phantom:
    """Return the synthetic patient of all tests; its truth is known."""
    return small_phantom
