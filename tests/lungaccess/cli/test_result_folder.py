"""One question, one folder; nothing that others wrote is moved, hidden or overwritten."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from anatomy.base.errors import FileError
from anatomy.base.unfinished import locked
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.result_folder import MARK, claim_folder, held, keep_earlier


@pytest.fixture(autouse=True)
def released():
    yield
    held.close()


def test_results_of_an_earlier_question_are_moved_aside(tmp_path):
    for n in range(3):
        claim_folder(tmp_path, ("plan.json", "plan-*.json"))
        assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == (["notes.txt"] if n else [])
        for name in ("plan.json", "plan-1.json", "notes.txt"):
            (tmp_path / name).write_text(f"{n}")
        held.close()
    assert (tmp_path / "earlier-1" / "plan.json").read_text() == "0"
    assert (tmp_path / "earlier-2" / "plan-1.json").read_text() == "1"
    claim_folder(tmp_path, ("plan.json",), force=True)
    assert not (tmp_path / "plan.json").exists() and not (tmp_path / "earlier-3").exists()
    assert (tmp_path / "notes.txt").read_text() == "2"


def test_files_of_others_are_not_moved(tmp_path):
    (tmp_path / "plan.json").write_text("mine")
    with pytest.raises(FileError, match=r"plan\.json"):
        claim_folder(tmp_path, ("plan.json",))
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]


def test_two_commands_do_not_share_a_folder(tmp_path):
    claim_folder(tmp_path, ())
    with pytest.raises(FileError, match="Another command"):
        claim_folder(tmp_path, ())
    (tmp_path / "notes.txt").touch()
    held.close()
    with locked(tmp_path / MARK):
        assert main(["plan", str(tmp_path), "--nodule", "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    claim_folder(tmp_path, ())


@pytest.mark.parametrize("new", ["first", "second", None])
def test_a_single_file_of_another_question_is_kept(tmp_path, new, capsys):
    path = tmp_path / "a.png"
    path.write_text("first")
    keep_earlier(path)
    assert not path.exists()
    if new:
        path.write_text(new)
    held.close()
    assert path.read_text() == (new or "first")
    kept = [each.read_text() for each in tmp_path.iterdir() if each != path]
    assert kept == (["first"] if new == "second" else [])
    assert ("kept as a.earlier-1.png" in " ".join(capsys.readouterr().err.split())) == bool(kept)


def test_a_wrong_command_line_leaves_results_where_they_are(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("first")
    assert main(["tubes", "--outer", "nan", "--inner", "30", "--out", str(path)]) == ExitCode.BAD_INPUT
    assert [each.read_text() for each in tmp_path.iterdir()] == ["first"]


@pytest.mark.parametrize("words", [["template", "patient", "--out", "x.toml"], ["phantom", "--out", "."]])
def test_what_is_there_is_not_overwritten_unasked(tmp_path, monkeypatch, words, capsys):
    monkeypatch.chdir(tmp_path)
    Path("x.toml").write_text("precious")
    assert main(words) == ExitCode.BAD_INPUT
    assert [p.name for p in tmp_path.iterdir()] == ["x.toml"] and Path("x.toml").read_text() == "precious"
    assert "--force" in capsys.readouterr().err
    if words[0] == "template":
        assert main([*words, "--force"]) == ExitCode.OK
        assert "precious" not in Path("x.toml").read_text()


@pytest.mark.parametrize(
    "words",
    [
        ["window", "plan.json", "P", "--out", "plan.json"],
        ["window", "plan.json", "P", "--out=./plan.json"],
        ["report", "plan.json", "P", "--out", "P/ct.html"],
        ["segment", "P/ct.html", "--out", "o", "--lungs", "P/ct.html#1,2", "--page", "P/../P/ct.html"],
    ],
)
def test_inputs_are_not_overwritten(tmp_path, monkeypatch, words, capsys):
    monkeypatch.chdir(tmp_path)
    Path("P").mkdir()
    for name in ("plan.json", "P/ct.html"):
        Path(name).write_text("precious")
    assert main(words) == ExitCode.BAD_INPUT
    assert "would be overwritten" in " ".join(capsys.readouterr().err.split())
    assert {Path(name).read_text() for name in ("plan.json", "P/ct.html")} == {"precious"}


def test_a_segmentation_leaves_its_inputs_and_masks_of_others_alone(tmp_path, patient, capsys):
    for name, copy in (("ct", "ct"), ("nodules", "nodule"), ("vessels", "vessels")):
        shutil.copy(patient / f"{name}.nii.gz", tmp_path / f"{copy}.nii.gz")
    (tmp_path / "patient.toml").write_text('name = "mine"')
    words = ["segment", str(tmp_path / "ct.nii.gz"), "--out", str(tmp_path), "--no-pictures"]
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert main([*words, "--nodule-mask", str(tmp_path / "nodule.nii.gz")]) == ExitCode.BAD_INPUT
    assert "are inputs" in " ".join(capsys.readouterr().err.split())
    assert main(words) == ExitCode.BAD_INPUT
    assert "vessels.nii.gz, patient.toml" in " ".join(capsys.readouterr().err.split())
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
