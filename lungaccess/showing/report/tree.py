"""The airway tree over its mask, coloured by generation; and an organ without airways."""

import os
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.organ import Organ
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import STANDARD, View

WIDTH_IN, HEIGHT_IN = 17.0, 6.6
PANELS_IN = ((0.55, 0.6, 5.4, 5.3), (6.5, 0.6, 5.4, 5.3), (12.4, 0.6, 3.6, 5.3))
BAR_IN = (16.2, 0.8, 0.16, 4.9)
"""Left, bottom, width and height of panels and colour bar."""


@style.plain_look
def tree_png(lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw the airway tree of a patient over the airway mask, from three sides.

    Every branch has the colour of its generation (trachea 0) and a width that follows its radius;
    the carina and every gap that was bridged are marked.  Segmental bronchi have their names.

    FileError is raised if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    # One colour a generation, distinct in lightness too.
    deepest = int(np.max(lung.tree.generation))
    shades = matplotlib.colormaps["plasma"](np.linspace(0.0, 0.88, deepest + 1))
    colours, norm = ListedColormap(shades), BoundaryNorm(np.arange(deepest + 2) - 0.5, deepest + 1)
    for box, view in zip(PANELS_IN, STANDARD, strict=True):
        axes = style.panel(figure, box)
        _tree_panel(axes, lung.tree, layers, view, colours, norm)
    bar = figure.colorbar(ScalarMappable(norm=norm, cmap=colours), cax=style.panel(figure, BAR_IN))
    bar.set_ticks(range(deepest + 1), labels=[str(g) for g in range(deepest + 1)], fontsize=8)
    bar.set_label("generation (trachea 0)", fontsize=9)
    style.heading(
        figure, f"Airway tree of {lung.name}: {lung.tree.n_branches} branches, up to generation {deepest}"
    )
    return style.save_png(figure, path)


def _tree_panel(
    axes: Axes, tree: AirwayTree, layers: Layers, view: View, colours: Colormap, norm: BoundaryNorm
) -> None:
    points = view.project(tree.points_lps)
    lung = layers.footprint("lung", view)
    drawing.see_through(axes, layers.footprint("airway", view), "#555555", 5.0, 0.45)
    drawing.outline(axes, lung, "#B9AEA2", 0.8)
    axes.add_collection(_branches(tree, points, colours, norm))
    carina = view.project(np.asarray(tree.carina_lps))
    axes.plot(*carina, marker="*", ms=13, mfc="white", mec=style.INK, mew=1.0, ls="none", zorder=9)
    for gap in tree.report.gaps_bridged:
        u, v = view.project(np.asarray(gap.position_lps))
        axes.plot(u, v, marker="x", ms=7, color="#00A0A0", mew=1.8, ls="none", zorder=9)
    drawing.fit_around(axes, lung, points)
    _names(axes, tree, points)
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, view.name)


def _names(axes: Axes, tree: AirwayTree, points: Float) -> None:
    """Write the names of segmental bronchi beside their ends, moved outwards until none covers another."""
    named = [n for n in np.flatnonzero(tree.bronchi.starts).tolist() if tree.bronchi.segments[n]]
    ends = points[[np.flatnonzero(tree.branch_of_point == branch)[-1] for branch in named]]
    for branch, place in zip(named, drawing.beside(axes, ends, points.mean(axis=0)), strict=True):
        axes.text(
            place[0], place[1], tree.bronchi.names[branch], ha="center", va="center", fontsize=7,
            color=style.INK, path_effects=drawing.halo(2.0), zorder=10,
        )  # fmt: skip


def _branches(tree: AirwayTree, points: Float, colours: Colormap, norm: BoundaryNorm) -> LineCollection:
    """Join each point to its parent; deep branches lie on top."""
    child = np.flatnonzero(np.asarray(tree.parent_point) >= 0)
    generation = np.asarray(tree.generation)[tree.branch_of_point[child]]
    child = child[np.argsort(generation, kind="stable")]
    segments = np.stack([points[tree.parent_point[child]], points[child]], axis=1)
    lines = LineCollection(list(segments), cmap=colours, norm=norm, zorder=5, capstyle="round")
    lines.set_array(np.asarray(tree.generation)[tree.branch_of_point[child]])
    lines.set_linewidth(np.clip(0.35 * np.asarray(tree.radius_mm)[child], 0.9, 3.2).tolist())
    return lines


ARROW_MM = 25.0
"""Length of the arrow at a start: long enough to show its direction in a whole organ."""


@style.plain_look
def organ_png(organ: Organ, path: str | os.PathLike[str]) -> Path:
    """Draw an organ seen through from three sides; an arrow is a start, a ring a target.

    FileError is raised if the file cannot be written.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(organ)
    for box, view in zip(PANELS_IN, STANDARD, strict=True):
        _panel(style.panel(figure, box), organ, layers, view)
    style.heading(
        figure,
        f"{organ.name}: vessels red, nodules green, starts as arrows ({len(organ.starts)}), "
        f"targets as rings ({len(organ.targets_lps)})",
    )
    return style.save_png(figure, path)


def _panel(axes: Axes, organ: Organ, layers: Layers, view: View) -> None:
    drawing.anatomy_seen_through(axes, layers, view)
    drawing.see_through(axes, layers.footprint("nodule", view), style.NODULE, 10.0, 0.8)
    corners = [organ.grid.lps(np.zeros(3)), organ.grid.lps(np.array(organ.grid.shape) - 1.0)]
    shown = [view.project(corner) for corner in corners]
    for pose in organ.starts:
        tail, tip = view.project(pose[:3, 3] - ARROW_MM * pose[:3, 2]), view.project(pose[:3, 3])
        axes.annotate(
            "", xy=(tip[0], tip[1]), xytext=(tail[0], tail[1]),
            arrowprops={"color": style.INK, "arrowstyle": "-|>"}, zorder=9,
        )  # fmt: skip
        shown += [tail, tip]
    for point in organ.targets_lps:
        drawing.target_mark(axes, view.project(point))
    drawing.fit_around(axes, None, np.array(shown))
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, view.name)
