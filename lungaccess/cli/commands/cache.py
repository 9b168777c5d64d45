"""The commands `lungaccess cache ...`: what is kept for the next command, and how to get rid of it."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from anatomy.base.cache import cache_limit_bytes, default_cache, parse_size, size_in_words
from lungaccess.cli import terminal
from lungaccess.cli.examples import epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative
from lungaccess.cli.options import CacheOptions

if TYPE_CHECKING:
    from anatomy.base.cache_entries import CacheEntry

cache = App(
    name="cache",
    help="List, prune or clear what is kept for the next command.",
    help_epilogue=epilogue("cache"),
)


@cache.default
def show(*, output: CacheOptions = CacheOptions()) -> ExitCode:
    """List what is kept: anatomies, atlases, resting scopes, shapes of tubes, the longest unused first."""
    folder = output.cache or default_cache()
    entries, limit = _entries(folder), cache_limit_bytes()
    size = sum(entry.size_bytes for entry in entries)
    if output.json:
        rows = [_record(entry) for entry in entries]
        terminal.show_json({"folder": str(folder), "size_bytes": size, "limit_bytes": limit, "entries": rows})
        return ExitCode.OK
    if entries:
        headings = ("kind", "patient", "size", "pictures", "last used", "name")
        terminal.show([terminal.table(f"Kept in {folder}", headings, [_row(entry) for entry in entries])])
    terminal.say(
        f"{folder} holds {size_in_words(size)} of at most {size_in_words(limit)} (LUNGACCESS_CACHE_LIMIT); "
        "beyond that the least recently used goes."
    )
    return ExitCode.OK


@cache.command(help_epilogue=epilogue("cache prune"))
def prune(
    *,
    older_than: NotNegative | None = None,
    max_size: str | None = None,
    output: CacheOptions = CacheOptions(),
) -> ExitCode:
    """Remove old formats, leftovers of killed commands, and what is too old or too much.

    Args:
        older_than: Days without use after which something goes.
        max_size: What may stay, such as 2GB; LUNGACCESS_CACHE_LIMIT if not given.
    """
    from anatomy.base.cache_entries import overdue

    most = cache_limit_bytes() if max_size is None else parse_size(max_size, "--max-size")
    found = _entries(output.cache or default_cache())
    return _remove(overdue(found, most_bytes=most, older_than_days=older_than), output)


@cache.command(help_epilogue=epilogue("cache clear"))
def clear(*, output: CacheOptions = CacheOptions()) -> ExitCode:
    """Remove all that is kept; what another command is writing just then stays."""
    entries = _entries(output.cache or default_cache())
    return _remove([each for each in entries if each.kind != "unfinished" or each.abandoned], output)


def _entries(folder: Path) -> "tuple[CacheEntry, ...]":
    from anatomy.base.cache_entries import cache_entries
    from anatomy.store import stored_format
    from lungaccess.planning.coupled.atlas import atlas_format
    from lungaccess.uncertainty.risk.resting import resting_format
    from stages.tube import shapes_format

    formats = {
        "anatomy": stored_format(),
        "atlas": atlas_format(),
        "resting": resting_format(),
        "shapes": shapes_format(),
    }
    return cache_entries(folder, formats)


def _remove(entries: "Iterable[CacheEntry]", output: CacheOptions) -> ExitCode:
    """Remove entries and say so."""
    from anatomy.base.cache_entries import remove_entry

    gone = []
    for entry in entries:
        remove_entry(entry)
        gone.append(entry)
    size = sum(entry.size_bytes for entry in gone)
    if output.json:
        terminal.show_json({"removed": [_record(entry) for entry in gone], "size_bytes": size})
    else:
        for each in gone:
            terminal.say(f"  {each.kind} {each.patient or each.path.name}, {size_in_words(each.size_bytes)}")
        terminal.say(f"Removed {len(gone)} of what was kept, {size_in_words(size)}.")
    return ExitCode.OK


def _row(entry: "CacheEntry") -> terminal.Row:
    used = "today" if entry.days_unused < 1.0 else f"{entry.days_unused:.0f} days ago"
    kind = entry.kind if entry.current else f"old {entry.kind}"
    pictures = size_in_words(entry.pictures_bytes) if entry.pictures_bytes else ""
    return kind, entry.patient, size_in_words(entry.size_bytes), pictures, used, entry.path.name[:12]


def _record(entry: "CacheEntry") -> dict[str, object]:
    return {
        "path": str(entry.path),
        "kind": entry.kind,
        "patient": entry.patient,
        "size_bytes": entry.size_bytes,
        "pictures_bytes": entry.pictures_bytes,
        "last_used_days_ago": round(entry.days_unused, 3),
        "current_format": entry.current,
    }
