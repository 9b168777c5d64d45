"""Simulated procedures: what is measured without error is corrected, and open loop is what `assess` says."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import FileError, SettingsError
from anatomy.lung import Lung
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.procedure import simulate_procedure
from lungaccess.planning.procedure.choices import scope_frames
from lungaccess.planning.procedure.policy import Policy
from lungaccess.planning.procedure.report import NO_PATH
from lungaccess.planning.procedure.simulation import ORDER, SUCCESS
from lungaccess.planning.procedure.truth import ends_of, with_stop
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import AngleError, CurvatureError, ErrorModel, PositionError
from lungaccess.problem.procedures import (
    Imaging,
    NeedleSteering,
    Procedure,
    ScopePlacing,
    TubesOut,
    load_procedure,
    procedure_names,
)
from lungaccess.uncertainty.risk import MISSES, assess
from lungaccess.uncertainty.risk.deviations import deviated_starts

SCOPE_ONLY = ErrorModel(
    scope_position=PositionError(attempt_mm=0.4), scope_direction=AngleError(attempt_deg=1.0)
)
SEEN_EXACTLY = Procedure(scope=ScopePlacing(measured=True), tubes=TubesOut(measured=True))


# Open loop ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gated-ct", "expiratory-free"])
def test_open_loop_is_what_assess_says(plan: Plan, small_lung: Lung, name: str) -> None:
    model = load_errors(name)
    report = assess(plan, small_lung, model=model, samples=400, seed=3, radius_mm=3.0, each_kind=False)
    found = simulate_procedure(plan, small_lung, errors=model, samples=400, seed=3, radius_mm=3.0)
    assert (found.succeeds, dict(found.touches)) == (report.succeeds, dict(report.touches))
    assert dict(found.miss_mm) == dict(report.miss_mm)
    assert found.stages == () and found.placements == 1.0


def test_a_needle_carried_out_arc_by_arc_is_that_of_open_loop(plan: Plan, small_lung: Lung) -> None:
    """Where the needle is followed by itself, it ends where the kernel lets the whole plan end."""
    model = load_errors("gated-ct")
    blind = Procedure(needle=NeedleSteering(closed_loop=True, measure_every_mm=500.0))
    sure = replace(model, needle_roll=AngleError(), needle_insertion=PositionError())
    steered = simulate_procedure(plan, small_lung, errors=sure, procedure=blind, samples=60, radius_mm=3.0)
    plain = simulate_procedure(plan, small_lung, errors=sure, samples=60, radius_mm=3.0)
    assert dict(steered.ends)[SUCCESS] == plain.succeeds
    for share, miss in plain.miss_mm.items():
        assert steered.miss_mm[share] == pytest.approx(miss, abs=1e-6)


# What is measured --------------------------------------------------------------------------------


def test_without_errors_every_procedure_succeeds(plan: Plan, small_lung: Lung) -> None:
    every = replace(SEEN_EXACTLY, imaging=Imaging(measured=True), needle=NeedleSteering(closed_loop=True))
    found = simulate_procedure(plan, small_lung, errors=ErrorModel(), procedure=every, samples=3)
    assert found.succeeds.value == 1.0 and found.miss_mm[0.95] < 0.01
    assert [stage.stage for stage in found.stages] == ["scope", "tube", "needle"]


def test_an_error_that_is_measured_exactly_does_no_harm(plan: Plan, small_lung: Lung) -> None:
    found = simulate_procedure(plan, small_lung, errors=SCOPE_ONLY, procedure=SEEN_EXACTLY, samples=40)
    blind = simulate_procedure(plan, small_lung, errors=SCOPE_ONLY, samples=40)
    assert found.succeeds.count >= max(blind.succeeds.count, 29)
    scope, tube = found.stages
    assert scope.replans == 40 and scope.corrected_mm > 0.3
    # Where the centre cannot be reached, going on as planned ends within the goal all the same.
    assert tube.corrected_mm < found.radius_mm


def test_the_tip_of_the_tubes_is_corrected(plan: Plan, small_lung: Lung) -> None:
    model = ErrorModel(
        tube_rotation=AngleError(attempt_deg=4.0), tube_insertion=PositionError(attempt_mm=0.7)
    )
    procedure = Procedure(tubes=TubesOut(measured=True))
    found = simulate_procedure(plan, small_lung, errors=model, procedure=procedure, samples=40, radius_mm=3.0)
    assert found.stages[0].corrected_mm > 0.3
    # The needle ends in the centre, or where that cannot be reached in the goal: as planned, or beside it.
    assert found.miss_mm[0.95] < 3.0


def test_imaging_finds_the_target_where_it_is(plan: Plan, small_lung: Lung) -> None:
    model = ErrorModel(target_position=PositionError(patient_mm=1.0))
    seen = Procedure(tubes=TubesOut(measured=True), imaging=Imaging(measured=True))
    with_image, without = (
        simulate_procedure(plan, small_lung, errors=model, procedure=each, samples=30, radius_mm=1.5)
        for each in (seen, replace(seen, imaging=Imaging()))
    )
    # The planned needle bends nearly as much as it can: where no path leads to the target seen, it stays out.
    assert with_image.miss_mm[0.95] < 1.5 < without.miss_mm[0.95]


def test_steering_corrects_what_nobody_measured_before(plan: Plan, small_lung: Lung) -> None:
    model = ErrorModel(
        tube_insertion=PositionError(attempt_mm=0.3),
        tube_rotation=AngleError(attempt_deg=1.5),
        needle_curvature=CurvatureError(median=0.9),
    )
    steering = Procedure(needle=NeedleSteering(closed_loop=True, measure_every_mm=3.0))
    steered, blind = (
        simulate_procedure(plan, small_lung, errors=model, procedure=each, samples=30, radius_mm=3.0)
        for each in (steering, Procedure())
    )
    assert steered.miss_mm[0.5] < 0.5 * blind.miss_mm[0.5]
    assert steered.succeeds.count >= blind.succeeds.count


def test_the_scope_is_placed_again_where_no_path_is_left(plan: Plan, small_lung: Lung) -> None:
    model = SCOPE_ONLY.scaled(3.0)
    once, often = (
        simulate_procedure(
            plan,
            small_lung,
            errors=model,
            procedure=replace(SEEN_EXACTLY, scope=ScopePlacing(measured=True, placements=number)),
            samples=30,
        )
        for number in (1, 4)
    )
    assert once.placements == 1.0 < often.placements <= 4.0
    assert once.ends[NO_PATH].count > often.ends[NO_PATH].count
    assert often.succeeds.count >= once.succeeds.count


# The report --------------------------------------------------------------------------------------


def test_every_procedure_ends_once(plan: Plan, small_lung: Lung) -> None:
    procedure = load_procedure("closed-loop")
    found = simulate_procedure(plan, small_lung, procedure=procedure, samples=24, seed=5)
    assert sum(share.count for share in found.ends.values()) == 24
    assert set(found.ends) <= {*ORDER, NO_PATH, MISSES, SUCCESS}
    counts = [share.count for _name, share in found.failures]
    assert counts == sorted(counts, reverse=True) and sum(counts) == 24 - found.succeeds.count
    again = simulate_procedure(plan, small_lung, procedure=procedure, samples=24, seed=5, processes=3)
    assert again.ends == found.ends and again.miss_mm == found.miss_mm
    assert [stage.replans for stage in again.stages] == [stage.replans for stage in found.stages]


def test_a_scope_is_measured_in_the_lumen(plan: Plan, small_lung: Lung) -> None:
    procedure = Procedure(scope=ScopePlacing(measured=True, position_mm=5.0))
    model = ErrorModel(scope_position=PositionError(attempt_mm=5.0))
    policy = Policy(plan, small_lung, model, procedure)
    seen = np.tile(np.asarray(plan.scope.lps_from_scope_tip), (20, 1, 1))
    seen[:, :3, 3] += 5.0 * np.random.default_rng(0).standard_normal((20, 3))
    placed = policy.scopes_measured(seen)
    tips = placed.frames[:, :3, 3]
    assert np.linalg.norm(tips - tips.mean(axis=0), axis=1).max() > 0.2
    for points in (tips, placed.drawn.reshape(-1, 3)):
        assert (small_lung.lumen_depth.lower_bound_mm(points) > 0.0).all()


# Geometry ----------------------------------------------------------------------------------------


def test_a_stop_too_late_or_too_early() -> None:
    arcs = np.array([[10.0, 0.1, 0.01], [5.0, 0.2, 0.0]])
    assert with_stop(arcs, 2.0)[:, 0].tolist() == [10.0, 7.0]
    assert with_stop(arcs, -2.0)[:, 0].tolist() == [10.0, 3.0]
    assert with_stop(arcs, -7.0)[:, 0].tolist() == [8.0, 0.0]
    assert with_stop(arcs, -99.0)[:, 0].tolist() == [0.0, 0.0]
    assert (with_stop(arcs, 3.0)[:, 1:] == arcs[:, 1:]).all()


def test_the_tubes_end_where_the_plan_has_their_tip(plan: Plan, small_lung: Lung) -> None:
    from lungaccess.uncertainty.risk import RiskAssessor
    from lungaccess.uncertainty.risk.deviations import deviated_pieces

    there = RiskAssessor(plan, small_lung)
    exact = there.draws(1, 0).deviations(ErrorModel())
    start, pieces = deviated_starts(plan, small_lung, exact)[0], deviated_pieces(plan, exact)[0]
    tip = ends_of(scope_frames(start[None]), pieces[None, : len(pieces) - there.n_arcs])[0]
    assert np.allclose(tip[:3, 3], plan.needle.lps_from_start[:3, 3], atol=1e-6)


# Files and the command ---------------------------------------------------------------------------


def test_presets_say_what_they_measure(tmp_path: Path) -> None:
    assert procedure_names() == ("closed-loop", "measured-scope", "measured-tip", "open-loop")
    measured = {
        name: (each.scope.measured, each.tubes.measured, each.imaging.measured, each.needle.closed_loop)
        for name, each in ((name, load_procedure(name)) for name in procedure_names())
    }
    assert measured == {
        "open-loop": (False, False, False, False),
        "measured-scope": (True, False, False, False),
        "measured-tip": (True, True, True, False),
        "closed-loop": (True, True, True, True),
    }
    assert load_procedure("open-loop").is_open_loop
    file = tmp_path / "mine.toml"
    file.write_text("[tubes]\nmeasured = true\nposition_mm = 0.2\n")
    stated = load_procedure(file)
    assert stated.name == "mine.toml" and stated.tubes.position_mm == 0.2 and not stated.scope.measured


WRONG = (
    "[scope]\nplacements = 0",
    "[scope]\nmeasured = 1",
    "[needle]\ngain = 0.0",
    "[needle]\nmeasure_every_mm = nan",
    "[tubes]\nposition_mm = -1.0",
    "[shaft]\nmeasured = true",
    "least_margin_share = 2.0",
    "[scope",
)


@pytest.mark.parametrize("written", WRONG)
def test_a_wrong_file_is_refused(tmp_path: Path, written: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(written)
    with pytest.raises(SettingsError) as refused:
        load_procedure(file)
    assert refused.value.expected and refused.value.remedy


def test_bad_input_is_refused(plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="measured-tipp") as refused:
        load_procedure("measured-tipp")
    assert "measured-tip" in refused.value.remedy
    with pytest.raises(FileError):
        load_procedure(tmp_path / "nowhere.toml")
    for values in ({"samples": 0}, {"processes": 0}, {"radius_mm": math.nan}):
        with pytest.raises(SettingsError):
            simulate_procedure(plan, small_lung, **values)  # type: ignore[arg-type]


def test_the_command(
    plan: Plan, small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_args, **_options: small_lung)
    plan.save(tmp_path / "plan.json")
    command = [
        "risk",
        str(tmp_path / "plan.json"),
        "patient",
        "--samples",
        "12",
        "--procedure",
        "measured-tip",
    ]
    assert main([*command, "--errors", "gated-ct", "--json"]) == ExitCode.OK
    written = json.loads(capsys.readouterr().out)
    procedure = load_procedure("measured-tip")
    found = simulate_procedure(
        plan, small_lung, errors=load_errors("gated-ct"), procedure=procedure, samples=12
    )
    assert written["procedure"]["name"] == "measured-tip" and written["errors"]["name"] == "gated-ct"
    assert written["succeeds"]["probability"] == found.succeeds.value
    assert written["ends"].keys() == found.ends.keys()
    assert [each["stage"] for each in written["stages"]] == ["scope", "tube"]
    assert main(command) == ExitCode.OK
    said = capsys.readouterr().out
    assert "measured-tip" in said and "success" in said
    assert main([*command[:-1], "nonsense"]) == ExitCode.BAD_INPUT


def test_replan_asks_the_policy(
    plan: Plan, small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_args, **_options: small_lung)
    file, record = str(tmp_path / "plan.json"), str(tmp_path / "record.json")
    plan.save(file)
    asked = ["replan", "patient", "--plan", file, "--scope", file, "--errors", "gated-ct"]
    command = [*asked, "--procedure", "measured-tip", "--radius", "5", "--record", record, "--placement", "3"]
    assert main([*command, "--json"]) == ExitCode.OK
    first = json.loads(capsys.readouterr().out)
    assert 0.0 < first["chance"] <= 1.0 and first["tube"] and first["needle"]
    assert main([*command, "--tube", file]) == ExitCode.OK
    assert "estimated chance of success" in capsys.readouterr().out
    assert len(json.loads(Path(record).read_text())["steps"]) == 2
    assert main(asked) == ExitCode.BAD_INPUT
