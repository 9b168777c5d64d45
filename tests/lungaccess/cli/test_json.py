"""JSON on standard output: one style, with --quiet, on real commands."""

from __future__ import annotations

import inspect
import json
import os
import re
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from anatomy.base.cache import default_cache
from anatomy.machine_code.sources import kernel_digest
from lungaccess.cli import anatomy_tables, plan_search, terminal
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.plan import Plan
from lungaccess.plans.version import software_version
from lungaccess.problem.system import shipped_names
from tests.lungaccess.appraisals import appraise_as_told, make_risk
from tests.lungaccess.cli.every_command import commands
from tests.lungaccess.loading import load_with

WITHOUT_RESULT = {"benchmark synthetic-v1 schema", "completion", "template"}
"""Commands that print a script or a file."""


def test_every_command_has_one_style_of_json() -> None:
    found = commands()
    assert {"plan", "demo", "info", "export", "doctor", "tour"} <= set(found)
    assert {name for name, function in found.items() if function in cli.WITHOUT_JSON} == WITHOUT_RESULT
    for name, function in found.items():
        assert not {"json", "cache", "quiet"} & set(inspect.signature(function).parameters), name
        tells = re.search(r"\b(tell|_show_sheet|plan_and_report|_remove)\(", inspect.getsource(function))
        assert bool(tells) is (name not in WITHOUT_RESULT), name


@pytest.mark.parametrize(
    "words", ["template study", "completion bash", "benchmark synthetic-v1 schema", "study"]
)
@pytest.mark.parametrize("before", [True, False])
def test_what_answers_nothing_refuses_json(
    words: str, before: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["--json", *words.split()] if before else [*words.split(), "--json"]
    assert cli.main(asked) == ExitCode.BAD_INPUT
    said = json.loads(capsys.readouterr().out)["error"]
    assert said["kind"] == "UsageError" and "--json" in said["found"]
    assert f"`lungaccess {words.removesuffix(' study').removesuffix(' bash')} --help`" in said["remedy"]


@pytest.mark.parametrize("known", ["nowhere/known", None])
def test_the_cache_is_stated_for_one_command(
    known: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("LUNGACCESS_CACHE", raising=False)
    if known is not None:
        monkeypatch.setenv("LUNGACCESS_CACHE", known)
    here = str(tmp_path / "cache")
    for words in (["cache", "--cache", here], ["--cache", here, "cache"], [f"--cache={here}", "cache"]):
        assert answer_of(words, capsys)["folder"] == here
        assert os.environ.get("LUNGACCESS_CACHE") == known
    assert answer_of(["cache"], capsys)["folder"] == str(default_cache())
    assert cli.main(["cache", "prune", "--max-size", "big", "--cache", here]) == ExitCode.BAD_INPUT
    assert os.environ.get("LUNGACCESS_CACHE") == known
    capsys.readouterr()
    assert cli.main(["plan", "PATIENT", "--cache"]) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "--cache has no value" in said and "`lungaccess plan --help`" in said


def test_presets_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["presets", "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert set(found) == set(shipped_names())
    assert found["lung-default"]["needle"]["diameter_mm"] == 0.8


@pytest.mark.parametrize("word", ["--quiet", "-q"])
@pytest.mark.parametrize("before", [True, False])
def test_quiet_prints_json_and_errors_alone(
    word: str, before: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: str) -> tuple[int, Any]:
        code = cli.main([word, *words] if before else [*words, word])
        return code, capsys.readouterr()

    code, said = run("presets")
    assert (code, said.out, said.err) == (ExitCode.OK, "", "")
    code, said = run("presets", "--json")
    assert code == ExitCode.OK and set(json.loads(said.out)) == set(shipped_names())
    code, said = run("plan", "toy", "--nodule", "--system", "no-such-system")
    assert code == ExitCode.BAD_INPUT and said.out == "" and "no-such-system" in said.err
    assert cli.main(["presets"]) == ExitCode.OK
    assert "lung-default" in capsys.readouterr().out


@pytest.mark.parametrize("fails", [False, True])
def test_the_view_of_a_ct_tells_its_address_alone(
    fails: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The CT is segmented first, by a command that answers, too; its errors are told."""
    from anatomy.base.errors import AnatomyError
    from lungaccess.cli import lazy
    from lungaccess.showing.explorer import Address, Explorer

    async def serve(_explorer: Explorer, started: Any) -> None:
        started(Address(port=8, token="t"))

    def segment(*_: Any, **__: Any) -> None:
        if fails:
            raise AnatomyError("no lungs")
        terminal.tell({"lungs": 2})
        terminal.say("two lungs")

    monkeypatch.setattr(lazy, "is_ct", lambda _path: True, raising=False)
    monkeypatch.setattr("lungaccess.cli.commands.patients.segment", segment)
    monkeypatch.setattr(Explorer, "serve", serve)
    load_with(monkeypatch, lambda *_, **__: None)
    code = cli.main(["view", "ct", "--out", str(tmp_path), "--no-browser", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert code == (ExitCode.BAD_INPUT if fails else ExitCode.OK)
    assert said["error"]["found"] == "no lungs" if fails else said["port"] == 8


@given(
    st.recursive(st.floats() | st.text(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner))
)
def test_json_is_json_whatever_the_numbers(value: Any) -> None:
    def expected(part: Any) -> Any:
        if isinstance(part, float):
            return part if abs(part) < float("inf") else None
        if isinstance(part, list):
            return [expected(inner) for inner in part]
        return {key: expected(inner) for key, inner in part.items()} if isinstance(part, dict) else part

    stream = StringIO()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(terminal, "console", Console(file=stream, quiet=True))
        terminal.show_json(value)
    assert json.loads(stream.getvalue(), parse_constant=pytest.fail) == expected(value)


def test_a_plan_as_json_says_what_the_check_says(
    toy_lung: Any, toy_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    from lungaccess.plans.no_plan import NoPlan

    target = SimpleNamespace(lps_mm=toy_plan.target_lps)
    load_with(monkeypatch, lambda *_, **__: toy_lung)
    monkeypatch.setattr("lungaccess.problem.target.StatedTarget.resolve", lambda *_: target)
    for name in ("overview_png", "tree_png", "cost_over_time_png"):
        monkeypatch.setattr(f"lungaccess.showing.report.{name}", lambda *_: None)
    appraise_as_told(monkeypatch, {"accepted": True, "risk": make_risk(1900)})
    monkeypatch.setattr(plan_search, "run_search", lambda *_: (toy_plan, []))
    words = ["plan", "toy", "--nodule", "--json", "--out", str(tmp_path)]
    assert cli.main(words) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    assert said["found"] and said["accepted"] and said["digest"] == toy_plan.digest
    assert said["cost"] == toy_plan.cost and said["costs"]["length_mm"] == toy_plan.costs["length_mm"]
    assert said["costs"]["cost_map"] is None and "plan.json" in said["files"]
    assert said["headline"]["grade"] == "good" and said["headline"]["success"]["probability"] == 0.95
    assert json.loads((tmp_path / "summary.json").read_text()) == said
    assert "overview.png" in said["files"]
    for name in ("overview_png", "tree_png", "cost_over_time_png"):
        monkeypatch.setattr(f"lungaccess.showing.report.{name}", lambda *_: pytest.fail("it draws"))
    assert cli.main([*words, "--no-pictures"]) == ExitCode.OK
    assert not [file for file in json.loads(capsys.readouterr().out)["files"] if file.endswith(".png")]

    def fail(*_: Any) -> None:
        raise NoPlan("No way", reasons={"too near a vessel": 3}, advice="A thinner scope")

    monkeypatch.setattr(plan_search, "run_search", fail)
    assert cli.main([*words, "--explain-time", "0"]) == ExitCode.NEGATIVE
    assert json.loads(capsys.readouterr().out) == {
        "software_version": software_version(),
        "kernels": kernel_digest(),
        "found": False,
        "accepted": False,
        "why": "No way",
        "reasons": {"too near a vessel": 3},
        "advice": "A thinner scope",
        "attempts": {},
    }


def test_a_lung_as_json_agrees_with_its_tables(small_lung: Any) -> None:
    record = json.loads(json.dumps(anatomy_tables.organ_record(small_lung), allow_nan=False))
    assert record["tree"]["branches"] == small_lung.tree.n_branches
    assert sum(record["tree"]["branches_by_generation"]) == small_lung.tree.n_branches
    lumen = float(small_lung.mask("lumen").array.sum()) * small_lung.grid.voxel_volume_mm3 / 1000.0
    assert record["volumes_ml"]["lumen"] == pytest.approx(lumen)
    rows = {row[0]: row[1] for row in anatomy_tables._volume_rows(small_lung)}
    assert rows["lumen"] == f"{lumen:.1f}"


def answer_of(words: list[str], capsys: pytest.CaptureFixture[str], code: int = ExitCode.OK) -> Any:
    """Run a command with --json and return what it says; its standard output is JSON and nothing else."""
    assert cli.main([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
def test_info_and_tour_as_json(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = ["--cache", str(patient.parent / "cache")]
    found = answer_of(["info", str(patient), *cache], capsys)
    assert found["kind"] and found["tree"]["branches"] > 10 and len(found["targets_lps"]) > 0
    lesion = "lps:" + ",".join(f"{c:.3f}" for c in found["targets_lps"][0])
    (tmp_path / "lesions.txt").write_text(lesion + "\n")
    words = ["tour", str(patient), "--targets", str(tmp_path / "lesions.txt"), "--no-require-plan", *cache]
    tour = answer_of([*words, "--out", str(tmp_path / "tour")], capsys)
    assert tour == json.loads((tmp_path / "tour" / "tour.json").read_text())


@pytest.mark.slow
def test_alternatives_and_needle_as_json(
    patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--nodule", "1", "--system", "ultrathin", "--cache", str(patient.parent / "cache")]
    words = ["alternatives", str(patient), *common, "--count", "2", "--out", str(tmp_path)]
    found = answer_of(words, capsys)
    assert found and all(each["accepted"] for each in found)
    first = Plan.load(found[0]["plan"])
    assert found[0]["criteria"]["inverse_clearance"] == pytest.approx(first.costs["inverse_clearance"])
    np.savetxt(tmp_path / "pose.txt", first.tube.lps_from_tip)
    start = ["--start", str(tmp_path / "pose.txt"), "--frame", "lps", "--iterations", "2000"]
    path = answer_of(["needle", str(patient), *common, *start], capsys)["path"]
    assert path["length_mm"] == pytest.approx(sum(arc["length_mm"] for arc in path["arcs"]))
    assert path["lps_from_start"][3] == [0.0, 0.0, 0.0, 1.0]


def test_advice_as_json(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["advise", str(patient), "--nodule", "1", "--system", "ultrathin", "--out", str(tmp_path)]
    words += ["--cache", str(patient.parent / "cache"), "--json"]
    code = cli.main(words)
    advice = json.loads(capsys.readouterr().out)
    assert advice == json.loads((tmp_path / "advice.json").read_text())
    assert code == (ExitCode.OK if advice["reached"] else ExitCode.NEGATIVE)
