"""What is slow to make, kept: records in the cache, one file of arrays for all that a record depends on, and
plain values that follow from a lung alone, beside its stored arrays."""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from anatomy.base.cache import cache_limit_bytes, default_cache
from anatomy.base.cache_entries import make_room, note_use
from anatomy.base.checksums import array_checksum, values_checksum, warn_of_damage
from anatomy.base.errors import FileError, LungaccessError
from anatomy.base.files import DAMAGE, atomic_write, write_text
from anatomy.base.records import plain_values, record_from
from anatomy.base.unfinished import clear_place
from anatomy.grid import read_only

if TYPE_CHECKING:
    from anatomy.organ import Organ


T = TypeVar("T")


def kept_record(
    kind: str,
    version: str,
    depends_on: Mapping[str, Any],
    cls: type[T],
    *,
    make: Callable[[], T],
    cache: str | os.PathLike[str] | None = None,
    name: str = "",
    in_use: tuple[Path, ...] = (),
) -> T:
    """Return the record from the cache, or make and keep it; what was used least recently makes room for it.

    Raises FileError if the file cannot be written, and SettingsError if the limit of the cache is no size.

    Args:
        kind: What it is, one of `anatomy.base.cache_entries`; the file is named after it.
        version: Another one where `make` returns something else for the same `depends_on`, plain values, as
            other kernels may.
        cls: Class of the record, of arrays, plain values, and records of such.
        name: Whose it is; empty if it belongs to no patient.
        in_use: What has to stay in the cache as well.
    """
    path = record_path(kind, version, depends_on, cache)
    stored = _stored(path, cls) if path.exists() else None
    if stored is not None:
        note_use(path)
        return stored
    most_bytes = cache_limit_bytes()
    made = make()
    _save(kind, {"format": version, "name": name}, made, path)
    make_room(path.parent, most_bytes, {kind: version}, keep=(path, *in_use))
    return made


def record_path(
    kind: str, version: str, depends_on: Mapping[str, Any], cache: str | os.PathLike[str] | None = None
) -> Path:
    """Return the file in which `kept_record` keeps a record, whether or not there is one."""
    text = json.dumps({"format": version, **depends_on}, sort_keys=True, default=list)
    return Path(cache or default_cache()) / f"{kind}-{hashlib.sha256(text.encode()).hexdigest()}.npz"


def _stored(path: Path, cls: type[T]) -> T | None:
    """Return the record in a file; None if it is damaged, or belongs elsewhere."""
    try:
        with path.open("rb") as stream, np.load(stream) as stored:
            arrays = {name: read_only(stored[name]) for name in stored.files if name != "rest"}
            rest = json.loads(str(stored["rest"]))
        if rest.pop("checksum") == _checksum(path, rest, arrays):
            return cast(T, record_from(cls, rest["values"], arrays))
    except (*DAMAGE, LungaccessError):
        pass
    warn_of_damage(path)
    return None


def _checksum(path: Path, rest: Mapping[str, Any], arrays: Mapping[str, Any]) -> str:
    """Return what binds the values of a file to each other and to the name of the file."""
    parts = {name: array_checksum(array) for name, array in arrays.items()}
    return values_checksum({"file": path.name, "rest": rest, "arrays": parts})


def _save(kind: str, header: dict[str, str], made: object, path: Path) -> None:
    arrays: dict[str, Any] = {}
    rest = json.loads(json.dumps(header | {"values": plain_values(made, "", arrays)}))
    rest["checksum"] = _checksum(path, rest, arrays)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            clear_place(path)
        with atomic_write(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, rest=np.array(json.dumps(rest)), **arrays)
    except OSError as error:
        raise FileError(
            f"The {kind} cannot be stored in {path.parent}: {error}",
            remedy="Choose another folder with --cache or LUNGACCESS_CACHE",
            expected="a folder that may be written to, with room on the disk",
        ) from error


def kept(lung: "Organ", name: str, version: int, make: Callable[[], Any]) -> Any:
    """Return plain JSON values that follow from a lung: those kept with it, else those that `make` returns.

    A lung that is not stored keeps nothing.  What is kept, in a file of this name, is made anew if it is
    missing, damaged or of another version, and goes when the lung goes.  The version is raised when `make`
    returns something else for the same lung; its values should say the same after they were written as JSON
    and read.
    """
    if lung.folder is None:
        return make()
    path = lung.folder / f"{name}.json"
    try:
        stored = json.loads(path.read_text(encoding="ascii"))
        if stored["version"] == version:
            if stored["checksum"] == _seal_of(lung, name, stored["values"]):
                return stored["values"]
            warn_of_damage(path)
    except DAMAGE as error:
        if not isinstance(error, FileNotFoundError):
            warn_of_damage(path)
    plain = json.loads(json.dumps(values := make()))
    # A cache may be read-only, and another process may just have removed the lung.
    with contextlib.suppress(FileError):
        if path.is_dir():
            clear_place(path)
        seal = {"version": version, "checksum": _seal_of(lung, name, plain)}
        write_text(path, json.dumps({**seal, "values": plain}))
    return values


def _seal_of(lung: "Organ", name: str, values: Any) -> str:
    """Return what binds values to the lung and the name under which they are kept."""
    return values_checksum({"lung": lung.key, "name": name, "values": values})
