"""Errors about the resting shaft: what files state, what a plan makes of them, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy import poses
from anatomy.base.errors import SettingsError
from anatomy.base.settings import parse, to_mapping
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import NORMAL, RESTING, AngleError, ErrorModel, PositionError, with_known
from lungaccess.uncertainty.risk import RestingRow, assess, patient_errors, resting_rows, resting_tip
from lungaccess.uncertainty.risk.deviations import Draws
from lungaccess.uncertainty.risk.patient_errors import model_for
from stages.scope import RestingShape, TipSpread, WallContact, off_pose

COUNT = 5
RESTED = ErrorModel(
    scope_position=PositionError(distribution=RESTING, attempt_mm=0.3, bias_mm=(0.0, 1.0, 0.0)),
    scope_direction=AngleError(distribution=RESTING),
    wall=WallContact(source="[Wang2011]"),
)


def shape_of(force_n: float) -> RestingShape:
    return RestingShape(
        lps_from_scope_tip=np.eye(4), frames=np.zeros((COUNT + 1, 12)), lengths_mm=np.full(COUNT, 2.0),
        curvature=np.zeros((COUNT, 2)), force_n=np.full(COUNT, force_n / COUNT),
        give_mm=np.full(COUNT, 0.2), farther_mm=0.0, energy_n_mm=0.0, settled=True,
    )  # fmt: skip


def spread_of(**changed: Any) -> TipSpread:
    made = TipSpread(
        nominal=shape_of(0.5), nominal_off=np.array([3.0, 4.0, 0.0, 6.0, 8.0]), other=None,
        bias_mm=np.array([0.5, -1.0, 0.0]), bias_deg=np.array([6.0, -300.0]), patient_mm=0.4,
        attempt_mm=0.4, patient_deg=1.0, attempt_deg=2.0, wall_force_n=np.array([0.4, 1.2]),
        give_mm=np.array([0.2, 0.3]), held_share=1.0,
    )  # fmt: skip
    return replace(made, **changed)


# What a file states ------------------------------------------------------------------------------


def test_the_preset_states_the_wall_and_is_breath_hold_otherwise() -> None:
    preset, base = load_errors("resting"), load_errors("breath-hold")
    assert preset.wall is not None
    assert replace(preset.wall, source="assumption") == WallContact()
    assert parse(ErrorModel, to_mapping(preset), "again") == preset
    assert "where the shaft rests" in preset.words(with_needle=True)
    assert "where the shaft rests" not in base.words(with_needle=True)
    assert preset.scope_direction.size == 0.0
    others = {"scope_position": base.scope_position, "scope_direction": base.scope_direction, "wall": None}
    assert replace(preset, name=base.name, description=base.description, **others) == base


@pytest.mark.parametrize(
    "written",
    [
        'like = "resting"\n[tube_rotation]\ndistribution = "resting"',
        '[scope_direction]\ndistribution = "resting"',
        '[[place]]\n[place.scope_direction]\ndistribution = "resting"',
        'like = "resting"\n[wall]\nmax_friction = -0.1',
    ],
)
def test_what_cannot_rest_is_refused(tmp_path: Path, written: str) -> None:
    file = tmp_path / "errors.toml"
    file.write_text(written)
    with pytest.raises(SettingsError, match="resting|wall|max_friction"):
        load_errors(file)


def test_what_is_known_is_about_the_plan() -> None:
    known = with_known(RESTED, "scope_position", 0.5)
    assert known.scope_position.distribution == NORMAL
    assert known.scope_position.size == pytest.approx(0.5)
    assert known.scope_direction.distribution == RESTING


def test_without_a_plan_nothing_is_drawn() -> None:
    with pytest.raises(SettingsError, match="resting shaft"):
        Draws(3, 1, 0).deviations(replace(RESTED, scope_direction=AngleError()))


# What a plan makes of it -------------------------------------------------------------------------


def test_bias_and_spread_come_on_top_of_what_is_stated(
    monkeypatch: pytest.MonkeyPatch, toy_plan: Plan, toy_lung: Any
) -> None:
    monkeypatch.setattr(patient_errors, "resting_tip", lambda *_: spread_of())
    found = patient_errors.about_resting_tip(RESTED, toy_plan, toy_lung)
    assert found.wall is None and not found.rests
    assert found.scope_position.bias == (0.5, 0.0, 0.0)
    assert (found.scope_position.patient, found.scope_position.attempt) == (0.4, 0.5)
    # A tip turned farther than that fails all the same.
    assert found.scope_direction.bias == (6.0, -patient_errors.MOST)
    assert (found.scope_direction.patient, found.scope_direction.attempt) == (1.0, 2.0)
    assert found.scope_position.source.startswith("assumption; ")
    assert found.scope_direction.source == "shaft at rest on the wall: [Wang2011]"
    assert patient_errors.about_resting_tip(load_errors(), toy_plan, toy_lung) == load_errors()


def test_limits_that_are_exceeded_are_said() -> None:
    aside = poses.pose([0.0, 0.0, 2.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    other = replace(shape_of(0.5), lps_from_scope_tip=aside)
    rows = {each.name: each for each in resting_rows(spread_of(other=other), WallContact())}
    assert rows["tip off its planned place"].value == 5.0
    assert rows["tip turned"].value == 10.0
    assert rows["force on 10 mm of wall"].words == "1 N"
    assert rows["the same, at most"] == RestingRow(name="the same, at most", value=1.2, unit="N", limit=1.0)
    assert rows["the same, at most"].words == "1 N, EXCEEDED"
    assert rows["another shape at rest: tip apart"].value == 2.0
    assert rows["another shape at rest: tip turned"].value == pytest.approx(90.0)
    assert rows["tip turned"].words == ""


@pytest.mark.parametrize("other", [None, shape_of(0.7)])
def test_what_came_to_rest_in_a_lung_of_the_cache_is_kept(
    other: RestingShape | None,
    small_plan: Plan,
    small_lung: Lung,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = spread_of(other=other)
    monkeypatch.setattr(patient_errors, "spread_of_tip", lambda *_: made)
    monkeypatch.setattr(patient_errors, "_SPREADS", {})
    stored = replace(small_lung)
    object.__setattr__(stored, "folder", tmp_path / "lung")
    assert resting_tip(small_plan, stored, WallContact()) is made
    monkeypatch.setattr(patient_errors, "spread_of_tip", lambda *_: pytest.fail("made again"))
    monkeypatch.setattr(patient_errors, "_SPREADS", {})
    again = resting_tip(small_plan, stored, WallContact())
    assert resting_rows(again, WallContact()) == resting_rows(made, WallContact())
    assert again.nominal.settled and np.array_equal(again.nominal.frames, made.nominal.frames)
    with pytest.raises(pytest.fail.Exception, match="made again"):
        resting_tip(small_plan, stored, WallContact(max_friction=0.1))


def test_a_plan_is_counted_about_where_its_scope_rests(small_plan: Plan, small_lung: Lung) -> None:
    preset = load_errors("resting")
    assert preset.wall is not None
    spread = resting_tip(small_plan, small_lung, preset.wall)
    assert resting_tip(small_plan, small_lung, preset.wall) is spread
    planned = np.asarray(small_plan.scope.lps_from_scope_tip)
    assert off_pose(planned, spread.nominal.lps_from_scope_tip) == pytest.approx(spread.nominal_off)
    # The hand brings the tip to its planned depth, or the shaft is not at rest.
    assert spread.nominal.settled == (abs(spread.nominal_off[2]) < 0.1)
    found = model_for(preset, small_plan, small_lung)
    assert found.scope_direction.bias == pytest.approx(spread.bias_deg, abs=1e-3)
    samples = 2000
    freely = assess(small_plan, small_lung, model=load_errors(), samples=samples, each_kind=False)
    report = assess(small_plan, small_lung, model=preset, samples=samples, each_kind=False)
    again = assess(small_plan, small_lung, model=found, samples=samples, each_kind=False)
    assert report.model == found
    assert report.succeeds == again.succeeds
    assert report.miss_mm != freely.miss_mm
