"""The command `lungaccess doctor`: libraries, machine, kernels, folders, and what has to be mended."""

import os
import platform
import sys
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from anatomy.base.cache import default_cache
from anatomy.base.records import frozen_value
from anatomy.machine_code.ahead import usable_cores
from anatomy.machine_code.sources import kernel_digest
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import OutputOptions


def doctor(*, cache: Path | None = None, output: OutputOptions = OutputOptions()) -> ExitCode:
    """Show versions, machine, compiled kernels and folders; exit code 1 if something has to be mended.

    Args:
        cache: Folder of prepared anatomies; the usual one if not given.
    """
    health = examine(cache)
    if output.json:
        terminal.show_json(health.to_mapping())
    else:
        _show(health)
    return ExitCode.of(not health.complaints)


def _show(health: "Health") -> None:
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


def _folder(folder: "Folder") -> str:
    if not folder.exists:
        return f"{folder.path} (not there yet)"
    rights = "" if folder.writable else ", cannot be written"
    return f"{folder.path} ({folder.entries} entries, {_mib(folder.size_bytes)}{rights})"


def _gib(size: int | None) -> str:
    return "unknown" if size is None else f"{size / 2**30:.1f} GiB"


def _mib(size: int) -> str:
    return f"{size / 2**20:.0f} MiB"


@frozen_value
class Library:
    """A library that is needed: its name, what is required, and the version found; None if it is missing."""

    name: str
    required: str
    version: str | None


@frozen_value
class KernelCache:
    """Machine code of kernels on disk: for `warm` of the modules there is code of their present sources.

    Args:
        folders: Where it is looked for: where `lungaccess-kernels` is installed, its folder first, then that
            in which new code is kept.
        size_bytes: Of all code for this numba and Python there, that of other sources included.
        digest: Of all sources of kernels, as plans state it.
        writable: Whether new code can be kept; otherwise each process compiles anew.
    """

    folders: tuple[str, ...]
    modules: int
    warm: int
    size_bytes: int
    digest: str
    writable: bool

    @property
    def state(self) -> str:
        """One word: "warm", "cold", or "partly warm"."""
        if self.warm == 0:
            return "cold"
        return "warm" if self.warm == self.modules else "partly warm"


@frozen_value
class Folder:
    """A folder: where it is, whether it can be written, and what it holds."""

    path: str
    exists: bool
    writable: bool
    size_bytes: int
    entries: int


@frozen_value
class Health:
    """What `examine` found.

    Args:
        cores, usable_cores: Of the machine, and those that this process may use.
        memory_bytes, free_memory_bytes: None where the system does not say.
        cache: Prepared anatomies and atlases.
        data: Real anatomy for the tests, if `LUNGACCESS_DATA` names it.
    """

    version: str
    python: str
    system: str
    cores: int
    usable_cores: int
    memory_bytes: int | None
    free_memory_bytes: int | None
    libraries: tuple[Library, ...]
    kernels: KernelCache
    cache: Folder
    data: Folder | None

    @property
    def complaints(self) -> tuple[str, ...]:
        """What has to be mended before lungaccess can work."""
        missing = [f"The library {each.name} is missing" for each in self.libraries if each.version is None]
        if not self.cache.writable:
            missing.append(f"The cache folder {self.cache.path} cannot be written")
        if not self.kernels.writable:
            place = self.kernels.folders[-1]
            missing.append(f"Compiled kernels cannot be kept in {place}: name a folder in NUMBA_CACHE_DIR")
        if self.data is not None and not self.data.exists:
            missing.append(f"LUNGACCESS_DATA names {self.data.path}, which is no folder")
        return tuple(missing)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**asdict(self), "kernel_state": self.kernels.state, "complaints": list(self.complaints)}


def examine(cache: Path | None = None) -> Health:
    """Look at the installation; no library is imported for it, so that it works where one is missing.

    Args:
        cache: Folder of prepared anatomies; the usual one if None.
    """
    data = os.environ.get("LUNGACCESS_DATA")
    return Health(
        version=_version("lungaccess") or "not installed",
        python=f"{platform.python_version()} ({sys.executable})",
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        cores=os.cpu_count() or 1,
        usable_cores=usable_cores(),
        memory_bytes=_pages("SC_PHYS_PAGES"),
        free_memory_bytes=_free_memory(),
        libraries=_libraries(),
        kernels=kernel_cache(),
        cache=look_at(cache or default_cache()),
        data=None if data is None else look_at(Path(data)),
    )


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _libraries() -> tuple[Library, ...]:
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
            found.append(Library(name=name, required=required, version=_version(name)))
    return tuple(found)


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


def kernel_cache() -> KernelCache:
    """Return where machine code of kernels is, and for how many modules it is that of their present sources.

    numba is not imported for it, so that the answer comes at once, and also where numba is broken.
    """
    from anatomy.machine_code import folders
    from anatomy.machine_code.sources import Sources, kernel_modules

    sources = Sources()
    modules = kernel_modules(sources=sources)
    names = [folders.module_folder(each, sources.stamp(each) or "") for each in modules]
    places = folders.code_folders()
    files = [file for place in places for file in place.rglob("*.code")]
    there = {file.parent.name for file in files}
    return KernelCache(
        folders=tuple(str(place) for place in places),
        modules=len(names),
        warm=len(there.intersection(names)),
        size_bytes=sum(file.stat().st_size for file in files),
        digest=kernel_digest(),
        writable=look_at(folders.kernels_folder()).writable,
    )


def look_at(path: Path) -> Folder:
    """Return what a folder holds; a folder that can still be made counts as writable."""
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else []
    nearest = next((each for each in (path, *path.parents) if each.exists()), path)
    return Folder(
        path=str(path),
        exists=path.is_dir(),
        writable=nearest.is_dir() and os.access(nearest, os.W_OK),
        size_bytes=sum(file.stat().st_size for file in files),
        entries=sum(1 for _ in path.iterdir()) if path.is_dir() else 0,
    )
