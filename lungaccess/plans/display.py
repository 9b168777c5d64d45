"""How a plan looks in a notebook: what each device does, distances and costs, and two drawings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from anatomy.display import AXIAL, CORONAL, Drawing, point, side_by_side, table
from lungaccess.plans.curves import device_curves

if TYPE_CHECKING:
    from lungaccess.plans.plan import Plan

TARGET_COLOUR, EXIT_COLOUR = "#2ca02c", "#d62728"
STEP_MM = 1.0
"""Spacing of the drawn poses: the drawings are small, and finer ones only make the notebook larger."""
LEAST_WIDTH_MM = 1.5
"""A thinner device is drawn this wide, so that it can be seen."""


def plan_html(plan: Plan) -> str:
    """Return a plan as HTML."""
    drawings = [_drawing(plan, view).svg() for view in (CORONAL, AXIAL)]
    return side_by_side(table(_rows(plan), f"Plan for {plan.patient_name}, {plan.system.name}"), *drawings)


def _rows(plan: Plan) -> list[tuple[str, str]]:
    scope, tube, needle = plan.scope, plan.tube, plan.needle
    rows = [
        ("target, LPS mm", f"{point(plan.target_lps)} ({plan.target_origin})"),
        (
            "scope",
            f"{scope.length_from_carina_mm:.1f} mm beyond the carina, to generation {scope.generation}",
        ),
        (
            "tubes",
            f"turn to {np.degrees(tube.rotation_rad):.1f}°, outer {tube.outer_insertion_mm:.1f} mm, "
            f"inner {tube.inner_insertion_mm:.1f} mm",
        ),
        ("exit", f"branch {tube.exit.branch}, at {np.degrees(tube.exit.wall_angle_rad):.0f}° to the wall"),
        (
            "needle",
            f"{needle.length_mm:.1f} mm in {len(needle.arcs)} arc(s), at most "
            f"{np.degrees(needle.max_angle_from_start_rad):.1f}° from its start",
        ),
    ]
    for device, distances in plan.clearance_mm.items():
        least = plan.required_clearance_mm[{"tube": "inner_tube"}.get(device, device)]
        words = ", ".join(f"{name} {value:.2f}" for name, value in distances.items())
        rows.append((f"{device}: distance, mm", f"{words}; at least {least:.2f}"))
    costs = ", ".join(f"{name} {value:.4g}" for name, value in plan.costs.items())
    return [
        *rows,
        ("costs", f"{costs}; made small: {plan.objective}"),
        ("made by", f"{plan.method}, seed {plan.seed}, {plan.iterations} iterations"),
        ("digest", plan.digest[:16]),
    ]


def _drawing(plan: Plan, view: str) -> Drawing:
    drawing = Drawing(view)
    for curve in device_curves(plan, STEP_MM):
        red, green, blue = (round(255 * c) for c in curve.colour)
        width_mm = max(2.0 * float(curve.radius_mm.max()), LEAST_WIDTH_MM)
        drawing.line(curve.points_lps, f"#{red:02x}{green:02x}{blue:02x}", width_mm)
    drawing.mark(plan.tube.exit.point_lps, EXIT_COLOUR)
    drawing.mark(plan.target_lps, TARGET_COLOUR)
    return drawing
