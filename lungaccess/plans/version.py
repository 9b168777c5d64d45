"""The version of the software that plans and results state."""

from __future__ import annotations

from functools import cache


@cache
def software_version() -> str:
    """Return the version of the installed package."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("lungaccess")
    except PackageNotFoundError:
        return "unknown"
