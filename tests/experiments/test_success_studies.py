"""The studies of success: every error model with every procedure, counted for the same plans."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from experiments import procedures, success_planning
from experiments.run_all import STUDIES
from lungaccess.planning.procedure import ProcedureReport
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import Procedure, load_procedure, procedure_names
from lungaccess.uncertainty.risk import Share

COUNTS = {"a": 20, "b": 60, "c": 90}


def report(plan: str, errors: ErrorModel, procedure: Procedure, samples: int) -> ProcedureReport:
    """Return that as many of 100 procedures succeed as `COUNTS` says; all others touch a vessel."""
    count = COUNTS[plan]
    return ProcedureReport(
        model=errors, procedure=procedure, samples=100, seed=0, radius_mm=5.0, radius_origin="given",
        succeeds=Share(count=count, samples=100), touches={},
        ends={"success": Share(count=count, samples=100), "vessel": Share(count=100 - count, samples=100)},
        miss_mm={}, placements=1.5, stages=(),
    )  # fmt: skip


def run(study: Any, folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> dict[str, Any]:
    """Run a study whose patient and plans are names, and return what it stores."""
    monkeypatch.setattr(
        "sys.argv", ["study", "--quick", "--results", str(folder), "--patient", "toy", *words]
    )
    monkeypatch.setattr(study, "anatomy", lambda name: SimpleNamespace(name=name))
    monkeypatch.setattr("lungaccess.open_atlas", lambda *_: None, raising=False)
    monkeypatch.setattr(study, "plans_of", lambda _lung, _atlas, count, _seed: list("abc")[:count])
    study.main()
    stored: dict[str, Any] = json.loads(
        (folder / "quick" / f"{study.__name__.split('.')[-1]}.json").read_text()
    )
    return stored


def test_procedures_are_counted_under_every_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def simulate(plan: str, _lung: Any, *, errors: Any, procedure: Any, samples: int, seed: int) -> Any:
        assert samples == procedures.SIZES["quick"][1] and seed == 1
        return report(plan, errors, procedure, samples)

    monkeypatch.setattr(procedures, "simulate_procedure", simulate)
    rows = run(procedures, tmp_path, monkeypatch)["rows"]
    wanted = {
        f"{e}, {p}: succeed, median of the plans" for e in error_preset_names() for p in procedure_names()
    }
    assert {row["quantity"] for row in rows} == wanted
    assert {row["ours"] for row in rows} == {40.0}
    assert all(
        "quantile 24 and 56 %; mean 40 %; fail by vessel 60 %; placed 1.5 times" in r["note"] for r in rows
    )


def test_both_plans_are_counted_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def compare(plan: str, _lung: Any, _atlas: Any, errors: Any, procedure: Any, size: Any, seed: int) -> Any:
        asked.append((plan, errors.label, procedure.name, size))
        return success_planning.Pair(cost=0.01 * COUNTS[plan], success=0.95, cpu_s=1.0)

    monkeypatch.setattr(success_planning, "compare", compare)
    stored = run(success_planning, tmp_path, monkeypatch)
    assert len(stored["rows"]) == len(error_preset_names()) * len(success_planning.PROCEDURES)
    assert {row["ours"] for row in stored["rows"]} == {95.0}
    assert (
        "least cost 60 %; difference least +5.0, median +35.0, greatest +75.0 points"
        in stored["rows"][0]["note"]
    )
    assert asked[:3] == [(name, "breath-hold", "open-loop", (5, 10_000)) for name in "abc"]
    assert (tmp_path / "quick" / "success_planning.png").stat().st_size > 5000
    assert {"procedures", "success_planning"} <= set(STUDIES)


def test_a_comparison_has_one_luck(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def estimate(plan: str, _lung: Any, *, errors: Any, procedure: Any, samples: int, seed: int) -> Any:
        seen.append((plan, samples, seed))
        return report(plan, errors, procedure, samples)

    def search(_lung: Any, system: str, target: str, **options: Any) -> list[Any]:
        assert (system, target, options["iterations"], options["seed"]) == ("s", "t", 5, 4)
        assert options["goal"] == "success"
        return ["a", "c"]

    monkeypatch.setattr(success_planning, "estimate_success", estimate)
    monkeypatch.setattr("lungaccess.plan", search, raising=False)
    monkeypatch.setattr("lungaccess.point_target", lambda _lung, point: point, raising=False)
    stated = {"target_lps": "t", "system": "s", "seed": 4}
    plan: Any = type("Named", (str,), stated)("b")
    pair = success_planning.compare(
        plan,
        None,
        None,
        load_errors(),
        load_procedure(),
        (5, 400),
        7,  # type: ignore[arg-type]
    )
    assert (pair.cost, pair.success) == (0.6, 0.9)
    assert seen == [("b", 400, 7 + success_planning.COUNT_SEED), ("c", 400, 7 + success_planning.COUNT_SEED)]
