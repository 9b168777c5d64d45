"""The benchmark synthetic-v1 from cases to scores: killed runs, the breath, proofs of no plan."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import lungaccess as la
from anatomy.base.settings import override
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system
from lungaccess.running.benchmark.synthetic import scoring
from lungaccess.running.benchmark.synthetic.cases import all_queries, write_benchmark
from lungaccess.running.benchmark.synthetic.scoring import (
    CERTIFIED,
    CLAIMED,
    NONE,
    SOLVED,
    Score,
    refuted,
    score_sheet,
    score_submission,
)
from lungaccess.running.benchmark.synthetic.submission import (
    Submission,
    SubmittedAnswer,
    benchmark_study,
    read_submission,
    submissions_of,
)
from lungaccess.running.study.driver import run_study
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.tables import differences
from tests.lungaccess.cli.killing import START, require_gone, started
from tests.lungaccess.running.study.test_study_command import stored

pytestmark = pytest.mark.slow
DEVICE, TARGETS, ITERATIONS = "ultrathin", 3, 20
CHILD, BREATHING = "child-01", "breathing-04"


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cases of a child and of a patient that breathes."""
    folder = tmp_path_factory.mktemp("cases")
    write_benchmark(folder, [CHILD, BREATHING], with_tips=False)
    return folder


def command(cases: Path, out: Path, cache: Path) -> list[str]:
    return [
        "benchmark", "synthetic-v1", "run", str(cases), "--phantoms", CHILD, "--devices", DEVICE,
        "--targets", str(TARGETS), "--iterations", str(ITERATIONS), "--workers", "1", "--out", str(out),
        "--answers", str(out.parent / "answers"), "--cache", str(cache), "--json",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def undisturbed(cases: Path, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a start that nobody kills."""
    path = tmp_path_factory.mktemp("undisturbed") / "results.db"
    study = benchmark_study(cases, phantoms=[CHILD], systems=[DEVICE], targets=TARGETS, iterations=ITERATIONS)
    assert run_study(study, path, workers=1, cache=cache).added == 2 * TARGETS
    return path


def test_a_start_that_is_killed_goes_on(cases: Path, cache: Path, undisturbed: Path, tmp_path: Path) -> None:
    """SIGKILL of all its processes, as soon as a run is stored; the answers are those of the undisturbed."""
    path = tmp_path / "results.db"
    words = command(cases, path, cache)
    process = started(words)
    while process.poll() is None and stored(path) < 1:
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    require_gone(process.pid)
    before = stored(path)
    assert 1 <= before < 2 * TARGETS
    again = subprocess.run([sys.executable, "-c", START, *words], capture_output=True, text=True, check=True)
    done: dict[str, Any] = json.loads(again.stdout)
    assert (done["stored_before"], done["added"], done["failed"]) == (before, 2 * TARGETS - before, 0)
    assert differences(undisturbed, path) == []
    (handed_in,) = done["answers"]
    (expected,) = submissions_of(undisturbed)
    found = read_submission(Path(handed_in))
    parts = ("query", "scope", "tubes", "needle")
    for one, other in zip(found.answers, expected.answers, strict=True):
        assert [getattr(one, part) for part in parts] == [getattr(other, part) for part in parts]


def test_the_first_targets_of_each_lung_are_taken(undisturbed: Path) -> None:
    (submission,) = submissions_of(undisturbed)
    numbers = [all_queries()[each.query].target for each in submission.answers]
    assert numbers == [1, 2, 3, 11, 12, 13]


def test_more_targets_and_iterations_go_on_from_the_runs_that_are_stored(
    cases: Path, cache: Path, undisturbed: Path, tmp_path: Path
) -> None:
    path = tmp_path / "results.db"
    shutil.copy(undisturbed, path)
    asked: dict[str, Any] = {"phantoms": [CHILD], "systems": [DEVICE]}
    more = benchmark_study(cases, **asked, targets=TARGETS + 1, iterations=ITERATIONS)
    done = run_study(more, path, workers=1, cache=cache)
    assert (done.stored_before, done.added) == (2 * TARGETS, 2)
    longer = benchmark_study(cases, **asked, targets=1, iterations=ITERATIONS + 1)
    assert run_study(longer, path, workers=1, cache=cache).added == 2
    (submission,) = submissions_of(path)
    numbers = [all_queries()[each.query].target for each in submission.answers]
    assert numbers == [1, 2, 3, 4, 11, 12, 13, 14], "no query is answered twice"


def scores_of(submission: Submission, cases: Path, cache: Path, **options: Any) -> list[Score]:
    return list(score_submission(submission, cases, cache=cache, only_answered=True, **options))


def test_our_own_answers_are_accepted_and_claims_about_them_refuted(
    cases: Path, cache: Path, undisturbed: Path
) -> None:
    (submission,) = submissions_of(undisturbed)
    scores = scores_of(submission, cases, cache, samples=200)
    assert {each.status for each in scores} == {SOLVED, NONE}
    solved = [each for each in scores if each.status == SOLVED]
    assert all(each.cost and each.success is not None for each in solved)
    assert not any(each.not_checked for each in solved)
    with ResultsFile(undisturbed) as results:
        costs = sorted(cost for (cost,) in results.rows("SELECT cost FROM runs WHERE solved"))
    # The planner looks clearance up in a grid, the check measures it.
    assert sorted(each.cost or 0.0 for each in solved) == pytest.approx(costs, rel=0.01)
    claim = SubmittedAnswer(query=solved[0].query, unreachable=True)
    (claimed,) = scores_of(Submission(planner="doubter", answers=(claim,)), cases, cache, certify_boxes=2000)
    assert claimed.status == CLAIMED, "what a plan reaches is never proved unreachable"
    assert refuted([*scores, claimed]) == {claim.query: submission.planner}


def test_a_claim_is_proved_where_the_needle_is_too_short(
    cases: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No device of the benchmark is so weak that a few thousand boxes prove anything."""
    weak = override(load_system(DEVICE), {"needle.max_length_mm": 3.0, "tubes.max_extension_mm": 10.0})
    monkeypatch.setattr(scoring, "load_system", lambda _name: weak)
    query = f"{CHILD}/{DEVICE}/01"
    claim = Submission(planner="p", answers=(SubmittedAnswer(query=query, unreachable=True),))
    (claimed,) = scores_of(claim, cases, cache)
    assert claimed.status == CLAIMED, "a claim without a proof is only a claim"
    (proved,) = scores_of(claim, cases, cache, certify_boxes=100_000)
    assert proved.status == CERTIFIED
    (line,) = score_sheet([proved], by_family=False)
    assert (line.certified, line.solved, line.refuted) == (1, 0, 0)


def test_the_sheet_says_in_which_share_of_breath_plans_hold(cases: Path, cache: Path, tmp_path: Path) -> None:
    study = benchmark_study(cases, phantoms=[BREATHING], systems=[DEVICE], targets=1, iterations=ITERATIONS)
    run_study(study, tmp_path / "results.db", workers=1, cache=cache)
    (submission,) = submissions_of(tmp_path / "results.db")
    scores = scores_of(submission, cases, cache, samples=0)
    lung = la.load_patient(cases / BREATHING, cache=cache)
    with ResultsFile(tmp_path / "results.db") as results:
        plans = [Plan.from_json(text) for (text,) in results.rows("SELECT plan FROM plans ORDER BY runid")]
    shares = sorted(la.breathing_window(plan, lung).share for plan in plans)
    assert len(shares) == 2 and 0.0 < shares[0] < 1.0, "one of the plans does not hold in all of the breath"
    found = sorted(each.breath_share or 0.0 for each in scores if each.status == SOLVED)
    assert found == pytest.approx(shares, abs=1e-6)
    line = score_sheet(scores, by_family=False)[0]
    assert line.breath_share == pytest.approx(sum(shares) / len(shares), abs=1e-6)
