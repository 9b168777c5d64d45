"""The one picture of a plan: three projections, two cuts, the clearances and the key numbers."""

import os
import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Appraisal
from lungaccess.judging.appraisal.headline import Headline
from lungaccess.plans.plan import Plan
from lungaccess.showing.report import drawing, style, zoom
from lungaccess.showing.report.key_numbers import key_numbers
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import STANDARD, View

WIDTH_IN, HEIGHT_IN = 18.0, 11.9
HEADLINE_TOP_IN = 0.47
# left, bottom, width, height of each panel, inches
PROJECTIONS_IN = ((0.55, 6.0, 4.75, 4.7), (5.85, 6.0, 4.75, 4.7), (11.15, 6.0, 3.35, 4.7))
EXIT_IN, NEEDLE_IN = (0.3, 0.75, 4.3, 4.3), (4.8, 0.75, 4.3, 4.3)
TEXT_LETTERS = 46
"""The width of the panel of the words: a label and its value on one line have no more letters."""
CLEARANCE_IN, TEXT_IN = (9.75, 0.95, 4.75, 4.05), (14.85, 0.5, 2.95, 10.4)


@style.plain_look
def overview_png(
    plan: Plan, lung: Lung, path: str | os.PathLike[str], appraisal: Appraisal | None = None
) -> Path:
    """Draw a plan in its anatomy and write the picture to `path`.

    Below the title stands the headline of the appraisal; without one it says that nothing was checked.

    The axial projection is seen from the feet and the coronal one from the front, as radiologists
    do: the patient's left is on the right of the picture.  Ticks are LPS mm.  The two cuts below show
    scope, tubes and needle true to their width; vessels up to 2 mm beside the cut show faintly.
    Fissures, nodules and cost may be missing.

    FileError is raised if the file cannot be written, as when the folder is missing.  Returns its path.
    """
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    for box, view in zip(PROJECTIONS_IN, STANDARD, strict=True):
        _projection(style.panel(figure, box), plan, layers, view)
    zoom.exit_zoom(style.panel(figure, EXIT_IN), plan, layers)
    zoom.needle_zoom(style.panel(figure, NEEDLE_IN), plan, layers)
    _clearance_panel(style.panel(figure, CLEARANCE_IN), plan, lung)
    _text_panel(style.panel(figure, TEXT_IN), plan, lung, appraisal)
    _heading(figure, plan, appraisal)
    _legend(figure, layers, plan)
    return style.save_png(figure, path)


def _projection(axes: Axes, plan: Plan, layers: Layers, view: View) -> None:
    """Draw anatomy and all three stages as seen along a view."""
    frame = layers.footprint("lung", view) or layers.footprint("airway", view)
    scope = view.project(plan.curves().scope.points_lps)
    drawing.anatomy_seen_through(axes, layers, view)
    drawing.fit_around(axes, frame, scope)
    footprint = layers.footprint("nodule", view)
    drawing.see_through(axes, footprint, style.NODULE, 2.0, 0.8)
    drawing.outline(axes, footprint, style.NODULE, 1.0)
    _stages(axes, plan, view, scope)
    zoom.goal_marks(axes, plan, view)
    drawing.dress(axes, view, ticks=True)
    drawing.title(axes, view.name)


def _stages(axes: Axes, plan: Plan, view: View, scope: Float) -> None:
    _scope, *others = plan.shown_curves()
    drawing.curve(axes, scope, style.SCOPE, 3.4, 6)
    for order, curve in enumerate(others, start=7):
        colour, width = (style.NEEDLE, 2.2) if curve.name.startswith("needle") else (style.TUBE, 3.0)
        drawing.curve(axes, view.project(curve.points_lps), colour, width, order)


def _heading(figure: Figure, plan: Plan, appraisal: Appraisal | None) -> None:
    """Write the title, and the headline below it in the colour of its grade."""
    stages = "Three-stage plan" if plan.needle is not None else "Plan of scope and tubes"
    style.heading(figure, f"{stages} for {plan.patient_name}", size=15)
    headline = Headline.of(None, None) if appraisal is None else appraisal.headline
    words = f"{headline.grade.mark} {headline.verdict}: {headline.text}"
    figure.text(
        0.3 / WIDTH_IN,
        1 - HEADLINE_TOP_IN / HEIGHT_IN,
        # This many letters of the headline's size fill the width of the picture.
        textwrap.fill(words, 240),
        va="top",
        fontsize=10,
        color=headline.grade.colour,
    )


def _legend(figure: Figure, layers: Layers, plan: Plan) -> None:
    entries: list[Line2D | Patch] = [
        Line2D([], [], color=style.SCOPE, lw=4, label="bronchoscope"),
        Line2D([], [], color=style.TUBE, lw=4, label="tubes"),
        *([Line2D([], [], color=style.NEEDLE, lw=3, label="needle")] if plan.needle is not None else []),
        Line2D([], [], color=style.INK, lw=0.9, ls=(0, (3, 2)), label="required clearance"),
        Line2D([], [], ls="none", marker="D", mfc="white", mec=style.INK, label="exit"),
        Line2D([], [], ls="none", marker="o", ms=9, mfc="none", mec=style.TARGET, mew=2, label="target"),
    ]
    if plan.aim is not None:
        entries.append(Line2D([], [], ls="none", marker="x", ms=7, mec=style.AIM, mew=2, label="aim"))
    if layers.has("nodule"):
        entries.append(Patch(color=style.NODULE, alpha=0.6, label="nodule"))
    entries.append(Patch(facecolor=style.LUMEN, edgecolor=style.AIRWAY, label="airway lumen"))
    if layers.count("airway") > layers.count("lumen"):
        entries.append(Patch(color=style.AIRWAY, label="airway wall"))
    entries += [Patch(color=style.VESSEL, label="vessel"), Patch(color="#C9C9C9", label="outside the lung")]
    if layers.has("fissure"):
        entries.append(Patch(color=style.FISSURE, alpha=0.6, label="fissure"))
    figure.legend(
        handles=entries, loc="lower left",
        bbox_to_anchor=(0.2 / WIDTH_IN, 0.08 / HEIGHT_IN), ncols=len(entries), fontsize=9, frameon=False,
        handlelength=1.8, columnspacing=1.3,
    )  # fmt: skip


CURVES = {
    "airway": ("airway wall", "#2F7FB5", "-"),
    "vessel": ("vessel", "#B4485A", "--"),
    "pleura": ("pleura", "#5F5F5F", "-."),
    "fissure": ("fissure", style.FISSURE, ":"),
}
LEAST_TOP_MM, MOST_TOP_MM = 4.0, 15.0
"""Least and greatest upper end of the clearance axis, so that what is near and required fills it."""


def _clearance_panel(axes: Axes, plan: Plan, lung: Lung) -> None:
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
    # Show where the wall of the pierced airway may be near: from the scope to the exempt needle.
    stop = plan.exemption.needle_length_mm
    axes.axvspan(-tube_arc[-1], stop, color=style.AIRWAY, alpha=0.16, lw=0, zorder=0)
    axes.axvline(plan.tube.exit.arc_length_mm - tube_arc[-1], color=style.TUBE, lw=1.4, ls=":", zorder=3)
    axes.axvline(0.0, color=style.FAINT_INK, lw=0.8, zorder=2)
    axes.set_xlim(along[0], along[-1])
    axes.set_ylim(0.0, min(highest, MOST_TOP_MM))
    drawing.title(axes, "Distance of the device's axis to each structure")
    note = "mm beyond the tube tip (negative: along the tube)\nblue: pierced wall is exempt; dotted: exit"
    drawing.graph(axes, note, "mm")
    axes.legend(fontsize=8, loc="upper right", framealpha=0.92, ncols=2, borderpad=0.5, handlelength=2.4)


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


def _text_panel(axes: Axes, plan: Plan, lung: Lung, appraisal: Appraisal | None = None) -> None:
    """Write the key numbers of a plan, evenly over the height of a panel."""
    axes.set_axis_off()
    blocks = [(heading, rows) for heading, rows in key_numbers(plan, lung, appraisal) if rows]
    blocks = [(heading, [line for row in rows for line in _fitting(*row)]) for heading, rows in blocks]
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


def _fitting(label: str, value: str) -> list[tuple[str, str]]:
    """Return the lines of a label and its value, none of which is wider than the panel of the words."""
    *first, last = textwrap.wrap(label, max(TEXT_LETTERS - len(value), TEXT_LETTERS // 2)) or [""]
    if len(last) + len(value) > TEXT_LETTERS:
        first, last = [*first, last], ""
    return [*((line, "") for line in first), (last, value)]
