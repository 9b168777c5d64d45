"""Centreline files in every encoding; frames; damage."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import FileError, FrameError
from anatomy.io.centerlines import read_centerlines, write_centerlines
from anatomy.tree import tree_from_graph

POINTS = np.array(
    [(0, 0, z) for z in range(80, -1, -8)]
    + [(3 * n, 0, -4 * n) for n in range(1, 11)]
    + [(-3 * n, 0, -4 * n) for n in range(1, 7)],
    dtype=np.float64,
) + (0.1, 1 / 3, 0)
RADIUS = np.repeat((8.0, 6.0, 6.5), (11, 10, 6)) + 1 / 7
LINES = [list(range(11)), [10, *range(11, 21)], [10, *range(21, 27)]]


def _tree() -> AirwayTree:
    edges = [(a, b) for line in LINES for a, b in zip(line[:-1], line[1:], strict=True)]
    return tree_from_graph(POINTS, RADIUS, edges)


class _Encoder:
    """Writes arrays as VTK does."""

    def __init__(self, form: str, header: str, compress: bool, order: str = "<") -> None:
        self.form, self.compress, self.order = form, compress, order
        self.code = order + ("I" if header == "UInt32" else "Q")
        self.appended = b""

    def packed(self, data: bytes) -> tuple[bytes, bytes]:
        if not self.compress:
            return struct.pack(self.code, len(data)), data
        blocks = [data[n : n + 100] for n in range(0, len(data), 100)]
        squeezed = [zlib.compress(b) for b in blocks]
        numbers = [len(blocks), 100, len(data) % 100, *map(len, squeezed)]
        return b"".join(struct.pack(self.code, n) for n in numbers), b"".join(squeezed)

    def array(self, name: str, kind: str, values: np.ndarray, width: int = 1) -> str:
        head = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" '
        if self.form == "ascii":
            return head + f'format="ascii">{" ".join(map(repr, values.ravel().tolist()))}</DataArray>'
        header, data = self.packed(values.astype(values.dtype.newbyteorder(self.order)).tobytes())
        if self.compress:
            coded = base64.b64encode(header) + base64.b64encode(data)
        else:
            coded = base64.b64encode(header + data)
        if self.form == "binary":
            return head + f'format="binary">\n{coded.decode()}\n</DataArray>'
        offset = len(self.appended)
        self.appended += coded if self.form == "base64" else header + data
        return head + f'format="appended" offset="{offset}"/>'


def _write(
    path: Path,
    form: str = "ascii",
    header: str = "UInt32",
    compress: bool = False,
    *,
    radius_name: str = "Radius",
    space: str | None = "LPS",
    points: np.ndarray = POINTS,
    order: str = "<",
) -> None:
    e = _Encoder(form, header, compress, order)
    unstructured = path.suffix == ".vtu"
    kind, cells = ("UnstructuredGrid", "Cells") if unstructured else ("PolyData", "Lines")
    attributes = f' header_type="{header}"' + (' compressor="vtkZLibDataCompressor"' if compress else "")
    codes = " ".join(str(c) for c in f"{space}\0".encode())
    field = f'<Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{codes}</Array>'
    parts = [
        f'<VTKFile type="{kind}" byte_order="{"LittleEndian" if order == "<" else "BigEndian"}"{attributes}>',
        f"<{kind}><FieldData>{field if space else ''}</FieldData>",
        f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="3" NumberOfLines="3">',
        "<PointData>" + e.array(radius_name, "Float64", RADIUS) + "</PointData>",
        "<Points>" + e.array("Points", "Float64", points, 3) + "</Points>",
        f"<{cells}>" + e.array("connectivity", "Int64", np.concatenate(LINES)),
        e.array("offsets", "Int64", np.cumsum([len(line) for line in LINES])),
        e.array("types", "UInt8", np.full(3, 4, np.uint8)) if unstructured else "",
        f"</{cells}></Piece></{kind}>",
    ]
    content = "\n".join(parts).encode()
    if form in ("raw", "base64"):
        content += f'<AppendedData encoding="{form}">\n_'.encode() + e.appended + b"\n</AppendedData>"
    path.write_bytes(content + b"\n</VTKFile>\n")


def _same(a: AirwayTree, b: AirwayTree) -> bool:
    names = ("points_lps", "radius_mm", "parent_point", "branch_start", "generation", "tangents")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)


@pytest.mark.parametrize("suffix", [".vtp", ".vtu"])
@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("header", ["UInt32", "UInt64"])
@pytest.mark.parametrize("form", ["ascii", "binary", "base64", "raw"])
def test_every_encoding_gives_the_same_tree(
    tmp_path: Path, form: str, header: str, compress: bool, suffix: str
):
    path = tmp_path / f"tree{suffix}"
    _write(path, form, header, compress)
    assert _same(read_centerlines(path), _tree())


def test_big_endian(tmp_path: Path):
    _write(tmp_path / "a.vtp", "raw", order=">")
    assert _same(read_centerlines(tmp_path / "a.vtp"), _tree())


@pytest.mark.parametrize("name", ["Radius", "radius", "MaximumInscribedSphereRadius"])
def test_names_of_the_radius(tmp_path: Path, name: str):
    _write(tmp_path / "a.vtp", radius_name=name)
    assert _same(read_centerlines(tmp_path / "a.vtp"), _tree())


def test_missing_radius_names_what_is_there(tmp_path: Path):
    _write(tmp_path / "a.vtp", radius_name="Curvature")
    with pytest.raises(FileError, match="Curvature"):
        read_centerlines(tmp_path / "a.vtp")


def test_ras_file_is_flipped(tmp_path: Path):
    _write(tmp_path / "a.vtp", space="RAS", points=POINTS * (-1, -1, 1))
    tree = read_centerlines(tmp_path / "a.vtp")
    assert _same(tree, _tree())
    longest = tree.branch_points(1 + int(np.argmax(tree.branch_length_mm[1:])))
    assert tree.points_lps[longest[-1], 0] > 0


def test_frame_must_be_stated_once(tmp_path: Path):
    _write(tmp_path / "a.vtp", space=None)
    with pytest.raises(FrameError, match="does not state"):
        read_centerlines(tmp_path / "a.vtp")
    assert _same(read_centerlines(tmp_path / "a.vtp", frame="lps"), _tree())
    _write(tmp_path / "b.vtp", space="RAS")
    with pytest.raises(FrameError, match="states RAS"):
        read_centerlines(tmp_path / "b.vtp", frame="lps")
    _write(tmp_path / "c.vtp", space="scanner")
    with pytest.raises(FrameError, match="scanner"):
        read_centerlines(tmp_path / "c.vtp")


def test_written_tree_is_read_back_without_loss(tmp_path: Path):
    write_centerlines(tmp_path / "a.vtp", _tree())
    assert _same(read_centerlines(tmp_path / "a.vtp"), _tree())
    assert [p.name for p in tmp_path.iterdir()] == ["a.vtp"]


@pytest.mark.parametrize("form", ["ascii", "binary", "base64", "raw"])
@pytest.mark.parametrize("compress", [False, True])
def test_truncated_file_is_refused(tmp_path: Path, form: str, compress: bool):
    path = tmp_path / "a.vtp"
    _write(path, form, "UInt64", compress)
    content = path.read_bytes()
    for share in (0.0, 0.2, 0.5, 0.8, 0.9):
        path.write_bytes(content[: int(len(content) * share)])
        with pytest.raises(FileError):
            read_centerlines(path)


def test_other_files_are_refused(tmp_path: Path):
    with pytest.raises(FileError, match="no file"):
        read_centerlines(tmp_path / "none.vtp")
    path = tmp_path / "a.vtp"
    _write(path)
    text = path.read_text()
    for old, new in (
        ('type="PolyData"', 'type="ImageData"'),
        ("<PolyData>", "<!DOCTYPE x><PolyData>"),
        ('header_type="UInt32"', 'compressor="vtkLZ4DataCompressor"'),
        ('NumberOfPoints="27"', 'NumberOfPoints="28"'),
        ("VTKFile", "Other"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(FileError):
            read_centerlines(path)


def test_surface_is_refused(tmp_path: Path):
    path = tmp_path / "a.vtu"
    _write(path)
    path.write_text(path.read_text().replace(">4 4 4<", ">5 5 5<"))
    with pytest.raises(FileError, match="VTK types"):
        read_centerlines(path)


def test_unwritable_name_and_folder(tmp_path: Path):
    with pytest.raises(FileError, match=r"\.vtp"):
        write_centerlines(tmp_path / "a.vtk", _tree())
    with pytest.raises(FileError, match="cannot be written"):
        write_centerlines(tmp_path / "none" / "a.vtp", _tree())


@pytest.mark.data
def test_real_centrelines(data_dir: Path):
    tree = read_centerlines(data_dir / "airway-tree" / "TestSubject002MajorAirways.vtu", frame="lps")
    # The root is one of the 84 ends.
    assert len(tree.leaf_branches) == 83
    assert tree.points_lps[0, 2] > tree.carina_lps[2] + 40
    assert 6.0 < tree.branch_mean_radius_mm[0] < 8.2
    main = sorted(tree.children(0), key=lambda b: tree.points_lps[tree.branch_points(b)[-1], 0])
    right, left = tree.branch_length_mm[main]
    assert left > 1.5 * right
