"""Centreline files: .vtp and .vtu with a radius at every point, as an `AirwayTree` and back."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import FileError, FrameError
from anatomy.base.files import require_suffix, write_text
from anatomy.base.typed import Float, Int
from anatomy.grid import transform_points
from anatomy.io.frames import LPS_FROM, MOST_COORDINATE_MM, Frame
from anatomy.io.vtk_xml import VtkFile, VtkPiece, read_vtk_xml
from anatomy.tree import tree_from_graph

RADIUS_NAMES = ("Radius", "radius", "MaximumInscribedSphereRadius")

_VTK_LINE, _VTK_POLY_LINE = 3, 4


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
    """Read the lines of a centreline file of any tubes, airways or vessels; see `read_centerlines`.

    Returns:
        (N, 3) float64, (N,) float64, (E, 2) int64: Points in LPS mm, radii in mm, and pairs of points that
            follow each other on a line.

    Raises:
        FileError, FrameError: As `read_centerlines`.
    """
    file = read_vtk_xml(path)
    lps_from_file = LPS_FROM[_frame(file, path, frame)]
    points, radii, edges, count = [], [], [], 0
    for piece in file.pieces:
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


def _frame(file: VtkFile, path: str | Path, given: Frame | None) -> Frame:
    text = bytes(file.field_data.get("SPACE", np.zeros(0, np.uint8)).astype(np.uint8)).decode("latin-1")
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


def _radius(piece: VtkPiece, path: str | Path) -> Float:
    for name in RADIUS_NAMES:
        if name in piece.point_data:
            radius = piece.point_data[name].astype(np.float64)
            if (
                radius.shape != (len(piece.points),)
                or not (radius >= 0).all()
                or not np.isfinite(radius).all()
            ):
                raise FileError(
                    f"{path} has radii in {name!r} that are negative or no numbers",
                    expected="one length in mm a point",
                    remedy="Export the centreline again",
                )
            return radius
    raise FileError(
        f"{path} has no radius; its point arrays are {sorted(piece.point_data)}",
        expected=f"a point array named {', '.join(RADIUS_NAMES)}",
        remedy="Export the centreline with its radius",
    )


def _edges(piece: VtkPiece, path: str | Path) -> Int:
    """Return the pairs of points `(E, 2)` that follow each other on a line."""
    types = piece.cell_types
    if types is not None and not np.isin(types, (_VTK_LINE, _VTK_POLY_LINE)).all():
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

    Every branch after the first begins with the point it hangs on.  No digit is lost.

    Raises:
        FileError: If the name does not end in .vtp, or the file cannot be written.
    """
    require_suffix(path, ".vtp")
    lines = []
    for b in range(tree.n_branches):
        nodes = tree.branch_points(b).tolist()
        lines.append(nodes if b == 0 else [int(tree.parent_point[nodes[0]]), *nodes])
    ends = np.cumsum([len(line) for line in lines]).tolist()
    space = " ".join(str(c) for c in b"LPS\0")
    generation = tree.generation[tree.branch_of_point]
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
            _data_array("Int64", "Generation", generation.tolist()),
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
