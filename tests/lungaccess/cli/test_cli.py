"""Tests of the command line: exit codes, what is written, and what bad input looks like."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import lungaccess as la
from anatomy.base.errors import AnatomyError, FrameError
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import DEFAULT_BUDGET_S, DEFAULT_SYSTEM
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.request import Limits, Request
from tests.lungaccess.appraisals import appraise_as_told, make_risk
from tests.lungaccess.loading import load_with

WRITTEN = {
    "plan.json",
    "summary.json",
    "overview.png",
    "tree.png",
    "cost_over_time.png",
    "cost_over_time.csv",
}

pytestmark = pytest.mark.usefixtures("wide_terminal")


@pytest.fixture
def never_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail a test that reads a patient although its input is bad."""

    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError("the patient was read")

    load_with(monkeypatch, fail)


@pytest.fixture
def toy_commands(monkeypatch: pytest.MonkeyPatch, toy_lung: Any, toy_plan: Plan) -> dict[str, Any]:
    """Let commands work on the toy patient; the planner yields two plans, the check accepts."""
    seen: dict[str, Any] = {
        "plans": [
            replace(toy_plan, costs={"inverse_clearance": 20.0}, timing={"planning_s": 0.2}),
            replace(toy_plan, timing={"planning_s": 0.4}),
        ]
    }
    seen.update(accepted=True, risk=make_risk(60))
    monkeypatch.setattr("lungaccess.judging.advice.advise", lambda *_, **__: ())

    def search(request: Request, **options: Any) -> Iterator[Plan]:
        seen.update(system=request.system, target=request.target, goal=request.goal, limits=request.limits)
        for number, found in enumerate(seen["plans"]):
            event = SimpleNamespace(
                iteration=10 * number, elapsed_s=0.1, best_cost=None, phase="search", message=""
            )
            options["on_progress"](event)
            yield found
        if not seen["plans"]:
            raise NoPlan(
                "No plan", reasons={"the tube comes too near a vessel": 12}, advice="A thinner scope"
            )

    load_with(monkeypatch, lambda *_, **__: toy_lung)
    monkeypatch.setattr("lungaccess.planning.coupled.open_atlas", lambda *_, **__: None)
    monkeypatch.setattr("lungaccess.judging.answering.run", search)
    monkeypatch.setattr(
        "lungaccess.problem.target.StatedTarget.resolve",
        lambda stated, lung: SimpleNamespace(named=stated.origin, lps_mm=toy_plan.target_lps),
    )
    appraise_as_told(monkeypatch, seen)
    return seen


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the two slow pictures out where a test does not look at them."""
    for name in ("overview_png", "tree_png"):
        monkeypatch.setattr(f"lungaccess.showing.report.{name}", lambda *_: None)


# Help and speed ----------------------------------------------------------------------------------


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for command in ("demo", "plan", "needle", "tubes", "check", "info", "presets", "--version"):
        assert command in text


@pytest.mark.parametrize("command", ["demo", "plan", "needle", "tubes", "check", "info", "presets"])
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "--help"]) == 0
    assert command in capsys.readouterr().out


def test_plan_help_explains_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["plan", "--help"])
    text = capsys.readouterr().out
    options = "target nodule system budget iterations seed goal objective method allow-fissures out cache"
    for option in options.split():
        assert f"--{option}" in text
    assert "inverse-clearance" in text and "kuntz2015" in text


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from lungaccess.cli.app import main; main(['--help']);"
        "heavy = {'matplotlib', 'numba', 'scipy', 'skimage', 'SimpleITK', 'ompl', 'fcl', 'casadi'};"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_presets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["presets"]) == 0
    text = capsys.readouterr().out
    assert DEFAULT_SYSTEM in text and "121" in text
    assert "- med-rad-needle: The needle is 1.8 times as stiff" in text
    assert f"- {DEFAULT_SYSTEM}: The needle" not in text, "its needle is counted"


# Plans -------------------------------------------------------------------------------------------


def test_an_accepted_plan_writes_everything_and_exits_0(
    toy_commands: dict[str, Any], toy_plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["plan", "toy", "--target", "lps:1,2,3", "--goal", "inverse-clearance"]
    assert cli.main([*words, "--out", str(out)]) == ExitCode.OK
    assert {file.name for file in out.iterdir() if file.is_file()} == WRITTEN
    assert Plan.load(out / "plan.json").digest == toy_plan.digest
    with (out / "cost_over_time.csv").open(newline="", encoding="utf-8") as file:
        costs = [row["best"] for row in csv.DictReader(file)]
    assert costs == ["", "20.0", "20.0", "12.34"]
    text = capsys.readouterr().out
    assert text.index("53.0 mm") < text.index("Estimated to succeed in 3 of 100 procedures")
    assert "likely to fail" in text and "3 arcs," in text and "cost map" not in text
    assert "[made by hand]" in text


@pytest.mark.usefixtures("no_pictures")
def test_a_refused_plan_exits_1_and_says_why(
    toy_commands: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy_commands["accepted"] = False
    assert cli.main(["plan", "toy", "--nodule", "--out", str(tmp_path)]) == ExitCode.NEGATIVE
    text = capsys.readouterr().out
    assert "do not use" in text and "needle.clearance.vessel" in text and "Estimated" not in text


def test_no_plan_exits_1_with_counted_reasons(
    toy_commands: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy_commands["plans"] = []
    words = ["plan", "toy", "--nodule", "--explain-time", "0", "--out", str(tmp_path)]
    assert cli.main(words) == ExitCode.NEGATIVE
    text = capsys.readouterr().out
    assert "12" in text and "near a vessel" in text and "A thinner scope" in text
    assert not (tmp_path / "plan.json").exists()


def test_a_missing_cost_map_is_bad_input(
    toy_commands: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["plan", "toy", "--nodule", "--objective", "cost-map", "--out", str(tmp_path)]
    assert cli.main(words) == ExitCode.BAD_INPUT
    assert "no cost map" in capsys.readouterr().err


@pytest.mark.usefixtures("no_pictures")
def test_an_interruption_keeps_the_best_plan(
    toy_commands: dict[str, Any], toy_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def search(*_: Any, **__: Any) -> Iterator[Plan]:
        yield toy_plan
        raise KeyboardInterrupt

    monkeypatch.setattr("lungaccess.judging.answering.run", search)
    assert cli.main(["plan", "toy", "--nodule", "--out", str(tmp_path)]) == ExitCode.OK
    assert (tmp_path / "plan.json").exists()


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--nodule"], "the largest nodule"),
        (["--nodule", "--seed", "4"], "the largest nodule"),
        (["--nodule", "2"], "nodule 2"),
        (["--nodule=3"], "nodule 3"),
        (["--target", "ras:-1,2,3"], "point ras:-1,2,3"),
    ],
)
def test_targets_are_understood(
    words: list[str], expected: Any, toy_commands: dict[str, Any], tmp_path: Path
) -> None:
    cli.main(["plan", "toy", *words, "--out", str(tmp_path)])
    assert toy_commands["target"].named == expected


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(
    ("words", "time_s", "iterations"),
    [([], DEFAULT_BUDGET_S, None), (["--budget", "2"], 2.0, None), (["--iterations", "7"], None, 7)],
)
def test_an_iteration_budget_leaves_the_time_open(
    words: list[str], time_s: Any, iterations: Any, toy_commands: dict[str, Any], tmp_path: Path
) -> None:
    cli.main(["plan", "toy", "--nodule", *words, "--out", str(tmp_path)])
    assert toy_commands["limits"] == Limits(time_s=time_s, iterations=iterations)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("words", ["length=1,inverse-clearance=2", "inverse_clearance=2, length_mm"])
def test_an_objective_may_be_a_weighted_sum(words: str, toy_commands: dict[str, Any], tmp_path: Path) -> None:
    cli.main(["plan", "toy", "--nodule", "--objective", words, "--out", str(tmp_path)])
    assert toy_commands["goal"].objective == la.Objective(inverse_clearance=2.0, length=1.0)


@pytest.mark.usefixtures("no_pictures")
def test_success_is_the_goal_of_whoever_states_none(toy_commands: dict[str, Any], tmp_path: Path) -> None:
    cli.main(["plan", "toy", "--nodule", "--cpu-budget", "3", "--out", str(tmp_path)])
    assert toy_commands["goal"] is SUCCESS
    assert toy_commands["limits"] == Limits(time_s=DEFAULT_BUDGET_S, cpu_s=3.0)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(("word", "allowed"), [("--allow-fissures", True), ("--no-allow-fissures", False)])
def test_the_user_decides_about_fissures(
    word: str, allowed: bool, toy_commands: dict[str, Any], tmp_path: Path
) -> None:
    cli.main(["plan", "toy", "--nodule", word, "--out", str(tmp_path)])
    system = toy_commands["system"]
    assert system.fissures_allowed is allowed
    # A preset that was changed does not go by the name of the preset.
    assert (system.name == DEFAULT_SYSTEM) is not allowed


@pytest.mark.parametrize(("accepted", "code"), [(True, ExitCode.OK), (False, ExitCode.NEGATIVE)])
def test_check_exits_with_its_verdict(
    accepted: bool, code: int, toy_commands: dict[str, Any], toy_plan: Plan, tmp_path: Path
) -> None:
    toy_plan.save(tmp_path / "plan.json")
    toy_commands["accepted"] = accepted
    assert cli.main(["check", str(tmp_path / "plan.json"), "toy"]) == code
    assert toy_commands["judged_with"] is None
    cli.main(["check", str(tmp_path / "plan.json"), "toy", "--system", "ultrathin"])
    assert toy_commands["judged_with"].name == "ultrathin"


def test_check_shows_value_limit_and_margin(
    toy_commands: dict[str, Any], toy_plan: Plan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy_plan.save(tmp_path / "plan.json")
    words = ["check", str(tmp_path / "plan.json"), "toy"]
    toy_commands["accepted"] = False
    assert cli.main(words) == ExitCode.NEGATIVE
    said = capsys.readouterr().out.splitlines()
    assert "REFUSED needle.clearance.vessel 0.4 mm (at least 1, margin -0.6): why" in said
    (row,) = [line for line in said if "needle to vessel" in line]
    assert " ".join(row.split()) == "needle to vessel 0.40 mm at least 1.00 mm BROKEN"
    assert cli.main([*words, "--all"]) == ExitCode.NEGATIVE
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(" refused")]
    assert " ".join(row.split()) == "refused needle.clearance.vessel 0.4 mm at least 1 -0.6 why"
    assert cli.main([*words, "--json"]) == ExitCode.NEGATIVE
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["margin"] == pytest.approx(-0.6)
    assert (finding["stage"], finding["side"], finding["ok"]) == ("needle", "at least", False)


@pytest.mark.slow
def test_the_demonstration_ends_with_an_accepted_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["demo", "--budget", "1", "--out", str(out), "--cache", str(tmp_path / "cache")]
    assert cli.main(words) == ExitCode.OK, capsys.readouterr().out
    assert {file.name for file in out.iterdir() if file.is_file()} == WRITTEN | {"report.html"}
    page, advice = (out / "report.html").read_text(), json.loads((out / "summary.json").read_text())["advice"]
    assert advice and all(shlex.join(each["options"]) in page for each in advice)


# Bad input ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ["plan"],
        ["bogus"],
        ["plan", "toy", "--objective", "beauty"],
        ["plan", "toy", "--seed", "x"],
        ["plan", "toy", "--unknown", "1"],
    ],
)
def test_bad_usage_exits_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err


@pytest.mark.usefixtures("never_loads")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "No target was given"),
        (["--target", "lps:1,2,3", "--nodule"], "Both a target and a nodule"),
        (["--target", "1,2,3"], "1,2,3"),
        (["--target", "lps:1,2,nan"], "nan"),
        (["--nodule", "--budget", "0"], "--budget is 0"),
        (["--nodule", "--budget", "nan"], "--budget is nan"),
        (["--nodule", "--iterations", "0"], "--iterations is 0"),
        (["--nodule", "--system", "no-such-system"], "no-such-system"),
    ],
)
def test_bad_requests_exit_2_before_the_patient_is_read(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["plan", "toy", *words, "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err


@pytest.mark.usefixtures("never_loads")
@pytest.mark.parametrize("command", [["plan", "toy", "--nodule"], ["info", "toy"], ["demo"]])
def test_an_unwritable_output_folder_is_found_before_planning(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("not a folder")
    assert cli.main([*command, "--out", str(tmp_path / "file" / "out")]) == ExitCode.BAD_INPUT
    assert "cannot be written" in capsys.readouterr().err


@pytest.mark.parametrize("error", [FrameError, AnatomyError])
def test_a_typed_error_is_a_panel_and_exits_2(
    error: type[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error("The mask [airway] is empty", expected="one voxel", remedy="Look at it")

    load_with(monkeypatch, fail)
    assert cli.main(["info", "toy"]) == ExitCode.BAD_INPUT
    text = capsys.readouterr().err
    for part in ("The mask [airway] is empty.", "one voxel", "Look at it"):
        assert part in text


def test_a_missing_plan_exits_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(tmp_path / "plan.json"), "toy"]) == ExitCode.BAD_INPUT
    assert "plan.json" in capsys.readouterr().err


def test_lack_of_memory_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise MemoryError

    load_with(monkeypatch, fail)
    assert cli.main(["info", "toy"]) == ExitCode.BAD_INPUT
    assert "not enough memory" in capsys.readouterr().err


def test_an_interrupted_loading_of_a_library_is_an_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(_words: object) -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr(cli, "with_nodule_number", load)
    assert cli.main(["presets"]) == 130
