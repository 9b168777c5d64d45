"""A proof of unreachability as a picture: from where deployments are ruled out, and from where not."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from anatomy.base.typed import Float
from anatomy.base.words import percent
from anatomy.lung import Lung
from lungaccess.planning.reachability import ReachVerdict, UnreachableProof
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import AXIAL, CORONAL, View

WIDTH_IN, HEIGHT_IN = 12.4, 7.2
PANELS_IN = ((0.6, 1.0, 5.3, 5.3), (6.6, 1.0, 5.3, 5.3))
"""Left, bottom, width and height of the panels."""
NARROWEST = "#D55E00"
"""Colour of a place that is too small to halve."""
LEAST_SIZE, GREATEST_SIZE = 8.0, 60.0
"""The area of a dot grows with the share of the deployment space that is open there."""
NAMED = 3
"""Places that are numbered and named in the legend."""


@style.plain_look
def open_places_png(
    lung: Lung,
    proof: UnreachableProof,
    verdict: ReachVerdict,
    target_lps: Float,
    path: str | os.PathLike[str],
) -> Path:
    """Draw the places of the scope tip that are ruled out and those that are open, in two views.

    FileError is raised if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    for box, view in zip(PANELS_IN, (CORONAL, AXIAL), strict=True):
        _panel(style.panel(figure, box), layers, view, proof, verdict, target_lps)
    figure.legend(
        handles=_legend(verdict), loc="lower left", bbox_to_anchor=(0.02, 0.01), ncols=3, frameon=False,
        fontsize=8.5,
    )  # fmt: skip
    said = "proved unreachable" if verdict.proved else f"{len(verdict.open_places)} places are open"
    style.heading(
        figure, f"{lung.name}: {said}, {percent(verdict.share_ruled_out)} of the deployments ruled out"
    )
    return style.save_png(figure, path)


def _panel(
    axes: Axes, layers: Layers, view: View, proof: UnreachableProof, verdict: ReachVerdict, target_lps: Float
) -> None:
    lung = layers.footprint("lung", view)
    drawing.see_through(axes, layers.footprint("airway", view), style.AIRWAY, 5.0, 0.5)
    drawing.outline(axes, lung, "#B9AEA2", 0.9)
    tips = [piece.cones[piece.cones[:, 6] > 0.0, :3] for piece in proof.space.pieces]
    if tips:
        dots = view.project(np.concatenate(tips))
        axes.scatter(dots[:, 0], dots[:, 1], s=LEAST_SIZE, c=style.NODULE, lw=0, zorder=5)
    largest = max((place.share for place in verdict.open_places), default=1.0)
    for number, place in enumerate(verdict.open_places):
        dots = view.project(place.points_lps)
        size = LEAST_SIZE + (GREATEST_SIZE - LEAST_SIZE) * place.share / max(largest, 1e-300)
        colour = NARROWEST if place.narrowest else style.TUBE
        axes.scatter(dots[:, 0], dots[:, 1], s=size, c=colour, lw=0, zorder=7)
        if number < NAMED:
            middle = dots.mean(axis=0)
            axes.text(
                middle[0], middle[1], f" {number + 1}", fontsize=10, fontweight="bold", color=style.INK,
                path_effects=drawing.halo(2.5), zorder=15,
            )  # fmt: skip
    spot = view.project(target_lps)
    drawing.target_mark(axes, spot, 19)
    drawing.fit_around(axes, lung, spot[None])
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, f"Places of the scope tip: {view.name}")


def _legend(verdict: ReachVerdict) -> list[Line2D]:
    def dot(colour: str, label: str) -> Line2D:
        return Line2D([], [], marker="o", ls="none", color=colour, ms=5, label=label)

    handles = [dot(style.NODULE, "all deployments ruled out")]
    if any(not place.narrowest for place in verdict.open_places):
        handles.append(dot(style.TUBE, "not looked at to the end"))
    if any(place.narrowest for place in verdict.open_places):
        handles.append(dot(NARROWEST, "a part too small to halve is open"))
    handles += [
        Line2D(
            [],
            [],
            ls="none",
            label=f"{n + 1}: branch {place.name}, {percent(place.share)} of the deployments open",
        )
        for n, place in enumerate(verdict.open_places[:NAMED])
    ]
    handles.append(
        Line2D([], [], marker="o", ls="none", mfc="none", mec=style.TARGET, mew=2.0, ms=8, label="target")
    )
    return handles
