"""The commands `lungaccess doctor`, `selftest` and `cache`: what is installed here, and what it keeps."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from anatomy.base.cache import cache_limit_bytes, default_cache, parse_size, size_in_words
from anatomy.machine_code.ahead import usable_cores
from anatomy.machine_code.sources import kernel_digest
from lungaccess.cli import lazy, terminal
from lungaccess.cli.examples import epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.progress import progress
from lungaccess.plans.record import picked


def doctor() -> ExitCode:
    """Show versions, machine, compiled kernels and folders; exit code 1 if something has to be mended."""
    health = examine()
    terminal.tell(health)
    _show_doctor(health)
    return ExitCode.of(not health["complaints"])


def _show_doctor(health: Mapping[str, Any]) -> None:
    kernels, data = health["kernels"], health["data"]
    warm = f"{health['kernel_state']}: {kernels['warm']} of {kernels['modules']} modules"
    rows: list[terminal.Row] = [
        ("lungaccess", health["version"]),
        ("Python", health["python"]),
        ("system", health["system"]),
        ("cores", f"{health['cores']}, usable {health['usable_cores']}"),
        ("memory", f"{_gib(health['memory_bytes'])}, free {_gib(health['free_memory_bytes'])}"),
        ("compiled kernels", f"{warm}, {_mib(kernels['size_bytes'])}"),
        ("kept in", ", ".join(kernels["folders"])),
        ("digest of their sources", kernels["digest"]),
        ("prepared anatomies", _folder(health["cache"])),
        ("data for tests", "LUNGACCESS_DATA is not set" if data is None else _folder(data)),
    ]
    libraries = [
        (each["name"], each["required"], each["version"] or "MISSING") for each in health["libraries"]
    ]
    terminal.show(
        [
            terminal.table("Installation", ("", ""), rows),
            terminal.table("Libraries", ("name", "required", "found"), libraries),
        ]
    )
    if health["kernel_state"] != "warm":
        terminal.console.print("The first use of a kernel compiles it, for some seconds each.")
    for complaint in health["complaints"]:
        terminal.console.print(f"{complaint}.", style="bold red")


def _folder(folder: Mapping[str, Any]) -> str:
    if not folder["exists"]:
        return f"{folder['path']} (not there yet)"
    rights = "" if folder["writable"] else ", cannot be written"
    return f"{folder['path']} ({folder['entries']} entries, {_mib(folder['size_bytes'])}{rights})"


def _gib(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 2**30:.1f} GiB"


def _mib(size: int) -> str:
    return f"{size / 2**20:.0f} MiB"


def examine() -> dict[str, Any]:
    """Return what there is of the installation, as plain values; sizes of memory are None where not known.

    No library is imported for it, so that it works where one is missing.
    """
    data, kernels = os.environ.get("LUNGACCESS_DATA"), kernel_cache()
    health: dict[str, Any] = {
        "version": _version("lungaccess") or "not installed",
        "python": f"{platform.python_version()} ({sys.executable})",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": os.cpu_count() or 1,
        "usable_cores": usable_cores(),
        "memory_bytes": _pages("SC_PHYS_PAGES"),
        "free_memory_bytes": _free_memory(),
        "libraries": _libraries(),
        "kernels": kernels,
        "cache": _look_at(default_cache()),
        "data": None if data is None else _look_at(Path(data)),
    }
    warm = "warm" if kernels["warm"] == kernels["modules"] else "partly warm"
    state = warm if kernels["warm"] else "cold"
    return health | {"kernel_state": state, "complaints": _complaints(health)}


def _complaints(health: Mapping[str, Any]) -> list[str]:
    """Return what has to be mended before lungaccess can work."""
    missing = [
        f"The library {each['name']} is missing" for each in health["libraries"] if not each["version"]
    ]
    if not health["cache"]["writable"]:
        missing.append(f"The cache folder {health['cache']['path']} cannot be written")
    if not health["kernels"]["writable"]:
        place = health["kernels"]["folders"][-1]
        missing.append(f"Compiled kernels cannot be kept in {place}: name a folder in NUMBA_CACHE_DIR")
    if health["data"] is not None and not health["data"]["exists"]:
        missing.append(f"LUNGACCESS_DATA names {health['data']['path']}, which is no folder")
    return missing


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _libraries() -> list[dict[str, str | None]]:
    """Return the libraries that the installed package requires on this platform."""
    from packaging.requirements import Requirement

    try:
        lines = metadata.requires("lungaccess") or []
    except metadata.PackageNotFoundError:
        lines = []
    found = []
    for each in map(Requirement, lines):
        if each.marker is None or each.marker.evaluate({"extra": ""}):
            name, required = each.name, str(each.specifier)
            found.append({"name": name, "required": required, "version": _version(name)})
    return found


def _pages(name: str) -> int | None:
    try:
        return os.sysconf(name) * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return None


def _free_memory() -> int | None:
    """Return the memory that a new process can have; Linux says how much of its caches it would give up."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return _pages("SC_AVPHYS_PAGES")
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")), None)


def kernel_cache() -> dict[str, Any]:
    """Return where machine code of kernels is, and for how many modules it is that of their present sources.

    Code is looked for where `lungaccess-kernels` is installed, whose folder stands first, and in the one in
    which new code is kept, if it can be written.  The size is that of all code there, also of other sources.
    numba is not imported for it, so that the answer comes at once, and also where numba is broken.
    """
    from anatomy.machine_code import folders

    sources = lazy.Sources()
    modules = lazy.kernel_modules(sources=sources)
    names = [folders.module_folder(each, sources.stamp(each) or "") for each in modules]
    places = folders.code_folders()
    files = [file for place in places for file in place.rglob("*.code")]
    return {
        "folders": [str(place) for place in places],
        "modules": len(names),
        "warm": len({file.parent.name for file in files}.intersection(names)),
        "size_bytes": sum(file.stat().st_size for file in files),
        "digest": kernel_digest(),
        "writable": _look_at(folders.kernels_folder())["writable"],
    }


def _look_at(path: Path) -> dict[str, Any]:
    """Return what a folder holds; a folder that can still be made counts as writable."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else []
    nearest = next((each for each in (path, *path.parents) if each.exists()), path)
    return {
        "path": str(path),
        "exists": path.is_dir(),
        "writable": nearest.is_dir() and os.access(nearest, os.W_OK),
        "size_bytes": sum(file.stat().st_size for file in files),
        "entries": sum(1 for _ in path.iterdir()) if path.is_dir() else 0,
    }


def selftest(*, kind: Annotated[tuple[str, ...], Parameter(negative="")] = ()) -> ExitCode:
    """Compute proofs of every kind on drawn cases: compiled, in plain Python, and against a truth.

    Exit code 0 if all agree; 1 if a proof disagrees: kind, seed of the case and both numbers are said.

    Args:
        kind: Kinds of proofs, as the table names them; all of them if not given.
    """
    with progress("proofs") as shown:
        outcomes = lazy.self_test(kind, progress=shown.step)
    terminal.tell([{**asdict(each), "held": each.held} for each in outcomes])
    _show_selftest(outcomes)
    return ExitCode.of(all(each.held for each in outcomes))


def _show_selftest(outcomes: tuple[lazy.Outcome, ...]) -> None:
    rows = [
        (
            each.kind,
            str(each.cases),
            "not compiled" if each.differences is None else _verdict(each.differences),
            _verdict(each.contradictions),
            f"{each.seconds:.1f}",
        )
        for each in outcomes
    ]
    headings = ("kind", "cases", "compiled = Python", "truth held", "seconds")
    terminal.show([terminal.table("Self-test of the proofs", headings, rows)])
    for each in outcomes:
        for failure in (*(each.differences or ()), *each.contradictions):
            terminal.console.print(f"{each.kind}, seed {failure.seed}: {failure.said}", style="bold red")


def _verdict(failures: tuple[lazy.Failure, ...]) -> str:
    return f"NO, in {len(failures)}" if failures else "yes"


cache = App(
    name="cache",
    help="List, prune or clear what is kept for the next command.",
    help_epilogue=epilogue("cache"),
)


@cache.default
def show() -> ExitCode:
    """List what is kept: anatomies, atlases, resting scopes, shapes of tubes, the longest unused first."""
    folder = default_cache()
    entries, limit = _entries(folder), cache_limit_bytes()
    size = sum(entry.size_bytes for entry in entries)
    records = [_record(entry) for entry in entries]
    terminal.tell({"folder": str(folder), "size_bytes": size, "limit_bytes": limit, "entries": records})
    if entries:
        headings = ("kind", "patient", "size", "pictures", "last used", "name")
        terminal.show([terminal.table(f"Kept in {folder}", headings, [_row(entry) for entry in entries])])
    terminal.say(
        f"{folder} holds {size_in_words(size)} of at most {size_in_words(limit)} (LUNGACCESS_CACHE_LIMIT); "
        "beyond that the least recently used goes."
    )
    return ExitCode.OK


@cache.command(help_epilogue=epilogue("cache prune"))
def prune(*, older_than: NotNegative | None = None, max_size: str | None = None) -> ExitCode:
    """Remove old formats, leftovers of killed commands, and what is too old or too much.

    Args:
        older_than: Days without use after which something goes.
        max_size: What may stay, such as 2GB; LUNGACCESS_CACHE_LIMIT if not given.
    """
    most = cache_limit_bytes() if max_size is None else parse_size(max_size, "--max-size")
    found = _entries(default_cache())
    return _remove(lazy.overdue(found, most_bytes=most, older_than_days=older_than))


@cache.command(help_epilogue=epilogue("cache clear"))
def clear() -> ExitCode:
    """Remove all that is kept; what another command is writing just then stays."""
    entries = _entries(default_cache())
    return _remove([each for each in entries if each.kind != "unfinished" or each.abandoned])


def _entries(folder: Path) -> tuple[lazy.CacheEntry, ...]:
    return lazy.cache_entries(
        folder,
        {
            "anatomy": lazy.stored_format(),
            "atlas": lazy.atlas_format(),
            "resting": lazy.resting_format(),
            "shapes": lazy.shapes_format(),
        },
    )


def _remove(entries: Iterable[lazy.CacheEntry]) -> ExitCode:
    gone = list(entries)
    for entry in gone:
        lazy.remove_entry(entry)
    size = sum(entry.size_bytes for entry in gone)
    terminal.tell({"removed": [_record(entry) for entry in gone], "size_bytes": size})
    for each in gone:
        terminal.say(f"  {each.kind} {each.patient or each.path.name}, {size_in_words(each.size_bytes)}")
    terminal.say(f"Removed {len(gone)} of what was kept, {size_in_words(size)}.")
    return ExitCode.OK


def _row(entry: lazy.CacheEntry) -> terminal.Row:
    used = "today" if entry.days_unused < 1.0 else f"{entry.days_unused:.0f} days ago"
    kind = entry.kind if entry.current else f"old {entry.kind}"
    pictures = size_in_words(entry.pictures_bytes) if entry.pictures_bytes else ""
    return kind, entry.patient, size_in_words(entry.size_bytes), pictures, used, entry.path.name[:12]


def _record(entry: lazy.CacheEntry) -> dict[str, object]:
    return {
        "path": str(entry.path),
        **picked(entry, "kind patient size_bytes pictures_bytes"),
        "last_used_days_ago": round(entry.days_unused, 3),
        "current_format": entry.current,
    }
