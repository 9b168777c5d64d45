"""Which files make a patient, and their hashes, without reading a single voxel."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from anatomy.io.files import require_file, sha256
from anatomy.io.images import image_suffix
from anatomy.io.own_masks import DESCRIPTION

TEXT_SUFFIXES = (".txt", ".json", ".toml")


def input_hashes(path: str | Path) -> dict[str, str]:
    """Return the SHA-256 of every file a patient may be read from, by file name.

    Parameters
    ----------
    path : str or Path
        What `anatomy.io.load_patient` takes.

    Raises
    ------
    FileError
        If there is nothing at `path`, or a file cannot be read.
    """
    path = Path(path)
    if path.is_dir() and (path / DESCRIPTION).is_file():
        path = path / DESCRIPTION
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if _may_be_read(file)]
    elif path.suffix == ".toml":
        files = [require_file(path), *_files_named_in(path)]
    else:
        files = [file for file in sorted(require_file(path).parent.iterdir()) if _may_be_read(file)]
    return {str(file.name): sha256(file) for file in files}


def _may_be_read(path: Path) -> bool:
    return path.is_file() and (bool(image_suffix(path)) or path.suffix in TEXT_SUFFIXES)


def _files_named_in(description: Path) -> list[Path]:
    """Return the files that strings of a description name, itself being judged elsewhere."""
    try:
        values = tomllib.loads(description.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError):
        return []
    named = (description.parent / text for text in _strings(values))
    return sorted(file for file in named if file.is_file())


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from _strings(item)
    elif isinstance(value, list):
        for item in value:
            yield from _strings(item)
