"""What an installation looks like: libraries, machine, compiled kernels, folders."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict
from importlib import metadata, util
from pathlib import Path
from typing import Any

from anatomy.cache import default_cache
from anatomy.records import frozen_value

PACKAGES = ("anatomy", "stages", "lungaccess")
_REQUIREMENT = re.compile(r"^\s*([A-Za-z0-9._-]+)\s*([^;]*)")
_COMPILED = re.compile(r"^@(?:\w+\.)?njit\(.*cache=True|^@(?:\w+\.)?njit$|^from \S*compil", re.MULTILINE)


@frozen_value
class Library:
    """A library that is needed: its name, what is required, and the version found; None if it is missing."""

    name: str
    required: str
    version: str | None


@frozen_value
class KernelCache:
    """Compiled kernels on disk: `warm` of the modules have compiled code not older than their source."""

    folders: tuple[str, ...]
    modules: int
    warm: int
    size_bytes: int

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

    Parameters
    ----------
    cores, usable_cores : int
        Of the machine, and those that this process may use.
    memory_bytes, free_memory_bytes : int or None
        None where the system does not say.
    cache : Folder
        Prepared anatomies and atlases.
    data : Folder or None
        Real anatomy for the tests, if `LUNGACCESS_DATA` names it.
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
        if self.data is not None and not self.data.exists:
            missing.append(f"LUNGACCESS_DATA names {self.data.path}, which is no folder")
        return tuple(missing)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**asdict(self), "kernel_state": self.kernels.state, "complaints": list(self.complaints)}


def examine(cache: Path | None = None) -> Health:
    """Look at the installation; no library is imported for it, so that it works where one is missing.

    Parameters
    ----------
    cache : Path, optional
        Folder of prepared anatomies; the usual one if None.
    """
    data = os.environ.get("LUNGACCESS_DATA")
    return Health(
        version=_version("lungaccess") or "not installed",
        python=f"{platform.python_version()} ({sys.executable})",
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        cores=os.cpu_count() or 1,
        usable_cores=_usable_cores(),
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
    """Return the libraries that the installed package requires."""
    try:
        lines = metadata.requires("lungaccess") or []
    except metadata.PackageNotFoundError:
        lines = []
    found = []
    for line in lines:
        match = _REQUIREMENT.match(line)
        if match is not None and "extra ==" not in line:
            name, required = match[1], match[2].strip()
            found.append(Library(name=name, required=required, version=_version(name)))
    return tuple(found)


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
    """Return where numba keeps the compiled kernels, and how many modules of them are ready."""
    stated = os.environ.get("NUMBA_CACHE_DIR")
    folders: set[Path] = {Path(stated)} if stated else set()
    modules = warm = 0
    for source in _kernel_sources():
        modules += 1
        home = Path(stated) if stated else source.parent / "__pycache__"
        folders.add(home)
        warm += any(
            index.stat().st_mtime >= source.stat().st_mtime
            for index in _indices(home, source, deep=stated is not None)
        )
    files = {file for folder in folders if folder.is_dir() for file in folder.rglob("*.nb[ic]")}
    return KernelCache(
        folders=tuple(sorted(str(folder) for folder in folders)),
        modules=modules,
        warm=warm,
        size_bytes=sum(file.stat().st_size for file in files),
    )


def _indices(home: Path, source: Path, *, deep: bool) -> Iterator[Path]:
    """Return numba's index files of the functions of a module."""
    pattern = f"{source.stem}.*.nbi"
    return home.rglob(pattern) if deep else home.glob(pattern)


def _kernel_sources() -> Iterator[Path]:
    """Return the modules of our packages that hold kernels whose compiled code is kept."""
    for package in PACKAGES:
        spec = util.find_spec(package)
        for root in (spec.submodule_search_locations or ()) if spec else ():
            for source in sorted(Path(root).rglob("*.py")):
                kernel = "kernels" in source.parts or source.name == "kernels.py"
                if kernel and _COMPILED.search(source.read_text(encoding="utf-8")):
                    yield source


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
