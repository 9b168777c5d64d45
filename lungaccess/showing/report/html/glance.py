"""What is read of a plan at a glance: chance of success, why it fails, its geometry, its nearest limit."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lungaccess.judging.appraisal.grade import Grade, grade_of_chance
from lungaccess.judging.appraisal.headline import Geometry, of_hundred
from lungaccess.showing.report.html import words

if TYPE_CHECKING:
    from lungaccess.judging.appraisal import Appraisal, Headline, Limit


def glance_section(appraisal: Appraisal) -> str:
    """Return a list of the few things that decide about a plan, each as a number with its mark."""
    said = appraisal.headline
    tiles = [_chance(said), *_failures(said), _geometry(said), *map(_limit, appraisal.limits[:1])]
    return f'<ul class="glance" aria-label="At a glance">{"".join(tiles)}</ul>'


def _tile(what: str, grade: Grade | None, value: str, note: str, bar: str = "") -> str:
    """Return one of the things: its name, its value with the mark of a grade, and what belongs to it."""
    coloured = "" if grade is None else f' class="grade-{grade.key}"'
    mark = "" if grade is None else f'<span class="mark">{grade.mark}</span> '
    return (
        f"<li{coloured}><span class='what'>{words.text(what)}</span>"
        f"<strong>{mark}{words.text(value)}</strong>{bar}<span class='note'>{words.text(note)}</span></li>"
    )


def _chance(said: Headline) -> str:
    success = said.success
    if success is None:
        return _tile("Chance of success", Grade.UNKNOWN, "not computed", "")
    low, high = success.interval
    width = max(100.0 * (high - low), 1.0)
    bar = (
        '<span class="bar" aria-hidden="true">'
        f'<span style="margin-left:{min(100.0 * low, 99.0):.1f}%;width:{width:.1f}%"></span></span>'
    )
    note = f"95 % interval {of_hundred(low)} to {of_hundred(high, up=True)}"
    value = f"{of_hundred(success.value)} of 100"
    return _tile("Chance of success", grade_of_chance(success), value, note, bar)


def _failures(said: Headline) -> list[str]:
    """Return what fails most often, nothing where nothing failed."""
    return [
        _tile("Fails most", None, f"{of_hundred(share.value, up=True)} of 100", name)
        for name, share in said.failures[:1]
    ]


def _geometry(said: Headline) -> str:
    grade = {
        Geometry.PROVED: Grade.UNKNOWN if said.fissures_unknown else Grade.GOOD,
        Geometry.UNCHECKED: Grade.UNKNOWN,
        Geometry.REFUSED: Grade.POOR,
    }[said.geometry]
    note = "fissures not checked" if said.fissures_unknown else "by the planner and by an independent check"
    if said.geometry is not Geometry.PROVED:
        note = "by the independent check" if said.geometry is Geometry.REFUSED else ""
    return _tile("Geometry", grade, str(said.geometry), note)


def _limit(limit: Limit) -> str:
    note = f"{limit.what}: {limit.found_words}, needs {limit.bound_words}"
    if limit.ok:
        return _tile("Nearest limit", None, f"{limit.used_words} used", note)
    return _tile("Broken limit", Grade.POOR, "BROKEN", note)
