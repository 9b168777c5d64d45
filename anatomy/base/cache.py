"""Where prepared anatomies are kept, and how large that folder may grow."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from anatomy.base.errors import SettingsError

LUNG_FILE = "lung.json"
"""Describes a stored anatomy; its time of change is when the anatomy was last used."""
BUILDING, REMOVED = ".building-", ".removed-"
"""How the names of folders begin that are being filled, or emptied."""
DEFAULT_LIMIT = "10GB"
"""Room for some eight patients with their atlases, and what most disks can spare."""
UNITS = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


def stated_cache() -> Path | None:
    """Return the folder for cached lungs that `$LUNGACCESS_CACHE` names; None if it names none."""
    stated = os.environ.get("LUNGACCESS_CACHE")
    return Path(os.path.expanduser(stated)) if stated else None


@contextlib.contextmanager
def cache_in(folder: Path | None) -> Iterator[None]:
    """Let a folder be the stated cache meanwhile, also of processes that start then; as ever if None."""
    before = os.environ.get("LUNGACCESS_CACHE")
    if folder is not None:
        os.environ["LUNGACCESS_CACHE"] = str(folder)
    try:
        yield
    finally:
        os.environ.pop("LUNGACCESS_CACHE", None)
        if before is not None:
            os.environ["LUNGACCESS_CACHE"] = before


def default_cache() -> Path:
    """Return the folder for cached lungs: the stated one, or `lungaccess` in the user's cache."""
    return stated_cache() or user_cache() / "lungaccess"


def user_cache() -> Path:
    """Return the user's folder for what can be made again; no temporary one, where anybody may leave code."""
    base = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else None)
    # By its standard a relative path there is as good as none.
    if base and os.path.isabs(base):
        return Path(base)
    try:
        return Path.home() / ".cache"
    except RuntimeError:
        return Path(os.devnull)


def cache_limit_bytes() -> int:
    """Return how large the cache may grow: `$LUNGACCESS_CACHE_LIMIT`, such as 20GB, or `DEFAULT_LIMIT`.

    Raises SettingsError if the variable holds no size.
    """
    return parse_size(os.environ.get("LUNGACCESS_CACHE_LIMIT") or DEFAULT_LIMIT, "LUNGACCESS_CACHE_LIMIT")


def parse_size(text: str, name: str) -> int:
    """Return the bytes that a text such as ``2GB`` or ``500 MB`` stands for; `name` says where it stood.

    Raises SettingsError if it is no size.

    Examples:
        >>> parse_size("1.5GB", "--max-size")
        1500000000
    """
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*([A-Za-z]*)\s*", text)
    if match is None or match[2].upper() not in UNITS:
        raise SettingsError(
            f"{name} is {text!r}",
            expected="a number of bytes with the unit KB, MB, GB or TB",
            remedy=f"Write for example {name}=2GB",
        )
    return int(float(match[1]) * UNITS[match[2].upper()])


def size_in_words(size_bytes: int) -> str:
    """Return a number of bytes for people.

    Examples:
        >>> size_in_words(1_234_567_890), size_in_words(500)
        ('1.2 GB', '500 bytes')
    """
    for unit in ("TB", "GB", "MB", "KB"):
        if size_bytes >= UNITS[unit]:
            return f"{size_bytes / UNITS[unit]:.1f} {unit}"
    return f"{size_bytes} bytes"
