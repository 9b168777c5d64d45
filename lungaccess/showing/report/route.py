"""A route along tubes: from two sides, with its curvature and its distance to the wall."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from anatomy.base.typed import Float
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.views import CORONAL, SAGITTAL, View
from stages.scope.route import Centreline, Curve, Route

WIDTH_IN, HEIGHT_IN = 15.0, 9.0
VIEWS_IN = ((0.5, 3.6, 6.9, 4.7), (7.9, 3.6, 6.6, 4.7))
GRAPHS_IN = ((0.9, 0.95, 6.2, 2.1), (8.3, 0.95, 6.2, 2.1))
FLAT = View(name="The drawing", right=np.array([1.0, 0, 0]), up=np.array([0, -1.0, 0]))
PER_SPAN = 16
"""Points drawn for each span of the spline."""
AROUND_MM = 6.0
"""Border around the route in a picture."""


@style.plain_look
def route_png(name: str, centreline: Centreline, route: Route, path: str | os.PathLike[str]) -> Path:
    """Draw a route in its tubes, the tentative curve beside it, and both along their length.

    Raises FileError if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    flat = bool(np.ptp(centreline.nodes_mm[:, 2]) == 0.0)
    boxes = ((0.5, 3.6, 14.0, 4.7),) if flat else VIEWS_IN
    for box, view in zip(boxes, (FLAT,) if flat else (CORONAL, SAGITTAL), strict=True):
        _view(style.panel(figure, box), centreline, route, view)
    bend, wall = (style.panel(figure, box) for box in GRAPHS_IN)
    most, least_mm = route.limits.max_curvature_per_mm, route.limits.needed_mm
    _graph(bend, route, lambda curve, at: curve.curvature_per_mm(at), most, "curvature, 1/mm")
    bend.set_ylim(0.0, 3.0 * most)

    def depth_mm(curve: Curve, at: Float) -> Float:
        return np.maximum(centreline.depth_mm(curve.at(at)[0]), -1.0)

    _graph(wall, route, depth_mm, least_mm, "distance to the wall, mm")
    wall.set_ylim(bottom=min(0.0, wall.get_ylim()[0]))
    verdict = "proved on the whole curve" if route.proved else "NOT PROVED"
    style.heading(
        figure, f"{name}: route of {route.curve.length_mm():.0f} mm, repair {route.repair!r}, {verdict}"
    )
    figure.legend(handles=_legend(), loc="lower center", ncol=4, frameon=False, fontsize=10)
    return style.save_png(figure, path)


def _view(axes: Axes, centreline: Centreline, route: Route, view: View) -> None:
    nodes = view.project(centreline.nodes_mm)
    curve, tentative = view.project(route.curve.sampled()), view.project(route.tentative.sampled())
    low, high = (
        np.minimum(curve.min(axis=0), tentative.min(axis=0)),
        np.maximum(curve.max(axis=0), tentative.max(axis=0)),
    )
    drawing.fit(axes, low - AROUND_MM, high + AROUND_MM)
    _lumen(axes, centreline, nodes)
    axes.plot(*tentative.T, color=style.TUBE, lw=1.2, zorder=5)
    drawing.curve(axes, curve, style.SCOPE, 2.2, 6)
    for point, mark in ((route.guide.points_mm[0], "s"), (route.guide.points_mm[-1], "*")):
        axes.plot(
            *view.project(point), marker=mark, ms=11, mfc=style.NODULE, mec="white", ls="none", zorder=8
        )
    if view is FLAT:
        axes.set_xticks([])
        axes.set_yticks([])
    else:
        drawing.dress(axes, view, ticks=False)
    drawing.title(axes, view.name)
    drawing.scale_bar(axes)


def _lumen(axes: Axes, centreline: Centreline, nodes: Float) -> None:
    """Paint every edge as wide as its tube: the lumen seen through."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    a, b = centreline.edges.T
    middle = 0.5 * (nodes[a] + nodes[b])
    margin = float(centreline.radius_mm.max())
    seen = (middle[:, 0] > left - margin) & (middle[:, 0] < right + margin)
    seen &= (middle[:, 1] > bottom - margin) & (middle[:, 1] < top + margin)
    a, b = a[seen], b[seen]
    box = axes.get_position()
    inches = box.width * WIDTH_IN
    points_per_mm = 72.0 * inches / (right - left)
    width = points_per_mm * (centreline.radius_mm[a] + centreline.radius_mm[b])
    lines = LineCollection(list(np.stack((nodes[a], nodes[b]), axis=1)), colors=style.LUMEN, zorder=2)
    lines.set_linewidth(width.tolist())
    lines.set_capstyle("round")
    axes.add_collection(lines)


def _graph(axes: Axes, route: Route, value: Callable[[Curve, Float], Float], limit: float, name: str) -> None:
    """Draw a value of both curves along their length, and its limit."""
    for curve, colour in ((route.tentative, style.TUBE), (route.curve, style.SCOPE)):
        parameters = curve.parameters(PER_SPAN)
        step = np.linalg.norm(np.diff(curve.at(parameters)[0], axis=0), axis=1)
        axes.plot(np.append(0.0, np.cumsum(step)), value(curve, parameters), color=colour, lw=1.4)
    axes.axhline(limit, color=style.INK, lw=1.0, ls=(0, (4, 3)))
    drawing.graph(axes, "length along the curve, mm", name)
    axes.margins(x=0.0)


def _legend() -> list[Line2D | Patch]:
    return [
        Line2D([], [], color=style.SCOPE, lw=2.2, label="route"),
        Line2D([], [], color=style.TUBE, lw=1.2, label="tentative spline"),
        Line2D([], [], color=style.INK, lw=1.0, ls=(0, (4, 3)), label="limit"),
        Patch(facecolor=style.LUMEN, label="lumen"),
    ]
