"""How a plan looks in a notebook: its figures, and its devices drawn from the front and from the feet."""

from collections.abc import Iterable

from anatomy.base.typed import Float
from anatomy.display import AXIAL, CORONAL, Drawing, side_by_side, table
from lungaccess.plans.curves import DeviceCurves

TARGET_COLOUR, EXIT_COLOUR = "#2ca02c", "#d62728"
"""The colours of target and exit in 3D Slicer's scene and in the drawings."""


def plan_html(
    heading: str, rows: Iterable[tuple[str, str]], curves: DeviceCurves, exit_lps: Float, target_lps: Float
) -> str:
    """Return a plan as HTML.

    Args:
        rows (iterable of (str, str)): Names and values of the table.
        exit_lps, target_lps ((3,) float64, LPS mm): Where rings are drawn.
    """
    drawings = [_drawing(view, curves, exit_lps, target_lps) for view in (CORONAL, AXIAL)]
    return side_by_side(table(rows, heading), *drawings)


def _drawing(view: str, curves: DeviceCurves, exit_lps: Float, target_lps: Float) -> str:
    drawing = Drawing(view)
    for curve in curves.present:
        red, green, blue = (round(255 * c) for c in curve.colour)
        # A thinner device is drawn this wide, so that it can be seen.
        width_mm = max(2.0 * float(curve.radius_mm.max()), 1.5)
        drawing.line(curve.points_lps, f"#{red:02x}{green:02x}{blue:02x}", width_mm)
    drawing.mark(exit_lps, EXIT_COLOUR)
    drawing.mark(target_lps, TARGET_COLOUR)
    return drawing.svg()
