"""Read the arrays of a VTK XML file (.vtp, .vtu): ascii, base64 and raw, plain or compressed by zlib."""

from __future__ import annotations

import base64
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from anatomy.base.files import reading, require_file
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8", "String": "u1",
}  # fmt: skip
_HEADER_TYPES = {"UInt32": "u4", "UInt64": "u8"}
MOST_BYTES = 1 << 28
"""A file, and all that it inflates to: some million points, which no tree of tubes has."""
_APPENDED = re.compile(rb"<AppendedData\s+encoding\s*=\s*[\"'](\w+)[\"']\s*>\s*_")


@frozen_record
class VtkPiece:
    """The arrays of one piece: points, point data by name, cells as connectivity and offsets."""

    points: Array
    point_data: dict[str, Array]
    connectivity: Array
    offsets: Array
    cell_types: Array | None


@frozen_record
class VtkFile:
    """The pieces of a file and its field data by name."""

    kind: str
    pieces: list[VtkPiece]
    field_data: dict[str, Array]


def read_vtk_xml(path: str | Path) -> VtkFile:
    """Read a PolyData (lines only) or UnstructuredGrid file.

    Raises:
        FileError: If the file is missing, damaged, truncated, of another kind or compressed otherwise than by
            zlib.
    """
    path = require_file(path)
    with reading(path):
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES >> 20} MiB")
        return _Reader(path.read_bytes()).file()


class _Reader:
    """The bytes of a file and how its arrays are stored."""

    def __init__(self, content: bytes) -> None:
        match = _APPENDED.search(content)
        self.appended, self.encoding, self.inflated_bytes = b"", "", 0
        if match:
            self.appended, self.encoding = content[match.end() :], match.group(1).decode()
            content = content[: match.start()] + b"</VTKFile>"
        if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
            raise ValueError("it declares XML entities, which VTK files never do")
        self.root = ElementTree.fromstring(content)
        compressor = self.root.get("compressor", "")
        if compressor not in ("", "vtkZLibDataCompressor"):
            raise ValueError(f"it is compressed by {compressor}; save it with zlib or without compression")
        self.compressed = bool(compressor)
        order = "<" if self.root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
        self.order = order
        self.header = np.dtype(order + _HEADER_TYPES[self.root.get("header_type", "UInt32")])

    def file(self) -> VtkFile:
        kind = self.root.get("type", "")
        if self.root.tag != "VTKFile" or kind not in ("PolyData", "UnstructuredGrid"):
            raise ValueError(f"it is <{self.root.tag} type={kind!r}>, not PolyData or UnstructuredGrid")
        data = self.root.find(kind)
        if data is None:
            raise ValueError(f"it has no <{kind}> element")
        cells = "Lines" if kind == "PolyData" else "Cells"
        pieces = [self.piece(piece, cells) for piece in data.iter("Piece")]
        field = {}
        for parent in (self.root, data):
            field.update(self.named(parent.find("FieldData")))
        return VtkFile(kind=kind, pieces=pieces, field_data=field)

    def piece(self, piece: Element, cells: str) -> VtkPiece:
        count = int(piece.get("NumberOfPoints", "0"))
        found = self.named(piece.find("Points"))
        points = next(iter(found.values()), np.zeros((0, 3))).reshape(-1, 3)
        point_data = self.named(piece.find("PointData"))
        for name, array in [("Points", points), *point_data.items()]:
            if len(array) != count:
                raise ValueError(f"{name!r} holds {len(array)} values for {count} points")
        topology = self.named(piece.find(cells))
        empty = np.zeros(0, dtype=np.int64)
        connectivity, offsets = topology.get("connectivity", empty), topology.get("offsets", empty)
        beyond = len(offsets) and (offsets[-1] > len(connectivity) or (np.diff(offsets, prepend=0) < 0).any())
        if beyond or ((connectivity < 0) | (connectivity >= count)).any():
            raise ValueError("the cells refer to points that are not listed")
        return VtkPiece(
            points=points,
            point_data=point_data,
            connectivity=connectivity,
            offsets=offsets,
            cell_types=topology.get("types"),
        )

    def named(self, parent: Element | None) -> dict[str, Array]:
        if parent is None:
            return {}
        return {e.get("Name", ""): self.array(e) for e in parent if e.tag in ("DataArray", "Array")}

    def array(self, element: Element) -> Array:
        dtype = np.dtype(self.order + _TYPES[element.get("type", "")])
        form = element.get("format", "ascii")
        if form == "ascii":
            # Through text, so that 64-bit integers stay exact.
            values = np.array((element.text or "").split()).astype(dtype)
        else:
            values = np.frombuffer(self.payload(element, form), dtype=dtype)
        width = int(element.get("NumberOfComponents", "1") or 1)
        values = values.astype(dtype.newbyteorder("="))
        return values if width == 1 else values.reshape(-1, width)

    def payload(self, element: Element, form: str) -> bytes:
        """Return the bytes of an array, decoded and decompressed."""
        if form == "appended":
            stream = self.appended[max(int(element.get("offset", "0")), 0) :]
            base64_coded = self.encoding == "base64"
        else:
            stream = (element.text or "").strip().encode()
            base64_coded = True
        blocks = _Base64(stream) if base64_coded else _Raw(stream)
        return self.inflate(blocks) if self.compressed else self.plain(blocks)

    def plain(self, stream: _Raw) -> bytes:
        size = self.header.itemsize
        count = int(np.frombuffer(stream.peek(size), self.header)[0])
        return stream.take(size, count)

    def inflate(self, stream: _Raw) -> bytes:
        size = self.header.itemsize
        blocks = int(np.frombuffer(stream.peek(size), self.header)[0])
        if blocks == 0:
            return b""
        head = np.frombuffer(stream.peek((3 + blocks) * size), self.header)
        stream.skip((3 + blocks) * size)
        sizes = head[3:].tolist()
        packed = stream.take(0, sum(sizes))
        at, block_bytes, out = 0, int(head[1]), []
        for packed_bytes in sizes:
            out.append(self.inflated(packed[at : at + packed_bytes], block_bytes))
            at += packed_bytes
        return b"".join(out)

    def inflated(self, packed: bytes, most_bytes: int) -> bytes:
        """Return a decompressed block, which is at most as long as the file says."""
        self.inflated_bytes += most_bytes
        if self.inflated_bytes > MOST_BYTES:
            raise ValueError(f"its arrays say that they inflate to more than {MOST_BYTES >> 20} MiB")
        decoder = zlib.decompressobj()
        block = decoder.decompress(packed, most_bytes + 1)
        if len(block) > most_bytes or not decoder.eof:
            raise ValueError("a compressed block is longer than the file says, or cut short")
        return block


class _Raw:
    """A stream of plain bytes."""

    def __init__(self, stream: bytes) -> None:
        self.stream = stream
        self.at = 0

    def peek(self, count: int) -> bytes:
        return self.take(0, count)

    def skip(self, count: int) -> None:
        self.at += count

    def take(self, skip: int, count: int) -> bytes:
        found = self.stream[self.at + skip : self.at + skip + count]
        if len(found) < count:
            raise ValueError(f"an array ends after {len(found)} of {count} bytes")
        return found


class _Base64(_Raw):
    """A stream of base64 text, in which header and data are coded together or one after the other."""

    def take(self, skip: int, count: int) -> bytes:
        coded = -(-skip // 3) * 4
        if skip and self.stream[self.at : self.at + coded].rstrip().endswith(b"="):
            return _decode(self.stream[self.at + coded :], count)
        return _decode(self.stream[self.at :], skip + count)[skip:]

    def skip(self, count: int) -> None:
        self.at += -(-count // 3) * 4


def _decode(text: bytes, count: int) -> bytes:
    found = base64.b64decode(text[: -(-count // 3) * 4], validate=True)[:count]
    if len(found) < count:
        raise ValueError(f"an array ends after {len(found)} of {count} bytes")
    return found
