"""Panels of numbers: clearance along tube and needle, and the key figures of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from anatomy.typed import Float
from anatomy.words import plural
from lungaccess.appraisal.limits import SHOWN_LIMITS
from lungaccess.plans.costs import costs_in_words, known_costs
from lungaccess.report import drawing, style

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.appraisal import Appraisal
    from lungaccess.plans.plan import Plan


CURVES = {
    "airway": ("airway wall", "#2F7FB5", "-"),
    "vessel": ("vessel", "#B4485A", "--"),
    "pleura": ("pleura", "#5F5F5F", "-."),
    "fissure": ("fissure", style.FISSURE, ":"),
}
STRUCTURES = {"airway": "airway wall", "outside": "outside of the lung"}
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
    """Draw the least distance of the axis (radius and margins), which steps at each tube end."""
    required = plan.required_clearance_mm
    outer_end = plan.tube.outer_insertion_mm - tube_arc[-1]
    places = [along[0], max(outer_end, along[0]), 0.0, along[-1]]
    levels = [required["outer_tube"], required["inner_tube"], required["needle"]]
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
    axes.set_xlabel(note, fontsize=8)
    axes.set_ylabel("mm", fontsize=8.5)
    axes.tick_params(labelsize=8)
    axes.grid(color="#E6E6E6", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, loc="upper right", framealpha=0.92, ncols=2, borderpad=0.5, handlelength=2.4)


Row = tuple[str, str]


def key_numbers(plan: Plan, lung: Lung, appraisal: Appraisal | None = None) -> list[tuple[str, list[Row]]]:
    """Return headed rows of a label and a value; distances are those of the appraisal, if there is one."""
    distances = _clearance_rows(plan) if appraisal is None else _limit_rows(appraisal)
    return [*figures_of_plan(plan, lung), distances]


def figures_of_plan(plan: Plan, lung: Lung) -> list[tuple[str, list[Row]]]:
    """Return headed rows of what the plan does and costs, without its limits."""
    costs = costs_in_words(known_costs(plan.costs, has_map=lung.cost is not None))
    return [("Plan", _general_rows(plan)), *_stage_rows(plan), ("Cost", costs)]


def _general_rows(plan: Plan) -> list[Row]:
    x, y, z = (float(c) for c in plan.target_lps)
    return [
        ("patient", plan.patient_name),
        ("system", plan.system.name),
        ("target, LPS mm", f"{x:.1f}, {y:.1f}, {z:.1f}"),
        ("target, RAS mm", f"{-x + 0.0:.1f}, {-y + 0.0:.1f}, {z:.1f}"),
        ("fissures", _fissures(plan)),
        ("breath hold", plan.breath_hold or "not stated"),
        ("method, seed", f"{plan.method}, {plan.seed}"),
    ]


def _fissures(plan: Plan) -> str:
    if plan.fissures_are_obstacles:
        return "are obstacles"
    return "may be crossed" if plan.system.fissures_allowed else "not known"


def _stage_rows(plan: Plan) -> list[tuple[str, list[Row]]]:
    scope, tube, needle = plan.scope, plan.tube, plan.needle
    insertions_mm = f"{tube.outer_insertion_mm:.1f} / {tube.inner_insertion_mm:.1f} mm"
    scope_rows = [
        ("airway generation at the tip", f"{scope.generation}"),
        ("advance beyond the carina", f"{scope.length_from_carina_mm:.1f} mm"),
    ]
    tube_rows = [
        ("rotation", f"{np.degrees(tube.rotation_rad):.1f}°"),
        ("outer / inner beyond scope", insertions_mm),
        ("pierced branch", f"{tube.exit.branch}"),
    ]
    needle_rows = [
        ("length", f"{needle.length_mm:.1f} mm in {plural(len(needle.arcs), 'arc')}"),
        ("greatest angle from start", f"{np.degrees(needle.max_angle_from_start_rad):.1f}°"),
        ("accumulated turn", f"{np.degrees(needle.accumulated_turn_rad):.1f}°"),
    ]
    return [("Scope", scope_rows), ("Tube", tube_rows), ("Needle", needle_rows)]


def _limit_rows(appraisal: Appraisal) -> tuple[str, list[Row]]:
    rows = [(each.what, each.comparison) for each in appraisal.limits]
    return "Nearest to a limit", rows[:SHOWN_LIMITS]


def _clearance_rows(plan: Plan) -> tuple[str, list[Row]]:
    return "Least distance stated by the plan / required", [
        (f"{device} to {STRUCTURES.get(name, name)}", f"{value:.2f} / {_least(plan, device, name)}")
        for device in ("tube", "needle")
        for name, value in plan.clearance_mm[device].items()
    ]


def _least(plan: Plan, device: str, structure: str) -> str:
    if structure == "fissure" and not plan.fissures_are_obstacles:
        return "allowed"
    return f"{plan.required_clearance_mm[{'tube': 'inner_tube'}.get(device, device)]:.2f} mm"


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
