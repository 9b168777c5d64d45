"""The page of a search that found no plan: where needles can start, what blocks, and what would reach it."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.judging.explanation import Explanation
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.colours import MISS, NEAREST, OTHER, START_COLOURS
from lungaccess.showing.report.html import words
from lungaccess.showing.report.html.document import scene_figure, slice_controls, write_page
from lungaccess.showing.report.html.meshes import structure_meshes
from lungaccess.showing.report.html.volumes import page_image
from lungaccess.showing.report.pack import Packed, pack

MODULES = ("devices.js", "no_plan.js")
PLACES = '<label>Through <select id="place"></select></label>'
"""Places to which the cross of the slices can be put."""


def no_plan_page(explanation: Explanation, lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Write the page of a search that found no plan to one HTML file that opens offline.

    Raises FileError if the file cannot be written.
    """
    rows = [(reason, count) for reason, count in explanation.failure.reasons.items() if count]
    parts = {
        "title": words.text(f"No plan for {explanation.patient_name}"),
        "headline": words.text(explanation.headline),
        "advice": words.text(explanation.advice or "Nothing that was tried reaches the target"),
        "slice_controls": slice_controls(more=PLACES),
        "scene": scene_figure(),
        "sections": _sections_html(explanation),
        "reasons": words.pairs("What was looked at, and what was ruled out", rows),
    }
    return write_page(path, "no_plan.html", MODULES, _page_data(explanation, lung), parts)


def _page_data(explanation: Explanation, lung: Lung) -> dict[str, Any]:
    """Return what the scripts of the page draw, as plain JSON values."""
    target = explanation.target.lps_mm
    paths = list(_paths(explanation))
    # The fine slices show no more of a path than what is within 60 mm of the target.
    near = [points[np.linalg.norm(points - target, axis=1) <= 60.0] for _, points in paths]
    return {
        "page": "no plan",
        "patient": lung.name,
        "structures": structure_meshes(lung),
        "starts": _starts(explanation),
        "paths": [packed for packed, _points in paths],
        "target_lps": target.tolist(),
        "places": [
            {"name": f"{each.place.kind}, {each.arcs} arcs", "lps": each.place.lps_mm.tolist()}
            for each in explanation.blocking
        ],
        **page_image(lung, np.vstack([target, *near])),
    }


def _sections_html(explanation: Explanation) -> str:
    """Return the sections of an explanation as tables."""
    from lungaccess.judging.explanation import sections

    return "".join(
        words.table(each.title, each.headings, [[words.text(cell) for cell in row] for row in each.rows])
        for each in sections(explanation)
    )


def _starts(explanation: Explanation) -> list[Packed]:
    """Return the cells of starts, a group for each reason, the nearest to success first."""
    from lungaccess.judging.explanation import FAILS

    starts = explanation.starts
    if starts is None:
        return []
    return [
        {
            "key": key,
            "name": f"{name} ({starts.counts[name]})",
            "colour": START_COLOURS[key],
            "points": pack(starts.points_lps[starts.why == code], "f4"),
        }
        for code, (key, name) in enumerate(FAILS.items())
        if (starts.why == code).any()
    ]


def _paths(explanation: Explanation) -> Iterator[tuple[Packed, Float]]:
    """Yield the paths that can be shown: the miss, the nearest plan, and plans of other systems."""
    radius = explanation.system.track_radius_mm
    if explanation.miss is not None:
        points = explanation.miss.points_lps
        yield _path("path that violates least (not allowed)", MISS, radius, [points], True)
    if explanation.neighbour is not None:
        yield _devices("plan to the nearest point reached", NEAREST, explanation.neighbour.plan, True)
    for attempt in explanation.attempts:
        if attempt.succeeded and attempt.plan is not None:
            yield _devices(f"plan with {attempt.system.name}", OTHER, attempt.plan, True)
    for each in explanation.changes:
        if each.accepted:
            yield _devices(f"plan with {each.change}", OTHER, each.change.plan, False)


def _devices(name: str, colour: str, plan: Plan, shown: bool) -> tuple[Packed, Float]:
    curves = [curve.points_lps for curve in plan.curves().present]
    return _path(name, colour, plan.system.track_radius_mm, curves, shown)


def _path(name: str, colour: str, radius_mm: float, curves: list[Float], shown: bool) -> tuple[Packed, Float]:
    packed = {
        "name": name, "colour": colour, "radius_mm": radius_mm, "shown": shown,
        "curves": [pack(curve, "f4") for curve in curves],
    }  # fmt: skip
    return packed, curves[-1]
