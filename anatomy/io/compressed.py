"""Compressed bytes read in pieces, with the checksum proved at the end."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from anatomy.base.errors import FileError

PIECE_BYTES = 1 << 22
_ANY_HEADER = 47  # zlib or gzip, found out from the first bytes
_MAGIC_GZIP = b"\x1f\x8b"


def is_gzip(path: Path) -> bool:
    """Tell whether a file begins like a gzip file, whatever its name."""
    with path.open("rb") as stream:
        return stream.read(2) == _MAGIC_GZIP


def pieces(path: Path, offset: int = 0, *, compressed: bool | None = None) -> Iterator[bytes]:
    """Yield the bytes of a plain or compressed file from an offset on, in pieces of a few MiB.

    Whether they are compressed is found out at the beginning of the file if it is not stated.

    Raises:
        FileError: At the end of a compressed file whose checksum is wrong or that was cut short.
    """
    with path.open("rb") as stream:
        stream.seek(offset)
        packed = is_gzip(path) if compressed is None else compressed
        yield from inflate(stream, path) if packed else plain_pieces(stream)


def plain_pieces(stream: BinaryIO) -> Iterator[bytes]:
    """Yield the rest of `stream` in pieces."""
    while piece := stream.read(PIECE_BYTES):
        yield piece


def inflate(stream: BinaryIO, path: Path) -> Iterator[bytes]:
    """Yield the decompressed rest of `stream` (gzip, also several members, or zlib).

    Raises:
        FileError: If the stream is damaged or ends early; `path` is named.
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
        raise _damaged(path, f"its compressed data are corrupt ({error})") from error
    if not decoder.eof:
        raise _damaged(path, "it ends before its compressed data do")


def _damaged(path: Path, why: str) -> FileError:
    return FileError(
        f"{path} is damaged: {why}", expected="a complete file", remedy="Copy or download the file again"
    )
