"""Plans of all stages: no target lost, none costlier, every plan valid, every run repeatable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.scenarios.cases import COST_TOLERANCE, PLANNERS, Case
from tests.scenarios.conftest import AnswersOf, marked
from tests.scenarios.runs import answer_for, costlier, lost
from tests.scenarios.scenes import Scenes

pytestmark = pytest.mark.parametrize("case", marked())


def test_no_target_is_lost(case: Case, answers_of: AnswersOf, expected: dict[str, Any]) -> None:
    found = [answer.cost for answer in answers_of(case)]
    assert lost(expected["plans"][case.name]["costs"], found) == []


def test_no_plan_is_dearer(case: Case, answers_of: AnswersOf, expected: dict[str, Any]) -> None:
    found = [answer.cost for answer in answers_of(case)]
    assert costlier(expected["plans"][case.name]["costs"], found, COST_TOLERANCE) == []


def test_every_plan_is_valid_and_every_refusal_names_a_stage(case: Case, answers_of: AnswersOf) -> None:
    wrong = {number: answer.faults for number, answer in enumerate(answers_of(case)) if answer.faults}
    assert wrong == {}


def test_a_second_run_gives_the_same_bytes(
    case: Case, answers_of: AnswersOf, scenes_of: Callable[[Case], Scenes], expected: dict[str, Any]
) -> None:
    answers, targets = answers_of(case), expected["targets"][case.anatomy.name]
    planned = [number for number, answer in enumerate(answers) if answer.cost is not None]
    refused = [number for number, answer in enumerate(answers) if answer.cost is None]
    for number in planned[:1] + refused[:1]:
        again = answer_for(scenes_of(case), case, targets[number])
        assert again.digest == answers[number].digest


def test_the_case_is_recorded(case: Case, expected: dict[str, Any]) -> None:
    stored = expected["plans"][case.name]
    assert stored["iterations"] == PLANNERS[case.planner].iterations
    assert len(stored["costs"]) == len(expected["targets"][case.anatomy.name]) >= 6
