"""Where a drawn path fits its corridor, neither the proof nor the search that ends denies it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.search.resolution import Outcome, Resolution, ResolutionSearch
from tests.stages.needle.corridors import Corridor, drawn_corridor

STEPS = 25
"""Of the proof: the cubes, and the planes of the first one or two levels."""
POPS = 2000
RESOLUTION = Resolution(coarse_mm=8.0, fine_mm=2.0, coarse_rolls=4, fine_rolls=16)


def proved(corridor: Corridor) -> bool:
    """Tell whether the proof says that there is no path."""
    proof = NoPathProof(corridor.environment, corridor.query)
    return any(proof.advance() for _ in range(STEPS)) and proof.outcome == "no path"


def ended(corridor: Corridor) -> bool:
    """Tell whether the search of words says that there is none."""
    search = ResolutionSearch(corridor.environment, corridor.query, resolution=RESOLUTION)
    search.advance(POPS)
    return search.outcome == Outcome.NONE


def counterexamples(
    seed: int, count: int, is_denied: Callable[[Corridor], bool], resolution: Resolution | None = None
) -> list[int]:
    """Draw corridors, each from its own seed; return the numbers of those whose path is denied."""
    found, drawn = [], 0
    for number in range(count):
        corridor = drawn_corridor(np.random.default_rng([seed, number]), resolution)
        drawn += corridor is not None
        if corridor is not None and is_denied(corridor):
            found.append(number)
    assert drawn > 0.8 * count
    return found


def stiffer(corridor: Corridor) -> Corridor:
    """Return the question for a needle that bends less, by which some paths are none."""
    environment = corridor.environment
    limits = environment.limits._replace(kappa=0.8 * environment.limits.kappa)
    return replace(corridor, environment=replace(environment, limits=limits))


def test_no_path_in_a_corridor_is_proved_away() -> None:
    assert not counterexamples(0, 30, proved)


def test_no_word_in_a_corridor_is_missed_by_the_search_that_ends() -> None:
    assert not counterexamples(1, 40, ended, RESOLUTION)


@pytest.mark.parametrize("denied", [proved, ended])
def test_the_same_search_finds_a_needle_that_is_taken_to_bend_less(
    denied: Callable[[Corridor], bool],
) -> None:
    assert counterexamples(2, 25, lambda corridor: denied(stiffer(corridor)))


def test_the_same_search_finds_a_pierced_wall_that_is_taken_to_count() -> None:
    assert counterexamples(
        3, 40, lambda corridor: proved(replace(corridor, query=replace(corridor.query, branch=-1)))
    )


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_no_path_of_a_hundred_thousand_is_proved_away(part: int) -> None:
    assert not counterexamples(100 + part, 10_000, proved)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_no_word_of_a_hundred_thousand_is_missed_by_the_search_that_ends(part: int) -> None:
    assert not counterexamples(200 + part, 10_000, ended, RESOLUTION)
