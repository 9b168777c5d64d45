"""Numbers in sentences, and which of several names was meant."""

from collections.abc import Iterable
from difflib import get_close_matches


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, which takes an "s" unless the count is 1.

    Examples
    --------
    >>> plural(1, "arc"), plural(2000, "draw")
    ('1 arc', '2,000 draws')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def did_you_mean(given: str, names: Iterable[str]) -> str:
    """Return a question that offers the name nearest to a wrong one; "" if none is near.

    Examples
    --------
    >>> did_you_mean("lung_defualt", ["lung-default", "ultrathin"])
    "Did you mean 'lung-default'?"
    >>> did_you_mean("robot", ["lung-default", "ultrathin"])
    ''
    """
    plain = {name.lower().replace("_", "-"): name for name in names}
    found = get_close_matches(given.lower().replace("_", "-"), plain, n=1)
    return f"Did you mean {plain[found[0]]!r}?" if found else ""
