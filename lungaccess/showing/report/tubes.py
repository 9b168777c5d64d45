"""Shape, torsion and stability of deployed tubes in one picture, with the steps that led there."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle

from anatomy.base.typed import Float
from lungaccess.showing.report import drawing, style
from stages.tube import DeployedSequence, Equilibrium, Tube

WIDTH_IN, HEIGHT_IN = 15.6, 8.3
SIDE_IN, FRONT_IN, KEY_IN = (0.75, 4.3, 7.0, 3.2), (0.75, 0.65, 3.1, 2.8), (4.35, 0.65, 3.4, 2.8)
GRAPHS_IN = (5.7, 3.18, 0.65)
"""Lower edges of the graphs."""
BEHIND_IN, AHEAD_IN, GRAPH_HEIGHT_IN = (9.05, 1.3), (10.5, 4.85), 1.9
"""Left edge and width of the parts of a graph behind and ahead of the scope tip."""

TUBE_COLOURS = (style.TUBE, "#CC79A7", "#009E73", "#56B4E9")
"""From the innermost tube; Okabe and Ito's palette."""
DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = ("-", (0, (5, 2)), (0, (1, 1)), (0, (5, 1, 1, 1)))
GHOST = "#4D4D4D"
GHOSTS = 9
SCOPE_LENGTH_MM = 8.0
STABILITY = "Stability: stable while the determinant stays above 0"
SPACING_MM = 0.2


@style.plain_look
def tubes_png(
    equilibrium: Equilibrium,
    path: str | os.PathLike[str],
    *,
    deployed: DeployedSequence | None = None,
    scope_diameter_mm: float | None = None,
    heading: str = "Concentric tubes",
    notes: Sequence[str] = (),
) -> Path:
    """Draw deployed tubes: side and front view, torsion, and stability.

    All coordinates are those of the scope tip: z forward, mm.  Raises FileError if the file cannot be
    written.

    Args:
        equilibrium: What to draw; at least one tube must be out of the scope.
        deployed: Its earlier steps are drawn as thin grey lines.
        scope_diameter_mm: Drawn around the tubes; a little more than the outermost tube's if None.
        notes: Lines to print beside the picture.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    widest = scope_diameter_mm or 1.15 * equilibrium.mechanics.tubes[-1].outer_diameter_mm
    lines = [_body(equilibrium)]
    if deployed is not None:
        # The centrelines of some earlier steps, evenly spread over those with a tube out.
        out = [step for step in deployed.steps[:-1] if step.length_mm > 0.0]
        chosen = np.unique(np.linspace(0, max(len(out) - 1, 0), GHOSTS).round().astype(int))
        lines += [_body(out[number]) for number in chosen[: len(out)]]
    _side_view(style.panel(figure, SIDE_IN), equilibrium, lines, widest)
    _front_view(style.panel(figure, FRONT_IN), equilibrium, lines, widest)
    _key(style.panel(figure, KEY_IN), equilibrium, notes, with_ghosts=len(lines) > 1)
    _graphs(figure, equilibrium)
    style.heading(figure, heading)
    return style.save_png(figure, path)


def _body(equilibrium: Equilibrium) -> Float:
    return np.asarray(equilibrium.backbone(_along(0.0, equilibrium.length_mm)))


def _along(start_mm: float, end_mm: float) -> Float:
    return np.linspace(start_mm, end_mm, max(2, round((end_mm - start_mm) / SPACING_MM) + 1))


def _sideways(points: Float) -> Float:
    """Return the unit direction (2,) across the scope's axis in which the tip, or else the body, lies."""
    tip = points[-1, :2]
    if np.linalg.norm(tip) > 0.02 * np.linalg.norm(points[-1]):
        return np.asarray(tip / np.linalg.norm(tip))
    return np.asarray(np.linalg.svd(points[:, :2])[2][0])


def _side_view(axes: Axes, equilibrium: Equilibrium, lines: Sequence[Float], scope_mm: float) -> None:
    """Draw the tubes true to their width, seen so that the tip lies in the picture plane."""
    sideways = _sideways(lines[0])

    def project(points: Float) -> Float:
        return np.column_stack([points[:, 2], points[:, :2] @ sideways])

    for ghost in lines[1:]:
        axes.plot(*project(ghost).T, color=GHOST, lw=0.8, alpha=0.7, zorder=11)
    for number, tube, points in _outermost_first(equilibrium):
        fill = 0.9 if number == 0 else 0.4
        drawing.ribbon(
            axes, project(points), tube.radius_mm, TUBE_COLOURS[number % 4], fill=fill,
            order=5 + min(number, 4),
        )  # fmt: skip
    axes.add_patch(
        Rectangle(
            (-SCOPE_LENGTH_MM, -scope_mm / 2), SCOPE_LENGTH_MM, scope_mm, facecolor=style.SCOPE, alpha=0.35,
            edgecolor=style.SCOPE, zorder=3,
        )  # fmt: skip
    )  # fmt: skip
    every = np.concatenate([project(line) for line in lines])
    low = np.minimum(every.min(axis=0), [-SCOPE_LENGTH_MM, -scope_mm / 2]) - 1.5
    drawing.fit(axes, low, np.maximum(every.max(axis=0), [0.0, scope_mm / 2]) + 1.5)
    azimuth = np.degrees(np.arctan2(sideways[1], sideways[0])).round() + 0.0  # no -0
    across = f"across, {azimuth:.0f}° from x towards y (mm)"
    _dress(axes, "Side view, in the plane of the tip", "z, forward (mm)", across)


def _front_view(axes: Axes, equilibrium: Equilibrium, lines: Sequence[Float], scope_mm: float) -> None:
    """Draw the tubes as seen from ahead, looking back at the scope."""
    for ghost in lines[1:]:
        axes.plot(ghost[:, 0], ghost[:, 1], color=GHOST, lw=0.8, alpha=0.7, zorder=11)
    axes.add_patch(
        Circle((0.0, 0.0), scope_mm / 2, facecolor=style.SCOPE, alpha=0.35, edgecolor=style.SCOPE, zorder=1)
    )
    for number, _tube, points in _outermost_first(equilibrium):
        colour, width = TUBE_COLOURS[number % 4], 2.6 + 2.4 * number
        axes.plot(
            points[:, 0], points[:, 1], color=colour, lw=width, zorder=5 + min(number, 4),
            solid_capstyle="butt", alpha=1.0 if number == 0 else 0.6,
        )  # fmt: skip
        axes.plot(*points[-1, :2], "o", ms=width + 2, mfc="white", mec=colour, mew=1.6, zorder=10)
    every = np.concatenate([line[:, :2] for line in lines])
    low, high = np.minimum(every.min(axis=0), -scope_mm / 2), np.maximum(every.max(axis=0), scope_mm / 2)
    drawing.fit(axes, low - 1.5, high + 1.5)
    _dress(axes, "Front view, looking back at the scope", "x (mm)", "y (mm)")


def _outermost_first(equilibrium: Equilibrium) -> list[tuple[int, Tube, Float]]:
    """Return number, tube and centreline of every tube that is out, with a little of it in the scope."""
    mechanics = equilibrium.mechanics
    ends = np.minimum(equilibrium.beta_mm + mechanics.lengths_mm, equilibrium.length_mm)
    return [
        (number, mechanics.tubes[number], equilibrium.backbone(_along(-SCOPE_LENGTH_MM, ends[number])))
        for number in reversed(range(mechanics.count))
        if ends[number] > 0.0
    ]


def _dress(axes: Axes, title: str, horizontal: str, vertical: str) -> None:
    drawing.title(axes, title)
    drawing.graph(axes, horizontal, vertical)


def _key(axes: Axes, equilibrium: Equilibrium, notes: Sequence[str], *, with_ghosts: bool) -> None:
    """Name the tubes and print the notes."""
    axes.axis("off")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=TUBE_COLOURS[n % 4], ls=DASHES[n % 4], lw=3, label=_name(n, equilibrium))
        for n in range(equilibrium.mechanics.count)
    ]
    if with_ghosts:
        handles.append(Line2D([], [], color=GHOST, lw=0.8, alpha=0.7, label="earlier steps"))
    handles.append(Patch(facecolor=style.SCOPE, alpha=0.35, label="scope"))
    axes.legend(handles=handles, loc="upper left", fontsize=8.5, frameon=False, handlelength=3.4)
    axes.text(
        0.02, 0.86 - 0.105 * len(handles), "\n".join(notes), transform=axes.transAxes, va="top", fontsize=9,
        color=style.INK, linespacing=1.5,
    )  # fmt: skip


def _name(number: int, equilibrium: Equilibrium) -> str:
    tube, count = equilibrium.mechanics.tubes[number], equilibrium.mechanics.count
    role = {0: "inner tube", count - 1: "outer tube"}.get(number, f"tube {number + 1}")
    curve = f"{tube.max_precurvature_per_mm:.4g}/mm" if tube.bends else "straight"
    return f"{role if count > 1 else 'tube'}, {tube.outer_diameter_mm:g} mm, {curve}"


def _graphs(figure: Figure, equilibrium: Equilibrium) -> None:
    """Plot torsion and stability along the tubes; the part in the scope is compressed."""
    in_scope = np.linspace(min(float(equilibrium.beta_mm.min()), -1e-3), 0.0, 120)
    ahead = _along(0.0, equilibrium.length_mm)
    # Title, label, values at arc lengths, least height of the axis.
    rows: tuple[tuple[str, str, Callable[[Float], Float], float], ...] = (
        ("Rotation of each tube's material", "psi (deg)", lambda s: np.degrees(equilibrium.angles(s)), 10.0),
        ("Torsion of each tube", "u_z (deg/mm)", lambda s: np.degrees(equilibrium.torsion(s)), 0.02),
        (STABILITY, "determinant", lambda s: np.asarray(equilibrium.determinant(s))[:, None], 1.2),
    )
    for bottom, (title, label, values, least) in zip(GRAPHS_IN, rows, strict=True):
        left = style.panel(figure, (BEHIND_IN[0], bottom, BEHIND_IN[1], GRAPH_HEIGHT_IN))
        right = style.panel(figure, (AHEAD_IN[0], bottom, AHEAD_IN[1], GRAPH_HEIGHT_IN))
        behind, before = values(in_scope), values(ahead)
        limits = _limits(np.concatenate([behind, before]), least, with_zero=title == STABILITY)
        for axes, s, curves in ((left, in_scope, behind), (right, ahead, before)):
            _curves(axes, s, curves, single=title == STABILITY)
            axes.set_xlim(s[0], max(s[-1], s[0] + 1e-3))
            axes.set_ylim(*limits)
            _dress(axes, "", "", "")
            if title == STABILITY:
                axes.axhspan(limits[0], 0.0, color=style.FORBIDDEN, lw=0, zorder=0)
                axes.axhline(0.0, color=style.INK, lw=1.4, zorder=1)
                axes.set_xlabel(
                    "s (mm), in the scope" if axes is left else "s (mm), ahead of it", fontsize=8.5
                )
        left.set_ylabel(label, fontsize=8.5)
        left.set_xticks([round(float(in_scope[0])), 0])
        right.tick_params(labelleft=False)
        drawing.title(left, title)


def _limits(values: Float, least: float, *, with_zero: bool) -> tuple[float, float]:
    """Return limits of an axis around the finite values, at least `least` apart."""
    finite = values[np.isfinite(values)]
    low, high = float(finite.min()), float(finite.max())
    if with_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    border = max(0.12 * (high - low), 0.5 * (least - high + low))
    return low - border, high + border


def _curves(axes: Axes, s: Float, curves: Float, *, single: bool) -> None:
    if single:
        axes.plot(s, curves[:, 0], color=style.SCOPE, lw=2.0, zorder=4)
        return
    for number in reversed(range(curves.shape[1])):
        axes.plot(
            s, curves[:, number], color=TUBE_COLOURS[number % 4], ls=DASHES[number % 4],
            lw=2.0 + 1.2 * number, zorder=6 - min(number, 4),
        )  # fmt: skip
