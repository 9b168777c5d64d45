"""The example in the help of every command works, and so does every template."""

from __future__ import annotations

import json
import shlex
from dataclasses import fields, replace
from pathlib import Path

import pytest

from anatomy.base.settings import parse
from anatomy.grid import Grid
from anatomy.io.frames import read_pose
from anatomy.io.own_masks import PatientFile
from anatomy.segmentation.nodules import nodule_from_contours
from lungaccess.cli import app as cli
from lungaccess.cli.commands.exchange import FILES
from lungaccess.cli.examples import EXAMPLES
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning import read_lesions
from lungaccess.planning.one_stage import load_tubes
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.running.design.settings import read_design
from lungaccess.running.study.settings import read_study
from tests.lungaccess.cli.every_command import commands

QUICK = ("presets", "template", "tubes", "shapes", "doctor", "completion")
"""Examples that need no patient."""
MAY_SAY_NO = ("advise", "certify", "benchmark med-rad")
"""Commands that end with 1 where a device does not get there, which depends on the patient."""


def test_every_command_has_one_example() -> None:
    assert sorted(EXAMPLES) == sorted(commands())


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_the_help_shows_it(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*name.split(), "--help"]) == ExitCode.OK
    said = " ".join(capsys.readouterr().out.split())
    assert f"Example: {EXAMPLES[name]}" in said and "Exit codes: 0" in said
    assert EXAMPLES[name].startswith(f"lungaccess {name}")


def run(name: str) -> None:
    """Run the example of a command in the folder at hand."""
    code = cli.main(shlex.split(EXAMPLES[name])[1:])
    assert code in ((ExitCode.OK, ExitCode.NEGATIVE) if name in MAY_SAY_NO else (ExitCode.OK,)), name


@pytest.mark.parametrize("name", QUICK)
def test_a_quick_example_works(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(name)


@pytest.mark.slow
def test_all_examples_work_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder: each uses what those before it wrote."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LUNGACCESS_CACHE", str(tmp_path / "cache"))
    for name in EXAMPLES:
        if name != "view":  # It serves until it is ended; its tests are in tests/lungaccess/showing/explorer.
            run(name)


def test_without_a_command_there_is_a_start_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == ExitCode.OK
    said = capsys.readouterr()
    named = {line.split()[1] for line in said.out.splitlines() if line.startswith("  lungaccess ")}
    assert {"demo", "phantom", "plan"} <= named <= set(EXAMPLES) and said.err == ""


def test_the_help_says_that_a_number_may_be_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["plan", "--help"])
    assert "--nodule [INT]" in capsys.readouterr().out


@pytest.fixture
def templates(tmp_path: Path) -> Path:
    """Return a folder with every template, written by the command."""
    for kind, file in FILES.items():
        assert cli.main(["template", kind, "--out", str(tmp_path / file)]) == ExitCode.OK
    return tmp_path


def test_every_template_can_be_read(templates: Path) -> None:
    import tomllib

    assert load_errors(templates / "errors.toml") == replace(
        load_errors("breath-hold"), name="errors.toml", description=""
    )
    assert load_procedure(templates / "procedure.toml") == replace(
        load_procedure("closed-loop"), name="procedure.toml", description=""
    )
    assert read_study(templates / "study.toml").case
    assert read_design(templates / "design.toml").vary
    assert load_tubes(templates / "tubes.toml").name == "curved pair"
    assert read_lesions(templates / "lesions.txt").shape == (2, 3)
    assert read_pose(templates / "pose.txt", "lps")[2, 3] == 60.0
    patient = (templates / "patient.toml").read_text()
    assert parse(PatientFile, tomllib.loads(patient), "patient.toml").lumen == "airway.nii.gz"
    whole = "\n".join(line.removeprefix("# ") if " = " in line else line for line in patient.splitlines())
    stated = parse(PatientFile, tomllib.loads(whole), "patient.toml")
    assert stated.targets and stated.thick_slices_mm == 5.0
    keys = {field.name for field in fields(PatientFile)}
    assert not [key for key in keys if f"{key} = " not in patient]


def test_the_template_of_contours_outlines_a_nodule(templates: Path) -> None:
    import numpy as np

    lps_from_ijk = np.eye(4)
    lps_from_ijk[2, 3] = -530.0
    grid = Grid(shape=(300, 300, 20), lps_from_ijk=lps_from_ijk)
    assert json.loads((templates / "contours.json").read_text())["annotations"]
    assert nodule_from_contours(templates / "contours.json", grid).sum() > 50


def test_a_preset_is_printed_as_a_file_to_start_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from lungaccess.problem.system import load_system

    assert cli.main(["presets", "--show", "ultrathin"]) == ExitCode.OK
    (tmp_path / "mine.toml").write_text(capsys.readouterr().out)
    assert load_system(tmp_path / "mine.toml") == load_system("ultrathin")
    assert cli.main(["presets", "--show", "ultra"]) == ExitCode.BAD_INPUT
    assert "Did you mean 'ultrathin'?" in capsys.readouterr().err
