"""Voxels of NIfTI files, streamed so that a mask never exists as anything but bool."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from anatomy.errors import AnatomyError, FileError
from anatomy.grid import Volume
from anatomy.io.compressed import pieces
from anatomy.io.frames import Frame
from anatomy.io.nifti_header import NiftiHeader, data_offset, is_header, parse_header
from anatomy.typed import Array

_HEADER_BYTES = 540


def begins_as_nifti(path: Path) -> bool:
    """Tell whether a file, compressed or not, begins with a NIfTI header, whatever its name."""
    try:
        start = next(pieces(path), b"")
    except (FileError, OSError):
        return False
    return len(start) >= _HEADER_BYTES and is_header(start)


def read_nifti_header(path: Path, frame: Frame | None = None) -> NiftiHeader:
    """Read everything before the voxels."""
    return _open(path, frame)[0]


def read_nifti(path: Path, frame: Frame | None = None) -> Volume:
    """Read a NIfTI image with its own type of voxel (float32 where the header scales)."""
    header, stream = _open(path, frame)
    values = np.zeros(header.grid.shape, np.float32 if header.is_scaled else header.dtype, order="F")
    flat = values.reshape(-1, order="F")
    for at, chunk in _chunks(header, stream, path):
        flat[at : at + chunk.size] = chunk
    native = values.astype(values.dtype.newbyteorder("="), copy=False)
    return Volume(grid=header.grid, array=native[::-1] if header.is_reversed else native)


def read_nifti_mask(path: Path, frame: Frame | None = None) -> Volume:
    """Read a NIfTI image as a bool mask, true where a voxel is not zero.

    Raises
    ------
    AnatomyError
        If a voxel is not a number.
    """
    header, stream = _open(path, frame)
    mask = np.zeros(header.grid.shape, dtype=np.bool_, order="F")
    flat = mask.reshape(-1, order="F")
    for at, chunk in _chunks(header, stream, path):
        require_numbers(chunk, path)
        np.not_equal(chunk, 0, out=flat[at : at + chunk.size])
    return Volume(grid=header.grid, array=mask[::-1] if header.is_reversed else mask)


def require_numbers(values: Array, path: Path) -> None:
    """Raise `AnatomyError` if a value is not-a-number."""
    if values.dtype.kind == "f" and bool(np.isnan(values).any()):
        raise AnatomyError(
            f"{path} holds voxels that are not a number (NaN)",
            expected="numbers only",
            remedy="Replace NaN by 0 where nothing is",
        )


def _open(path: Path, frame: Frame | None) -> tuple[NiftiHeader, Iterator[bytes]]:
    """Parse the header and return it with the rest of the bytes, from the first voxel on."""
    stream = pieces(path)
    start = _at_least(b"", _HEADER_BYTES, stream)
    start = _at_least(start, data_offset(start, path), stream)
    header = parse_header(start, path, frame)
    return header, _chain(start[header.data_offset :], stream)


def _at_least(start: bytes, n_bytes: int, stream: Iterator[bytes]) -> bytes:
    while len(start) < n_bytes and (piece := next(stream, b"")):
        start += piece
    return start


def _chain(first: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield first
    yield from rest


def _chunks(header: NiftiHeader, stream: Iterator[bytes], path: Path) -> Iterator[tuple[int, Array]]:
    """Yield (index of the first voxel, values) until the image is full, then drain the stream.

    Draining proves the checksum, which stands at the end of a compressed file.
    """
    n_voxels, size, at, tail = int(np.prod(header.grid.shape)), header.dtype.itemsize, 0, b""
    for piece in stream:
        if at == n_voxels:
            continue
        data = tail + piece if tail else piece
        count = min(len(data) // size, n_voxels - at)
        tail = data[count * size :]
        if count:
            stored = np.frombuffer(data, dtype=header.dtype, count=count)
            yield at, stored * header.slope + header.intercept if header.is_scaled else stored
            at += count
    if at < n_voxels:
        raise FileError(
            f"{path} is truncated: it holds {at} of {n_voxels} voxels",
            expected="a complete file",
            remedy="Copy or download the file again",
        )
