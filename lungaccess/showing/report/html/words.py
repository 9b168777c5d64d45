"""HTML made of plain values: escaped text, tables, lists."""

import math
import shlex
from collections.abc import Iterable, Sequence
from html import escape

from lungaccess.judging.advice import Advice
from lungaccess.judging.appraisal import Grade, Headline

Cell = str


def text(value: object) -> str:
    """Return a value as HTML text."""
    return escape(str(value), quote=True)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number of so many significant digits, a dash for none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[Cell]], kind: str = "") -> str:
    """Return a table; its cells are HTML already, the first one of each row is its heading.

    Args:
        headings: Empty for a table of names and values.
        kind: Class of the table for the style sheet.
    """
    head = "".join(f'<th scope="col">{text(name)}</th>' for name in headings)
    head = f"<thead><tr>{head}</tr></thead>" if headings else ""
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>'
        for first, *rest in rows
    )
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{text(caption)}">'
        f'<table class="{text(kind)}"><caption>{text(caption)}</caption>'
        f"{head}<tbody>{body}</tbody></table></div>"
    )


def pairs(caption: str, rows: Iterable[tuple[str, object]], kind: str = "pairs") -> str:
    """Return a table of names and values, both plain text; of the kind "shares" no value is wrapped."""
    return table(caption, (), [(text(name), text(value)) for name, value in rows], kind)


def steps(items: Iterable[str]) -> str:
    """Return a numbered list of plain sentences."""
    return "<ol>" + "".join(f"<li>{text(item)}</li>" for item in items) + "</ol>"


def verdict(ok: bool | None, no: str = "REFUSED") -> str:
    """Return a word with a mark, so that it does not depend on its colour."""
    if ok is None:
        return "? not checked"
    return '<span class="good">✓ ok</span>' if ok else f'<span class="bad">✗ {text(no)}</span>'


def bullets(items: Iterable[object]) -> str:
    """Return a list; nothing for no items."""
    listed = "".join(f"<li>{text(item)}</li>" for item in items)
    return f"<ul>{listed}</ul>" if listed else ""


def headline(said: Headline) -> str:
    """Return a headline in one sentence, whose colour and mark follow the worse of its parts."""
    return (
        f'<p class="headline grade-{said.grade.key}"><span class="mark">{said.grade.mark}</span> '
        f"<strong>{text(said.verdict.capitalize())}:</strong> "
        f'<span class="said">{text(said.reasons)}.</span></p>'
    )


def estimate_details(said: Headline) -> str:
    """Return what the estimate of success rests on, folded; nothing where there is none."""
    sentences = (said.chance_text, *said.details) if said.details else ()
    details = "".join(f"<p class='note'>{text(each)}</p>" for each in sentences)
    return f"<details><summary>What the estimate rests on</summary>{details}</details>" if details else ""


def advice(given: Sequence[Advice]) -> str:
    """Return what would lift the chance of success as a list, nothing where there is nothing."""
    items = "".join(
        f"<li>{text(each.sentence)} <code>{text(shlex.join(each.options))}</code></li>" for each in given
    )
    return f"<div class='advice'><b>What lifts the chance</b><ul>{items}</ul></div>" if items else ""


def grade(which: Grade, said: str) -> str:
    """Return words with the mark and the colour of a grade."""
    return f'<span class="grade-{which.key}">{which.mark} {text(said)}</span>'
