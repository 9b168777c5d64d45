"""Successive halving of numbers, which cost what they are."""

from __future__ import annotations

import math

import pytest

from stages.needle.search.portfolio import successive_halving


def half(count: int, _finite: int) -> int:
    return count // 2


def test_the_cheaper_half_goes_on_for_twice_the_work_until_one_is_left() -> None:
    rungs = list(successive_halving([3.0, 1.0, 2.0, 4.0], float, work=5, survivors=half))
    assert rungs == [([3.0, 1.0, 2.0, 4.0], 5), ([1.0, 2.0], 10), ([1.0], 20)]


def test_candidates_of_infinite_cost_go_no_further() -> None:
    rungs = list(successive_halving([math.inf, 2.0, math.inf, math.inf], float, work=1, survivors=half))
    assert rungs[1:] == [([2.0], 2)]


@pytest.mark.parametrize("candidates", [[], [1.0], [5.0, 2.0, 3.0]])
def test_rungs_may_be_counted(candidates: list[float]) -> None:
    rungs = list(successive_halving(candidates, float, work=1, survivors=lambda _n, m: (m + 1) // 2, rungs=4))
    assert [work for _, work in rungs] == [1, 2, 4, 8]
    assert rungs[-1][0] == sorted(candidates)[:1]


def test_costs_are_those_after_the_work() -> None:
    costs = {"a": math.inf, "b": 5.0}
    rungs = successive_halving(["a", "b"], costs.__getitem__, work=1, survivors=half)
    assert next(rungs)[0] == ["a", "b"]
    costs["a"] = 1.0
    assert next(rungs)[0] == ["a"]
