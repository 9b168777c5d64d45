"""What the explorer sends: JSON as text, or JSON and arrays as one binary message."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Array
from lungaccess.showing.report.pack import TYPES

ALIGNMENT = 4
"""Arrays begin at multiples of so many bytes, so that the page reads them in place."""
Message = Mapping[str, Any]
Frame = str | bytes


def frame(message: Message, arrays: Mapping[str, Array] | None = None) -> Frame:
    """Return a message as it is sent.

    With arrays it is binary: the length of the JSON as a little-endian uint32, the JSON, whose "arrays" list
    name, kind ("u1", "u2", "i4" or "f4"), shape and offset of each, and the arrays, little-endian.  Raises
    ValueError if a number of the message is not finite.
    """
    if not arrays:
        return _json(message)
    begin, parts, listed = 0, [], []
    for name, array in arrays.items():
        kind = next(key for key, dtype in TYPES.items() if np.dtype(dtype) == array.dtype)
        data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        listed.append({"name": name, "kind": kind, "shape": list(array.shape), "offset": begin})
        padding = -len(data) % ALIGNMENT
        parts += [data, bytes(padding)]
        begin += len(data) + padding
    head = _json({**message, "arrays": listed}).encode("ascii")
    head += b" " * (-len(head) % ALIGNMENT)
    return struct.pack("<I", len(head)) + head + b"".join(parts)


def read_frame(sent: Frame) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return message and arrays of what `frame` made."""
    if isinstance(sent, str):
        return json.loads(sent), {}
    (length,) = struct.unpack_from("<I", sent)
    message = json.loads(sent[4 : 4 + length])
    arrays = {}
    for each in message.pop("arrays"):
        dtype = np.dtype(TYPES[each["kind"]]).newbyteorder("<")
        count = int(np.prod(each["shape"]))
        flat = np.frombuffer(sent, dtype=dtype, count=count, offset=4 + length + each["offset"])
        arrays[each["name"]] = flat.reshape(each["shape"])
    return message, arrays


def error_message(number: int | None, error: LungaccessError) -> Message:
    """Return the answer to a question that cannot be answered; None where its number is not known."""
    return {"id": number, "answer": "error", "error": {**error.to_mapping(), "words": str(error)}}


def _json(message: Message) -> str:
    return json.dumps(message, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
