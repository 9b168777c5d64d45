"""Overlays of a segmentation on its CT, on three planes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds
from anatomy.segmentation.steps import Parts
from anatomy.typed import Array, Float, Int, Mask
from lungaccess.report import style

SLICES = 5
WINDOW_HU = (-1100.0, 250.0)
PANEL_IN = 3.1
MARGIN_MM = 12.0
LARGE_VESSEL, SMALL_VESSEL = "#D81B1B", "#F0A050"
RIGHT, LEFT, NODULE, CENTRAL, WALL = "#E6C200", "#00B4D8", "#00FF5A", "#C77DFF", "#7BD0FF"
PLANES = (("sagittal", 0, (1, 2)), ("coronal", 1, (0, 2)), ("axial", 2, (0, 1)))
"""Name, normal, and the axes across and up, as LPS axes."""


def segmentation_png(ct: Volume, parts: Parts | None, path: str | os.PathLike[str]) -> Path:
    """Draw the masks over the CT: five sagittal, coronal and axial slices through the lungs.

    Axial slices are seen from the feet, coronal ones from the front: the patient's right is on the left.

    Parameters
    ----------
    parts : Parts or None
        On the grid of the CT; None draws the whole CT alone.

    Raises
    ------
    anatomy.errors.FileError
        If the file cannot be written.
    """
    pad = np.ceil(MARGIN_MM / ct.grid.spacing_mm).astype(np.int64)
    shown = ct.array < np.inf if parts is None else parts.left | parts.right | parts.lumen
    low, high = bounds(shown, pad)
    axis_of = [int(np.argmax(np.abs(ct.grid.lps_from_ijk[row, :3]))) for row in range(3)]
    figure = style.new_figure(SLICES * PANEL_IN, 3 * PANEL_IN + 0.7)
    panels = figure.subplots(3, SLICES, squeeze=False)
    for row, (name, normal, (across, up)) in enumerate(PLANES):
        through = axis_of[normal]
        for column in range(SLICES):
            share = (column + 0.5) / SLICES
            level = int(low[through] + share * (high[through] - low[through]))
            axes = panels[row, column]
            _panel(axes, ct, parts, (low, high), through, level, (axis_of[across], axis_of[up]), up == 1)
            place = ct.grid.lps(np.where(np.arange(3) == through, level, low))[normal]
            axes.set_title(f"{name}, LPS {'xyz'[normal]} = {place:.0f} mm", fontsize=8, color=style.INK)
    if parts is not None:
        figure.legend(handles=_legend(), loc="lower center", ncol=8, fontsize=9, frameon=False)
    figure.subplots_adjust(left=0.005, right=0.995, top=0.975, bottom=0.045, wspace=0.02, hspace=0.09)
    return style.save_png(figure, path)


def _panel(
    axes: Axes,
    ct: Volume,
    parts: Parts | None,
    box: tuple[Int, Int],
    through: int,
    level: int,
    shown: tuple[int, int],
    downwards: bool,
) -> None:
    """Draw one slice; `shown` are the voxel axes across and up, `downwards` if LPS grows down the page."""
    extent = _extent(ct.grid, box, shown)

    def cut(array: Array) -> Array:
        window: list[Any] = [slice(int(a), int(b)) for a, b in zip(*box, strict=True)]
        window[through] = level
        plane: Array = array[tuple(window)]
        return plane.T if shown[0] < shown[1] else plane

    axes.imshow(
        cut(ct.array), cmap="gray", vmin=WINDOW_HU[0], vmax=WINDOW_HU[1], extent=extent, origin="lower",
        interpolation="nearest",
    )  # fmt: skip
    if parts is not None:
        _draw_parts(axes, parts, cut, extent)
    if downwards:
        axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_parts(axes: Axes, parts: Parts, cut: Callable[[Array], Array], extent: Any) -> None:
    for mask, colour, alpha in (
        (parts.all_vessels, SMALL_VESSEL, 0.55),
        (parts.large_vessels, LARGE_VESSEL, 0.75),
        (parts.wall, WALL, 0.8),
        (parts.lumen, style.SCOPE, 0.9),
    ):
        _fill(axes, cut(mask), colour, alpha, extent)
    for mask, colour in (
        (parts.right, RIGHT), (parts.left, LEFT), (parts.central_airway, CENTRAL), (parts.nodule, NODULE)
    ):  # fmt: skip
        plane = cut(mask)
        if plane.any():
            axes.contour(plane, [0.5], colors=colour, linewidths=0.8, extent=extent, origin="lower")


def _extent(grid: Grid, box: tuple[Int, Int], shown: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top in LPS mm: reversed where voxels run against LPS."""
    first, last = grid.lps(box[0] - 0.5), grid.lps(box[1] - 0.5)
    ends: list[float] = []
    for axis in shown:
        along = int(np.argmax(np.abs(grid.lps_from_ijk[:3, axis])))
        ends += [float(first[along]), float(last[along])]
    return ends[0], ends[1], ends[2], ends[3]


def _fill(axes: Axes, plane: Mask, colour: str, alpha: float, extent: Any) -> None:
    if not plane.any():
        return
    rgba: Float = np.zeros((*plane.shape, 4))
    rgba[plane] = [*(int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)), alpha]
    axes.imshow(rgba, extent=extent, origin="lower", interpolation="nearest")


def _legend() -> list[Line2D]:
    entries = (
        ("right lung", RIGHT), ("left lung", LEFT), ("airway lumen", style.SCOPE), ("airway wall", WALL),
        ("trachea and main bronchi", CENTRAL), ("large vessel", LARGE_VESSEL), ("vessel", SMALL_VESSEL),
        ("nodule", NODULE),
    )  # fmt: skip
    return [Line2D([], [], color=colour, lw=3, label=label) for label, colour in entries]
