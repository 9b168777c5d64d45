"""How the lungs of a patient breathe: displacements from end-exhale to end-inhale, from three sides."""

import os
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import OUTSIDE
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import STANDARD

WIDTH_IN, HEIGHT_IN = 17.0, 6.6
PANELS_IN = ((0.55, 0.6, 5.2, 5.3), (6.2, 0.6, 5.2, 5.3), (11.9, 0.6, 3.8, 5.3))
BAR_IN = (16.2, 0.8, 0.16, 4.9)
"""Left, bottom, width and height of panels and colour bar."""
ARROW_MM = 12.0
"""Distance of the arrows: dense enough to see how a lung moves, and each can be told from the next."""
SLAB_MM = 6.0
"""Half the thickness of the slab through the middle of each lung whose places are drawn."""


@style.plain_look
def motion_png(lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw where places of the masks move from end-exhale to end-inhale, in their true length.

    Raises:
        AnatomyError: If nothing is known of the patient's breathing.
        FileError: If the file cannot be written.
    """
    motion = lung.motion
    if motion is None:
        raise AnatomyError(f"Nothing is known of the breathing of {lung.name}", expected="a motion")
    figure, layers = style.new_figure(WIDTH_IN, HEIGHT_IN), Layers(lung)
    places, vectors = _arrows(lung)
    length = np.linalg.norm(vectors, axis=1)
    norm, colours = Normalize(0.0, float(length.max(initial=1.0))), matplotlib.colormaps["viridis"]
    for box, view in zip(PANELS_IN, STANDARD, strict=True):
        axes = style.panel(figure, box)
        footprint = layers.footprint("lung", view)
        drawing.see_through(axes, layers.footprint("airway", view), "#555555", 5.0, 0.35)
        drawing.outline(axes, footprint, "#B9AEA2", 0.8)
        # Which places lie in the slab through the middle of their lung, as the view looks at it.
        depth = places @ view.towards_viewer
        left = places[:, 0] > lung.tree.carina_lps[0]
        middle = np.where(left, np.median(depth[left]), np.median(depth[~left]))
        near = np.asarray(np.abs(depth - middle) <= SLAB_MM)
        at, along = view.project(places[near]), view.project(vectors[near])
        axes.quiver(
            *at.T, *along.T, length[near], cmap=colours, norm=norm, angles="xy", scale_units="xy", scale=1.0,
            width=0.004, zorder=6,
        )  # fmt: skip
        drawing.fit_around(axes, footprint, at)
        drawing.dress(axes, view, ticks=True)
        drawing.title(axes, view.name)
    bar = figure.colorbar(ScalarMappable(norm=norm, cmap=colours), cax=style.panel(figure, BAR_IN))
    bar.set_label("from end-exhale to end-inhale, mm (arrows in true length)", fontsize=9)
    style.heading(
        figure,
        f"Breathing of {lung.name}: {motion.source}; the masks show {100.0 * motion.masks_phase:.0f} %",
    )
    return style.save_png(figure, path)


def _arrows(lung: Lung) -> tuple[Float, Float]:
    """Return places `(N, 3)` in the lungs at the masks' phase, and their displacements."""
    motion = lung.motion
    steps = np.maximum(np.rint(ARROW_MM / lung.grid.spacing_mm).astype(int), 1)
    inside = (lung.labels[tuple(slice(None, None, n) for n in steps)] & OUTSIDE) == 0
    places = lung.grid.lps(np.argwhere(inside) * steps)
    if motion is None:
        return places, np.zeros_like(places)
    sides = [motion.displacements_mm(places, side) for side in (0, 1)]
    left = places[:, :1] > motion.middle_x_mm
    return places, np.asarray(motion.amplitude * np.where(left, sides[1], sides[0]))
