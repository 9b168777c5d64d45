"""Why there is no plan, as a picture: where needles can start and why each fails, and the nearest misses."""

import os
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.judging.explanation import FAILS, Explanation
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.colours import MISS, NEAREST, OTHER, START_COLOURS
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import AXIAL, CORONAL, View, plane_view
from lungaccess.showing.report.zoom import paint_cut

WIDTH_IN, HEIGHT_IN = 17.0, 7.4
PANELS_IN = ((0.5, 1.0, 5.0, 5.3), (5.9, 1.0, 5.0, 5.3), (11.4, 1.0, 5.3, 5.3))
"""Left, bottom, width and height of the panels."""
HEADLINE_LETTERS = 150
MARGIN_MM = 12.0
BLOCKED_AT = "#D32F2F"
"""Colour of the cross where a path is blocked first."""


@style.plain_look
def no_plan_png(explanation: Explanation, lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw the starts of the needle from the front and the feet, and a cut along the nearest miss.

    FileError is raised if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    for box, view in zip(PANELS_IN, (CORONAL, AXIAL), strict=False):
        _starts_panel(style.panel(figure, box), explanation, layers, view)
    _cut_panel(style.panel(figure, PANELS_IN[2]), explanation, layers)
    figure.legend(
        handles=_legend(explanation), loc="lower left", bbox_to_anchor=(0.02, 0.01), ncols=5, frameon=False,
        fontsize=8.5,
    )  # fmt: skip
    style.heading(figure, "\n".join(textwrap.wrap(explanation.headline, HEADLINE_LETTERS)), size=11.5)
    return style.save_png(figure, path)


def _starts_panel(axes: Axes, explanation: Explanation, layers: Layers, view: View) -> None:
    lung = layers.footprint("lung", view)
    drawing.see_through(axes, layers.footprint("airway", view), style.AIRWAY, 5.0, 0.7)
    drawing.outline(axes, lung, "#B9AEA2", 0.9)
    starts = explanation.starts
    if starts is not None:
        # What is nearest to success lies on top.
        for code in range(len(FAILS) - 1, -1, -1):
            dots = view.project(starts.points_lps[starts.why == code])
            colour = START_COLOURS[tuple(FAILS)[code]]
            axes.scatter(dots[:, 0], dots[:, 1], s=7, c=colour, lw=0, zorder=5 + len(FAILS) - code)
    _paths(axes, explanation, view)
    drawing.fit_around(axes, lung, view.project(explanation.target.lps_mm)[None])
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, f"Starts of the needle: {view.name}")


def _paths(axes: Axes, explanation: Explanation, view: View) -> None:
    for points, colour in (
        (_other(explanation), OTHER),
        (_miss(explanation), MISS),
        (_nearest(explanation), NEAREST),
    ):
        if points is not None:
            drawing.curve(axes, view.project(points), colour, 1.6, 16)
    if explanation.blocked_arc is not None:
        spot = view.project(explanation.blocked_arc.structure.lps_mm)
        axes.plot(*spot, marker="x", ms=10, mew=2.4, color=BLOCKED_AT, ls="none", zorder=18)
    drawing.target_mark(axes, view.project(explanation.target.lps_mm), 19)


def _cut_panel(axes: Axes, explanation: Explanation, layers: Layers) -> None:
    """Cut the anatomy along the nearest miss, and show it around where it is blocked and the target."""
    target = explanation.target.lps_mm
    points = _miss(explanation)
    if points is None:
        points = _nearest(explanation)
    view = CORONAL if points is None else plane_view(np.vstack([points, target]), "")
    shown = [target]
    if explanation.blocked_arc is not None:
        shown.append(explanation.blocked_arc.structure.lps_mm)
    if explanation.neighbour is not None:
        shown.append(explanation.neighbour.plan.target_lps)
    uv = view.project(np.array(shown))
    middle = 0.5 * (uv.min(axis=0) + uv.max(axis=0))
    # The cut shows at least so much around what it is about.
    half = np.maximum(0.5 * np.ptp(uv, axis=0) + MARGIN_MM, 25.0)
    drawing.fit(axes, middle - half, middle + half)
    paint_cut(axes, layers, view, target)
    _paths(axes, explanation, view)
    drawing.dress(axes, view, ticks=False)
    drawing.title(axes, "Cut through the target; paths are projected onto it")


def _miss(explanation: Explanation) -> Float | None:
    """Return the points of the path to the target that violates least."""
    return None if explanation.miss is None else explanation.miss.points_lps


def _nearest(explanation: Explanation) -> Float | None:
    """Return the points of the needle, or of the tubes, to the nearest point that is reached."""
    neighbour = explanation.neighbour
    return None if neighbour is None else neighbour.plan.costed_poses()[0][:, :3, 3]


def _other(explanation: Explanation) -> Float | None:
    """Return the points of the needle, or of the tubes, of the least invasive preset that does."""
    plans = [attempt.plan for attempt in explanation.attempts if attempt.succeeded]
    return None if not plans or plans[0] is None else plans[0].costed_poses()[0][:, :3, 3]


def _legend(explanation: Explanation) -> list[Line2D]:
    counts = {} if explanation.starts is None else explanation.starts.counts
    handles = [
        Line2D([], [], marker="o", ls="none", color=START_COLOURS[key], ms=5, label=f"{why} ({counts[why]})")
        for key, why in FAILS.items()
        if counts.get(why)
    ]  # fmt: skip
    if _miss(explanation) is not None:
        exceeds = explanation.blocked_arc is None
        label = "path that exceeds the needle's limits least" if exceeds else "path that violates least"
        handles.append(Line2D([], [], color=MISS, label=label))
    if _other(explanation) is not None:
        handles.append(Line2D([], [], color=OTHER, label="needle of another preset that reaches the target"))
    if explanation.blocked_arc is not None:
        handles.append(
            Line2D(
                [], [], marker="x", mew=2.4, ls="none", color=BLOCKED_AT, label="where it is blocked first"
            )
        )
    if explanation.neighbour is not None:
        handles.append(
            Line2D([], [], color=NEAREST, label="needle to the nearest point found that is reached")
        )
    handles.append(
        Line2D([], [], marker="o", ls="none", mfc="none", mec=style.TARGET, mew=2.0, ms=8, label="target")
    )
    return handles
