"""Let commands load a patient in another way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


def load_with(monkeypatch: pytest.MonkeyPatch, load: Callable[..., Any]) -> None:
    """Replace `load_lung` in the commands that plan, check or show a patient."""
    for name in ("check", "info", "needle", "plan"):
        monkeypatch.setattr(f"lungaccess.cli.commands.{name}.load_lung", load)
