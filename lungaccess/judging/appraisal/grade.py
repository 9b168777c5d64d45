"""How good the news about a plan is: the one place where chances become grades, and grades get their mark."""

from enum import IntEnum

from lungaccess.uncertainty.risk.statistics import Share

GOOD_FROM = 0.90
"""From here on fewer than one procedure in ten has to be repeated or fails."""
FAIR_FROM = 0.50
"""Below this a plan fails more often than it succeeds."""


class Grade(IntEnum):
    """How good the news is; of several parts, the greatest value, the worst part, holds for the whole."""

    GOOD = 0
    FAIR = 1
    UNKNOWN = 2
    """Something was not checked or not estimated: worse than fair, because nothing is known."""
    POOR = 3

    @property
    def mark(self) -> str:
        """A character that tells the grade without its colour."""
        return {Grade.GOOD: "✓", Grade.FAIR: "!", Grade.UNKNOWN: "?", Grade.POOR: "✗"}[self]

    @property
    def colour(self) -> str:
        """A colour for pictures and notebooks, dark enough for white paper."""
        return {
            Grade.GOOD: "#00704A",
            Grade.FAIR: "#8A5A00",
            Grade.UNKNOWN: "#8A5A00",
            Grade.POOR: "#B00020",
        }[self]

    @property
    def key(self) -> str:
        """The grade in JSON and in style sheets."""
        return self.name.lower()


def grade_of_chance(success: Share | None) -> Grade:
    """Return the grade of a chance of success, by the lower end of its 95 % interval.

    The lower end decides, so that few draws cannot make a grade better than many would.
    """
    if success is None:
        return Grade.UNKNOWN
    low, _high = success.interval
    if low >= GOOD_FROM:
        return Grade.GOOD
    return Grade.FAIR if low >= FAIR_FROM else Grade.POOR
