"""Let commands load a patient in another way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


def load_with(monkeypatch: pytest.MonkeyPatch, load: Callable[..., Any]) -> None:
    """Replace `load_lung` in all commands."""
    monkeypatch.setattr("lungaccess.cli.options.load_lung", load)
