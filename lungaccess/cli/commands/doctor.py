"""The command `lungaccess doctor`: what is installed, and what has to be mended."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import OutputOptions

if TYPE_CHECKING:
    from lungaccess.cli.installation import Folder, Health


def doctor(*, cache: Path | None = None, output: OutputOptions = OutputOptions()) -> ExitCode:
    """Show versions, machine, compiled kernels and folders; exit code 1 if something has to be mended.

    Parameters
    ----------
    cache : Path
        Folder of prepared anatomies; the usual one if not given.
    """
    from lungaccess.cli.installation import examine

    health = examine(cache)
    if output.json:
        terminal.show_json(health.to_mapping())
    else:
        _show(health)
    return ExitCode.of(not health.complaints)


def _show(health: Health) -> None:
    kernels = health.kernels
    rows: list[terminal.Row] = [
        ("lungaccess", health.version),
        ("Python", health.python),
        ("system", health.system),
        ("cores", f"{health.cores}, usable {health.usable_cores}"),
        ("memory", f"{_gib(health.memory_bytes)}, free {_gib(health.free_memory_bytes)}"),
        (
            "compiled kernels",
            f"{kernels.state}: {kernels.warm} of {kernels.modules} modules, {_mib(kernels.size_bytes)}",
        ),
        ("kept in", ", ".join(kernels.folders)),
        ("digest of their sources", kernels.digest),
        ("prepared anatomies", _folder(health.cache)),
        ("data for tests", "LUNGACCESS_DATA is not set" if health.data is None else _folder(health.data)),
    ]
    libraries = [(each.name, each.required, each.version or "MISSING") for each in health.libraries]
    terminal.show(
        [
            terminal.table("Installation", ("", ""), rows),
            terminal.table("Libraries", ("name", "required", "found"), libraries),
        ]
    )
    if kernels.state != "warm":
        terminal.console.print("The first use of a kernel compiles it, for some seconds each.")
    for complaint in health.complaints:
        terminal.console.print(f"{complaint}.", style="bold red")


def _folder(folder: Folder) -> str:
    if not folder.exists:
        return f"{folder.path} (not there yet)"
    rights = "" if folder.writable else ", cannot be written"
    return f"{folder.path} ({folder.entries} entries, {_mib(folder.size_bytes)}{rights})"


def _gib(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 2**30:.1f} GiB"


def _mib(size: int) -> str:
    return f"{size / 2**20:.0f} MiB"
