"""All commands by their names."""

from __future__ import annotations

from typing import Any

from cyclopts import App

from lungaccess.cli import app as cli


def commands() -> dict[str, Any]:
    """Return all commands by name, those of a group by its name and theirs."""
    found: dict[str, Any] = {}
    for name in (each for each in cli.app if not each.startswith("-")):
        command = cli.app[name]
        if not isinstance(command, App):
            continue
        if command.default_command is not None:
            found[name] = command.default_command
            continue
        found |= {f"{name} {part}": command[part].default_command for part in command if part[0] != "-"}
    return found
