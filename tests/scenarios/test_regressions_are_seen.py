"""The scenarios fail where they should: costlier plans, lost targets, plans too near to something."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from lungaccess.plans import evaluator
from stages.needle.environment import NeedleEnvironment, needle_environment
from tests.scenarios import runs
from tests.scenarios.cases import CASES, COST_TOLERANCE, NEEDLE_PLANNERS
from tests.scenarios.runs import answer_for, costlier, lost
from tests.scenarios.scenes import Scenes

(CASE,) = (case for case in CASES if case.name == "phantom-1/flexure-needle/atlas-shortest")


def test_5_percent_are_seen_and_rounding_is_not(expected: dict[str, Any]) -> None:
    stored = expected["plans"][CASE.name]["costs"]
    known = sum(cost is not None for cost in stored)

    def times(factor: float) -> list[float | None]:
        return [None if cost is None else factor * cost for cost in stored]

    assert len(costlier(stored, times(1.05), COST_TOLERANCE)) == known > 0
    assert len(costlier(stored, times(np.nan), COST_TOLERANCE)) == known
    assert costlier(stored, times(1.0 + 1e-6), COST_TOLERANCE) == []
    assert costlier(stored, times(0.5), COST_TOLERANCE) == []


def test_a_lost_target_is_seen_and_a_new_one_is_no_fault() -> None:
    assert lost([1.0, None, 2.0], [1.0, 3.0, None]) == [2]
    with pytest.raises(ValueError, match="shorter|longer"):
        lost([1.0, None], [1.0])


def test_every_planner_and_device_has_something_to_lose(expected: dict[str, Any]) -> None:
    synthetic = [case for case in CASES if not case.anatomy.is_real]
    for part in ("planner", "device"):
        for value in {getattr(case, part) for case in synthetic}:
            cases = [case for case in synthetic if getattr(case, part) == value]
            assert any(cost for case in cases for cost in expected["plans"][case.name]["costs"])
    for planner in NEEDLE_PLANNERS:
        names = [name for name in expected["needles"] if name.endswith(f"/{planner}")]
        assert sum(cost is not None for name in names for cost in expected["needles"][name]["costs"]) >= 6


@pytest.mark.slow
def test_a_planner_without_the_clearance_test_is_refused(
    synthetic: Scenes, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def careless_environment(*arguments: Any, **options: Any) -> NeedleEnvironment:
        environment = needle_environment(*arguments, **options)
        limits = environment.limits._replace(required_mm=0.0)
        return replace(environment, limits=limits, required_clearance_mm=0.0)

    monkeypatch.setattr(evaluator, "needle_environment", careless_environment)
    answers = [answer_for(synthetic, CASE, target) for target in expected["targets"][CASE.anatomy.name]]
    assert any("the check refuses" in fault for answer in answers for fault in answer.faults)


@pytest.mark.slow
def test_reasons_without_a_stage_are_seen(
    synthetic: Scenes, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def give_up(*_: Any, **__: Any) -> Any:
        raise la.NoPlan("No plan", reasons={"too hard": 1})

    monkeypatch.setattr(runs.la, "plan", give_up)
    answer = answer_for(synthetic, CASE, expected["targets"][CASE.anatomy.name][0])
    assert answer.faults == ("the reason 'too hard' names no stage",)
