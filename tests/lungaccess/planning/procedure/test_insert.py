"""Insertions watched by a tracker: what its noise, rate, latency and losses do, and the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.cli import app as cli
from lungaccess.planning.procedure.insertion import InsertionStudy, TrackerModel, gain_for, insert_plan
from lungaccess.plans.plan import Plan

EXACT = {"position_mm": 0.0, "direction_deg": 0.0, "target_mm": 0.0}


def inserted(
    plan: Plan, lung: Lung, *, size: float = 1.0, samples: int = 6, **changes: float
) -> InsertionStudy:
    return insert_plan(plan, lung, TrackerModel(rate_hz=2.0, **changes), size=size, samples=samples)


def test_a_usual_tracker_is_believed_as_usual() -> None:
    assert gain_for(0.4, 5.0) == pytest.approx(0.3)


def test_exact_measurements_are_believed_and_frequent_ones_less_each() -> None:
    assert gain_for(0.0, 0.1) == 1.0
    gains = [gain_for(0.4, every) for every in (0.1, 1.0, 5.0, 50.0)]
    assert gains == sorted(gains) and 0.0 < gains[0] < 0.1 and gains[-1] < 1.0
    assert gain_for(2.0, 5.0) < gain_for(0.4, 5.0) < gain_for(0.01, 5.0)


@pytest.mark.parametrize("latency_s", [0.0, 0.5, 3.0])
def test_without_errors_an_exact_tracker_leads_to_the_target_however_late(
    latency_s: float, small_plan: Plan, breathing_lung: Lung
) -> None:
    """What was commanded since a measurement is added to it, rolls included, so that nothing is off."""
    found = inserted(small_plan, breathing_lung, size=0.0, samples=1, latency_s=latency_s, **EXACT).errors
    assert found.latency_mm == pytest.approx(2.0 * latency_s)
    tracker = TrackerModel(rate_hz=2.0, latency_s=latency_s, **EXACT)
    made = insert_plan(small_plan, breathing_lung, tracker, size=0.0, samples=1).made.closed_loop
    # The target's own drift is of size 0, too.
    assert made.median_error_mm < 1e-6 and made.insertions[0].replans


def test_the_same_seed_gives_the_same_result(small_plan: Plan, breathing_lung: Lung) -> None:
    one, other = (inserted(small_plan, breathing_lung, samples=2).to_mapping() for _ in range(2))
    assert one == other
    json.dumps(one, allow_nan=False)


def test_a_tracker_helps(small_plan: Plan, breathing_lung: Lung) -> None:
    found = inserted(small_plan, breathing_lung, size=2.0, samples=12).made
    assert found.closed_loop.median_error_mm < found.open_loop.median_error_mm
    assert found.closed_loop.reached_share >= found.open_loop.reached_share


def test_a_tracker_that_loses_everything_is_none(small_plan: Plan, breathing_lung: Lung) -> None:
    found = inserted(small_plan, breathing_lung, samples=3, lost_share=1.0).made
    for blind, watched in zip(found.open_loop.insertions, found.closed_loop.insertions, strict=True):
        assert not watched.replans
        assert np.allclose(blind.lps_from_tip[-1], watched.lps_from_tip[-1], atol=1e-9)


def test_replans_are_not_more_than_asked_for(small_plan: Plan, breathing_lung: Lung) -> None:
    length = small_plan.needle.length_mm
    for every in (2.0, 8.0):
        (run,) = inserted(
            small_plan, breathing_lung, samples=1, replan_every_mm=every
        ).made.closed_loop.insertions
        assert 0 < len(run.replans) <= length / every + 2


@pytest.mark.parametrize(("size", "samples"), [(-1.0, 5), (6.0, 5), (1.0, 0), (float("nan"), 1)])
def test_numbers_have_a_range(size: float, samples: int, small_plan: Plan, breathing_lung: Lung) -> None:
    with pytest.raises(SettingsError):
        insert_plan(small_plan, breathing_lung, size=size, samples=samples)


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
    code = cli.main([str(each) for each in (*words, "--film", film, "--picture", picture, "--json")])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0 and answer["plan_accepted"] and answer["samples"] == 2
    assert len(answer["closed_loop"]["tip_errors_mm"]) == 2
    with Image.open(film) as opened:
        assert opened.n_frames > 2  # type: ignore[attr-defined]
    with Image.open(picture) as opened:
        assert opened.width > 500
    assert cli.main([str(each) for each in (*words, "--film", tmp_path / "a.gif")]) == 2
    assert cli.main([str(each) for each in words]) == 0
    assert "tracked" in capsys.readouterr().out
