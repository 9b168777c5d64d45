"""Line charts of a plan as SVG: distances, curvature and cost along its path, and the room over the breath.

The page moves their cursors by two properties of its style, `--along-mm` and `--phase`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from anatomy.base.typed import Float
from lungaccess.plans.costs import known_costs
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html import words
from stages.needle import Objective

LEFT, RIGHT, TOP, FLOOR = 50.0, 506.0, 12.0, 226.0
"""The frame of a chart of 520 by 270 leaves room for numbers and names of the axes."""
STRUCTURES = {
    "airway": ("airway wall", "#3A9BD5", ""), "vessel": ("vessel", "#D81B60", "9 4"),
    "pleura": ("pleura", "#B8860B", "3 4"), "fissure": ("fissure", "#785EF0", "12 4 3 4"),
}  # fmt: skip
"""The name, colour and dashes of the line of each structure are told apart by every vision."""
COSTS = {"inverse_clearance": ("1/clearance", "#0072B2", ""), "cost_map": ("cost map", "#D55E00", "8 4")}
"""The name, colour and dashes of the line of each cost are told apart in the same way."""
ROOM = 3.0
"""The chart of distances reaches to so many times what is required or nearest, so that both are seen."""
MOST_SPARE_MM = 5.0
"""The chart of the breath ends here, as more to spare decides nothing."""
MASKS = "masks"
"""The chart in the phase of the masks has this in place of the number of a computed phase."""
ALONG, ALONG_NAME = "--along-mm", "mm beyond the tip of the scope"


NO_MARKS: Mapping[str, float] = {}


class Line(NamedTuple):
    """A line of a chart, with a gap where it is below 0; of stairs, each value holds up to the next."""

    name: str
    colour: str
    dash: str
    xs: Sequence[float] | Float
    ys: Sequence[float] | Float
    width: float = 2.2
    stairs: bool = False

    @property
    def least(self) -> float:
        """The least value that is not below 0, infinity without one."""
        return min((float(y) for y in self.ys if y >= 0.0), default=math.inf)


def figure(
    kind: str, title: str, names: tuple[str, str], lines: Sequence[Line], *, more: str = "", **options: Any
) -> str:
    """Return a figure with one chart, `more` as HTML behind its title, and the options of `line_chart`."""
    return _figure(kind, words.text(title) + more, line_chart(title, names, lines, **options))


def _figure(kind: str, caption: str, content: str) -> str:
    return f'<figure class="chart-{kind}"><figcaption>{caption}</figcaption>{content}</figure>'


def line_chart(
    title: str, names: tuple[str, str], lines: Sequence[Line], *, least: float = 0.0,
    most: float | None = None, spans: Iterable[Sequence[float]] = (), marks: Mapping[str, float] = NO_MARKS,
    cursor: str = "",
) -> str:  # fmt: skip
    """Return a chart and its legend as HTML.

    Args:
        names: Of the horizontal and the vertical axis.
        least, most: Ends of the vertical axis; what is above is cut off.  Without `most` it holds all lines.
        spans: Stretches of the horizontal axis that are shaded.
        marks: Places of the horizontal axis by their names.
        cursor: The property of the page's style that says where the cursor is; "" for no cursor.
    """
    xs = [float(x) for line in lines for x in line.xs]
    low, high = min(xs), max(*xs, min(xs) + 1e-9)
    end = most or 1.08 * max(1e-9, *(float(y) for line in lines for y in line.ys))
    across, up = (RIGHT - LEFT) / (high - low), (FLOOR - TOP) / (end - least)

    def at(x: float, y: float) -> tuple[float, float]:
        # What is cut off lies at the upper end of the picture, so that its path is short.
        return round(LEFT + (x - low) * across, 1), round(max(FLOOR - (y - least) * up, 0.0), 1)

    parts = []
    for begin, stop in spans:
        box = f'x="{at(begin, 0)[0]:.1f}" width="{max(stop - begin, 0) * across:.1f}"'
        parts.append(f'<rect {box} y="{TOP}" height="{FLOOR - TOP}" class="span"/>')
    for value in ticks(least, end):
        y = at(low, value)[1]
        parts += [_line(LEFT, y, RIGHT, y, 'class="grid"'), _text(LEFT - 7, y + 4, f"{value:.10g}", "end")]
    parts += [_text(at(value, 0)[0], FLOOR + 17, f"{value:.10g}") for value in ticks(low, high)]
    parts += [_line(LEFT, FLOOR, RIGHT, FLOOR, 'class="axis"'), _text(285, 262, names[0])]
    parts.append(_text(13, 113, names[1], more=' transform="rotate(-90 13 113)"'))
    for name, value in marks.items():
        x = at(value, 0)[0]
        parts += [_line(x, TOP, x, FLOOR, 'class="mark"'), _text(x + 4, TOP + 10, name, "start")]
    frame, size = f"{LEFT} {TOP} {RIGHT - LEFT} {FLOOR - TOP}", (RIGHT - LEFT, FLOOR - TOP)
    parts.append(f'<svg x="{LEFT}" y="{TOP}" width="{size[0]}" height="{size[1]}" viewBox="{frame}" ')
    parts.append(f'style="width: {size[0]}px; height: {size[1]}px">')
    for line in lines:
        places = [at(x, y) if y >= 0.0 else None for x, y in zip(line.xs, line.ys, strict=True)]
        stroke = f'stroke="{line.colour}" stroke-width="{line.width}" stroke-dasharray="{line.dash}"'
        parts.append(f'<path d="{_path(places, line.stairs)}" fill="none" {stroke}/>')
    if cursor:
        # Before the page has set the property, the cursor is beyond the frame.
        shift = f"calc((var({cursor}, {low - 1.0}) - {low}) * {across}px)"
        parts.append(_line(LEFT, TOP, LEFT, FLOOR, f'class="cursor" style="transform: translateX({shift})"'))
    ranges = "; ".join(f"{line.name} {line.least:.3g} to {max(line.ys):.3g}" for line in lines)
    legend = "".join(
        '<li><svg viewBox="0 0 34 8" class="sample" aria-hidden="true">'
        + _line(0, 4, 34, 4, f'stroke="{line.colour}" stroke-width="3" stroke-dasharray="{line.dash}"')
        + f"</svg>{words.text(line.name)}</li>"
        for line in lines
    )
    return (
        f'<svg viewBox="0 0 520 270" role="img" aria-label="{words.text(f"{title}: {ranges}")}">'
        f'{"".join(parts)}</svg></svg><ul class="legend">{legend}</ul>'
    )


def ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers between two."""
    raw = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.999 * raw)
    return [n * step for n in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _line(x1: float, y1: float, x2: float, y2: float, more: str) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" {more}/>'


def _text(x: float, y: float, said: str, anchor: str = "middle", more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{words.text(said)}</text>'


def _path(places: Sequence[tuple[float, float] | None], stairs: bool) -> str:
    """Return the path through places, which begins anew after a gap; within a level it has no places."""
    parts, before = [], None
    for place, after in zip(places, [*places[1:], None], strict=True):
        if place and before and stairs:
            parts.append(f"L{place[0]} {before[1]}")
        if place and not (before and after and before[1] == place[1] == after[1]):
            parts.append(f"{'L' if before else 'M'}{place[0]} {place[1]}")
        before = place
    return "".join(parts)


def plan_figures(plan: Plan, profile: Mapping[str, Any], samples: Mapping[str, Any], has_map: bool) -> str:
    """Return the charts of a plan.

    Args:
        profile: As `lungaccess.showing.report.html.deployment.profile` finds it.
        samples: As `lungaccess.showing.report.html.breathing.samples` finds them; empty without a breath.
        has_map: Whether the patient has a cost map.
    """
    along, begin_mm = profile["arc_length_mm"], profile["tube_mm"]
    title = (
        "Distance of the axis to each structure, near what is required (shaded: the pierced wall is exempt)"
    )
    distances = [_distances(title, ALONG_NAME, profile, profile["clearance_mm"], MASKS)]
    for n, phase in enumerate(samples.get("phases", ())):
        found = {name: values[n] for name, values in samples["clearance_mm"].items()}
        name = f"{ALONG_NAME}, at {100.0 * phase:.0f} % of the breath"
        distances.append(_distances(title, name, profile, found, str(n)))
    bend = [Line("curvature", "#0072B2", "", along, profile["curvature_per_mm"], stairs=True)]
    if plan.needle is not None:
        most = 2 * [profile["most_curvature_per_mm"]]
        bend.append(Line("limit of the needle", "currentColor", "6 4", [begin_mm, along[-1]], most, 1.6))
    costs = [Line(*COSTS[key], profile["cost_mm"], values) for key, values in profile["cost"].items()]
    total = words.number(known_costs(plan.costs, has_map=has_map)[plan.objective], 4)
    told = f"In all {total} ({Objective.of(plan.objective).words}, as the plan states)."
    curvature = figure(
        "curvature", "Curvature of tubes and needle", (ALONG_NAME, "1/mm"), bend, marks=profile["marks"],
        cursor=ALONG,
    )  # fmt: skip
    cost = figure(
        "cost", "Cost along the path in tissue.", (ALONG_NAME, "cost so far"), costs, cursor=ALONG,
        more=f' <span class="cost-total">{words.text(told)}</span>',
    )  # fmt: skip
    over_breath = _breath(plan, samples) if samples else ""
    return _figure("clearance", title, "".join(distances)) + over_breath + curvature + cost


def _distances(
    title: str, name: str, profile: Mapping[str, Any], found: Mapping[str, Float], key: str
) -> str:
    """Return the chart of the distances at one phase, hidden but for that of the masks."""
    along, cap_mm, required = profile["arc_length_mm"], profile["cap_mm"], profile["required_mm"]
    lines = [Line(*STRUCTURES[structure], along, ys) for structure, ys in found.items()]
    most = min(ROOM * max(min(line.least for line in lines), *required), cap_mm)
    for n, structure in enumerate(found):
        crossed = structure == "fissure" and not profile["fissures_are_obstacles"]
        least = f"{'over ' if lines[n].least >= cap_mm else ''}{lines[n].least:.1f} mm at least"
        lines[n] = lines[n]._replace(name=f"{lines[n].name}{' (may be crossed)' * crossed}: {least}")
    lines.append(Line("required", "currentColor", "", along, required, 1.8, stairs=True))
    spans = [(0.0, profile["exempt_to_mm"])]
    options = {"most": most, "marks": profile["marks"], "spans": spans, "cursor": ALONG}
    chart = line_chart(title, (name, "mm"), lines, **options)
    return f'<div data-sample="{key}"{"" if key == MASKS else " hidden"}>{chart}</div>'


def _breath(plan: Plan, samples: Mapping[str, Any]) -> str:
    """Return what is to spare over the breath; what is nearer than required, or too far, is on the floor."""
    xs = [100.0 * phase for phase in samples["phases"]]
    lines = [
        Line(*STRUCTURES[name], xs, [max(mm, 0.0) for mm in values])
        for name, values in samples["spare_mm"].items()
    ]
    target = [max(samples["allowed_mm"] - mm, 0.0) for mm in samples["target_mm"]]
    lines.append(Line("target", "#009E73", "1 3", xs, target, 3.0))
    title = (
        "To spare over the breath: clearance of tubes and needle beyond what is required, and tolerance of "
        f"the end (0: none left; at {len(xs)} phases; shaded: the window)"
    )
    names = "% of the breath (0: end-exhale, 100: end-inhale)", "mm to spare"
    window = () if plan.window is None else (100.0 * plan.window.phases).tolist()
    return figure("breath", title, names, lines, most=MOST_SPARE_MM, spans=window, cursor="--phase")


def history_figure(history: Sequence[Sequence[float]], made_small: str) -> str:
    """Return the best value of the goal over planning time, s; "" for less than two values."""
    if len(history) < 2:
        return ""
    xs, ys = zip(*history, strict=True)
    line = Line("best plan so far", "#0072B2", "", xs, ys, stairs=True)
    title, names = f"{made_small.capitalize()} over planning time", ("planning time, s", made_small)
    return figure("history", title, names, [line], least=0.98 * min(ys), most=1.02 * max(ys))
