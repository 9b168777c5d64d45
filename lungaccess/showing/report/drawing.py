"""What all anatomical pictures share: layers, edge letters, scale bar, curves with a halo."""

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Polygon
from matplotlib.ticker import Formatter

from anatomy.base.typed import Float
from lungaccess.showing.report import style
from lungaccess.showing.report.layers import Footprint, Layers
from lungaccess.showing.report.views import View

BAR_LENGTHS_MM = (1, 2, 5, 10, 20, 50, 100)
"""Round lengths of a scale bar; the longest that fits is taken."""
BORDER_MM = 4.0
"""Room for the letters at the edges of an anatomical picture."""
WORD_SHIFTS_MM = tuple(range(6, 90, 3))
"""A word is moved from its point so far as the first of these that leaves room for it."""
WORD_MM = np.array([20.0, 8.0])
"""About the size of a word of four letters in a picture of both lungs."""
ROUNDING_PIXELS = 0.8
"""Silhouettes lose the steps of their pixels, and nothing that is larger."""


def title(axes: Axes, text: str) -> None:
    """Put a heading above a panel."""
    axes.set_title(text, fontsize=10.5, fontweight="bold", color=style.INK, loc="left", pad=5)


def graph(axes: Axes, horizontal: str, vertical: str) -> None:
    """Label the axes of a graph, which has a grid and no frame."""
    axes.set_xlabel(horizontal, fontsize=8.5)
    axes.set_ylabel(vertical, fontsize=8.5)
    axes.tick_params(labelsize=8)
    axes.grid(color="#E6E6E6", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def dress(axes: Axes, view: View, *, ticks: bool) -> None:
    """Draw the anatomical directions at the edges, LPS ticks and a scale bar."""
    left, right, bottom, top = view.edge_letters()
    places = {left: (0.012, 0.5, "left", "center"), right: (0.988, 0.5, "right", "center")}
    places |= {bottom: (0.5, 0.012, "center", "bottom"), top: (0.5, 0.988, "center", "top")}
    for text, (x, y, horizontal, vertical) in places.items():
        axes.text(
            x, y, text, transform=axes.transAxes, ha=horizontal, va=vertical, fontsize=12,
            fontweight="bold", color=style.INK, path_effects=halo(2.5), zorder=20,
        )  # fmt: skip
    for spine in axes.spines.values():
        spine.set_color("#BBBBBB")
    if ticks:
        _lps_ticks(axes, view)
    else:
        axes.set_xticks([])
        axes.set_yticks([])
    scale_bar(axes)


def _lps_ticks(axes: Axes, view: View) -> None:
    """Label the ticks with LPS coordinates, whichever direction the axis has in the picture."""
    axes.tick_params(labelsize=7, colors=style.FAINT_INK, length=2, pad=2)
    for axis, direction in ((axes.xaxis, view.right), (axes.yaxis, view.up)):
        component = int(np.argmax(np.abs(direction)))
        sign = float(np.sign(direction[component]))
        axis.set_major_formatter(_SignedFormatter(sign))
        axis.set_label_text(f"{'xyz'[component]} (LPS, mm)", fontsize=7.5, color=style.FAINT_INK)
        axis.labelpad = 1


class _SignedFormatter(Formatter):
    """Writes a coordinate that grows against the direction of its picture axis."""

    def __init__(self, sign: float) -> None:
        self._sign = sign

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{self._sign * x + 0.0:.0f}"


def scale_bar(axes: Axes) -> None:
    """Draw a bar of a round length in the lower left corner."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    length = max((n for n in BAR_LENGTHS_MM if n <= 0.36 * (right - left)), default=BAR_LENGTHS_MM[0])
    x, y = left + 0.04 * (right - left), bottom + 0.05 * (top - bottom)
    line = axes.plot([x, x + length], [y, y], color=style.INK, lw=3, solid_capstyle="butt", zorder=20)
    line[0].set_path_effects(halo(6))
    axes.text(
        x + length / 2, y + 0.012 * (top - bottom), f"{length} mm", ha="center", va="bottom",
        fontsize=8, color=style.INK, path_effects=halo(2.5), zorder=20,
    )  # fmt: skip


def halo(width: float, colour: str = "white") -> list[patheffects.AbstractPathEffect]:
    """Return the effect that sets a line or letter off from what lies behind it."""
    return [patheffects.withStroke(linewidth=width, foreground=colour)]


def fit(axes: Axes, low: Float, high: Float) -> None:
    """Show the box `low`..`high` whole, undistorted, filling the panel."""
    figure = axes.get_figure()
    box = axes.get_position()
    width, height = box.width, box.height
    if figure is not None:
        inches = figure.get_size_inches()  # type: ignore[union-attr]
        width, height = width * inches[0], height * inches[1]
    size = np.maximum(high - low, 1e-3)
    mm_per_inch = max(size[0] / width, size[1] / height)
    middle = (low + high) / 2
    half = np.array([width, height]) * mm_per_inch / 2
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_aspect("equal", adjustable="box")


def fit_around(axes: Axes, footprint: Footprint | None, uv: Float) -> None:
    """Show a footprint and points `(N, 2)` whole, with a border."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    if footprint is not None:
        left, right, bottom, top = footprint.extent_mm
        low, high = np.minimum(low, [left, bottom]), np.maximum(high, [right, top])
    fit(axes, low - BORDER_MM, high + BORDER_MM)


def see_through(
    axes: Axes, footprint: Footprint | None, colour: str, depth_mm: float, strength: float
) -> None:
    """Draw a mask like stained glass: the thicker along the view, the stronger its colour."""
    if footprint is None:
        return
    image = np.zeros((*footprint.thickness_mm.shape, 4))
    image[..., :3] = to_rgb(colour)
    image[..., 3] = strength * (1.0 - np.exp(-footprint.thickness_mm / depth_mm))
    axes.imshow(image, extent=footprint.extent_mm, origin="lower", aspect="auto", zorder=1)


def outline(axes: Axes, footprint: Footprint | None, colour: str, width: float) -> None:
    """Draw the silhouette of a mask, rounded by about a pixel."""
    if footprint is None:
        return
    left, right, bottom, top = footprint.extent_mm
    rows, columns = footprint.thickness_mm.shape
    u = left + (np.arange(columns) + 0.5) * (right - left) / columns
    v = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    inside = _rounded((footprint.thickness_mm > 0).astype(np.float64))
    axes.contour(u, v, inside, levels=[0.5], colors=[colour], linewidths=[width], zorder=3)


def _rounded(image: Float) -> Float:
    """Return an image under a Gaussian of `ROUNDING_PIXELS`; scipy's takes longer to import than to run."""
    reach = int(4.0 * ROUNDING_PIXELS + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / ROUNDING_PIXELS) ** 2)
    for axis in (0, 1):
        padded = np.pad(image, [(reach, reach) if each == axis else (0, 0) for each in (0, 1)], "symmetric")
        shifted = (np.take(padded, np.arange(n, n + image.shape[axis]), axis) for n in range(len(weights)))
        image = np.sum([weight * part for weight, part in zip(weights, shifted, strict=True)], axis=0)
    return np.asarray(image / weights.sum() ** 2)


def anatomy_seen_through(axes: Axes, layers: Layers, view: View) -> None:
    """Draw lungs, fissures, vessels and airways as seen along a view."""
    lung = layers.footprint("lung", view)
    see_through(axes, lung, "#CDBBA7", 120.0, 0.35)
    see_through(axes, layers.footprint("fissure", view), style.FISSURE, 14.0, 0.35)
    see_through(axes, layers.footprint("vessel", view), style.VESSEL, 11.0, 0.68)
    see_through(axes, layers.footprint("airway", view), style.SCOPE, 14.0, 0.50)
    outline(axes, lung, "#8A7B6B", 0.9)


def curve(axes: Axes, uv: Float, colour: str, width: float, order: int) -> None:
    """Draw a curve of a device with a white halo."""
    axes.plot(
        uv[:, 0], uv[:, 1], color=colour, lw=width, zorder=order, solid_capstyle="round",
        path_effects=halo(width + 1.6),
    )  # fmt: skip


def ribbon(axes: Axes, uv: Float, radius_mm: float, colour: str, *, fill: float, order: int) -> None:
    """Draw a device true to its width: the band of `radius_mm` on both sides of its axis."""
    if len(uv) < 2:
        return
    normal = _normals(uv)
    band = np.concatenate([uv + radius_mm * normal, (uv - radius_mm * normal)[::-1]])
    face = (*to_rgb(colour), fill)
    axes.add_patch(Polygon(band, closed=True, facecolor=face, edgecolor=colour, lw=1.3, zorder=order))


def dashed_band(axes: Axes, uv: Float, half_width_mm: float, order: int) -> None:
    """Draw the border of the clearance that is required around a device."""
    if len(uv) < 2:
        return
    for side in (half_width_mm, -half_width_mm):
        line = uv + side * _normals(uv)
        axes.plot(line[:, 0], line[:, 1], color=style.INK, lw=0.8, ls=(0, (3, 2)), zorder=order)


def _normals(uv: Float) -> Float:
    tangent = np.gradient(uv, axis=0)
    length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / length)


def beside(axes: Axes, points: Float, middle: Float) -> Float:
    """Return places `(N, 2)` for short words about points, outwards of `middle`, and draw a line to each.

    No two places are nearer to each other than a word is large.
    """
    places = np.array(points, dtype=np.float64)
    for n, point in enumerate(points):
        away = (point - middle) / max(float(np.linalg.norm(point - middle)), 1e-9)
        for shift_mm in WORD_SHIFTS_MM:
            places[n] = point + shift_mm * away
            if not (np.abs(places[:n] - places[n]) < WORD_MM).all(axis=1).any():
                break
        axes.plot(*np.transpose([point, places[n]]), color=style.FAINT_INK, lw=0.5, zorder=8)
    return places


def target_mark(axes: Axes, uv: Float, order: int = 12) -> None:
    """Mark the target point."""
    axes.plot(
        uv[0], uv[1], marker="o", ms=9, mfc="none", mec=style.TARGET, mew=2.0, zorder=order,
        path_effects=halo(4.0, style.INK), ls="none",
    )  # fmt: skip


def aim_mark(axes: Axes, uv: Float) -> None:
    """Mark where devices end that were planned for a moving target."""
    axes.plot(
        uv[0], uv[1], marker="x", ms=7, mec=style.AIM, mew=2.0, zorder=13, path_effects=halo(4.0, style.INK),
        ls="none",
    )  # fmt: skip
