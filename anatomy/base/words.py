"""Numbers in sentences."""

from __future__ import annotations


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, which takes an "s" unless the count is 1.

    Examples
    --------
    >>> plural(1, "arc"), plural(2000, "draw")
    ('1 arc', '2,000 draws')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
