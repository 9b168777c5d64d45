"""Rows of states of a motion, written one step after the other."""

from __future__ import annotations

State = tuple[float, ...]
"""Advance in mm, twist and bend in rad."""


def turn(rows: list[State], twist: float, bend: float, by_straight: bool) -> None:
    """Add a change in place, which may go by the straight section: twisting that moves nothing."""
    advance, twist_before, bend_before = rows[-1]
    if (twist, bend) == (twist_before, bend_before):
        return
    if by_straight and bend_before != 0.0:
        rows.append((advance, twist_before, 0.0))
    if by_straight and twist != twist_before and bend != 0.0:
        rows.append((advance, twist, 0.0))
    rows.append((advance, twist, bend))


def slide(rows: list[State], advance_mm: float) -> None:
    """Add an advance with twist and bend held; one that goes on with the advance before replaces its end."""
    if advance_mm <= rows[-1][0]:
        return
    _, twist, bend = rows[-1]
    if len(rows) > 1 and rows[-2][1:] == (twist, bend):
        rows.pop()
    rows.append((advance_mm, twist, bend))
