"""Panels of numbers: clearance along tube and needle, and the key figures of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from anatomy.base.typed import Float
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.key_numbers import key_numbers

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.judging.appraisal import Appraisal
    from lungaccess.plans.plan import Plan


CURVES = {
    "airway": ("airway wall", "#2F7FB5", "-"),
    "vessel": ("vessel", "#B4485A", "--"),
    "pleura": ("pleura", "#5F5F5F", "-."),
    "fissure": ("fissure", style.FISSURE, ":"),
}
LEAST_TOP_MM, MOST_TOP_MM = 4.0, 15.0
"""Least and greatest upper end of the clearance axis, so that what is near and required fills it."""


def clearance_panel(axes: Axes, plan: Plan, lung: Lung) -> None:
    """Plot the distance of tube and needle axis to each structure, and what is required."""
    _scope, tube, needle = plan.curves()
    tube_arc = tube.arc_length_mm
    lps = np.concatenate([tube.points_lps, needle.points_lps[1:]])
    along = np.concatenate([tube_arc - tube_arc[-1], needle.arc_length_mm[1:]])
    highest = LEAST_TOP_MM
    for name, (label, colour, dashes) in CURVES.items():
        if name not in lung.fields or (name == "fissure" and not lung.has_fissures):
            continue
        clearance = np.maximum(lung.fields[name].lower_bound_mm(lps), 0.0)
        note = " (allowed)" if name == "fissure" and not plan.fissures_are_obstacles else ""
        axes.plot(along, clearance, color=colour, ls=dashes, lw=1.8, label=label + note, zorder=4)
        highest = max(highest, 1.2 * float(clearance[along >= 0].min()) + 4.0)
    _required_line(axes, plan, tube_arc, along)
    _exempt_span(axes, plan, tube_arc)
    axes.axvline(0.0, color=style.FAINT_INK, lw=0.8, zorder=2)
    axes.set_xlim(along[0], along[-1])
    axes.set_ylim(0.0, min(highest, MOST_TOP_MM))
    _label_clearance(axes)


def _required_line(axes: Axes, plan: Plan, tube_arc: Float, along: Float) -> None:
    """Draw the least distance of the axis (radius, margins and sweep), which steps at each tube end."""
    required, beside_mm = plan.required_clearance_mm, plan.tube.clearance_loss_mm
    tubes = plan.system.tubes
    ends = [max(length - tube_arc[-1], along[0]) for length in plan.tube.insertions_mm(tubes)]
    places, levels = [along[0], *ends], [required[f"{name}_tube"] + beside_mm for name, _tube in tubes.named]
    if plan.needle is not None:
        places, levels = [*places, along[-1]], [*levels, required["needle"]]
    for start, stop, level in zip(places[:-1], places[1:], levels, strict=True):
        axes.fill_between([start, stop], 0.0, level, color=style.FORBIDDEN, lw=0, zorder=1)
    axes.stairs(levels, places, baseline=None, color=style.INK, lw=1.4, label="required", zorder=5)


def _exempt_span(axes: Axes, plan: Plan, tube_arc: Float) -> None:
    """Show where the wall of the pierced airway may be near: from the scope to the exempt needle."""
    stop = plan.exemption.needle_length_mm
    axes.axvspan(-tube_arc[-1], stop, color=style.AIRWAY, alpha=0.16, lw=0, zorder=0)
    axes.axvline(plan.tube.exit.arc_length_mm - tube_arc[-1], color=style.TUBE, lw=1.4, ls=":", zorder=3)


def _label_clearance(axes: Axes) -> None:
    drawing.title(axes, "Distance of the device's axis to each structure")
    note = "mm beyond the tube tip (negative: along the tube)\nblue: pierced wall is exempt; dotted: exit"
    drawing.graph(axes, note, "mm")
    axes.legend(fontsize=8, loc="upper right", framealpha=0.92, ncols=2, borderpad=0.5, handlelength=2.4)


def text_panel(axes: Axes, plan: Plan, lung: Lung, appraisal: Appraisal | None = None) -> None:
    """Write the key numbers of a plan, evenly over the height of a panel."""
    axes.set_axis_off()
    blocks = [(heading, rows) for heading, rows in key_numbers(plan, lung, appraisal) if rows]
    lines = sum(len(rows) + 1.6 for _, rows in blocks)
    step = min(1.0 / lines, 0.034)
    y = 1.0
    for heading, rows in blocks:
        axes.text(0.0, y, heading, fontsize=9.5, fontweight="bold", color=style.INK, va="top")
        y -= 1.1 * step
        for label, value in rows:
            axes.text(0.02, y, label, fontsize=8.3, color=style.FAINT_INK, va="top")
            axes.text(1.0, y, value, fontsize=8.3, color=style.INK, va="top", ha="right")
            y -= step
        y -= 0.5 * step
