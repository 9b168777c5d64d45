"""Sources of centrelines for the route planner, and the record of a route."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.errors import FileError, SettingsError
from anatomy.io.frames import Frame
from anatomy.records import frozen_record
from anatomy.typed import Float

if TYPE_CHECKING:
    from stages.scope.route import Centreline, Route

CENTRELINE_SUFFIXES = (".vtp", ".vtu")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
CURVE_SPACING_MM = 0.5
"""Spacing of the points in the record: about a voxel; the spline itself is exact."""


@frozen_record
class RouteSource:
    """Where a route runs; its kind is "patient", "centreline", "mask" or "drawing"."""

    name: str
    kind: str
    centreline: Centreline


def open_source(
    path: Path, *, frame: Frame | None = None, pixel_mm: float | None = None, cache: Path | None = None
) -> RouteSource:
    """Return the centreline of a patient folder, a centreline file, a mask of vessels or a drawing.

    Parameters
    ----------
    frame : str, optional
        Frame of a centreline file or mask that states none.
    pixel_mm : float, optional
        Size of a pixel of a drawing; needed for one.
    cache : Path, optional
        Where prepared patients are kept.

    Raises
    ------
    SettingsError
        If a drawing has no pixel size.
    LungaccessError
        If the source cannot be read or holds no tubes.
    """
    from stages.scope.route import from_graph, from_image, from_lung, from_mask

    suffix = path.suffix.lower()
    if path.is_dir():
        from lungaccess.problem.patients import load_patient

        lung = load_patient(path, cache=cache)
        return RouteSource(name=lung.name, kind="patient", centreline=from_lung(lung))
    if suffix in CENTRELINE_SUFFIXES:
        from anatomy.io.centerlines import read_centerline_graph

        graph = read_centerline_graph(path, frame=frame)
        return RouteSource(name=path.stem, kind="centreline", centreline=from_graph(*graph))
    if suffix in PICTURE_SUFFIXES:
        if pixel_mm is None:
            raise SettingsError(f"The size of a pixel of {path} is not known", remedy="Give --pixel in mm")
        drawing = from_image(read_drawing(path), pixel_mm=pixel_mm)
        return RouteSource(name=path.stem, kind="drawing", centreline=drawing)
    from anatomy.io import read_mask

    mask = read_mask(path, frame=frame)
    return RouteSource(name=path.stem, kind="mask", centreline=from_mask(mask, rounded=True))


def read_drawing(path: Path) -> Any:
    """Read a picture of vessels, `(rows, columns)` bool: true where it is darker than half the range.

    Where more than half of it would be vessel, the picture is taken for a bright drawing on dark ground.

    Raises
    ------
    FileError
        If it cannot be read.
    """
    from skimage.io import imread

    try:
        picture = np.asarray(imread(path, as_gray=True), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise FileError(
            f"{path} cannot be read as a picture: {error}", expected="PNG, TIFF or JPEG"
        ) from error
    dark = picture < 0.5 * (picture.min() + picture.max())
    return ~dark if dark.mean() > 0.5 else dark


def widest_end(centreline: Centreline) -> Float:
    """Return the end of the tube system with the widest lumen, `(3,)` mm: where a device usually enters."""
    ends = np.flatnonzero(np.bincount(centreline.edges.ravel(), minlength=centreline.n_nodes) == 1)
    if not len(ends):
        ends = np.arange(centreline.n_nodes)
    return np.asarray(centreline.nodes_mm[ends[int(np.argmax(centreline.radius_mm[ends]))]])


def route_record(source: RouteSource, route: Route) -> dict[str, Any]:
    """Return a route as plain JSON types, in LPS mm."""
    from anatomy.settings import to_mapping
    from stages.scope.route import measure

    measured = measure(route.curve, source.centreline)
    count = max(round(route.curve.length_mm() / CURVE_SPACING_MM), 1)
    parameters = np.linspace(route.curve.breaks[0], route.curve.breaks[-1], count + 1)
    return {
        "source": source.name,
        "kind": source.kind,
        "repair": route.repair,
        "limits": to_mapping(route.limits),
        "proved": route.proved,
        "proved_curvature_per_mm": route.proof.curvature_bound_per_mm,
        "proved_depth_mm": route.proof.depth_bound_mm,
        "length_mm": route.curve.length_mm(),
        "normalised_length": measured.normalised_length,
        "largest_curvature_per_mm": measured.largest_curvature_per_mm,
        "mean_curvature_per_mm": measured.mean_curvature_per_mm,
        "least_wall_mm": measured.least_wall_mm,
        "mean_wall_mm": measured.mean_wall_mm,
        "spline": {
            "degree": 3,
            "knots": route.curve.knots.tolist(),
            "control_lps_mm": route.curve.control_mm.tolist(),
        },
        "points_lps_mm": route.curve.at(parameters)[0].tolist(),
    }
