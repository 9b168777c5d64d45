"""What follows from a lung alone and is slow to make, such as its projections: kept beside its stored arrays.

A lung that is not stored keeps nothing.  What is kept is made anew if it is missing, damaged or of another
version, and goes when the lung goes.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from anatomy.base.checksums import values_checksum, warn_of_damage
from anatomy.base.errors import FileError
from anatomy.base.files import DAMAGE, write_text
from anatomy.base.unfinished import clear_place

if TYPE_CHECKING:
    from anatomy.organ import Organ


def kept(lung: Organ, name: str, version: int, make: Callable[[], Any]) -> Any:
    """Return plain JSON values that follow from a lung: those kept with it, else those that `make` returns.

    Parameters
    ----------
    name : str
        What they are; the file is named after it.
    version : int
        To be raised when `make` returns something else for the same lung.
    make : callable
        Returns the values; they should say the same after they were written as JSON and read again.
    """
    if lung.folder is None:
        return make()
    path = lung.folder / f"{name}.json"
    try:
        stored = json.loads(path.read_text(encoding="ascii"))
        current = stored["version"] == version
        if current and stored["checksum"] == _checksum(lung, name, stored["values"]):
            return stored["values"]
        damaged = current
    except FileNotFoundError:
        damaged = False
    except DAMAGE:
        damaged = True
    if damaged:
        warn_of_damage(path)
    plain = json.loads(json.dumps(values := make()))
    # A cache may be read-only, and another process may just have removed the lung.
    with contextlib.suppress(FileError):
        if path.is_dir():
            clear_place(path)
        seal = {"version": version, "checksum": _checksum(lung, name, plain)}
        write_text(path, json.dumps({**seal, "values": plain}))
    return values


def _checksum(lung: Organ, name: str, values: Any) -> str:
    """Return what binds values to the lung and the name under which they are kept."""
    return values_checksum({"lung": lung.key, "name": name, "values": values})
