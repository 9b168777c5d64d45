"""A drawing of what plans trade against each other: chance of success, length in tissue and clearance."""

from collections.abc import Sequence

from anatomy.base.words import of_hundred
from lungaccess.planning import Alternative
from lungaccess.showing.report.html import words
from lungaccess.uncertainty.risk import Share

WIDTH, HEIGHT = 560.0, 366.0
LEFT, RIGHT, TOP, BOTTOM = 52.0, 26.0, 14.0, 72.0
COLOURS = ("#D81B60", "#E69F00", "#56B4E9", "#0072B2")
"""The colours of clearances up to each of `CLEARANCES` and beyond; readers who see no red or green can tell
them apart."""
CLEARANCES_MM = (1.0, 2.0, 4.0)
CAPTION = (
    "Success, length and clearance of each plan. Filled and joined: the Pareto front, which no other plan "
    "beats in all three. Bars: 95 % intervals."
)


def trade_off_svg(found: Sequence[Alternative], first: int = 1) -> str:
    """Return plans by length in tissue and chance of success, coloured by clearance; "" where none is known.

    Each plan has its number in the sequence, from `first`; the line joins those on the Pareto front.
    """
    rated = [(n, each) for n, each in enumerate(found, start=first) if each.chance is not None]
    if not rated:
        return ""
    lengths = [each.criteria["length_in_tissue_mm"] for _n, each in rated]
    low, high = 10.0 * (min(lengths) // 10.0), 10.0 * (max(lengths) // 10.0 + 1.0)
    parts = [*_axes(low, high)]

    def place(each: Alternative) -> tuple[float, float]:
        return _x(each.criteria["length_in_tissue_mm"], low, high), _y(each.criteria["success"])

    front = sorted(place(each) for _n, each in rated if each.on_front)
    joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in front)
    parts.append(f'<polyline points="{joined}" fill="none" stroke="currentColor" stroke-dasharray="5 4"/>')
    parts += [_mark(number, each, *place(each)) for number, each in rated]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH:.0f}" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" '
        f'role="img" aria-label="{CAPTION}" font-size="12" font-family="sans-serif" fill="currentColor">'
        f"{''.join(parts)}</svg>"
    )


def _mark(number: int, each: Alternative, x: float, y: float) -> str:
    """Return the drawing of one plan: interval, disc and number."""
    values, chance = each.criteria, each.chance
    if chance is None:
        return ""
    low, high = (_y(end) for end in Share(count=chance.successes, samples=chance.samples).interval)
    colour = COLOURS[sum(values["clearance_mm"] > bound for bound in CLEARANCES_MM)]
    front = ", on the front" if each.on_front else ""
    told = (
        f"plan {number}: succeeds in {of_hundred(chance.share)} of 100, "
        f"{values['length_in_tissue_mm']:.0f} mm in tissue, clearance {values['clearance_mm']:.1f} mm{front}"
    )
    return (
        f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{low:.1f}" y2="{high:.1f}" stroke="{colour}"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5.5" fill="{colour if each.on_front else "none"}" '
        f'stroke="{colour}" stroke-width="2"><title>{words.text(told)}</title></circle>'
        f'<text x="{x + 9:.1f}" y="{y + 4:.1f}">{number}</text>'
    )


def _axes(low: float, high: float) -> list[str]:
    """Return grid, ticks, names of the axes, and what the colours mean."""
    floor, end = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = [
        f'<line x1="{LEFT}" x2="{end}" y1="{_y(share):.1f}" y2="{_y(share):.1f}" stroke="currentColor" '
        f'opacity="0.2"/>{_text(LEFT - 7, _y(share) + 4, of_hundred(share), "end")}'
        for share in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    ]
    for tick in range(int(low), int(high) + 1, 10 if high - low <= 100.0 else 20):
        parts.append(_text(_x(tick, low, high), floor + 16, f"{tick}"))
    parts.append(_text((LEFT + end) / 2, floor + 34, "length in tissue, mm"))
    upright = f' transform="rotate(-90 13 {floor / 2})"'
    parts.append(_text(13, floor / 2, "procedures that succeed, %", more=upright))
    names = [f"up to {bound:g} mm" for bound in CLEARANCES_MM] + [f"more than {CLEARANCES_MM[-1]:g} mm"]
    parts.append(_text(LEFT, HEIGHT - 10, "clearance:", "start"))
    for column, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
        x = LEFT + 80 + 105 * column
        parts.append(f'<circle cx="{x}" cy="{HEIGHT - 14}" r="5" fill="{colour}"/>')
        parts.append(_text(x + 9, HEIGHT - 10, name, "start"))
    return parts


def _text(x: float, y: float, said: str, anchor: str = "middle", more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{more}>{said}</text>'


def _x(length_mm: float, low: float, high: float) -> float:
    return LEFT + (length_mm - low) / (high - low) * (WIDTH - LEFT - RIGHT)


def _y(share: float) -> float:
    return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)
