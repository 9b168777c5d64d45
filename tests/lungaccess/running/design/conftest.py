"""A search over devices with answers that no planner made: which targets a device reaches is a formula."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from lungaccess.problem.system import load_system
from lungaccess.running.design import search
from lungaccess.running.design.settings import Design, design_of
from lungaccess.running.study import driver
from lungaccess.running.study.runs import NO_PLAN, TIMEOUT, Answer, Patient, Problem, Run
from tests.lungaccess.running.study.toys import content, toy_answer

TARGETS = 9
BENT, TURN = "tubes.inner.precurvature_per_mm", "needle.max_curvature_per_mm"


def design_content(**changes: Any) -> dict[str, Any]:
    own = {
        "designs": 18,
        "rounds": 3,
        "make_large": ["reach", "needle-radius"],
        "vary": {
            "tubes": {"inner": {"precurvature_per_mm": [0.02, 0.06]}},
            TURN: [0.002, 0.05],
            "tubes.max_channel_curvature_per_mm": {"one_of": [0.08]},
        },
    }
    return content(**{"seeds": [0]} | changes | {"design": own | changes.get("design", {})})


@pytest.fixture
def design() -> Design:
    return design_of(design_content())


def toy_runs(study: Any, **_more: Any) -> list[Run]:
    """Return the runs of a cohort of two patients that nobody opens."""
    patient = Patient(anatomy="phantom", seed=0, size="small", spacing_mm=None, sources=())
    return [
        Run(
            problem=Problem(
                case=f"case {n % 2}", patient=patient, system=load_system("ultrathin", fissures_allowed=True),
                objective="default", target=n, target_lps=(float(n), 0.0, 0.0), origin="toy", start=0,
                rotations=8, stop_spacing_mm=8.0, site_spacing_mm=4.0, iterations=2, time_s=None,
            ),
            planner=study.planner[0],
            seed=0,
        )
        for n in range(1, TARGETS + 1)
    ]  # fmt: skip


def formula(run: Run) -> Answer:
    """The target n asks for so much curvature of tube and needle; the chance falls with the tube's."""
    system, n = run.problem.system, run.problem.target
    bent = system.tubes.inner.precurvature_per_mm
    if system.require_needle("it").max_curvature_per_mm < 0.004 * n or not 0.002 * n + 0.02 <= bent <= 0.055:
        return toy_answer(run, outcome=NO_PLAN, status=TIMEOUT, accepted=False, plan="")
    successes = round(1000.0 * (1.0 - 10.0 * bent))
    return toy_answer(run, plan=json.dumps({"chance": {"successes": successes, "samples": 1000}}))


class ToyWorkers:
    """Answers at once, the last asked first, and keeps the keys of what was asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}

    def each_done(
        self, client: Any, work: Any, asked: Sequence[Any], cache: Any
    ) -> Iterator[tuple[Any, Any]]:
        for piece in reversed(asked):
            if isinstance(piece, Run):
                self.asked.append(piece.key)
                yield piece, formula(piece)
            else:
                yield piece, None


@pytest.fixture
def workers(monkeypatch: pytest.MonkeyPatch) -> ToyWorkers:
    made = ToyWorkers()
    monkeypatch.setattr(driver, "connect", lambda *_where: contextlib.nullcontext(made))
    monkeypatch.setattr(driver, "each_done", made.each_done)
    monkeypatch.setattr(search, "runs_of", toy_runs)
    return made
