"""Hashes of inputs, and writing that leaves either the old file or the whole new one."""

import codecs
import errno
import hashlib
import json
import os
import secrets
import struct
import sys
import time
import tomllib
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from anatomy.base.errors import FileError, SettingsError

DAMAGE = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError,
    SyntaxError, TypeError, ValueError, BadZipFile, struct.error, zlib.error,
)  # fmt: skip
"""These errors are raised by code that reads a damaged file."""
REPLACE_TRIES = 20 if sys.platform == "win32" else 1
"""For a second: readers and scanners of viruses have a file open no longer."""


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of the bytes of a file as hex digits; FileError if the file cannot be read."""
    with reading(path), open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def require_file(path: str | Path) -> Path:
    """Return `path` as a Path, or raise `FileError` if it is not an existing file."""
    path = Path(path)
    if not path.is_file():
        raise FileError(
            f"There is no file {path}", expected="an existing file", remedy="Check the name and the folder"
        )
    return path


def read_text(path: str | Path) -> str:
    """Read a text file as any editor saves it: UTF-8, or UTF-16 with its mark, with any ends of lines.

    Raises FileError if it is none, or cannot be read.
    """
    path = require_file(path)
    with reading(path):
        content = path.read_bytes()
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise FileError(
            f"{path} is no text in {encoding.removesuffix('-sig').upper()}: byte {error.start} is "
            f"0x{content[error.start]:02x}",
            expected="UTF-8 text, or UTF-16 with a byte-order mark",
            remedy="Save the file as UTF-8 in its editor, or copy it again if it is damaged",
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_toml(path: str | Path, *, remedy: str, expected: str = "text in TOML syntax") -> dict[str, Any]:
    """Read a TOML file; `expected` and `remedy` are for the message.

    Raises SettingsError if it is not TOML, and FileError if it cannot be read, or is no text.
    """
    content = read_text(path)
    try:
        return tomllib.loads(content)
    except DAMAGE as error:
        raise SettingsError(
            f"{path} is not valid TOML ({reason(error)})", expected=expected, remedy=remedy
        ) from error


def read_json(path: str | Path, *, expected: str, remedy: str) -> Any:
    """Read a JSON file; `expected` and `remedy` are for the message.

    Raises FileError if it cannot be read or is not JSON.
    """
    text = read_text(path)
    try:
        return json.loads(text)
    except DAMAGE as error:
        raise FileError(f"{path} is not JSON ({reason(error)})", expected=expected, remedy=remedy) from error


def reason(error: Exception) -> str:
    """Return the last line of what an error says, of bounded length."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    # Letters of a reason that are shown: a damaged file can be quoted without end.
    return lines[-1][:300]


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Turn what reading a damaged file raises into a `FileError` that names the file.

    Raises FileError if the block raises one of `DAMAGE`; typed errors pass.
    """
    try:
        yield
    except DAMAGE as error:
        raise unreadable(path, error) from error


def unreadable(path: str | Path, error: Exception) -> FileError:
    """Make the error for a file that exists but cannot be read."""
    return FileError(
        f"{path} cannot be read: {reason(error)}",
        expected="a readable, complete file",
        remedy="Copy or export the file again",
    )


def require_writable_folder(folder: str | Path) -> Path:
    """Make `folder` if needed and prove that files can be written into it.

    Raises FileError if the folder cannot be made or written to.
    """
    folder = Path(folder)
    probe = folder / f".{secrets.token_hex(6)}.probe"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise _unwritable(folder, error) from error
    return folder


def require_suffix(path: str | Path, suffix: str) -> None:
    """Refuse a file to be written whose name does not end in `suffix`, in lower or upper case.

    Raises FileError if it ends differently.
    """
    if Path(path).suffix.lower() != suffix:
        raise FileError(
            f"{path} does not end in {suffix}", expected=f"a {suffix} file", remedy="Rename the file"
        )


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary name beside `path`, and rename it to `path` when the block succeeds.

    The temporary name ends like `path`, because writers choose the format by the ending.  When the block
    raises, `path` keeps its old contents and the temporary file is removed.  Raises FileError if the folder
    is missing or not writable, or the disk is full.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with atomic_write(folder / "plan.json") as temporary:
        ...     _ = temporary.write_text("{}")
        >>> (folder / "plan.json").read_text()
        '{}'
    """
    path = Path(path)
    # Short: Windows limits a whole path to 260 characters.
    temporary = path.with_name(f".{secrets.token_hex(6)}{''.join(path.suffixes[-2:])}")
    try:
        yield temporary
        _replace(temporary, path)
    except OSError as error:
        raise _unwritable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True) if path.parent.is_dir() else None


def _replace(source: Path, target: Path) -> None:
    """Give a file the name of another; on Windows that waits a moment for those who have the other open."""
    for left in reversed(range(REPLACE_TRIES)):
        try:
            return os.replace(source, target)
        except PermissionError:
            if not left:
                raise
            time.sleep(0.05)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, all of it or nothing; FileError if the file cannot be written."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: str | Path, value: object) -> None:
    """Write plain values as indented JSON, all of it or nothing; FileError if the file cannot be written."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def _unwritable(path: Path, error: OSError) -> FileError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    change = "Close what has it open, change its permissions" if path.is_file() else "Change its permissions"
    return FileError(
        f"{path} cannot be written: {error.strerror or error}",
        expected="an existing folder that may be written to, with room on the disk",
        remedy=f"{'Make room on the disk' if full else change}, or choose another folder",
    )
