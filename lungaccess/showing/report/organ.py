"""An organ without airways: its outline, vessels and nodules from three sides, with starts and targets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.tree import HEIGHT_IN, PANELS_IN, WIDTH_IN
from lungaccess.showing.report.views import STANDARD, View

if TYPE_CHECKING:
    from anatomy.organ import Organ

ARROW_MM = 25.0
"""Length of the arrow at a start: long enough to show its direction in a whole organ."""


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
            "",
            xy=(tip[0], tip[1]),
            xytext=(tail[0], tail[1]),
            arrowprops={"color": style.INK, "arrowstyle": "-|>"},
            zorder=9,
        )
        shown += [tail, tip]
    for point in organ.targets_lps:
        drawing.target_mark(axes, view.project(point))
    drawing.fit_around(axes, None, np.array(shown))
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, view.name)
