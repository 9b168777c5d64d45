"""`plan --objective success`: a plan with its chance, and words for what cannot be asked together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.plan import Plan


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--objective", "length", "--procedure", "open-loop"], "--objective success"),
        (["--objective", "success", "--method", "kuntz2015"], "neither --method"),
        (["--objective", "success", "--processes", "2"], "neither --method"),
        (["--objective", "success", "--system", "auto"], "one system"),
        (["--objective", "success", "--procedure", "measured-top"], "measured-tip"),
        (["--objective", "success", "--system", "tubes-only"], "needle"),
    ],
)
def test_what_cannot_be_asked_together_is_refused_in_words(
    words: list[str], said: str, patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = ["--cache", str(patient.parent / "cache"), "--out", str(tmp_path / "out")]
    asked = ["plan", str(patient), "--target", "lps:-45.6,47.0,-65.1", *words, *cache]
    assert cli.main(asked) == ExitCode.BAD_INPUT
    assert said in capsys.readouterr().err


def test_a_plan_and_its_chance(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--target", "lps:-45.6,47.0,-65.1", "--system", "ultrathin", "--objective", "success"]
    budget = ["--iterations", "2", "--no-pictures", "--json"]
    where = ["--errors", "gated-ct", "--out", str(tmp_path), "--cache", str(patient.parent / "cache")]
    assert cli.main(["plan", str(patient), *words, *budget, *where]) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    success = said["success"]
    assert (success["errors"], success["procedure"]) == ("gated-ct", "open-loop")
    low, high = success["interval_95"]
    assert 0.0 <= low <= success["probability"] <= high <= 1.0
    assert Plan.load(tmp_path / "plan.json").digest == said["digest"]
    assert json.loads((tmp_path / "summary.json").read_text())["success"] == success
