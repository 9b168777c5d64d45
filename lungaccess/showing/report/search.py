"""A search as pictures: its best cost over time, and its devices by what is made large."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from lungaccess.problem.goals import Goal
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.cost_history import CostPoint


@style.plain_look
def cost_over_time_png(history: Sequence[CostPoint], path: str | os.PathLike[str], goal: Goal) -> Path:
    """Draw the best value of a goal against planning time; a search without a plan says so.

    Costs fall, and chances of success rise.  Raises FileError if the file cannot be written.
    """
    figure = style.new_figure(8.0, 4.5)
    axes = figure.add_axes((0.105, 0.135, 0.86, 0.77))
    found = [point for point in history if point.best is not None]
    if found:
        _steps(axes, found, history[-1].elapsed_s, goal)
    else:
        axes.text(0.5, 0.5, "no plan was found", ha="center", va="center", transform=axes.transAxes)
    # As many letters fit beside the vertical axis.
    drawing.graph(axes, "planning time (s)", textwrap.fill(goal.words_with_unit, 44))
    drawing.title(axes, "Best plan over planning time")
    return style.save_png(figure, path)


def _steps(axes: Axes, found: Sequence[CostPoint], end_s: float, goal: Goal) -> None:
    times = [point.elapsed_s for point in found] + [max(end_s, found[-1].elapsed_s)]
    values = [float(point.best or 0.0) for point in found]
    axes.step(times, [*values, values[-1]], where="post", color=style.SCOPE, lw=2)
    better = [n for n in range(len(values)) if n == 0 or values[n] != values[n - 1]]
    axes.plot([times[n] for n in better], [values[n] for n in better], "o", color=style.SCOPE, ms=5)
    gained = abs(values[-1] - values[0])
    # Words stand on the side of the curve that it leaves free.
    side = -16 if goal.larger_is_better and gained else 2
    _note(
        axes, times[0], values[0], f"first plan {times[0]:.2f} s, {goal.said(values[0])}", (12, side), "left"
    )
    if gained:
        _note(axes, times[-1], values[-1], f"best {goal.said(values[-1])}", (-4, 8), "right")
        axes.set_ylim(min(values) - 0.14 * gained, max(values) + 0.14 * gained)
    if goal.is_share:
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    if len(better) > 2 and times[-1] > 50 * max(times[0], 1e-3):
        axes.set_xscale("log")
    else:
        axes.set_xlim(left=0.0)


def _note(axes: Axes, x: float, y: float, text: str, shift: tuple[float, float], side: str) -> None:
    axes.annotate(
        text, (x, y), xytext=shift, textcoords="offset points", ha=side, va="bottom",
        fontsize=9, color=style.INK, path_effects=drawing.halo(3),
    )  # fmt: skip


@style.plain_look
def front_png(
    criteria: Sequence[str],
    values: Mapping[str, Sequence[float]],
    front: Sequence[str],
    path: str | os.PathLike[str],
) -> Path:
    """Draw each device that was tried on all targets as a point, and the front numbered, with what it bounds.

    Args:
        criteria: Titles of one or two criteria; one alone is drawn over the order in which devices were
            counted.
        values: The criteria of each device by its name, the device first with which the search began.
    """
    two = len(criteria) == 2
    places = {name: (each[1] if two else n, each[0]) for n, (name, each) in enumerate(values.items(), 1)}
    figure = style.new_figure(8.0, 5.0)
    axes = figure.add_axes((0.105, 0.12, 0.86, 0.79))
    axes.plot(*zip(*places.values(), strict=True), "o", color=style.FAINT_INK, ms=4, alpha=0.6)
    steps = tuple(zip(*sorted(places[name] for name in front), strict=True))
    axes.step(
        *steps, "o-", where="pre", color=style.SCOPE, lw=1.2, ms=6, label="front, numbered as its files"
    )
    first = next(iter(places))
    began = f"{first}, where the search began"
    axes.plot(*places[first], "s", color=style.NEEDLE, ms=8, mfc="none", mew=1.6, label=began)
    for number, name in enumerate(front, start=1):
        axes.annotate(f"{number}", places[name], xytext=(6, 5), textcoords="offset points", fontsize=9)
    axes.margins(0.12)
    axes.legend(fontsize=8.5, frameon=False, loc="best")
    drawing.graph(axes, criteria[1] if two else "devices in the order of their count", criteria[0])
    drawing.title(axes, "Devices tried on all targets")
    return style.save_png(figure, path)
