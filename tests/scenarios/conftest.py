"""Scenes and answers, made once a session; cases of real patients carry their marks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.scenarios import expected as expectations
from tests.scenarios.cases import ANATOMIES, CASES, DEFAULT_DEVICE, LONG_PLANNERS, Case
from tests.scenarios.runs import Answer, answer_for
from tests.scenarios.scenes import Scenes

AnswersOf = Callable[[Case], list[Answer]]


def marked(cases: Sequence[Case] = CASES) -> list[Any]:
    """Return cases as parameters: those of real patients need the data and are slow.

    Of the first anatomy the cases of one device are run, unless their planner takes long; the rest is slow.
    """

    def marks(case: Case) -> tuple[pytest.MarkDecorator, ...]:
        if case.anatomy.is_real:
            return (pytest.mark.data, pytest.mark.slow)
        first = case.anatomy == ANATOMIES[0] and case.device == DEFAULT_DEVICE
        return () if first and case.planner not in LONG_PLANNERS else (pytest.mark.slow,)

    return [pytest.param(case, id=case.name, marks=marks(case)) for case in cases]


@pytest.fixture(scope="session")
def expected() -> dict[str, Any]:
    return expectations.load()


@pytest.fixture(scope="session")
def synthetic() -> Scenes:
    return Scenes()


@pytest.fixture(scope="session")
def scenes_of(synthetic: Scenes, request: pytest.FixtureRequest) -> Callable[[Case], Scenes]:
    """Return the scenes of a case; where they are real ones, skip without the data."""

    def scenes(case: Case) -> Scenes:
        if case.anatomy.is_real:
            synthetic.data = Path(request.getfixturevalue("data_dir"))
        return synthetic

    return scenes


@pytest.fixture(scope="session")
def answers_of(scenes_of: Callable[[Case], Scenes], expected: dict[str, Any]) -> AnswersOf:
    made: dict[Case, list[Answer]] = {}

    def answers(case: Case) -> list[Answer]:
        if case not in made:
            targets = expected["targets"][case.anatomy.name]
            made[case] = [answer_for(scenes_of(case), case, target) for target in targets]
        return made[case]

    return answers
