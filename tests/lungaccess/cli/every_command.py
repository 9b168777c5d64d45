"""All commands by their names."""

from __future__ import annotations

from typing import Any

from cyclopts import App

from lungaccess.cli import app as cli


def commands(app: App = cli.app, before: str = "") -> dict[str, Any]:
    """Return all commands by name, those of a group by the names of its groups and theirs."""
    found: dict[str, Any] = {}
    for name in (each for each in app if not each.startswith("-")):
        command = app[name]
        if not isinstance(command, App):
            continue
        found |= commands(command, f"{before}{name} ")
        if command.default_command is not None:
            found[before + name] = command.default_command
    return found
