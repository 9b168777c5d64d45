"""Voxels of an image file of any format, streamed so that a mask never exists as anything but bool."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from anatomy.base.errors import AnatomyError, FileError
from anatomy.base.typed import Array, Float32
from anatomy.grid import Volume
from anatomy.io.image_header import ImageHeader, truncated

PIECE_BYTES = 1 << 22
_ANY_HEADER = 47  # zlib or gzip, found out from the first bytes
_MAGIC_GZIP = b"\x1f\x8b"


def pieces(path: Path, offset: int = 0, *, compressed: bool | None = None) -> Iterator[bytes]:
    """Yield the bytes of a plain or compressed file from an offset on, in pieces of a few MiB.

    Whether they are compressed is found out at the beginning of the file if it is not stated.  Raises
    FileError at the end of a compressed file whose checksum is wrong or that was cut short.
    """
    with path.open("rb") as stream:
        packed = stream.read(2) == _MAGIC_GZIP if compressed is None else compressed
        stream.seek(offset)
        yield from _inflate(stream, path) if packed else iter(lambda: stream.read(PIECE_BYTES), b"")


def _inflate(stream: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield the decompressed rest of `stream` (gzip, also several members, or zlib).

    Raises FileError if the stream is damaged or ends early; `path` is named.
    """
    decoder, pending = zlib.decompressobj(_ANY_HEADER), b""
    try:
        while True:
            pending = pending or stream.read(PIECE_BYTES // 16)
            if not pending:
                break
            yield decoder.decompress(pending, PIECE_BYTES)
            pending = decoder.unconsumed_tail
            if decoder.eof:
                pending = decoder.unused_data or stream.read(PIECE_BYTES // 16)
                if not pending.startswith(_MAGIC_GZIP):
                    return
                decoder = zlib.decompressobj(_ANY_HEADER)
    except zlib.error as error:
        raise truncated(path, f"its compressed data are corrupt ({error})", "damaged") from error
    if not decoder.eof:
        raise truncated(path, "it ends before its compressed data do", "damaged")


def require_whole(header: ImageHeader, stream: Iterator[bytes], path: Path) -> None:
    """Read all voxels and keep none; errors as `read_array`."""
    for _ in _chunks(header, stream, path):
        pass


def read_array(header: ImageHeader, stream: Iterator[bytes], path: Path) -> Array:
    """Read the voxels `(ni, nj, nk)`, or the vectors `(ni, nj, nk, components)`, in their own type.

    They are float32 where the header scales.  Raises FileError if there are fewer or many more bytes than the
    header says, or they are damaged.
    """
    # The index that runs fastest comes first.
    n = (header.components,) if header.components > 1 else ()
    shape = n + header.grid.shape if header.components_first else header.grid.shape + n
    values = np.zeros(shape, np.float32 if header.is_scaled else header.dtype, order="F")
    flat = values.reshape(-1, order="F")
    for at, chunk in _chunks(header, stream, path):
        flat[at : at + chunk.size] = chunk
    native = values.astype(values.dtype.newbyteorder("="), copy=False)
    native = np.moveaxis(native, 0, -1) if header.components_first else native
    return native[::-1] if header.is_reversed else native


def read_two_valued(header: ImageHeader, stream: Iterator[bytes], path: Path) -> Volume | None:
    """Read voxels of 0 and one whole number above it as a mask, else None; errors as `read_array`."""
    mask = np.zeros(header.grid.shape, dtype=np.bool_, order="F")
    flat = mask.reshape(-1, order="F")
    mark = 0.0
    for at, chunk in _chunks(header, stream, path):
        mark = mark or float(chunk.max())
        part = np.equal(chunk, mark or 1, out=flat[at : at + chunk.size])
        if np.count_nonzero(part) != np.count_nonzero(chunk) or mark < 0 or not mark.is_integer():
            return None
    return Volume(grid=header.grid, array=mask[::-1] if header.is_reversed else mask)


def require_numbers(values: Array, path: str | Path) -> None:
    """Raise `AnatomyError` if a value is not-a-number."""
    if values.dtype.kind == "f" and bool(np.isnan(values).any()):
        raise AnatomyError(
            f"{path} holds voxels that are not a number (NaN)",
            expected="numbers only",
            remedy="Replace NaN by 0 where nothing is",
        )


def _chunks(header: ImageHeader, stream: Iterator[bytes], path: Path) -> Iterator[tuple[int, Array]]:
    """Yield (first voxel, values) until the image is full; drain the stream, for its checksum."""
    n_values, size, at, tail = header.n_values, header.dtype.itemsize, 0, b""
    for piece in stream:
        data = tail + piece if tail else piece
        count = min(len(data) // size, n_values - at)
        if count:
            stored = np.frombuffer(data, dtype=header.dtype, count=count)
            yield at, stored * header.slope + header.intercept if header.is_scaled else stored
            at += count
        tail = data[count * size :]
        if at == n_values and tail:
            raise FileError(
                f"{path} holds more data than the {n_values} voxels of its header",
                expected="as many voxels as the header says",
                remedy="Copy or export the file again",
            )
    if at < n_values:
        raise truncated(path, f"it holds {at} of {n_values} voxels")


OBSTACLE_COST = 1000.0
"""A file holds this where passing is forbidden: it is finite, exact in every type, and far from 0 to 1."""
COST_MAP_NOTE = f"cost of passing a voxel, 0 to 1; {OBSTACLE_COST:g} is an obstacle"
"""The header of the file says this of its voxels."""


def as_stored(cost: Float32) -> Float32:
    """Return a cost map as files hold it: `OBSTACLE_COST` in place of infinity."""
    return np.where(np.isposinf(cost), np.float32(OBSTACLE_COST), cost)


def from_stored(values: Array) -> Float32:
    """Return the cost map that a file holds as float32; files may also hold infinity."""
    cost: Float32 = values.astype(np.float32)
    return np.where(cost == np.float32(OBSTACLE_COST), np.float32(np.inf), cost)
