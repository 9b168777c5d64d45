"""Stamps of machine code: the contents of the sources of a kernel and of all that it calls.

numba binds the code that it keeps to the file of the function alone, while functions of other files are
compiled into it: after a change of such a file the old arithmetic would run on.  A stamp here covers the
module of a kernel and everything of this project that the module imports, directly or not.  What a kernel
calls its module has imported, so nothing else can be in the code.
"""

import hashlib
import os
import re
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import util
from pathlib import Path

PACKAGES = ("anatomy", "stages", "lungaccess")
_NOT_COMPILED = "anatomy.machine_code"
"""This package decides when kernels are compiled, and contributes no arithmetic to them."""
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))", re.MULTILINE
)
_DECORATED = re.compile(r"^[ \t]*@(?!merged_)(?:\w+_)?kernel\b(?!\(inline=.always)", re.MULTILINE)
"""Decorators of kernels that have machine code of their own: what is merged into a caller has none."""
_WORD = re.compile(r"[\w.]+")


class Sources:
    """The sources of this project's modules, each read once, and what they import of each other."""

    def __init__(self) -> None:
        self._texts: dict[str, str | None] = {}
        self._imports: dict[str, tuple[str, ...]] = {}
        self._digests: dict[str, str] = {}
        self._stamps: dict[str, str | None] = {}

    def stamp(self, module: str) -> str | None:
        """Return the SHA-256 of the sources that kernels of a module are compiled from; None without sources.

        To be asked while the module is imported: its file is read at that moment, and those of what it calls
        were when they were imported.  What is edited afterwards keeps the stamp of the content that runs, so
        code compiled from it is never kept under the stamp of another content.
        """
        if module not in self._stamps:
            for known in (self._texts, self._imports, self._digests):
                known.pop(module, None)
            there = self.text(module) is not None
            self._stamps[module] = self.digest(self.closure(module)) if there else None
        return self._stamps[module]

    def digest(self, modules: Iterable[str]) -> str:
        """Return the SHA-256 of the names and texts of modules."""
        return sha256("".join(f"{name} {self._text_digest(name)}\n" for name in sorted(modules)))

    def _text_digest(self, module: str) -> str:
        if module not in self._digests:
            self._digests[module] = sha256(self.text(module) or "")
        return self._digests[module]

    def closure(self, module: str) -> set[str]:
        """Return a module and what it imports of this project, directly or not; empty if it has no source."""
        seen: set[str] = set()
        ahead = [module]
        while ahead:
            name = ahead.pop()
            if name not in seen and self.text(name) is not None:
                seen.add(name)
                ahead.extend(self._imported(name))
        return seen

    def _imported(self, module: str) -> tuple[str, ...]:
        """Return the names of this project's modules that a module imports, also in functions and conditions.

        A name that a statement takes out of a package counts as a module; one that is none has no source.
        """
        if module not in self._imports:
            found = []
            for package, names, modules in _IMPORT.findall(self.text(module) or ""):
                found += [package, *(f"{package}.{name}" for name in _WORD.findall(names))] if package else []
                found += _WORD.findall(modules)
            ours = (name for name in found if name.partition(".")[0] in PACKAGES)
            self._imports[module] = tuple(name for name in ours if not name.startswith(_NOT_COMPILED))
        return self._imports[module]

    def text(self, module: str) -> str | None:
        """Return the text of a module of this project, None if there is no such file."""
        if module not in self._texts:
            self._texts[module] = _read(module)
        return self._texts[module]


running = Sources()
"""The sources of the kernels that this process has imported."""


@cache
def kernel_digest(*rooms: str) -> str:
    """Return 16 hexadecimal digits that tell kernels, and the numba that compiles them, from all others.

    The kernels of the packages `rooms` count, and those that they call; all of the project if none is named.
    """
    sources = Sources()
    names = set().union(*(sources.closure(name) for name in kernel_modules(*rooms, sources=sources)))
    return sha256(f"{sources.digest(names)} {version_of('numba')} {version_of('llvmlite')}")[:16]


def kernel_modules(*rooms: str, sources: Sources | None = None) -> tuple[str, ...]:
    """Return the modules that define kernels, by their dotted names; those in the packages named, if any."""
    sources = sources or Sources()
    return tuple(
        name
        for room in rooms or PACKAGES
        for name in sorted(_modules_beside_kernels(room))
        if _DECORATED.search(sources.text(name) or "")
    )


def _modules_beside_kernels(package: str) -> Iterator[str]:
    """Yield the modules of a package that lie in a folder of kernels, or are named so."""
    top, *inner = package.split(".")
    for root in _roots(top):
        for folder, _, files in os.walk(root.joinpath(*inner)):
            parts = Path(folder).relative_to(root).parts
            found = (file[:-3] for file in files if file.endswith(".py"))
            yield from (".".join((top, *parts, each)) for each in found if "kernels" in (*parts, each))


@cache
def version_of(distribution: str) -> str:
    """Return the installed version of a distribution, and an empty text where there is none."""
    from importlib import metadata  # Not before it is asked for: it takes as long as all else here.

    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def sha256(text: str) -> str:
    """Return the SHA-256 of a text, hexadecimal."""
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _read(module: str) -> str | None:
    top, *inner = module.split(".")
    for root in _roots(top) if top in PACKAGES else ():
        for file in (root.joinpath(*inner, "__init__.py"), root.joinpath(*inner).with_suffix(".py")):
            try:
                return file.read_text(encoding="utf-8", errors="surrogateescape")
            except OSError:
                continue
    return None


@cache
def _roots(package: str) -> tuple[Path, ...]:
    """Return the folders of a package; it is not imported for that."""
    loaded = sys.modules.get(package)
    if loaded is not None:
        return tuple(Path(path) for path in loaded.__path__)
    spec = util.find_spec(package)
    return tuple(Path(path) for path in (spec.submodule_search_locations or ())) if spec else ()
