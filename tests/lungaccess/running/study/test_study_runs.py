"""Runs are named by all that their answer depends on, and answered in any process alike."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, SettingsError, TargetError
from lungaccess.plans.plan import Plan
from lungaccess.problem import peripheral
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.problem.system import load_system
from lungaccess.running.study import one_run
from lungaccess.running.study.one_run import answer, needle_answer
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import EXACT, INVALID_GOAL, NO_PLAN, PATH, PLAN, Run, open_patient, runs_of
from lungaccess.running.study.settings import PlannerChoice, study_of
from lungaccess.running.study.tables import summarise
from tests.lungaccess.running.study.toys import NEAR, content


def test_every_target_with_every_seed(runs: list[Run]) -> None:
    assert [(run.problem.target, run.seed) for run in runs] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert len({run.key for run in runs}) == 4
    assert len({run.problem.key for run in runs}) == 2


@pytest.mark.parametrize(
    "changes",
    [
        {"objective": "length_mm"},
        {"target_lps": (0.0, 0.0, 1.0)},
        {"origin": "elsewhere"},
        {"iterations": 3},
        {"time_s": 1.0},
        {"first_plan": True},
        {"rotations": 9},
        {"stop_spacing_mm": 3.0},
        {"site_spacing_mm": 3.0},
        {"system": load_system("thin-scope")},
        {"case": "other"},
        {"errors": load_errors("gated-ct")},
        {"errors": load_errors(), "procedure": load_procedure("measured-tip")},
        {"start": 1},
    ],
)
def test_the_key_depends_on_the_problem(runs: list[Run], changes: dict[str, Any]) -> None:
    run = runs[0]
    assert replace(run, problem=replace(run.problem, **changes)).key != run.key


def test_the_key_depends_on_planner_seed_and_patient_but_not_on_where_it_lies(runs: list[Run]) -> None:
    run = runs[0]
    patient = run.problem.patient
    moved = replace(run.problem, patient=replace(patient, anatomy="/elsewhere"))
    other = replace(run.problem, patient=replace(patient, sources=(("labels", "0" * 64),)))
    assert replace(run, problem=moved).key == run.key
    assert replace(run, problem=other).key != run.key
    assert replace(run, seed=5).key != run.key
    assert replace(run, planner=replace(run.planner, method="kuntz2015")).key != run.key


def test_a_run_survives_the_way_to_another_process(runs: list[Run]) -> None:
    counted = {"errors": load_errors("gated-ct"), "procedure": load_procedure("measured-tip")}
    for run in [*runs, replace(runs[0], problem=replace(runs[0].problem, **counted))]:
        again = pickle.loads(pickle.dumps(run))
        assert again == run
        assert again.key == run.key


def test_a_planner_may_have_iterations_of_its_own(cache: Path) -> None:
    planners = [{"name": "a"}, {"name": "b", "iterations": 9}]
    found = list(runs_of(study_of(content(planner=planners, seeds=[0])), cache=cache))
    assert [run.iterations for run in found] == [2, 9, 2, 9]
    assert found[0].problem.key == found[1].problem.key


@pytest.mark.slow
def test_a_plan_is_checked_and_a_bad_target_is_an_answer(runs: list[Run], cache: Path) -> None:
    good, bad = answer(runs[0], cache), answer(runs[2], cache)
    assert (good.outcome, good.status, good.solved, good.accepted) == (PLAN, EXACT, True, True)
    plan = Plan.from_json(good.plan)
    assert plan.digest == good.digest
    assert plan.seed == runs[0].seed
    costs = [each.cost for each in good.improvements]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] == good.costs["inverse_clearance"]
    assert len(good.findings) > 50
    assert all(each["ok"] is not False for each in good.findings)
    assert (bad.outcome, bad.status, bad.solved, bad.failed) == ("TargetError", INVALID_GOAL, False, False)
    assert "outside the images" in bad.message
    assert answer(runs[0], cache).digest == good.digest


@pytest.mark.slow
def test_success_against_least_cost_with_the_same_luck(cache: Path, tmp_path: Path) -> None:
    """Each plan states its chance on the same draws; it is that of the results file, too."""
    planners = [{"name": "cost"}, {"name": "safe", "goal": "success", "iterations": 1}]
    asked = content(planner=planners, seeds=[0], case={"errors": "gated-ct", "targets": [NEAR]})
    with ResultsFile(tmp_path / "results.db", create=True) as results:
        chances = []
        for run in runs_of(study_of(asked), cache=cache):
            made = answer(run, cache)
            assert made.accepted and results.add(run, made)
            chance = Plan.from_json(made.plan).chance
            assert chance is not None and (chance.errors, chance.procedure) == ("gated-ct", "open-loop")
            chances.append(chance)
    assert answer(run, cache).digest == made.digest
    assert len({(each.samples, each.seed) for each in chances}) == 1
    assert chances[1].share >= chances[0].share - 0.02
    groups = {each.planner: each.success for each in summarise(tmp_path / "results.db")}
    assert groups == {"cost": chances[0].share, "safe": chances[1].share}


def test_an_unknown_nodule_and_words_that_are_no_target(cache: Path) -> None:
    for words in ("nodule 99", "nodule one", "1,2,3"):
        with pytest.raises(Exception, match="nodule|frame") as caught:
            list(runs_of(study_of(content(case={"targets": [words]})), cache=cache))
        assert hasattr(caught.value, "remedy")


@pytest.mark.parametrize(
    "planner", [{"method": "kuntz2015"}, {"needle_planner": "rrt"}, {"kind": "needle", "method": "rrt"}]
)
def test_a_planner_of_needles_is_refused_before_any_run_of_a_system_without(
    planner: dict[str, Any], cache: Path
) -> None:
    asked = content(case={"system": "tubes-only", "starts": [1]}, planner=[{"name": "mine", **planner}])
    with pytest.raises(SettingsError, match="'mine' of the study"):
        next(runs_of(study_of(asked), cache=cache))


def test_other_files_than_those_of_the_study_are_refused(runs: list[Run], tmp_path: Path) -> None:
    patient = replace(runs[0].problem.patient, sources=(("labels", "0" * 64),))
    with pytest.raises(FileError, match="differ from those the study began with"):
        open_patient(patient, tmp_path)


def test_a_device_without_an_atlas_is_an_answer(
    runs: list[Run], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of many devices is too wide for a patient's airways: the study goes on."""

    def refuse(*_asked: object, **_more: object) -> None:
        raise AnatomyError("No motion brings this bronchoscope to a place from which tubes leave the airway")

    monkeypatch.setattr(one_run, "open_atlas", refuse)
    wide = replace(runs[0].problem, system=replace(runs[0].problem.system, name="wide"))
    one_run.prepare(wide, cache)
    found = answer(replace(runs[0], problem=wide), cache)
    assert (found.outcome, found.failed) == ("AnatomyError", False)
    assert "No motion brings this bronchoscope" in found.message


@pytest.mark.slow
def test_few_patients_are_kept(runs: list[Run], cache: Path) -> None:
    for spacing in (4.0, 5.0, 6.0, 7.0):
        one_run.prepare(replace(runs[0].problem, site_spacing_mm=spacing, rotations=2), cache)
    assert one_run._atlas.cache_info().currsize == one_run.KEPT_PATIENTS


def test_drawing_targets_ends_where_there_is_no_room(
    runs: list[Run], cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lung = open_patient(runs[0].problem.patient, cache)
    points = peripheral.peripheral_targets(lung, 2, seed=4)
    assert points.shape == (4, 3)
    side = points[:, 0] - lung.tree.carina_lps[0]
    assert (side[:2] > 0).all()
    assert (side[2:] < 0).all()
    assert (points == peripheral.peripheral_targets(lung, 2, seed=4)).all()
    monkeypatch.setattr(peripheral, "CLEAR_MM", 1e6)
    monkeypatch.setattr(peripheral, "DRAWS_A_POINT", 50)
    with pytest.raises(TargetError, match="no peripheral target in its left lung"):
        peripheral.peripheral_targets(lung, 1, seed=0)


@pytest.mark.slow
def test_a_process_of_its_own_gives_the_same_plan(runs: list[Run], cache: Path) -> None:
    alone = replace(runs[0], planner=replace(runs[0].planner, own_process=True))
    found, here = answer(alone, cache), answer(runs[0], cache)
    assert found.key == alone.key != here.key
    assert found.digest == here.digest
    assert found.findings == here.findings


@pytest.mark.slow
def test_a_run_under_a_weighted_sum(cache: Path) -> None:
    """Whatever the spelling, the key is that of the sum; planner and needle alone are judged by it."""
    text = "inverse_clearance=2,length_mm=0.1"
    spelled = ("inverse-clearance=2,length=0.1", "length_mm=0.1, inverse_clearance=2.0")
    first, second = (
        next(runs_of(study_of(content(case={"objective": words})), cache=cache)) for words in spelled
    )
    assert first.problem.objective == text and first.key == second.key
    found = answer(first, cache)
    assert found.accepted
    expected = 2.0 * found.costs["inverse_clearance"] + 0.1 * found.costs["length_mm"]
    assert found.costs[text] == found.improvements[-1].cost == expected
    lung = open_patient(first.problem.patient, cache)
    tip = Plan.from_json(found.plan).tube.lps_from_tip
    choice = PlannerChoice(name="needle", kind="needle", method="optimal")
    alone = Run(problem=replace(first.problem, start=1, iterations=500), planner=choice, seed=3)
    path = needle_answer(alone, replace(lung, starts=(tip,)))
    assert path.accepted and path.improvements[0].cost == path.costs[text]


def test_a_run_of_the_needle_alone(runs: list[Run], cache: Path) -> None:
    """From where the tube of a plan ends, to the plan's target."""
    lung = open_patient(runs[0].problem.patient, cache)
    tip = Plan.from_json(answer(runs[0], cache).plan).tube.lps_from_tip
    choice = PlannerChoice(name="needle", kind="needle", method="optimal")
    problem = replace(runs[0].problem, start=1, objective="length_mm", iterations=500)
    run = Run(problem=problem, planner=choice, seed=3)
    found = needle_answer(run, replace(lung, starts=(tip,)))
    assert (found.outcome, found.status, found.accepted, found.message) == (PATH, EXACT, True, "")
    straight_mm = float(np.linalg.norm(np.array(problem.target_lps) - tip[:3, 3]))
    assert straight_mm <= found.costs["length_mm"] < 1.5 * straight_mm
    assert json.loads(found.plan)["path"]["arcs"]
    assert needle_answer(run, replace(lung, starts=(tip,))).digest == found.digest
    aside = replace(runs[0].problem, start=1, iterations=500)
    nothing = needle_answer(replace(run, problem=aside), replace(lung, starts=(np.eye(4),)))
    assert (nothing.outcome, nothing.solved, nothing.plan) == (NO_PLAN, False, "")
    with pytest.raises(SettingsError, match="no start pose 1"):
        needle_answer(run, lung)


OMPL_SCRIPT = """
import json, pickle, sys
from pathlib import Path
import numpy as np
from lungaccess.planning.one_stage.needle import plan_needle
from lungaccess.running.study.runs import open_patient
from lungaccess.problem.target import point_target
from anatomy.base.errors import SettingsError
text, tip, cache = json.loads(sys.stdin.read())
problem, tip = pickle.loads(bytes.fromhex(text)).problem, np.array(tip)
lung = open_patient(problem.patient, Path(cache))
target = point_target(lung, tip[:3, 3] + 12.0 * tip[:3, 2])
asked = dict(planner="control.RRT", seed=4, time_s=60.0)
found = plan_needle(lung, problem.system, tip, target, **asked)
try:
    plan_needle(lung, problem.system, tip, target, **asked)
except SettingsError as error:
    print(json.dumps([found.path.arcs.tolist(), found.cost, str(error)]))
"""


@pytest.mark.ompl
@pytest.mark.slow
def test_planners_of_ompl_repeat_in_processes_of_their_own(runs: list[Run], cache: Path) -> None:
    tip = Plan.from_json(answer(runs[0], cache).plan).tube.lps_from_tip
    words = json.dumps([pickle.dumps(runs[0]).hex(), tip.tolist(), str(cache)])
    first, again = (
        json.loads(
            subprocess.run(
                [sys.executable, "-c", OMPL_SCRIPT], input=words, capture_output=True, text=True, check=True
            ).stdout.splitlines()[-1]
        )
        for _ in range(2)
    )
    assert first == again
    arcs, cost, refused = first
    assert sum(arc[0] for arc in arcs) == pytest.approx(cost)
    assert cost > 11.0 and "OMPL cannot begin" in refused


def test_planners_of_ompl_end_by_time() -> None:
    needle = {"name": "r", "kind": "needle", "method": "control.RRT"}
    case = {"name": "c", "anatomy": "phantom", "targets": ["nodule"], "starts": [1]}
    plain = {"name": "s", "case": [case], "planner": [needle], "budget": {"iterations": 5}}
    with pytest.raises(SettingsError, match="time_s"):
        study_of(plain)
    assert study_of(plain | {"budget": {"time_s": 5.0}}).planner[0].is_of_ompl
