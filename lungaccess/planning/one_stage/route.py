"""Sources of centrelines for the route planner, and the record of a route."""

from collections.abc import Collection, Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io.frames import Frame, parse_point
from anatomy.io.liver import LUMENS, is_liver, load_liver

if TYPE_CHECKING:
    from stages.scope.route import Centreline, Route


@frozen_record
class RouteSource:
    """Where a route runs; its kind is "patient", "liver", "centreline", "mask" or "drawing".

    `places` are starts and targets `(3,)` LPS mm that came with a patient, by name.
    """

    name: str
    kind: str
    centreline: "Centreline"
    places: Mapping[str, Float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def place(self, text: str, needed_mm: float = 0.0) -> Float:
        """Return a point `(3,)` LPS mm: one with its frame, or the place in the lumen nearest to a named one.

        The lumen is at least `needed_mm` deep there, if it is so anywhere.  FrameError is raised if the text
        is neither a name nor a point with its frame.
        """
        named = {name.lower(): point for name, point in self.places.items()}
        if text.lower() not in named:
            return parse_point(text)
        fits = self.centreline.radius_mm >= needed_mm
        nodes = self.centreline.nodes_mm[fits if fits.any() else slice(None)]
        return np.asarray(nodes[int(np.argmin(np.linalg.norm(nodes - named[text.lower()], axis=1)))])


def open_source(
    path: Path,
    *,
    lumen: str | None = None,
    frame: Frame | None = None,
    pixel_mm: float | None = None,
    accept: Collection[str] = (),
) -> RouteSource:
    """Return the centreline of a patient folder, a centreline file, a mask of vessels or a drawing.

    Args:
        lumen: Which vessel of a liver, a key of `anatomy.io.liver.LUMENS`; needed for one.
        frame: Frame of a centreline file or mask that states none.
        pixel_mm: Size of a pixel of a drawing; needed for one.

    Raises:
        SettingsError: If a drawing has no pixel size, or a liver is given and no vessel.
        LungaccessError: If the source cannot be read or holds no tubes.
    """
    from stages.scope.route import from_graph, from_image, from_lung, from_mask

    suffix = path.suffix.lower()
    if is_liver(path):
        return _in_liver(path, lumen)
    if lumen is not None:
        raise SettingsError(f"{path} is no liver, so that it has no {lumen}", remedy="Leave --lumen out")
    if path.is_dir():
        from lungaccess.problem.patients import load_patient

        lung = load_patient(path, accept=accept)
        return RouteSource(
            name=lung.name,
            kind="patient",
            centreline=from_lung(lung),
            places=dict(zip(lung.target_names, lung.targets_lps, strict=True))
            | {name: pose[:3, 3] for name, pose in zip(lung.start_names, lung.starts, strict=True)},
            warnings=lung.warnings,
        )
    if suffix in (".vtp", ".vtu"):
        from anatomy.io.centerlines import read_centerline_graph

        graph = read_centerline_graph(path, frame=frame)
        return RouteSource(name=path.stem, kind="centreline", centreline=from_graph(*graph))
    if suffix in (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"):
        if pixel_mm is None:
            raise SettingsError(
                f"The size of a pixel of {path} is not known",
                remedy="Give --pixel in mm",
                expected="its size in mm",
            )
        drawing = from_image(read_drawing(path), pixel_mm=pixel_mm)
        return RouteSource(name=path.stem, kind="drawing", centreline=drawing)
    from anatomy.io import read_mask

    said: list[str] = []
    centreline = from_mask(read_mask(path, frame=frame, say=said.append), rounded=True)
    return RouteSource(name=path.stem, kind="mask", centreline=centreline, warnings=tuple(said))


def _in_liver(folder: Path, lumen: str | None) -> RouteSource:
    from stages.scope.route import from_mask

    if lumen is None or lumen not in LUMENS:
        raise SettingsError(
            f"{folder} is a liver with {len(LUMENS)} trees of vessels",
            expected=f"one of them: --lumen {', --lumen '.join(LUMENS)}",
            remedy="State the vessel in which the catheter moves",
        )
    liver = load_liver(folder)
    return RouteSource(
        name=f"{liver.name}, {lumen.replace('-', ' ')}",
        kind="liver",
        centreline=from_mask(liver.lumens[lumen], rounded=True),
        places=dict(zip(liver.target_names, liver.targets_lps, strict=True))
        | {name: pose[:3, 3] for name, pose in zip(liver.start_names, liver.starts, strict=True)},
        warnings=liver.warnings,
    )


def read_drawing(path: Path) -> Any:
    """Read a picture of vessels, `(rows, columns)` bool: true where it is darker than half the range.

    Where more than half of it would be vessel, the picture is taken for a bright drawing on dark ground.
    FileError is raised if it cannot be read.
    """
    from skimage.io import imread

    try:
        picture = np.asarray(imread(path, as_gray=True), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise FileError(
            f"{path} cannot be read as a picture: {error}",
            expected="PNG, TIFF or JPEG",
            remedy="Convert the picture, or export it again",
        ) from error
    dark = picture < 0.5 * (picture.min() + picture.max())
    return ~dark if dark.mean() > 0.5 else dark


def widest_end(centreline: "Centreline") -> Float:
    """Return the end of the tube system with the widest lumen, `(3,)` mm: where a device usually enters."""
    ends = np.flatnonzero(np.bincount(centreline.edges.ravel(), minlength=centreline.n_nodes) == 1)
    if not len(ends):
        ends = np.arange(centreline.n_nodes)
    return np.asarray(centreline.nodes_mm[ends[int(np.argmax(centreline.radius_mm[ends]))]])


def route_record(source: RouteSource, route: "Route") -> dict[str, Any]:
    """Return a route as plain JSON types, in LPS mm."""
    from anatomy.base.settings import to_mapping
    from stages.scope.route import measure

    measured = measure(route.curve, source.centreline)
    # Spacing of the points in the record: about a voxel; the spline itself is exact.
    count = max(round(route.curve.length_mm() / 0.5), 1)
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
