"""The benchmark synthetic-v1: fixed phantoms, submissions read and refused, scores by the check alone."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, LungaccessError, SettingsError
from anatomy.base.settings import to_mapping
from anatomy.io.patients import load_patient as read_images
from anatomy.phantom import write_phantom
from experiments.synthetic_manifest import measured_entry
from lungaccess.plans.plan import Plan
from lungaccess.running.benchmark.synthetic import cases as manifest
from lungaccess.running.benchmark.synthetic.cases import (
    FAMILIES,
    OF_A_FAMILY,
    SYSTEMS,
    BenchmarkQuery,
    all_queries,
    benchmark_phantoms,
    entries,
    make_benchmark_phantom,
    masks_sha256,
    phantom_named,
    require_cases,
    unproved_phantom,
)
from lungaccess.running.benchmark.synthetic.scoring import (
    CLAIMED,
    MISSING,
    REFUSED,
    SOLVED,
    Score,
    read_scores,
    refuted,
    score_sheet,
    write_scores,
    write_sheet,
)
from lungaccess.running.benchmark.synthetic.submission import (
    SCHEMA,
    answer_of_plan,
    method_choice,
    read_submission,
    submission_of,
    submission_schema,
)

NAMES = [each.name for each in benchmark_phantoms()]
CHEAP = ("child-01",)
NAN = float("nan")
POSE = np.eye(4).tolist()
ANSWER = {
    "query": "child-01/ultrathin/01",
    "scope": {"tip": 3},
    "tubes": {
        "rotation_rad": 0.5, "outer_insertion_mm": 0, "inner_insertion_mm": 12.5, "lps_from_tip": POSE,
    },
    "needle": {"arcs": [{"length_mm": 20.0, "roll_rad": 0.0, "curvature_per_mm": 0.001}]},
}  # fmt: skip


def submitted(*answers: Any, **head: Any) -> dict[str, Any]:
    return {"schema": SCHEMA, "benchmark": "synthetic-v1", "planner": "p", "answers": list(answers), **head}


def test_there_are_fifty_phantoms_twenty_targets_and_three_devices() -> None:
    assert len(set(NAMES)) == 50 and len(all_queries()) == 50 * 20 * 3
    assert Counter(each.family for each in benchmark_phantoms()) == dict.fromkeys(FAMILIES, OF_A_FAMILY)
    assert len({each.seed for each in benchmark_phantoms()}) == 50
    assert list(entries()) == NAMES
    open_ones = [each for each in benchmark_phantoms() if each.traits.open_fissures]
    assert len(open_ones) == 25 and {each.family for each in open_ones} == set(FAMILIES)


@pytest.mark.parametrize(
    "name", [*CHEAP, *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES if n not in CHEAP)]
)
def test_a_phantom_is_that_of_the_manifest(name: str) -> None:
    made = make_benchmark_phantom(phantom_named(name)).images
    assert masks_sha256(made) == entries()[name].masks_sha256


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"{family}-01" for family in FAMILIES])
def test_targets_are_those_of_the_manifest(name: str, tmp_path: Path) -> None:
    assert measured_entry(phantom_named(name), tmp_path) == entries()[name]


@pytest.mark.slow
def test_a_changed_generator_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    case = phantom_named("child-01")
    other = replace(case, traits=replace(case.traits, vessel_calibre=case.traits.vessel_calibre + 0.1))
    made = unproved_phantom(other)
    monkeypatch.setattr(manifest, "unproved_phantom", lambda _case: made)
    with pytest.raises(AnatomyError, match="masks of child-01 made here"):
        make_benchmark_phantom(case)


@pytest.mark.slow
def test_masks_read_from_files_have_the_hash_of_those_written(tmp_path: Path) -> None:
    made = unproved_phantom(phantom_named("child-02"))
    write_phantom(made, tmp_path / "child-02", with_ct=False)
    assert not (tmp_path / "child-02" / "ct.nii.gz").exists()
    assert masks_sha256(read_images(tmp_path / "child-02")) == masks_sha256(made.images)


def test_an_unknown_phantom_is_named() -> None:
    with pytest.raises(SettingsError, match="no phantom 'adult-99'"):
        phantom_named("adult-99")


def test_a_folder_of_other_cases_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        require_cases(tmp_path)
    (tmp_path / "benchmark.json").write_text(json.dumps({"manifest_sha256": "0" * 64, "phantoms": []}))
    with pytest.raises(FileError, match="has the manifest 0000"):
        require_cases(tmp_path)


def test_a_submission_is_read_without_loss(tmp_path: Path) -> None:
    path = tmp_path / "answers.json"
    none = {"query": "child-01/ultrathin/02", "unreachable": True}
    path.write_text(json.dumps(submitted(ANSWER, none)))
    read = read_submission(path)
    first, second = read.answers
    assert first.planned and first.scope is not None and first.scope.tip == 3
    assert second.unreachable and not second.planned
    assert submission_of(json.loads(json.dumps(to_mapping(read)))) == read


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"query": "child-01/ultrathin/21"}, "there is no query"),
        ({"needle": None}, "scope, tubes, needle"),
        ({"needle": {"arcs": []}}, "arcs"),
        ({"needle": {"arcs": [{"length_mm": -1.0, "roll_rad": 0.0, "curvature_per_mm": 0.0}]}}, "length_mm"),
        ({"needle": {"arcs": [{"length_mm": NAN, "roll_rad": 0.0, "curvature_per_mm": 0.0}]}}, "length"),
        ({"tubes": {**ANSWER["tubes"], "lps_from_tip": [[1.0, 0.0], [0.0, 1.0]]}}, "lps_from_tip"),
        ({"tubes": {**ANSWER["tubes"], "colour": 1}}, "colour"),
        ({"scope": {}}, "tip"),
        ({"scope": {"tip": "three"}}, "tip"),
        ({"unreachable": True}, "unreachable"),
        ({"cpu_s": -1.0}, "cpu_s"),
    ],
)  # fmt: skip
def test_a_bad_answer_is_refused_by_its_number(change: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words) as caught:
        submission_of(submitted({"query": "child-01/ultrathin/05"}, ANSWER | change))
    assert "answer 2" in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        [], {"answers": {}}, submitted("text"), submitted(ANSWER, ANSWER), submitted(planner=""),
        submitted(schema="other/1"), submitted(benchmark="synthetic-v2"), submitted(colour="red"),
    ],
)  # fmt: skip
def test_a_bad_submission_is_refused(content: object) -> None:
    with pytest.raises(SettingsError):
        submission_of(content)


def test_the_schema_names_every_part() -> None:
    text = json.dumps(submission_schema())
    assert all(
        word in text for word in ("lps_from_tip", "states", "roll_rad", "unreachable", "inner_insertion_mm")
    )


def test_methods_are_named_with_their_needle_planner() -> None:
    assert method_choice("kuntz2015+control.RRT", 10).needle_planner == "control.RRT"
    with pytest.raises(SettingsError):
        method_choice("atlas+nothing", 10)


def test_a_plan_of_ours_is_handed_in_as_its_motions_alone(toy_plan: Plan) -> None:
    query = BenchmarkQuery(
        name="child-01/ultrathin/01", phantom="child-01", system="ultrathin", target=1, target_lps=(0, 0, 0)
    )
    answer = answer_of_plan(query, toy_plan, first_cpu_s=0.1, cpu_s=0.2)
    assert answer.planned and "costs" not in json.dumps(to_mapping(answer))
    assert submission_of(submitted(to_mapping(answer))).answers == (answer,)


def score(query: str, planner: str, status: str, **values: Any) -> Score:
    phantom, system, target = query.split("/")
    family = phantom_named(phantom).family
    return Score(
        query=query, phantom=phantom, family=family, system=system, target=int(target), planner=planner,
        status=status, **values,
    )  # fmt: skip


SCORES = [
    score("adult-01/ultrathin/01", "a", SOLVED, cost=4.0, cpu_s=1.0, success=0.5),
    score("adult-01/ultrathin/02", "a", SOLVED, cost=8.0, cpu_s=3.0, success=0.7),
    score("child-01/thin-scope/01", "a", REFUSED, reason="REFUSED x", cpu_s=2.0),
    score("child-01/thin-scope/02", "a", MISSING),
    score("adult-01/ultrathin/01", "b", CLAIMED),
    score("adult-01/ultrathin/02", "b", SOLVED, cost=6.0),
]


def test_the_sheet_counts_what_is_accepted_and_compares_what_all_solved() -> None:
    whole = {line.planner: line for line in score_sheet(SCORES, by_family=False)}
    assert (whole["a"].queries, whole["a"].solved, whole["a"].refused) == (4, 2, 1)
    assert (whole["a"].cost, whole["a"].shared_cost, whole["b"].shared_cost) == (6.0, 8.0, 6.0)
    assert whole["a"].cpu_s == 2.0 and whole["a"].success == pytest.approx(0.6)
    assert refuted(SCORES) == {"adult-01/ultrathin/01": "a"} and whole["b"].refuted == 1
    lines = {(line.planner, line.family, line.system): line for line in score_sheet(SCORES)}
    assert lines["a", "child", "all"].solved == 0 and lines["a", "all", "ultrathin"].solved == 2


def test_scores_are_kept_without_loss_and_others_are_refused(tmp_path: Path) -> None:
    write_scores(SCORES, tmp_path / "scores.json")
    assert read_scores(tmp_path / "scores.json") == SCORES
    write_scores(SCORES, tmp_path / "scores.csv")
    write_sheet(score_sheet(SCORES), tmp_path / "sheet.csv")
    assert len((tmp_path / "scores.csv").read_text().splitlines()) == len(SCORES) + 1
    for damaged in ({}, [], {"manifest_sha256": manifest.manifest_sha256(), "scores": [{"query": 1}]}):
        (tmp_path / "other.json").write_text(json.dumps(damaged))
        with pytest.raises(LungaccessError):
            read_scores(tmp_path / "other.json")


def test_devices_of_the_benchmark_have_planar_tubes_and_a_needle() -> None:
    from lungaccess.problem.system import load_system

    assert all(load_system(name).tubes.planar and load_system(name).needle for name in SYSTEMS)
