"""What several commands share: exit codes, defaults, and what they print in the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from rich.panel import Panel

from anatomy.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.terminal import console

if TYPE_CHECKING:
    from anatomy.lung import Lung

OK, NO_PLAN, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done, no plan or a refused one, bad input, stopped by Ctrl-C."""
DEFAULT_SYSTEM = "lung-default"
DEFAULT_BUDGET_S = 10.0

Objective = Literal["inverse-clearance", "cost-map", "voxel-sum", "length"]


def verdict(accepted: bool) -> int:
    """Say whether the check accepts the plan, and return the exit code for it."""
    terminal.show_verdict(accepted)
    return OK if accepted else NO_PLAN


def print_warnings(lung: Lung) -> None:
    """Print what was odd about a patient, if anything was."""
    if lung.warnings:
        text = terminal.escaped("\n".join(f"- {warning}" for warning in lung.warnings))
        console.print(Panel(text, title="warnings", title_align="left", border_style="yellow"))


def require_budget(budget: float | None, iterations: int | None) -> None:
    """Raise SettingsError unless time and iterations are numbers that a search can end with."""
    if budget is not None and not 0.0 < budget < float("inf"):
        raise SettingsError(f"--budget is {budget:g} s", expected="a finite time above 0")
    if iterations is not None and iterations < 1:
        raise SettingsError(f"--iterations is {iterations}", expected="at least 1")
