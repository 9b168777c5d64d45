"""`lungaccess shapes`: the summary, the table of all shapes, and designs that allow nothing."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode

ONE_TUBE = """
name = "one tube"

[[tubes]]
outer_diameter_mm = 1.5
inner_diameter_mm = 1.3
length_mm = 680.0
curved_length_mm = {length}
precurvature_per_mm = {curvature}
"""


def run(tmp_path: Path, *words: str) -> int:
    return cli.main(["shapes", "--cache", str(tmp_path / "cache"), *words])


def test_default_design(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "shapes.csv"
    assert run(tmp_path, "--out", str(table)) == ExitCode.OK
    said = " ".join(capsys.readouterr().out.split())
    assert "looked at 440 insertions every 2 mm, no relative rotation" in said
    assert "allowed 230" in said
    with table.open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 230
    assert max(float(row["lateral_sweep_mm"]) for row in rows) <= 1.0
    assert all(float(row["insertion_1_mm"]) >= float(row["insertion_2_mm"]) for row in rows)


def test_one_tube_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "one.toml"
    file.write_text(ONE_TUBE.format(length=60.0, curvature=0.02))
    assert run(tmp_path, "--system", str(file), "--json") == ExitCode.OK
    told = json.loads(capsys.readouterr().out)
    assert told["n_tubes"] == 1 and told["shapes"] == told["candidates"] == 30 and told["refused"] == {}
    assert told["largest"]["tip_turned_rad"] == pytest.approx(60.0 * 0.02)
    assert told["largest"]["lateral_sweep_mm"] == pytest.approx(0.0, abs=1e-9)


def test_a_design_that_allows_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "one.toml"
    file.write_text(ONE_TUBE.format(length=60.0, curvature=0.08))
    assert run(tmp_path, "--system", str(file)) == ExitCode.NEGATIVE
    said = " ".join(capsys.readouterr().out.split())
    assert "refused: a tube would be" in said
    assert "allowed 0" in said
