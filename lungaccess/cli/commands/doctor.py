"""The commands `lungaccess doctor` and `lungaccess completion`: the installation and the shell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lungaccess.cli import terminal

if TYPE_CHECKING:
    from lungaccess.cli.doctor import Folder, Health

HEALTHY, SICK = 0, 1


def doctor(*, json: bool = False, cache: Path | None = None) -> int:
    """Show versions, machine, compiled kernels and folders; exit code 1 if something has to be mended.

    Parameters
    ----------
    json : bool
        Print JSON instead of tables.
    cache : Path
        Folder of prepared anatomies; the usual one if not given.
    """
    from lungaccess.cli.doctor import examine

    health = examine(cache)
    if json:
        terminal.show_json(health.to_mapping())
    else:
        _show(health)
    return SICK if health.complaints else HEALTHY


def completion(shell: Literal["bash", "zsh", "fish"], /) -> int:
    """Print a script that lets a shell complete commands, options and choices.

    Parameters
    ----------
    shell : str
        bash, zsh or fish; docs/command_line.md says where the script goes.
    """
    from lungaccess.cli.app import app

    terminal.console.file.write(app.generate_completion(prog_name="lungaccess", shell=shell))
    return HEALTHY


def _show(health: Health) -> None:
    kernels = health.kernels
    folders = kernels.folders[:1] if len(kernels.folders) == 1 else ("__pycache__ beside each kernel",)
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
        ("kept in", ", ".join(folders)),
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
        terminal.console.print(f"[bold red]{terminal.escaped(complaint)}.[/]")


def _folder(folder: Folder) -> str:
    if not folder.exists:
        return f"{folder.path} (not there yet)"
    rights = "" if folder.writable else ", cannot be written"
    return f"{folder.path} ({folder.entries} entries, {_mib(folder.size_bytes)}{rights})"


def _gib(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 2**30:.1f} GiB"


def _mib(size: int) -> str:
    return f"{size / 2**20:.0f} MiB"
