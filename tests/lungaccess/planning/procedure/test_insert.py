"""Insertions watched by a tracker: the errors of `risk`, what a tracker is worth, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.cli import app as cli
from lungaccess.planning.procedure.insertion import WATCHED, InsertionStudy, Outcome, insert_plan
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import AngleError, CurvatureError, ErrorModel, PositionError
from lungaccess.uncertainty.risk import RiskAssessor

EXACT = {"position_mm": 0.0, "direction_deg": 0.0, "target_mm": 0.0}
SLOW = replace(WATCHED, measure_every_mm=1.0)


def inserted(
    plan: Plan,
    lung: Lung,
    errors: ErrorModel | None = None,
    *,
    samples: int = 6,
    seed: int = 0,
    **changes: Any,
) -> InsertionStudy:
    return insert_plan(plan, lung, replace(SLOW, **changes), errors=errors, samples=samples, seed=seed)


@pytest.mark.parametrize("latency_mm", [0.0, 1.0, 6.0])
def test_without_errors_an_exact_tracker_leads_to_the_target_however_late(
    latency_mm: float, small_plan: Plan, breathing_lung: Lung
) -> None:
    """What was commanded since a measurement is added to it, rolls included, so that nothing is off."""
    found = inserted(
        small_plan, breathing_lung, ErrorModel(), samples=1, latency_mm=latency_mm, **EXACT
    ).closed_loop
    assert found.tip_errors_mm.max() < 1e-6 and found.insertions[0].replans


def test_blind_insertions_are_those_of_the_risk(small_plan: Plan, breathing_lung: Lung) -> None:
    """One model of errors and one simulator: the same draws end at the same places and touch the same."""
    found = inserted(small_plan, breathing_lung, load_errors("gated-ct"), samples=50, seed=4)
    assessor = RiskAssessor(small_plan, breathing_lung, radius_mm=2.0)
    drawn = assessor.draws(50, 4).deviations(found.errors)
    outcomes = assessor.outcomes(drawn)
    assert np.allclose(found.open_loop.tip_errors_mm, outcomes.miss_mm, atol=1e-9)
    assert found.open_loop.reached.count == assessor.succeeded(outcomes).sum()
    assert not found.errors.scope_position.size and not found.errors.tube_rotation.size
    assert [run.factor for run in found.open_loop.insertions] == drawn.factor.tolist()


def test_the_same_seed_gives_the_same_result(small_plan: Plan, breathing_lung: Lung) -> None:
    one, other = (inserted(small_plan, breathing_lung, samples=2).to_mapping() for _ in range(2))
    assert one == other
    json.dumps(one, allow_nan=False)


def test_a_tracker_helps(small_plan: Plan, breathing_lung: Lung) -> None:
    found = inserted(small_plan, breathing_lung, samples=12)
    assert np.median(found.closed_loop.tip_errors_mm) < np.median(found.open_loop.tip_errors_mm)
    assert found.closed_loop.reached.count >= found.open_loop.reached.count


def test_the_curvature_is_learned_on_the_way(small_plan: Plan, breathing_lung: Lung) -> None:
    errors = ErrorModel(
        needle_curvature=CurvatureError(attempt_ln=0.4), needle_roll=AngleError(attempt_deg=5.0)
    )
    found = inserted(small_plan, breathing_lung, errors, samples=8, measure_every_mm=0.1)
    runs = found.closed_loop.insertions
    known = [abs(np.log(run.believed_factor / run.factor)) for run in runs]
    assert np.median(known) < 0.1 < np.median([abs(np.log(run.factor)) for run in runs])
    weak = [run for run in runs if run.factor > 1.0]
    assert all(run.outcome is Outcome.REACHED for run in weak)


def test_a_bias_moves_all_targets_alike(small_plan: Plan, breathing_lung: Lung) -> None:
    errors = ErrorModel(target_position=PositionError(bias_mm=(0.0, 0.0, 1.5)))
    found = inserted(small_plan, breathing_lung, errors, samples=2)
    for blind, watched in zip(found.open_loop.insertions, found.closed_loop.insertions, strict=True):
        assert np.allclose(blind.target_lps, small_plan.end_lps + [0.0, 0.0, 1.5])
        assert blind.tip_error_mm == pytest.approx(1.5) and watched.tip_error_mm < 1.0


def test_a_tracker_that_loses_everything_is_none(small_plan: Plan, breathing_lung: Lung) -> None:
    errors = ErrorModel(needle_curvature=CurvatureError(attempt_ln=0.2))
    found = inserted(small_plan, breathing_lung, errors, samples=3, lost_share=1.0)
    for blind, watched in zip(found.open_loop.insertions, found.closed_loop.insertions, strict=True):
        assert not watched.replans
        assert np.allclose(blind.lps_from_tip[-1], watched.lps_from_tip[-1], atol=1e-9)


def test_replans_are_not_more_than_asked_for(small_plan: Plan, breathing_lung: Lung) -> None:
    length = small_plan.needle.length_mm
    for every in (2.0, 8.0):
        (run,) = inserted(small_plan, breathing_lung, samples=1, replan_every_mm=every).closed_loop.insertions
        assert 0 < len(run.replans) <= length / every + 2


@pytest.mark.parametrize("wrong", [{"samples": 0}, {"tolerance_mm": -1.0}])
def test_numbers_have_a_range(wrong: dict[str, Any], small_plan: Plan, breathing_lung: Lung) -> None:
    with pytest.raises(SettingsError):
        insert_plan(small_plan, breathing_lung, **wrong)


@pytest.mark.slow
def test_the_command_writes_a_film_and_a_picture(
    small_plan: Plan,
    breathing_lung: Lung,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: breathing_lung)
    monkeypatch.setattr("lungaccess.showing.report.insertion.FRAMES", 4)
    small_plan.save(tmp_path / "plan.json")
    film, picture = tmp_path / "a.webp", tmp_path / "a.png"
    words: list[Any] = ["insert", tmp_path / "plan.json", "toy", "--samples", 2, "--rate", 1]
    words += ["--errors", "gated-ct"]
    code = cli.main([str(each) for each in (*words, "--film", film, "--picture", picture, "--json")])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0 and answer["plan_accepted"] and answer["samples"] == 2
    assert len(answer["closed_loop"]["tip_errors_mm"]) == 2 and answer["errors"]["name"] == "gated-ct"
    with Image.open(film) as opened:
        assert opened.n_frames > 2  # type: ignore[attr-defined]
    with Image.open(picture) as opened:
        assert opened.width > 500
    assert cli.main([str(each) for each in (*words, "--film", tmp_path / "a.gif")]) == 2
    assert cli.main([str(each) for each in words]) == 0
    said = capsys.readouterr().out
    assert "tracked" in said and "curvature known to" in said
