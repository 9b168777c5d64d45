"""What a page says of success: as the plan states it, as it was computed, and what plans trade for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from anatomy.base.errors import PlanFileError
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Headline
from lungaccess.planning import Alternative, with_front
from lungaccess.planning.procedure import ProcedureReport
from lungaccess.planning.procedure.report import StageReport
from lungaccess.planning.success import chance_of
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.showing.report.html import page_of_plan, trade_off_svg
from lungaccess.showing.report.html.tables import risk_section
from lungaccess.showing.slicer import export
from lungaccess.uncertainty.risk import Share
from tests.lungaccess.appraisals import make_check, make_risk

STATED = chance_of(make_risk(1200, reaches=1900, vessel=700))
ORIGIN = "{http://www.w3.org/2000/svg}"


def of_procedures() -> ProcedureReport:
    """Return 120 procedures, of which 84 succeed."""
    return ProcedureReport(
        model=load_errors("gated-ct"), procedure=load_procedure("measured-tip"), samples=120, seed=3,
        radius_mm=5.0, radius_origin="given", succeeds=Share(count=84, samples=120), touches={},
        ends={"success": Share(count=84, samples=120), "no path left": Share(count=36, samples=120)},
        miss_mm={0.5: 1.25}, placements=1.5,
        stages=(StageReport(stage="scope", replans=180, without_path=Share(count=36, samples=180),
                            corrected_mm=float("nan")),),
    )  # fmt: skip


def rated(lengths: list[float], counts: list[int | None], clearances: list[float]) -> tuple[Alternative, ...]:
    """Return the front of plans that only have lengths, clearances and chances."""
    plans: Any = [
        SimpleNamespace(
            clearance_mm={"needle": {"vessel": clearance, "outside": 9.0}}, fissures_are_obstacles=False,
            tissue_mm=length, costs={"inverse_clearance": 1.0, "cost_map": 0.0}, window=None,
        )
        for length, clearance in zip(lengths, clearances, strict=True)
    ]  # fmt: skip
    chances = [None if n is None else replace(STATED, samples=100, successes=n, failures={}) for n in counts]
    return with_front(plans, chances)


def test_what_a_plan_states_is_shown_and_not_computed_again(toy_plan: Plan) -> None:
    stating = replace(toy_plan, chance=STATED)
    again = Plan.from_json(stating.to_json()).chance
    assert again is not None and (again.share, dict(again.failures)) == (0.6, dict(STATED.failures))
    assert toy_plan.digest != stating.digest and "chance" not in toy_plan.to_json()
    computed, stated = Headline.of(make_check(True), make_risk(1200, vessel=700)), Headline.of(None, again)
    assert "not computed again" in stated.details[0] and "not computed again" not in computed.details[0]
    assert stated.to_mapping()["stated_by_plan"] and not computed.to_mapping()["stated_by_plan"]
    section = risk_section(again, "a region")
    assert "<p>a region.</p>" in section and "not computed again" in section and "35 %" in section
    with pytest.raises(PlanFileError, match="counts"):
        replace(STATED, successes=2001)


def test_procedures_that_measure_say_what_fails_and_what_measuring_corrects() -> None:
    report = of_procedures()
    headline = Headline.of(make_check(True), report)
    assert headline.text.startswith("Estimated to succeed in 70 of 100 procedures (95 % interval 61 to 78); ")
    assert "fails most because it has no path left (30 of 100). Procedure 'measured-tip'" in headline.text
    assert "planned again each time" in headline.details[0]
    section = risk_section(report, "")
    for words in ("no path left", "30 %", "What measuring corrects", "1.50", "20 %", "1.25 mm", "–"):
        assert words in section
    assert risk_section(None, "") == "<p>.</p><p>Chance of success not computed.</p>"


def test_other_plans_are_estimated_as_the_plan_states(
    toy_plan: Plan, small_lung: Lung, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, Any]] = []

    class Appraiser:
        def __init__(self, _lung: Any, errors: Any = None, **options: Any) -> None:
            self.given = {"errors": errors, **options}

        def appraise(self, plan: Plan, **_: Any) -> Any:
            asked.append(self.given)
            return SimpleNamespace(risk=plan.chance)

    monkeypatch.setattr(page_of_plan, "Appraiser", Appraiser)
    plans = (replace(toy_plan, chance=STATED), toy_plan)
    page_of_plan._appraised(plans, small_lung, page_of_plan.PageOptions())
    first, other = asked
    assert set(first.values()) == {None}
    assert (other["errors"], other["draws"], other["seed"]) == (load_errors(), 2000, 0)
    unknown = replace(toy_plan, chance=replace(STATED, errors="mine.toml"))
    page_of_plan._appraised((unknown, toy_plan), small_lung, page_of_plan.PageOptions())
    assert asked[-1]["draws"] == 0


def test_the_front_is_of_success_length_and_clearance() -> None:
    found = rated([50.0, 40.0, 60.0, 55.0, 30.0], [70, 60, 70, 20, None], [1.0, 1.0, 3.0, 0.5, 9.0])
    assert [each.on_front for each in found] == [True, True, True, False, False]
    assert "success" not in found[4].criteria and found[0].criteria["success"] == 0.7


def test_a_trade_off_is_drawn_where_it_is(tmp_path: Path) -> None:
    found = rated([50.0, 40.0, 60.0, 55.0, 30.0], [70, 60, 70, 20, None], [1.0, 1.0, 3.0, 0.5, 9.0])
    drawing = ElementTree.fromstring(trade_off_svg(found))
    discs = [each for each in drawing.iter(f"{ORIGIN}circle") if each.find(f"{ORIGIN}title") is not None]
    told = [each.findtext(f"{ORIGIN}title") for each in discs]
    assert told[0] == "plan 1: succeeds in 70 of 100, 50 mm in tissue, clearance 1.0 mm, on the front"
    assert len(discs) == 4 and [each.get("fill") == "none" for each in discs] == [False, False, False, True]
    x, y = ([float(each.get(key, "")) for each in discs] for key in ("cx", "cy"))
    assert np.argsort(x).tolist() == [1, 0, 3, 2] and y[0] == y[2] < y[1] < y[3]
    assert trade_off_svg(rated([50.0], [None], [1.0])) == ""


def test_without_a_start_region_page_and_export_say_why(
    toy_plan: Plan, small_lung: Lung, tmp_path: Path
) -> None:
    costs = np.zeros(small_lung.grid.shape, dtype=np.float32)
    costs[0, 0, 0] = np.inf
    forbidding = replace(small_lung, cost=Volume(grid=small_lung.grid, array=costs))
    plan = replace(toy_plan, lung_key=small_lung.key)
    said = page_of_plan.start_region_of(plan, forbidding)
    assert said == "No safe start region: The cost map forbids voxels, of which the proof knows nothing"
    items, why = export._write_start_region(plan, forbidding, tmp_path)
    text = export.readme(plan, make_check(True), ("README.txt",), why)
    assert not items and f"No safe start region: {why}." in text
