"""What a cache holds, and how it is kept from growing: what was used least recently goes first.

Every entry is published and removed by one renaming, so a process that is killed, or that runs at the same
time, never leaves or meets half an entry.  Files of others in the folder are not touched.
"""

import contextlib
import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.cache import BUILDING, LUNG_FILE, REMOVED
from anatomy.base.errors import FileError
from anatomy.base.files import DAMAGE
from anatomy.base.records import frozen_value
from anatomy.base.unfinished import SECONDS_PER_DAY, clear_abandoned, is_abandoned

ARRAYS_PATTERN = re.compile(r"(atlas|resting|shapes)-[0-9a-f]{64}\.npz")
"""Files of arrays: deployment atlases, scopes at rest on the wall, and the shapes of tubes."""
KEY_PATTERN = re.compile(r"[0-9a-f]{24}")
UNFINISHED_PATTERN = re.compile(rf"({re.escape(BUILDING)}|{re.escape(REMOVED)}).*|\.[0-9a-f]{{12}}\.npz")


@frozen_value
class CacheEntry:
    """Something in a cache.

    Args:
        path: A folder, or a file of arrays.
        kind: "anatomy", "atlas", "resting", "shapes", or "unfinished" for what is being written or was left
            behind.
        patient: Whose it is; empty if it does not say so.
        size_bytes: On disk, pictures included.
        pictures_bytes: Of that, what pictures and pages keep with an anatomy.
        last_used: Seconds since 1970.
        current: False if no command reads it any more, because its format is an old one.
    """

    path: Path
    kind: str
    patient: str
    size_bytes: int
    pictures_bytes: int
    last_used: float
    current: bool

    @property
    def days_unused(self) -> float:
        """Days since it was last used."""
        return (time.time() - self.last_used) / SECONDS_PER_DAY

    @property
    def abandoned(self) -> bool:
        """Whether it was left behind by a process that was killed."""
        try:
            return self.kind == "unfinished" and is_abandoned(self.path)
        except FileNotFoundError:
            return False


def cache_entries(cache: Path, formats: Mapping[str, str]) -> tuple[CacheEntry, ...]:
    """Return what a cache holds, the least recently used first.

    `formats` are the present formats by kind; entries of a kind that is not named count as current.
    """
    found = []
    for path in list(cache.iterdir()) if cache.is_dir() else []:
        with contextlib.suppress(OSError):  # Another process may have removed it meanwhile.
            entry = _entry(path, formats)
            if entry is not None:
                found.append(entry)
    return tuple(sorted(found, key=lambda entry: (entry.last_used, entry.path.name)))


def _entry(path: Path, formats: Mapping[str, str]) -> CacheEntry | None:
    """Return what a path in a cache is, None if it is nothing of ours."""
    if UNFINISHED_PATTERN.fullmatch(path.name):
        return _made(path, "unfinished", {}, path.stat().st_mtime, formats)
    stated: Any = {}
    if KEY_PATTERN.fullmatch(path.name) and path.is_dir():
        told = path / LUNG_FILE
        with contextlib.suppress(*DAMAGE):
            stated = json.loads(told.read_text(encoding="utf-8")) if told.is_file() else {}
        used = told.stat().st_mtime if told.is_file() else path.stat().st_mtime
        return _made(path, "anatomy", stated, used, formats)
    if arrays := ARRAYS_PATTERN.fullmatch(path.name):
        with contextlib.suppress(*DAMAGE), path.open("rb") as stream, np.load(stream) as stored:
            stated = json.loads(str(stored["rest"]))
        return _made(path, arrays[1], stated, path.stat().st_mtime, formats)
    return None


def _made(path: Path, kind: str, stated: Any, last_used: float, formats: Mapping[str, str]) -> CacheEntry:
    """Return an entry with its size; `stated` is what it says of itself."""
    facts = stated if isinstance(stated, dict) else {}
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    sizes = {each.name: each.stat().st_size for each in files}
    pictures = sum(size for name, size in sizes.items() if name.endswith(".json") and name != LUNG_FILE)
    return CacheEntry(
        path=path,
        kind=kind,
        patient=str(facts.get("name", "")),
        size_bytes=sum(sizes.values()),
        pictures_bytes=pictures,
        last_used=last_used,
        current=kind not in formats or facts.get("format") == formats[kind],
    )


def note_use(path: Path) -> None:
    """Note that a file was used at this moment, if the cache can be written."""
    with contextlib.suppress(OSError):
        os.utime(path)


def remove_entry(entry: CacheEntry) -> None:
    """Remove an entry; one that another process has removed, or fills, is no error.

    Raises FileError if it may not be removed.
    """
    try:
        if entry.kind == "unfinished" and entry.path.is_dir():
            clear_abandoned(entry.path)
        elif entry.path.is_dir():
            doomed = entry.path.with_name(f"{REMOVED}{uuid.uuid4().hex}")
            os.replace(entry.path, doomed)
            shutil.rmtree(doomed, ignore_errors=True)
        else:
            entry.path.unlink(missing_ok=True)
    except (FileNotFoundError, BlockingIOError):
        return
    except OSError as error:
        raise FileError(
            f"{entry.path} cannot be removed: {error.strerror or error}",
            remedy="End what uses it, change the permissions of the cache folder, or choose another one",
        ) from error


def overdue(
    entries: tuple[CacheEntry, ...], *, most_bytes: int, older_than_days: float | None = None
) -> Iterator[CacheEntry]:
    """Yield what is to go: leftovers, old formats, what is too old, then the least recently used of the rest.

    `entries` begin with the least recently used; `most_bytes` may stay.
    """
    stay = []
    for entry in entries:
        aged = older_than_days is not None and entry.days_unused > older_than_days
        if entry.kind == "unfinished":
            if entry.abandoned:
                yield entry
        elif aged or not entry.current:
            yield entry
        else:
            stay.append(entry)
    size = sum(entry.size_bytes for entry in stay)
    for entry in stay:
        if size <= most_bytes:
            return
        size -= entry.size_bytes
        yield entry


def make_room(cache: Path, most_bytes: int, formats: Mapping[str, str], *, keep: tuple[Path, ...]) -> None:
    """Remove what a cache may not hold any longer, after something was stored; what cannot go stays.

    What is in use, `keep`, stays even if it alone is larger than `most_bytes`; `formats` as in
    `cache_entries`.
    """
    entries = cache_entries(cache, formats)
    if sum(entry.size_bytes for entry in entries) <= most_bytes:
        return
    kept_bytes = sum(entry.size_bytes for entry in entries if entry.path in keep)
    others = tuple(entry for entry in entries if entry.path not in keep)
    for entry in overdue(others, most_bytes=max(most_bytes - kept_bytes, 0)):
        with contextlib.suppress(FileError):
            remove_entry(entry)


def remove_abandoned(cache: Path) -> None:
    """Remove what was left behind by processes that were killed."""
    for entry in cache_entries(cache, {}):
        if entry.abandoned:
            with contextlib.suppress(FileError):
                remove_entry(entry)
