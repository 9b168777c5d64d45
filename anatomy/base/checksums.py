"""What tells that stored values are those that were stored: checksums of files, arrays and plain values."""

import hashlib
import json
import warnings
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.typed import Array, UInt8


class DamagedCacheWarning(UserWarning):
    """Something in the cache is not what was stored, and is made again."""


def warn_of_damage(path: Path) -> None:
    """Say that what is stored at a path is damaged or foreign, and is made again."""
    warnings.warn(f"{path} is damaged or was changed: it is made again", DamagedCacheWarning, stacklevel=3)


def values_checksum(values: Any) -> str:
    """Return the SHA-256 (hex) of plain values, whatever their order."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def canonical_sha256(values: Any) -> str:
    """Return the SHA-256 (hex) of plain values as JSON: ASCII, sorted keys, no spaces, finite numbers."""
    canonical = json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def array_checksum(array: Array) -> list[Any]:
    """Return type, shape and CRC-32 of an array."""
    return [array.dtype.str, list(array.shape), _crc(np.ascontiguousarray(array).reshape(-1).view(np.uint8))]


def file_states(folder: Path, names: Iterable[str]) -> dict[str, list[int]]:
    """Return size, time of change (`st_ctime_ns`, which cannot be set back) and CRC-32 of files by name."""
    found = {}
    for name in names:
        state = (folder / name).stat()
        found[name] = [state.st_size, state.st_ctime_ns, _file_checksum(folder / name)]
    return found


def are_unchanged(folder: Path, states: Mapping[str, list[int]]) -> bool:
    """Tell whether files are what `file_states` saw.

    A file of the same size and time of change counts as unchanged without being read, so that opening a
    stored lung does not read gigabytes.  Any other file must have the same checksum.
    """
    for name, (size, time_ns, checksum) in states.items():
        state = (folder / name).stat()
        if state.st_size != size or (
            state.st_ctime_ns != time_ns and _file_checksum(folder / name) != checksum
        ):
            return False
    return True


def _file_checksum(path: Path) -> int:
    return _crc(np.memmap(path, dtype=np.uint8, mode="r")) if path.stat().st_size else 0


def _crc(content: UInt8) -> int:
    return zlib.crc32(content.data)
