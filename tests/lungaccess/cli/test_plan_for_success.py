"""`plan` for success and for a window: a plan with its chance, and what cannot be asked together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.success.ratings import OPEN_LOOP
from lungaccess.plans.plan import Plan


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--goal", "sucess"], "Did you mean 'success'"),
        (["--goal", "success", "--gap", "0.1"], "no bound of the best possible"),
        (["--goal", "length", "--gap", "0.1", "--phases", "0:0.3"], "breathes is not known"),
        (["--goal", "success", "--procedure", "measured-top"], "measured-tip"),
        (["--goal", "window"], "breathes is not known"),
        (["--goal", "window", "--system", "auto"], "breathes is not known"),
        (["--objective", "success", "--phases", "0:0.3"], "breathes is not known"),
        (["--method", "kuntz2015", "--system", "tubes-only"], "needle"),
        (["--method", "kunz2015"], "Did you mean 'kuntz2015'"),
        (["--needle-planner", "control.EST", "--system", "auto"], "seeded once"),
        (["--exit", "lps:0,0,0", "--scope-tip", "lps:0,0,0"], "--exit and --scope-tip"),
        (["--least-clearance", "-1"], "--least-clearance"),
        (["--goal", "cost-map"], "no cost map"),
        (["--phases", "0.3"], "a colon between them"),
        (["--phases", "0.3:0.1"], "the first before the last"),
        (["--phases", "0.3:1.1"], "end-inhale"),
    ],
)
def test_what_cannot_be_asked_together_is_refused_in_words(
    words: list[str], said: str, patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = ["--cache", str(patient.parent / "cache"), "--out", str(tmp_path / "out")]
    asked = ["plan", str(patient), "--target", "lps:-45.6,47.0,-65.1", *words, *cache]
    assert cli.main(asked) == ExitCode.BAD_INPUT
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_plan_and_its_chance(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--target", "lps:-45.6,47.0,-65.1", "--system", "ultrathin", "--procedure", "open-loop"]
    budget = ["--iterations", "2", "--no-pictures", "--json"]
    where = ["--errors", "gated-ct", "--out", str(tmp_path), "--cache", str(patient.parent / "cache")]
    assert cli.main(["plan", str(patient), *words, *budget, *where]) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    headline = said["headline"]
    assert (headline["errors"]["name"], headline["procedure"]) == ("gated-ct", "open-loop")
    assert headline["stated_by_plan"] and headline["draws"] == OPEN_LOOP.fresh
    low, high = headline["success"]["interval_95"]
    assert 0.0 <= low <= headline["success"]["probability"] <= high <= 1.0
    plan = Plan.load(tmp_path / "plan.json")
    assert plan.digest == said["digest"]
    assert plan.chance is not None and plan.chance.share == headline["success"]["probability"]
    assert json.loads((tmp_path / "summary.json").read_text())["headline"] == headline
    check = ["check", str(tmp_path / "plan.json"), str(patient), "--json", *where[4:]]
    assert cli.main(check) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["headline"] == headline
    assert cli.main([*check, "--errors", "gated-ct"]) == ExitCode.OK
    computed = json.loads(capsys.readouterr().out)["headline"]
    assert not computed["stated_by_plan"] and computed["draws"] == 2000
