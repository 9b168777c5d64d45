"""What SQLite raises, as errors that say what to do."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from anatomy.base.errors import FileError

BUSY_S = 60.0
"""Longer than any other process needs for the transaction of a run."""


@contextlib.contextmanager
def file_errors(path: Path) -> Iterator[None]:
    """Turn what SQLite raises into a FileError that says what to do."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise damaged(path, str(error)) from error
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            raise FileError(
                f"{path} cannot be written: {error}",
                expected="room on the disk",
                remedy="What is stored is sound: make room and start the study again, it goes on from there",
            ) from error
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise FileError(
                f"{path} has been locked by another program for {BUSY_S:g} s",
                remedy="Close that program and start the study again, it goes on from there",
                expected="a file that no other program holds",
            ) from error
        if code in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
            raise damaged(path, str(error)) from error
        raise FileError(
            f"{path} cannot be used: {error}",
            expected="a folder that exists and may be written to",
            remedy="Choose another file with --out",
        ) from error


def damaged(path: Path, why: str) -> FileError:
    """Return the error for a file that is no sound database."""
    return FileError(
        f"{path} is damaged or is not a database: {why}",
        expected="a results file of `lungaccess study run`",
        remedy="Restore it from a copy, or choose another file with --out and run the study again",
    )
