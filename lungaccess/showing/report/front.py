"""The devices of a search by what is made large, with their front, as a picture."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from lungaccess.showing.report import drawing, style


def front_png(
    criteria: Sequence[str],
    values: Mapping[str, Sequence[float]],
    front: Sequence[str],
    path: str | os.PathLike[str],
) -> Path:
    """Draw each device that was tried on all targets as a point, and the front numbered, with what it bounds.

    Parameters
    ----------
    criteria : sequence of str
        Titles of one or two criteria; one alone is drawn over the order in which devices were counted.
    values : mapping
        The criteria of each device by its name, the device first with which the search began.
    front : sequence of str
        Names of the devices that no other one surpasses, in the order of their numbers.
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
