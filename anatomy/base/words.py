"""Numbers in sentences, and which of several names was meant."""

import math
from collections.abc import Iterable
from difflib import get_close_matches


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, which takes an "s" unless the count is 1.

    Examples:
        >>> plural(1, "arc"), plural(2000, "draw")
        ('1 arc', '2,000 draws')
    """
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def of_hundred(share: float, *, up: bool = False) -> str:
    """Return a share as a number of 100, rounded down, or up where the greater number is the worse.

    Near 0 and 100 it has one decimal, and below 0.1 one digit, so that neither end is stated where it does
    not hold.  Tables, sentences and pages all write shares by it, so that one share never reads as two.

    Examples:
        >>> of_hundred(0.0065), of_hundred(0.428), of_hundred(0.9996), of_hundred(0.428, up=True)
        ('0.6', '42', '99.9', '43')
        >>> of_hundred(0.000123), of_hundred(0.0)
        ('0.01', '0')
    """
    decimals = 0 if 0.1 <= share <= 0.9 else 1
    if 0.0 < share < 0.001:
        # Shares that are smaller than these decimals tell are written as 0: nothing is known so well.
        decimals = min(-math.floor(math.log10(share)) - 2, 6)
    exact = round(100.0 * 10**decimals * share, 6)
    text = f"{(math.ceil(exact) if up else math.floor(exact)) / 10**decimals:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if decimals else text


def percent(share: float, *, up: bool = False) -> str:
    """Return a share in percent, as `of_hundred` writes it.

    Examples:
        >>> percent(0.428), percent(0.428, up=True)
        ('42 %', '43 %')
    """
    return f"{of_hundred(share, up=up)} %"


def range_of_hundred(interval: Iterable[float]) -> str:
    """Return an interval of a share as two numbers of 100, rounded outwards.

    Examples:
        >>> range_of_hundred((0.267, 0.331))
        '26 to 34'
    """
    low, high = interval
    return f"{of_hundred(low)} to {of_hundred(high, up=True)}"


def point_in_words(lps_mm: Iterable[float]) -> str:
    """Return a point in mm in both frames, since a reader may have either at hand.

    Examples:
        >>> point_in_words((1.0, 0.0, 3.0))
        'LPS (1.0, 0.0, 3.0) = RAS (-1.0, 0.0, 3.0) mm'
    """
    x, y, z = (float(v) + 0.0 for v in lps_mm)
    return f"LPS ({x:.1f}, {y:.1f}, {z:.1f}) = RAS ({-x + 0.0:.1f}, {-y + 0.0:.1f}, {z:.1f}) mm"


def did_you_mean(given: str, names: Iterable[str]) -> str:
    """Return a question that offers the name nearest to a wrong one; "" if none is near.

    Examples:
        >>> did_you_mean("lung_defualt", ["lung-default", "ultrathin"])
        "Did you mean 'lung-default'?"
        >>> did_you_mean("robot", ["lung-default", "ultrathin"])
        ''
    """
    plain = {name.lower().replace("_", "-"): name for name in names}
    found = get_close_matches(given.lower().replace("_", "-"), plain, n=1)
    return f"Did you mean {plain[found[0]]!r}?" if found else ""
