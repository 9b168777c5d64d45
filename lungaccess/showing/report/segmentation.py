"""Overlays of a segmentation on its CT, on three planes."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Grid, Volume
from anatomy.lobes import LEAST_CHANCE, UNKNOWN
from anatomy.morphology import bounds
from anatomy.segmentation.parts import Parts
from lungaccess.showing.report import style

SLICES = 5
WINDOW_HU = (-1100.0, 250.0)
PANEL_IN = 3.1
MARGIN_MM = 12.0
LARGE_VESSEL, SMALL_VESSEL = "#D81B1B", "#F0A050"
RIGHT, LEFT, NODULE, CENTRAL, WALL = "#E6C200", "#00B4D8", "#00FF5A", "#C77DFF", "#7BD0FF"
FISSURE, NOT_KNOWN = "#B58CFF", "#FF8FB1"
PLANES = (("sagittal", 0, (1, 2)), ("coronal", 1, (0, 2)), ("axial", 2, (0, 1)))
"""Name, normal, and the axes across and up, as LPS axes."""


@style.plain_look
def segmentation_png(ct: Volume, parts: Parts | None, path: str | os.PathLike[str]) -> Path:
    """Draw the masks over the CT as it was measured: five sagittal, coronal and axial slices.

    Axial slices are seen from the feet, coronal ones from the front: the patient's right is on the left.
    Raises FileError if the file cannot be written.

    Args:
        parts: Its voxels run along those of the CT; None draws the whole CT alone.
    """
    low, high = _shown_lps(ct, parts)
    axis_of = [int(np.argmax(np.abs(ct.grid.lps_from_ijk[row, :3]))) for row in range(3)]
    figure = style.new_figure(SLICES * PANEL_IN, 3 * PANEL_IN + 0.7)
    panels = figure.subplots(3, SLICES, squeeze=False)
    for row, (name, normal, (across, up)) in enumerate(PLANES):
        through = axis_of[normal]
        for column in range(SLICES):
            share = (column + 0.5) / SLICES
            middle = np.where(np.arange(3) == normal, low + share * (high - low), 0.5 * (low + high))
            axes = panels[row, column]
            shown = _Section(low, high, middle, through, (axis_of[across], axis_of[up]))
            _panel(axes, ct, parts, shown, up == 1)
            axes.set_title(
                f"{name}, LPS {'xyz'[normal]} = {middle[normal]:.0f} mm", fontsize=8, color=style.INK
            )
    if parts is not None:
        figure.legend(handles=_legend(), loc="lower center", ncol=5, fontsize=9, frameon=False)
    figure.subplots_adjust(left=0.005, right=0.995, top=0.975, bottom=0.065, wspace=0.02, hspace=0.09)
    return style.save_png(figure, path)


def _shown_lps(ct: Volume, parts: Parts | None) -> tuple[Float, Float]:
    """Return the least and greatest LPS mm of what is shown."""
    grid, ends = ct.grid, np.array([(0.0, 0.0, 0.0), np.array(ct.grid.shape) - 1.0])
    if parts is not None:
        grid = parts.ct.grid
        pad = np.ceil(MARGIN_MM / grid.spacing_mm).astype(np.int64)
        low, high = bounds(parts.left | parts.right | parts.lumen, pad)
        ends = np.array([low, high - 1]).astype(np.float64)
    corners = grid.lps(ends)
    return corners.min(axis=0), corners.max(axis=0)


class _Section:
    """A section through images: a box LPS mm, a point in it, the voxel axis through, those across and up."""

    def __init__(self, low: Float, high: Float, point: Float, through: int, shown: tuple[int, int]) -> None:
        self._low, self._high, self._point, self._through, self._shown = low, high, point, through, shown

    def of(self, array: Array, grid: Grid) -> tuple[Array, tuple[float, float, float, float]]:
        """Return the part of an image to show, and its left, right, bottom and top in LPS mm.

        They are reversed where voxels run against LPS.
        """
        window = list(grid.window(np.array([self._low, self._high]), 0.0))
        level = int(np.rint(grid.ijk(self._point)[self._through]))
        ends: list[float] = []
        for axis in self._shown:
            along = int(np.argmax(np.abs(grid.lps_from_ijk[:3, axis])))
            for edge in (window[axis].start - 0.5, window[axis].stop - 0.5):
                ends.append(float(grid.lps(np.where(np.arange(3) == axis, edge, 0.0))[along]))
        index: list[Any] = list(window)
        index[self._through] = min(max(level, 0), grid.shape[self._through] - 1)
        plane: Array = array[tuple(index)]
        return plane.T if self._shown[0] < self._shown[1] else plane, (ends[0], ends[1], ends[2], ends[3])


def _panel(axes: Axes, ct: Volume, parts: Parts | None, section: _Section, downwards: bool) -> None:
    """Draw one slice, `downwards` if LPS grows down the page."""
    plane, extent = section.of(ct.array, ct.grid)
    axes.imshow(
        plane, cmap="gray", vmin=WINDOW_HU[0], vmax=WINDOW_HU[1], extent=extent, origin="lower",
        interpolation="nearest",
    )  # fmt: skip
    if parts is not None:
        _draw_parts(axes, parts, section)
    if downwards:
        axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_parts(axes: Axes, parts: Parts, section: _Section) -> None:
    fissures = parts.fissures
    for mask, colour, alpha in (
        (fissures == UNKNOWN, NOT_KNOWN, 0.12),
        ((fissures >= LEAST_CHANCE) & (fissures < UNKNOWN), FISSURE, 0.25),
        ((fissures > 0) & (fissures < LEAST_CHANCE), FISSURE, 0.9), (parts.all_vessels, SMALL_VESSEL, 0.55),
        (parts.large_vessels, LARGE_VESSEL, 0.75), (parts.wall, WALL, 0.8), (parts.lumen, style.SCOPE, 0.9),
    ):  # fmt: skip
        plane, extent = section.of(mask, parts.ct.grid)
        _fill(axes, plane, colour, alpha, extent)
    for mask, colour in (
        (parts.right, RIGHT), (parts.left, LEFT), (parts.central_airway, CENTRAL), (parts.nodule, NODULE)
    ):  # fmt: skip
        plane, extent = section.of(mask, parts.ct.grid)
        if plane.any():
            axes.contour(plane, [0.5], colors=colour, linewidths=0.8, extent=extent, origin="lower")


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
        ("nodule", NODULE), ("fissure, faint: its band", FISSURE), ("fissures not known", NOT_KNOWN),
    )  # fmt: skip
    return [Line2D([], [], color=colour, lw=3, label=label) for label, colour in entries]
