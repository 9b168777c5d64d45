"""The needle planners on queries in synthetic lungs, and on recorded ones in real lungs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.scenarios.cases import (
    ANATOMIES,
    COST_TOLERANCE,
    NEEDLE_ITERATIONS,
    NEEDLE_PLANNERS,
    SHARED_QUERIES,
    Anatomy,
)
from tests.scenarios.runs import Answer, costlier, lost, needle_answers
from tests.scenarios.scenes import Scenes
from tests.scenarios.shared_queries import SharedQueries

SYNTHETIC = [
    pytest.param(anatomy, id=anatomy.name, marks=() if number == 0 else pytest.mark.slow)
    for number, anatomy in enumerate(each for each in ANATOMIES if not each.is_real)
]


def require_no_regression(stored: dict[str, Any], answers: list[Answer]) -> None:
    """Fail unless as many queries are solved, as cheaply, by valid paths."""
    found = [answer.cost for answer in answers]
    assert stored["iterations"] == NEEDLE_ITERATIONS
    assert lost(stored["costs"], found) == []
    assert costlier(stored["costs"], found, COST_TOLERANCE) == []
    assert [answer.faults for answer in answers if answer.faults] == []


@pytest.mark.parametrize("planner", NEEDLE_PLANNERS)
@pytest.mark.parametrize("anatomy", SYNTHETIC)
def test_queries(anatomy: Anatomy, planner: str, synthetic: Scenes, expected: dict[str, Any]) -> None:
    queries = expected["queries"][anatomy.name]
    answers = needle_answers(synthetic, anatomy, queries, planner)
    require_no_regression(expected["needles"][f"{anatomy.name}/{planner}"], answers)
    again = needle_answers(synthetic, anatomy, queries, planner)
    assert [answer.digest for answer in again] == [answer.digest for answer in answers]


@pytest.fixture(scope="module")
def shared(data_dir: Path) -> SharedQueries:
    return SharedQueries(data_dir)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("planner", NEEDLE_PLANNERS)
def test_recorded_queries(planner: str, shared: SharedQueries, expected: dict[str, Any]) -> None:
    answers = shared.answers(planner)
    assert len(answers) == len(SHARED_QUERIES)
    require_no_regression(expected["shared"][planner], answers)
