"""How an appraisal looks in a notebook: the headline in the colour of its grade, then the nearest limits."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from anatomy.display import table
from lungaccess.appraisal.headline import Headline
from lungaccess.appraisal.limits import LIMITS_TITLE, Limit


def appraisal_html(headline: Headline, limits: Iterable[Limit]) -> str:
    """Return headline, details and limits as HTML."""
    said = escape(f"{headline.grade.mark} {headline.verdict}: {headline.text}")
    details = "".join(f"<div><small>{escape(each)}</small></div>" for each in headline.details)
    rows = [(each.what, f"{each.found_words}, {each.bound_words}") for each in limits]
    first = f'<div style="color:{headline.grade.colour}"><b>{said}</b></div>'
    return f"{first}{details}{table(rows, LIMITS_TITLE)}"
