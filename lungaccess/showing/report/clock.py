"""The breath as a clock: end-exhale at the top, end-inhale at the bottom, and the window on its rim."""

import math
import os
from pathlib import Path

from anatomy.base.records import frozen_value
from lungaccess.plans.window import BreathingWindow

PROVED, MODEL_ONLY, NOT_PROVED = "#009E73", "#B8860B", "#C9A5A0"
"""Proved for this patient, by a model of other people's lungs, and neither; their lightness differs, too."""
SIZE_IN = (8.0, 4.6)


@frozen_value
class Sector:
    """A stretch of phases on the rim; `proved` tells whether it belongs to the window."""

    begin: float
    end: float
    proved: bool


def sectors(window: BreathingWindow) -> list[Sector]:
    """Return the stretches of a breath in order, from end-exhale to end-inhale."""
    found, last = [], 0.0
    for begin, end in window.phases.tolist():
        found += [Sector(begin=last, end=begin, proved=False)] if begin > last else []
        found.append(Sector(begin=begin, end=end, proved=True))
        last = end
    return [*found, *([Sector(begin=last, end=1.0, proved=False)] if last < 1.0 else [])]


def limit_names(window: BreathingWindow) -> list[tuple[float, str]]:
    """Return where the window ends within the breath, in order, with a word for why."""
    return [(each.phase, f"{100.0 * each.phase:.1f} % {each.reason}") for each in window.limits]


def on_rim(phase: float, *, exhaling: bool = False, radius: float = 1.0) -> tuple[float, float]:
    """Return x to the right and y upwards of a phase: inhaling on the right half, exhaling on the left."""
    angle = math.pi * phase * (-1.0 if exhaling else 1.0)
    return radius * math.sin(angle), radius * math.cos(angle)


def window_png(window: BreathingWindow, path: str | os.PathLike[str]) -> Path:
    """Draw the window of a plan on the clock of a breath, with what ends it.

    Raises FileError if the file cannot be written.
    """
    from lungaccess.showing.report import style

    return style.plain_look(_drawn)(window, path)


def _drawn(window: BreathingWindow, path: str | os.PathLike[str]) -> Path:
    import textwrap

    from matplotlib.patches import Patch, Wedge

    from lungaccess.showing.report import style

    figure = style.new_figure(*SIZE_IN)
    held = MODEL_ONLY if window.warning_only else PROVED
    axes = style.panel(figure, (0.2, 0.2, 4.4, 3.8))
    for each in sectors(window):
        for begin, end in ((each.begin, each.end), (-each.end, -each.begin)):
            colour = held if each.proved else NOT_PROVED
            angles = (90.0 - 180.0 * end, 90.0 - 180.0 * begin)
            axes.add_patch(Wedge((0.0, 0.0), 1.0, *angles, width=0.26, facecolor=colour, edgecolor="none"))
    for phase, name in limit_names(window):
        for exhaling in (False, True):
            inner, outer = (on_rim(phase, exhaling=exhaling, radius=r) for r in (0.7, 1.06))
            axes.plot(*zip(inner, outer, strict=True), color=style.INK, lw=1.2)
        x, y = on_rim(phase, radius=1.12)
        axes.text(x, y, name, ha="left", va="center", fontsize=9, color=style.INK)
    x, y = on_rim(window.masks_phase, radius=0.6)
    axes.plot([0.0, x], [0.0, y], color=style.FAINT_INK, lw=1.0, ls=(0, (3, 2)))
    axes.text(0.0, 1.08, "end-exhale, 0 %", ha="center", va="bottom", fontsize=9)
    axes.text(0.0, -1.08, "end-inhale, 100 %", ha="center", va="top", fontsize=9)
    axes.text(0.36, 0.0, "in", ha="center", va="center", fontsize=9, color=style.FAINT_INK)
    axes.text(-0.36, 0.0, "out", ha="center", va="center", fontsize=9, color=style.FAINT_INK)
    axes.set(xlim=(-1.3, 1.95), ylim=(-1.25, 1.25), aspect="equal")
    axes.set_axis_off()
    style.heading(figure, "Window of breathing", size=13)
    said = "by a model only: a warning" if window.warning_only else "proved"
    patches = [Patch(color=held, label=said), Patch(color=NOT_PROVED, label="not proved")]
    figure.legend(handles=patches, loc="lower right", frameon=False, fontsize=9, ncol=2)
    sentences = (window.words, f"Motion: {window.motion_source}; broken line: the phase of the masks.")
    text = "\n\n".join(textwrap.fill(each, 38) for each in sentences)
    figure.text(0.575, 0.86, text, va="top", fontsize=9.5, color=style.INK)
    return style.save_png(figure, path)
