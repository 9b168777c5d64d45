"""What several commands share: exit codes, defaults, and what they print in the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from rich.panel import Panel

from anatomy.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.terminal import console
from stages.needle import TERMS, Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung

OK, NO_PLAN, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
"""Exit codes: done, no plan or a refused one, bad input, stopped by Ctrl-C."""
DEFAULT_SYSTEM = "lung-default"
DEFAULT_BUDGET_S = 10.0

if TYPE_CHECKING:
    ObjectiveText = str
else:
    ObjectiveText = Literal[tuple(term.option for term in TERMS)] | str
"""The costs by name, for help and completion, or a weighted sum; `Objective.of` reads it."""


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


def require_map(lung: Lung, objective: Objective) -> None:
    """Raise SettingsError if an objective weighs a cost map that the patient does not have."""
    if objective.weighs_map and lung.cost is None:
        raise SettingsError(
            f"Patient {lung.name} has no cost map",
            expected=f"a cost map among the patient's files for --objective {objective}",
            remedy="Choose inverse-clearance or length",
        )
