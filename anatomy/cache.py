"""Where prepared anatomies are kept."""

from __future__ import annotations

import os
from pathlib import Path


def default_cache() -> Path:
    """Return the folder for cached lungs: `$LUNGACCESS_CACHE`, or `lungaccess` in the user's cache."""
    stated = os.environ.get("LUNGACCESS_CACHE")
    if stated:
        return Path(stated)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "lungaccess"
