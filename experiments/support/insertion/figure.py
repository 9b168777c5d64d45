"""Pictures of needles inserted with errors: their true paths, and the errors of their tips."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from anatomy.lung import Lung
from lungaccess.planning.procedure.insertion import TOLERANCE_MM, InsertionStudy
from lungaccess.showing.report import style
from lungaccess.showing.report.insertion import draw_paths

LEVEL_COLOURS = (style.NODULE, style.SCOPE, style.VESSEL)


def draw_insertions(
    lung: Lung, at_target: InsertionStudy, by_level: dict[str, list[InsertionStudy]]
) -> Figure:
    """Draw the true paths to one target over a slice of the lung, and the tip errors of all by level."""
    figure = style.new_figure(13.0, 5.2)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.5, 1.0]})
    draw_paths(left, lung, at_target)
    left.set_title("True paths to one target, whole errors; grey: what the plane cuts", fontsize=10)
    for (level, made), colour in zip(by_level.items(), LEVEL_COLOURS, strict=True):
        modes = [each.open_loop for each in made], [each.closed_loop for each in made]
        for line, kind, mode in zip(("--", "-"), ("open", "closed"), modes, strict=True):
            errors = np.sort(np.concatenate([each.tip_errors_mm for each in mode]))
            share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
            label = f"{level} errors, {kind} loop"
            right.step(errors, share, line, where="post", color=colour, label=label)
    right.axvline(TOLERANCE_MM, color=style.FAINT_INK, lw=0.8)
    right.set(
        xscale="log", xlim=(0.05, 100.0), ylim=(0.0, 100.0), xlabel="tip error, mm", ylabel="insertions, %"
    )
    right.set_title(f"Tip error of {len(errors)} insertions each ({lung.name})", fontsize=10)
    right.legend(fontsize=8, loc="lower right", frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure
