"""The picture of a reachability map: three planes of what is reached and how clear, with the shares."""

import os
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from anatomy.base.typed import Bool, Float, UInt8
from anatomy.base.words import percent
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.planning.reachability import ReachMap
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import STANDARD, View

WIDTH_IN, HEIGHT_IN = 18.0, 11.0
LEFTS_IN, WIDTHS_IN = (0.55, 5.55, 10.55), (4.5, 4.5, 3.4)
BOTTOMS_IN, PANEL_IN = (5.75, 0.8), 4.3
BAR_IN = (14.1, 1.0, 0.15, 3.8)
TEXT_IN = (14.2, 10.0)
PIXEL_MM = 0.75
CLEARANCE_MM = (0.0, 8.0)

COLOURS: dict[str, str] = {
    "direct arc": "#009E73",
    "search": "#8FD3B6",
    "undecided": "#C4C4C4",
    "unreachable": "#D55E00",
}


@style.plain_look
def reach_png(reach: ReachMap, lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw a reachability map in three planes and write the picture to `path`.

    Each plane is the one with the most lung tissue.  Airways and vessels that it cuts are drawn over the
    map.  Borders are smoothed, so that a single voxel of a kind may vanish; shares and volumes count it.
    The upper row shows what is reached, the lower one the clearance of the best path found.

    FileError is raised if the file cannot be written, as when the folder is missing.  Returns its path.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    centre = fullest_point(reach.kinds)
    points = reach.kinds.grid.lps(np.argwhere(reach.kinds.array > 0))
    if not len(points):
        points = reach.kinds.grid.lps(np.array([[0, 0, 0], reach.kinds.grid.shape]))
    for left, width, view in zip(LEFTS_IN, WIDTHS_IN, STANDARD, strict=True):
        for bottom, paint in zip(BOTTOMS_IN, (_kind_colours, _clearance_colours), strict=True):
            axes = style.panel(figure, (left, bottom, width, PANEL_IN))
            uv = view.project(points)
            drawing.fit(axes, uv.min(axis=0) - 6.0, uv.max(axis=0) + 6.0)
            lps, extent = _plane(axes, view, centre)
            image = paint(reach, lps)
            image[~layers.cut("lung", lps)] = 0.0
            axes.imshow(image, extent=extent, origin="lower", aspect="auto", zorder=1)
            _anatomy(axes, layers, lps, extent)
            drawing.dress(axes, view, ticks=True)
            depth = float(centre @ view.towards_viewer)
            axis = "xyz"[int(np.argmax(np.abs(view.towards_viewer)))]
            sign = float(np.sign(view.towards_viewer.sum()))
            drawing.title(axes, f"{view.name}, {axis} = {sign * depth:.0f}")
    _bar(figure)
    _text(figure, reach)
    return style.save_png(figure, path)


def fullest_point(kinds: Volume) -> Float:
    """Return a point `(3,)` LPS mm through whose three LPS planes the most counted voxels pass."""
    points = kinds.grid.lps(np.argwhere(kinds.array > 0))
    if not len(points):
        return kinds.grid.lps(np.array(kinds.grid.shape) / 2.0)
    width = float(kinds.grid.spacing_mm.max())
    centre = np.zeros(3)
    for axis in range(3):
        slots = np.floor(points[:, axis] / width).astype(np.int64)
        counts = np.bincount(slots - slots.min())
        centre[axis] = (slots.min() + int(np.argmax(counts)) + 0.5) * width
    return centre


def _plane(axes: Axes, view: View, centre: Float) -> tuple[Float, tuple[float, float, float, float]]:
    """Return the points `(rows, columns, 3)` of a picture plane through `centre`, and its extent."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    u = np.arange(left + 0.5 * PIXEL_MM, right, PIXEL_MM)
    v = np.arange(bottom + 0.5 * PIXEL_MM, top, PIXEL_MM)
    depth = float(centre @ view.towards_viewer)
    lps = (
        u[None, :, None] * view.right
        + v[:, None, None] * view.up
        + depth * view.towards_viewer[None, None, :]
    )
    return lps, (left, left + len(u) * PIXEL_MM, bottom, bottom + len(v) * PIXEL_MM)


def _between(reach: ReachMap, values: Float | Bool, lps: Float) -> Float:
    """Return values of voxels at points `(..., 3)`, smooth between the centres and 0 beyond the grid."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    places = np.moveaxis(reach.kinds.grid.ijk(lps), -1, 0)
    # A Gaussian of this many voxels takes the steps of the borders.
    smooth = gaussian_filter(values.astype(np.float64), 0.7, mode="constant")
    return np.asarray(map_coordinates(smooth, places, order=1, mode="constant"))


def _likeliest(reach: ReachMap, lps: Float) -> tuple[UInt8, Float]:
    """Return the place in `KINDS` of the kind that weighs most at each point, and what all kinds weigh.

    Borders so run between the centres of voxels and not along their sides, as a map of 10 mm has few of them.
    """
    from lungaccess.planning.reachability import KINDS

    weights = np.array([_between(reach, reach.kinds.array == code, lps) for code in KINDS.values()])
    return weights.argmax(axis=0).astype(np.uint8), weights.sum(axis=0)


def _kind_colours(reach: ReachMap, lps: Float) -> Float:
    places, weight = _likeliest(reach, lps)
    image = np.array([(*to_rgb(colour), 0.85) for colour in COLOURS.values()])[places]
    image[weight <= 0.0] = 0.0
    return image


def _clearance_colours(reach: ReachMap, lps: Float) -> Float:
    places, weight = _likeliest(reach, lps)
    found = reach.kinds.array > 0
    found &= reach.clearance_mm.array > 0.0
    known = _between(reach, found, lps)
    clearance = _between(reach, np.where(found, reach.clearance_mm.array, 0.0), lps) / np.maximum(known, 1e-9)
    image = matplotlib.colormaps["viridis"](Normalize(*CLEARANCE_MM)(clearance))
    # The first two kinds of `COLOURS` are reached.
    image[(places > 1) | (known <= 0.0)] = (*to_rgb("#E6E6E6"), 1.0)
    image[weight <= 0.0] = 0.0
    return np.asarray(image)


def _anatomy(axes: Axes, layers: Layers, lps: Float, extent: tuple[float, float, float, float]) -> None:
    """Draw what the plane cuts of airways, vessels and fissures."""
    for name, colour in (("vessel", style.VESSEL), ("fissure", style.FISSURE), ("airway", style.SCOPE)):
        image = np.zeros((*lps.shape[:-1], 4))
        image[layers.cut(name, lps)] = (*to_rgb(colour), 0.9)
        axes.imshow(image, extent=extent, origin="lower", aspect="auto", interpolation="nearest", zorder=2)


def _bar(figure: Figure) -> None:
    axes = style.panel(figure, BAR_IN)
    bar = figure.colorbar(
        ScalarMappable(norm=Normalize(*CLEARANCE_MM), cmap="viridis"), cax=axes, extend="max"
    )
    bar.set_label("clearance of the best path found, mm; grey: none", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _text(figure: Figure, reach: ReachMap) -> None:
    from lungaccess.planning.reachability import KINDS, STATES

    system = reach.system
    style.heading(figure, reach.words, size=15)
    total = reach.total
    figure.legend(
        handles=[
            Patch(color=COLOURS[name], label=f"{name}: {percent(share)}")
            for name, share in zip(KINDS, total.shares, strict=True)
        ]
        + [
            Patch(color=style.SCOPE, label="airway"),
            Patch(color=style.VESSEL, label="vessel"),
            Patch(color=style.FISSURE, label="fissure"),
        ],
        loc="upper left", bbox_to_anchor=(TEXT_IN[0] / WIDTH_IN, TEXT_IN[1] / HEIGHT_IN), fontsize=10,
        frameon=False, title="share of the counted lung tissue", alignment="left",
    )  # fmt: skip
    lines = ["region: mL reachable / unreachable / undecided"]
    lines += [
        f"{row.name}: " + " / ".join(f"{row.state_ml(state):.0f}" for state in STATES)
        for row in reach.by_region()
    ]
    diameter, radius = system.needle_sizes
    of_needle = f"needle {diameter} mm,\nradius of curvature {radius} mm" if system.needle else "no needle"
    lines += [
        "",
        f"scope {system.scope.outer_diameter_mm:g} mm, " + of_needle,
        f"fissures {'are obstacles' if reach.with_fissures else 'may be crossed or have no mask'}",
        f"{reach.entries} deployments, voxels of {reach.kinds.grid.spacing_mm[0]:g} mm",
        "not counted: outside the lung, in an obstacle",
    ]
    figure.text(
        TEXT_IN[0] / WIDTH_IN, (TEXT_IN[1] - 2.6) / HEIGHT_IN, "\n".join(lines), va="top", fontsize=10,
        color=style.INK, linespacing=1.5,
    )  # fmt: skip
