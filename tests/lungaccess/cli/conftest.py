"""Consoles as they should be, and a patient on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from anatomy.phantom import Phantom, write_phantom
from lungaccess.cli import terminal
from lungaccess.cli.options import STEP_SHARES


@pytest.fixture(autouse=True)
def loud_again(wide_terminal: None) -> Any:
    """Let no test leave the consoles quiet or narrow."""
    yield
    terminal.set_answers()


@pytest.fixture(scope="session")
def patient(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic patient on disk, prepared in `cache` beside it."""
    from lungaccess.problem.patients import load_patient

    folder = tmp_path_factory.mktemp("prepared")
    write_phantom(small_phantom, folder / "patient")
    told: list[str] = []
    load_patient(folder / "patient", cache=folder / "cache", progress=told.append)
    assert set(told) <= set(STEP_SHARES), "the bar knows every step"
    assert [STEP_SHARES[step] for step in told] == sorted(STEP_SHARES[step] for step in told)
    return folder / "patient"
