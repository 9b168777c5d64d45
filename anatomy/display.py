"""Small HTML tables and drawings for notebooks, made of plain values; every text is escaped."""

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float

CORONAL, AXIAL = "coronal, from the front", "axial, from the feet"
GENERATION_COLOURS = ("#08306b", "#2171b5", "#4eb3d3", "#41ab5d", "#fe9929", "#cc4c02", "#7f0000")
DRAWING_PX = 260
"""Side of a drawing: two of them and a table stand side by side in a notebook."""


def table(rows: Iterable[tuple[str, str]], heading: str = "") -> str:
    """Return an HTML table of two columns, a name and a value, with a heading above it."""
    cells = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th>'
        f'<td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return title(heading) + f"<table>{cells}</table>"


def title(heading: str) -> str:
    """Return a heading as HTML; nothing for none."""
    return f"<div><b>{escape(heading)}</b></div>" if heading else ""


def side_by_side(*parts: str) -> str:
    """Return pieces of HTML in a row."""
    cells = "".join(f'<div style="margin-right:1.5em">{part}</div>' for part in parts)
    return f'<div style="display:flex;flex-wrap:wrap;align-items:flex-start">{cells}</div>'


class Drawing:
    """Lines and marks in LPS mm as SVG, `CORONAL` or `AXIAL` as in radiology: the patient's left is right."""

    def __init__(self, view: str) -> None:
        self._view = view
        self._lines: list[tuple[Float, str, float]] = []
        self._marks: list[tuple[Float, str]] = []

    def line(self, points_lps: ArrayLike, colour: str, width_mm: float) -> None:
        """Add a polyline `(N, 3)`."""
        self._lines.append((self._flat(points_lps), colour, width_mm))

    def mark(self, point_lps: ArrayLike, colour: str) -> None:
        """Add a ring around a point `(3,)`."""
        self._marks.append((self._flat(point_lps)[0], colour))

    def _flat(self, points_lps: ArrayLike) -> Float:
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        return points[:, [0, 1]] if self._view == AXIAL else points[:, [0, 2]] * (1.0, -1.0)

    def svg(self) -> str:
        """Return the drawing as an SVG element with R and L, and the name of the view."""
        everything = [points for points, _, _ in self._lines] + [point[None] for point, _ in self._marks]
        points = np.concatenate(everything) if everything else np.zeros((1, 2))
        low, high = points.min(axis=0) - 8.0, points.max(axis=0) + 8.0
        size = float((high - low).max())
        corner = 0.5 * (low + high - size)
        shapes = [_polyline(line, colour, width) for line, colour, width in self._lines]
        shapes += [
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{0.02 * size:.1f}" fill="none" stroke="{colour}" '
            f'stroke-width="{0.007 * size:.1f}"/>'
            for (x, y), colour in self._marks
        ]
        x, y = corner
        text = f'font-size="{0.06 * size:.1f}" fill="#555"'
        shapes.append(f'<text x="{x:.1f}" y="{y + size / 2:.1f}" {text}>R</text>')
        shapes.append(f'<text x="{x + 0.95 * size:.1f}" y="{y + size / 2:.1f}" {text}>L</text>')
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{DRAWING_PX}" height="{DRAWING_PX}" '
            f'viewBox="{x:.1f} {y:.1f} {size:.1f} {size:.1f}" style="background:#fff">'
            f"<title>{escape(self._view)}</title>{''.join(shapes)}</svg>"
            f'<div style="color:#555">{escape(self._view)}</div>'
        )


def _polyline(points: Float, colour: str, width_mm: float) -> str:
    kept = [0]
    for n in range(1, len(points)):
        # Points of a drawn line are at least this far apart, its ends excepted: half a pixel of a whole lung.
        if n == len(points) - 1 or np.linalg.norm(points[n] - points[kept[-1]]) >= 1.5:
            kept.append(n)
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points[kept])
    return (
        f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{width_mm:.1f}" '
        'stroke-linecap="round" stroke-linejoin="round"/>'
    )


def bullets(heading: str, lines: Sequence[str]) -> str:
    """Return a list under a heading; nothing for an empty one."""
    if not lines:
        return ""
    return title(heading) + "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def point(lps: ArrayLike) -> str:
    """Return a point in words."""
    return ", ".join(f"{c:.1f}" for c in np.asarray(lps, dtype=np.float64))
