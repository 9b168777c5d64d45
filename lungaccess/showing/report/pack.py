"""Arrays as text inside a page: deflated, in base64, with their type and shape beside them."""

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Array

Packed = dict[str, Any]

TYPES = {"u1": np.uint8, "u2": np.uint16, "i4": np.int32, "f4": np.float32}


def pack(values: ArrayLike, kind: str) -> Packed:
    """Return an array as plain JSON values.

    The bytes are stored by significance (all lowest bytes first), which makes whole numbers deflate well.
    Raises AnatomyError if a value is not finite, or too large for the type.

    Args:
        values (array_like of any shape): Its last axis runs fastest.
        kind: "u1", "u2", "i4" or "f4": the type as which it is stored, little-endian.

    Returns:
        "kind", "shape" and "data": base64 of the zlib stream.
    """
    array = np.asarray(values)
    stored = np.ascontiguousarray(array, dtype=np.dtype(TYPES[kind]).newbyteorder("<"))
    fits = np.isfinite(stored).all() if kind == "f4" else np.array_equal(stored, array)
    if not fits:
        raise AnatomyError("A number of the report cannot be stored", expected=f"values of the type {kind}")
    planes = stored.reshape(-1).view(np.uint8).reshape(-1, stored.itemsize).T
    # Level 9 of zlib takes eight times as long to save less than one part in a hundred.
    data = base64.b64encode(zlib.compress(planes.tobytes(), 6)).decode("ascii")
    return {"kind": kind, "shape": list(stored.shape), "data": data}


def unpack(packed: Packed) -> Array:
    """Return the array that `pack` stored."""
    kind = np.dtype(TYPES[packed["kind"]])
    flat = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), dtype=np.uint8)
    joined = np.ascontiguousarray(flat.reshape(kind.itemsize, -1).T)
    return joined.reshape(-1).view(kind.newbyteorder("<")).reshape(packed["shape"])


def script_text(content: Any) -> str:
    """Return JSON that may be put into a script element: it holds no `<`.

    Raises ValueError if a number is not finite.
    """
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
