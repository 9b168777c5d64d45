"""Successive halving [JamiesonTalwalkar2016]: candidates get work by rungs, and the better half goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count
from typing import TypeVar

C = TypeVar("C")


def successive_halving(
    candidates: list[C],
    cost: Callable[[C], float],
    *,
    work: int,
    survivors: Callable[[int, int], int],
    rungs: int | None = None,
) -> Iterator[tuple[list[C], int]]:
    """Yield the candidates of each rung, and how much work each of them is to get on it.

    The caller does the work before it asks for the next rung.  The cheapest candidates go on to that, the
    cheapest first, for twice the work each.

    Parameters
    ----------
    candidates : list
        Those of the first rung.
    cost : callable
        Returns what a candidate costs after the work so far; infinite ones go no further.
    work : int
        Work for each candidate on the first rung, in a unit of the caller's.
    survivors : callable
        Returns how many candidates go on, given how many a rung had and how many of them have a finite cost.
    rungs : int, optional
        Number of rungs; by default the last rung is the first that has no more than one candidate.
    """
    for rung in count() if rungs is None else range(rungs):
        yield candidates, work << rung
        if rungs is None and len(candidates) <= 1:
            return
        finite = sorted((each for each in candidates if math.isfinite(cost(each))), key=cost)
        candidates = finite[: survivors(len(candidates), len(finite))]
