"""A tour over the airway: how often each stretch is passed, and the order of the lesions."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.poses import pose
from lungaccess.planning import TourAnswer
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import CORONAL, SAGITTAL, View
from stages.needle import direct_path
from stages.scope.tour import Itinerary

WIDTH_IN, HEIGHT_IN = 15.0, 7.6
PANELS_IN = ((0.5, 0.9, 6.9, 5.8), (7.9, 0.9, 6.6, 5.8))
PASS_COLOURS = {1: style.TUBE, 2: style.SCOPE}


@style.plain_look
def tour_png(answer: TourAnswer, lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw the shortest tour of a patient from the front and from the left.

    Stretches that are passed once and twice have different colours; lesions are numbered in the order of
    visits, and an arc that leaves along the airway joins each to its exit.

    FileError is raised if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    for box, view in zip(PANELS_IN, (CORONAL, SAGITTAL), strict=True):
        axes = style.panel(figure, box)
        _panel(axes, answer, lung.tree, layers, view)
    tour = answer.shortest
    style.heading(
        figure,
        f"{lung.name}: {answer.title}, {tour.length_mm:.0f} mm ({answer.one_by_one_mm:.0f} mm one by one)",
    )
    figure.legend(handles=_legend(), loc="lower center", ncol=3, frameon=False, fontsize=10)
    return style.save_png(figure, path)


def _panel(axes: Axes, answer: TourAnswer, tree: AirwayTree, layers: Layers, view: View) -> None:
    lung = layers.footprint("lung", view)
    drawing.see_through(axes, lung, "#CDBBA7", 120.0, 0.25)
    drawing.see_through(axes, layers.footprint("airway", view), style.AIRWAY, 14.0, 0.5)
    drawing.outline(axes, lung, "#8A7B6B", 0.9)
    _stretches(axes, answer.shortest, tree, view)
    visits = answer.shortest.visits
    lesions = view.project(answer.lesions_lps[[visit.lesion for visit in visits]])
    places = drawing.beside(axes, lesions, view.project(tree.points_lps).mean(axis=0))
    for number, (visit, place) in enumerate(zip(visits, places, strict=True), 1):
        ends = view.project(_way_out(tree, visit.tree_point, answer.lesions_lps[visit.lesion]))
        drawing.curve(axes, ends, style.NEEDLE, 1.6, 8)
        axes.plot(*ends[0], marker="o", ms=5, mfc="white", mec=style.NEEDLE, zorder=9, ls="none")
        axes.plot(*ends[-1], marker="o", ms=7, mfc=style.NODULE, mec="white", mew=0.8, zorder=9, ls="none")
        axes.plot(*place, marker="o", ms=15, mfc=style.NODULE, mec="white", mew=1.2, zorder=10, ls="none")
        axes.text(
            place[0], place[1], str(number), ha="center", va="center", color="white", fontsize=10,
            fontweight="bold", zorder=11,
        )  # fmt: skip
    drawing.fit_around(axes, lung, view.project(np.vstack((answer.lesions_lps, tree.points_lps))))
    drawing.dress(axes, view, ticks=False)
    drawing.title(axes, view.name)
    drawing.scale_bar(axes)


def _way_out(tree: AirwayTree, point: int, lesion_lps: Float) -> Float:
    """Return points `(N, 3)` from an exit to its lesion: the arc that leaves along the airway.

    A lesion behind the exit is on no such arc, and is joined by a line.
    """
    begin, tangent = tree.points_lps[point], tree.tangents[point]
    if (lesion_lps - begin) @ tangent <= 0.0:
        return np.stack((begin, lesion_lps))
    return np.asarray(direct_path(pose(begin, tangent), lesion_lps).sample(1.0)[0])


def _stretches(axes: Axes, tour: Itinerary, tree: AirwayTree, view: View) -> None:
    subtree = tour.subtree
    for v in np.flatnonzero(tour.passes > 0).tolist():
        point, end = int(subtree.tree_point[v]), int(subtree.tree_point[subtree.parent[v]])
        line = [point]
        while line[-1] != end:
            line.append(int(tree.parent_point[line[-1]]))
        uv = view.project(tree.points_lps[line])
        drawing.curve(axes, uv, PASS_COLOURS[int(tour.passes[v])], 3.0, 6)


def _legend() -> list[Line2D]:
    return [
        Line2D([], [], color=PASS_COLOURS[2], lw=3, label="passed twice"),
        Line2D([], [], color=PASS_COLOURS[1], lw=3, label="passed once: the path to the last lesion"),
        Line2D([], [], marker="o", mfc="white", mec=style.NEEDLE, ls="none", label="exit"),
        Line2D([], [], marker="o", ms=12, mfc=style.NODULE, mec="white", ls="none",
               label="lesion, by the order of visits"),
        Line2D([], [], color=style.NEEDLE, lw=1.6,
               label="exit to lesion: an arc that leaves along the airway"),
    ]  # fmt: skip
