"""Package facades: a package names its public API once, and imports a name when it is first used.

The `__init__` of a package imports its public names for type checkers alone, under `if TYPE_CHECKING:`, each
as itself, or a stub `__init__.pyi` beside it does.  `lazy_exports` reads that when a name is first asked for;
of another facade a star stands for all its names.
Importing the package therefore loads none of its modules, and the names stand in one place.
"""

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any


@cache
def public_names(file: str) -> dict[str, str]:
    """Return the public names of a package by its file `__init__.py`, and the modules that define them."""
    import ast  # Not before a name is asked for, so that importing a package stays fast.
    from pathlib import Path

    stub = Path(file).with_suffix(".pyi")
    body = ast.parse((stub if stub.exists() else Path(file)).read_text(encoding="utf-8")).body
    for node in body:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            body = node.body
    found: dict[str, str] = {}
    for each in body:
        if isinstance(each, ast.ImportFrom) and each.module and each.names[0].name == "*":
            found |= public_names(str(import_module(each.module).__file__))
        elif isinstance(each, ast.ImportFrom) and each.module:
            found |= {alias.name: each.module for alias in each.names}
    return found


def lazy_exports(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are imported when they are used."""

    def get(name: str) -> Any:
        names = public_names(file)
        if name == "__all__":
            return sorted(names)
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        # Not kept here: who replaces a name where it is defined replaces it for all.
        return getattr(import_module(names[name]), name)

    def names_of() -> list[str]:
        return sorted({*vars(sys.modules[package]), *public_names(file)})

    return get, names_of
