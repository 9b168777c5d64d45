"""Centreline files, .vtp and .vtu with a radius at every point, as an `AirwayTree` and back."""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import FileError, FrameError
from anatomy.base.files import reading, require_file, require_suffix, write_text
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int
from anatomy.grid import transform_points
from anatomy.io.frames import LPS_FROM, MOST_COORDINATE_MM, Frame
from anatomy.tree import tree_from_graph

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8", "String": "u1",
}  # fmt: skip
_HEADER_TYPES = {"UInt32": "u4", "UInt64": "u8"}
MOST_BYTES = 1 << 28
"""A file, and all that it inflates to: some million points, which no tree of tubes has."""
_APPENDED = re.compile(rb"<AppendedData\s+encoding\s*=\s*[\"'](\w+)[\"']\s*>\s*_")


@frozen_record
class _VtkPiece:
    """The arrays of one piece: points, point data by name, cells as connectivity and offsets."""

    points: Array
    point_data: dict[str, Array]
    connectivity: Array
    offsets: Array
    cell_types: Array | None


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
        self.order = "<" if self.root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
        self.header = np.dtype(self.order + _HEADER_TYPES[self.root.get("header_type", "UInt32")])

    def contents(self) -> tuple[list[_VtkPiece], dict[str, Array]]:
        """Return the pieces of the file, and its field data by name."""
        kind = self.root.get("type", "")
        if self.root.tag != "VTKFile" or kind not in ("PolyData", "UnstructuredGrid"):
            raise ValueError(f"it is <{self.root.tag} type={kind!r}>, not PolyData or UnstructuredGrid")
        data = self.root.find(kind)
        if data is None:
            raise ValueError(f"it has no <{kind}> element")
        cells = "Lines" if kind == "PolyData" else "Cells"
        pieces = [self.piece(piece, cells) for piece in data.iter("Piece")]
        return pieces, self.named(self.root.find("FieldData")) | self.named(data.find("FieldData"))

    def piece(self, piece: Element, cells: str) -> _VtkPiece:
        count = int(piece.get("NumberOfPoints", "0"))
        points = next(iter(self.named(piece.find("Points")).values()), np.zeros((0, 3))).reshape(-1, 3)
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
        return _VtkPiece(
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
        """Return the bytes of an array, decoded and decompressed.

        In base64 header and data are coded together or one after the other, each up to its padding.
        """
        stream, coded = (element.text or "").strip().encode(), True
        if form == "appended":
            offset = max(int(element.get("offset", "0")), 0)
            stream, coded = self.appended[offset:], self.encoding == "base64"
        if coded:
            parts = re.findall(rb"[^=]+=*", stream.partition(b"<")[0].translate(None, b" \t\r\n"))
            stream = b"".join(base64.b64decode(part, validate=True) for part in parts)
        size = self.header.itemsize
        count = int(np.frombuffer(_taken(stream, 0, size), self.header)[0])
        if not self.compressed:
            return _taken(stream, size, count)
        if count == 0:
            return b""
        head = np.frombuffer(_taken(stream, 0, (3 + count) * size), self.header).tolist()
        at, out = (3 + count) * size, []
        for packed_bytes in head[3:]:
            out.append(self.inflated(_taken(stream, at, packed_bytes), head[1]))
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


def _taken(stream: bytes, at: int, count: int) -> bytes:
    found = stream[at : at + count]
    if len(found) < count:
        raise ValueError(f"an array ends after {len(found)} of {count} bytes")
    return found


RADIUS_NAMES = ("Radius", "radius", "MaximumInscribedSphereRadius")


def read_centerlines(path: str | Path, *, frame: Frame | None = None) -> AirwayTree:
    """Read a centreline file as an airway tree.

    Args:
        path (path of a .vtp or .vtu file in mm): Lines with one of the point arrays `RADIUS_NAMES`, mm.
        frame ("ras" or "lps"): The frame to assume if, and only if, the file states none in a field array
            `SPACE`.

    Raises:
        FileError: If the file is missing, damaged, holds no lines or no radius.
        FrameError: If the file states no frame and none is given, or another one than is given.
        AnatomyError: If the lines hold no trachea.
    """
    return tree_from_graph(*read_centerline_graph(path, frame=frame))


def read_centerline_graph(path: str | Path, *, frame: Frame | None = None) -> tuple[Float, Float, Int]:
    """Read the lines of a centreline file of any tubes, airways or vessels, plain or compressed by zlib.

    Returned are points `(N, 3)` LPS mm, radii `(N,)` mm, and pairs of points `(E, 2)` that follow each other
    on a line; parameters and errors are those of `read_centerlines`.
    """
    path = require_file(path)
    with reading(path):
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES >> 20} MiB")
        pieces, field_data = _Reader(path.read_bytes()).contents()
    lps_from_file = LPS_FROM[_frame(field_data, path, frame)]
    points, radii, edges, count = [], [], [], 0
    for piece in pieces:
        points.append(piece.points)
        radii.append(_radius(piece, path))
        edges.append(_edges(piece, path) + count)
        count += len(piece.points)
    if sum(len(e) for e in edges) == 0:
        raise FileError(
            f"{path} holds no lines",
            expected="centrelines as lines or polylines",
            remedy="Save the centreline model, not a surface",
        )
    lps = transform_points(lps_from_file, np.concatenate(points))
    if not np.abs(lps).max() <= MOST_COORDINATE_MM:
        raise FrameError(
            f"{path} has points that are no numbers, or absurdly far away",
            expected=f"coordinates of at most {MOST_COORDINATE_MM:.0f} mm",
            remedy="Export the centreline again, in mm",
        )
    return lps, np.concatenate(radii), np.concatenate(edges)


def _frame(field_data: dict[str, Array], path: str | Path, given: Frame | None) -> Frame:
    text = bytes(field_data.get("SPACE", np.zeros(0, np.uint8)).astype(np.uint8)).decode("latin-1")
    named = text.strip("\0 ").removeprefix("SPACE=").lower()
    stated = {"lps": "lps", "left-posterior-superior": "lps", "ras": "ras", "right-anterior-superior": "ras"}
    if named and named not in stated:
        raise FrameError(
            f"{path} states the frame {named!r}",
            expected="LPS or RAS",
            remedy="Save the centreline in one of them",
        )
    found: Frame | None = "ras" if stated.get(named) == "ras" else "lps" if named else None
    if found is None and given is None:
        raise FrameError(
            f"{path} does not state its frame",
            expected="a field array SPACE that says LPS or RAS",
            remedy='Give frame="lps" (3D Slicer and ITK write VTK files in LPS) or frame="ras"',
        )
    if found is not None and given is not None and found != given:
        raise FrameError(
            f"{path} states {found.upper()}, but {given.upper()} was given",
            expected="one frame",
            remedy="Leave out the frame, or correct the file",
        )
    return found or given or "lps"


def _radius(piece: _VtkPiece, path: str | Path) -> Float:
    name = next((name for name in RADIUS_NAMES if name in piece.point_data), None)
    if name is None:
        raise FileError(
            f"{path} has no radius; its point arrays are {sorted(piece.point_data)}",
            expected=f"a point array named {', '.join(RADIUS_NAMES)}",
            remedy="Export the centreline with its radius",
        )
    radius = piece.point_data[name].astype(np.float64)
    if radius.shape != (len(piece.points),) or not ((radius >= 0) & np.isfinite(radius)).all():
        raise FileError(
            f"{path} has radii in {name!r} that are negative or no numbers",
            expected="one length in mm a point",
            remedy="Export the centreline again",
        )
    return radius


def _edges(piece: _VtkPiece, path: str | Path) -> Int:
    """Return the pairs of points `(E, 2)` that follow each other on a line."""
    types = piece.cell_types
    if types is not None and not np.isin(types, (3, 4)).all():
        raise FileError(
            f"{path} holds cells of the VTK types {np.unique(types).tolist()}",
            expected="lines (3) and polylines (4) alone",
            remedy="Save the centreline model, not a surface or volume mesh",
        )
    pairs = np.stack((piece.connectivity[:-1], piece.connectivity[1:]), axis=1).astype(np.int64)
    last = np.zeros(len(pairs) + 1, dtype=bool)
    last[piece.offsets[(piece.offsets > 0) & (piece.offsets <= len(last))].astype(np.int64) - 1] = True
    return pairs[~last[:-1]]


def write_centerlines(path: str | Path, tree: AirwayTree) -> None:
    """Write a tree as .vtp in LPS mm, one polyline a branch, with `Radius`, `Generation` and `Branch`.

    Every branch after the first begins with the point it hangs on.  No digit is lost.  Raises FileError if
    the name does not end in .vtp, or the file cannot be written.
    """
    require_suffix(path, ".vtp")
    lines = []
    for b in range(tree.n_branches):
        nodes = tree.branch_points(b).tolist()
        lines.append(nodes if b == 0 else [int(tree.parent_point[nodes[0]]), *nodes])
    ends = np.cumsum([len(line) for line in lines]).tolist()
    space = " ".join(str(c) for c in b"LPS\0")
    content = "\n".join(
        (
            '<?xml version="1.0"?>',
            '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
            "<PolyData>",
            f'<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{space}</Array>',
            "</FieldData>",
            f'<Piece NumberOfPoints="{tree.n_points}" NumberOfVerts="0" NumberOfLines="{len(lines)}" '
            'NumberOfStrips="0" NumberOfPolys="0">',
            '<PointData Scalars="Radius">',
            _data_array("Float64", "Radius", tree.radius_mm.tolist()),
            _data_array("Int64", "Generation", tree.generation[tree.branch_of_point].tolist()),
            _data_array("Int64", "Branch", tree.branch_of_point.tolist()),
            "</PointData>",
            "<Points>",
            _data_array("Float64", "Points", tree.points_lps.ravel().tolist(), components=3),
            "</Points>",
            "<Lines>",
            _data_array("Int64", "connectivity", [n for line in lines for n in line]),
            _data_array("Int64", "offsets", ends),
            "</Lines>",
            "</Piece>",
            "</PolyData>",
            "</VTKFile>",
            "",
        )
    )
    write_text(path, content)


def _data_array(kind: str, name: str, values: Iterable[float], components: int = 1) -> str:
    text = " ".join(repr(v) for v in values)
    return (
        f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" format="ascii">'
        f"{text}</DataArray>"
    )
