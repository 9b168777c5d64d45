"""What messages tell a user to do can be done: commands, options, extras and files that they name."""

from __future__ import annotations

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, TargetError
from anatomy.io.patients import load_patient
from anatomy.lung import Lung
from lungaccess.cli.app import app, main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.one_stage.needle import reason_in_words
from lungaccess.problem.system import load_system
from lungaccess.problem.target import resolve_target
from lungaccess.uncertainty.breathing.window import require_motion
from stages.needle import Obstruction
from tests.lungaccess.cli.every_command import commands
from tests.lungaccess.cli.wrong_words import arguments_of

ROOT = Path(__file__).resolve().parents[3]
ADVICE = {"remedy", "advice", "caption", "note"}
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
COMMAND = re.compile(r"lungaccess ([a-z][a-z0-9-]*(?: [a-z][a-z0-9-]*)*)")


def _text(node: ast.AST) -> str:
    """Return the text of a literal, with "{}" for each of its values."""
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(each) for each in node.values)
    if isinstance(node, ast.BinOp):
        return _text(node.left) + _text(node.right)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else "{}"


@cache
def remedies() -> tuple[str, ...]:
    """Return what messages tell a user to do."""
    files = [file for top in ("anatomy", "stages", "lungaccess") for file in (ROOT / top).rglob("*.py")]
    nodes = (node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    calls = (node for node in nodes if isinstance(node, ast.Call))
    return tuple(_text(each.value) for call in calls for each in call.keywords if each.arg in ADVICE)


def named(pattern: re.Pattern[str]) -> list[str]:
    """Return all that remedies name of a kind, once each."""
    return sorted({found for text in remedies() for found in pattern.findall(text)})


def test_commands_that_remedies_name_are_there() -> None:
    known = set(commands()) | {name.split()[0] for name in commands()}
    assert len(named(COMMAND)) > 10
    for words in named(COMMAND):
        parts = words.split()
        assert any(" ".join(parts[:n]) in known for n in (1, 2, 3)), words


def test_options_that_remedies_name_are_there() -> None:
    known = {option for name in commands() for argument in arguments_of(name) for option in argument.names}
    known |= {option for argument in app.meta.assemble_argument_collection() for option in argument.names}
    known |= {"--task"}  # TotalSegmentator has this one.
    assert len(named(OPTION)) > 30
    assert set(named(OPTION)) <= known


def test_extras_that_remedies_name_are_there() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = named(re.compile(r"lungaccess\[([a-z]+)\]"))
    assert names and set(names) <= set(extras["optional-dependencies"])


@pytest.mark.parametrize("name", named(re.compile(r"lungaccess template ([a-z]+)")))
def test_templates_that_remedies_name_are_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["template", name]) == ExitCode.OK and capsys.readouterr().out


@pytest.mark.parametrize("name", named(re.compile(r"lungaccess presets --show ([a-z-]+)")))
def test_presets_that_remedies_name_are_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets", "--show", name]) == ExitCode.OK
    assert tomllib.loads(capsys.readouterr().out)["name"] == name


def test_a_motion_is_added_as_the_remedy_says(small_lung: Lung, tmp_path: Path, patient: Path) -> None:
    """Masks that are known by their names need no description of the masks besides."""
    with pytest.raises(AnatomyError) as raised:
        require_motion(small_lung)
    line = re.findall(r"motion = \{ population.*?\}", raised.value.remedy)[0]
    for role, name in (("lumen", "bronchialTree"), ("vessels", "vessels"), ("lung", "pleuralBoundary")):
        (tmp_path / f"{name}.nii.gz").write_bytes((patient / f"{role}.nii.gz").read_bytes())
    assert load_patient(tmp_path).motion is None
    (tmp_path / "patient.toml").write_text(line)
    assert load_patient(tmp_path).motion is not None


def test_a_target_outside_is_told_in_both_frames(small_lung: Lung) -> None:
    with pytest.raises(TargetError, match=r"LPS \(9000.0, 1.0, 2.0\) = RAS \(-9000.0, -1.0, 2.0\) mm"):
        resolve_target(small_lung, "lps:9000,1,2")


@pytest.mark.parametrize(("radius_mm", "gentlest"), [(64.47, True), (3.0, False)])
def test_a_radius_that_is_needed_is_that_of_the_system_that_is_named(
    radius_mm: float, gentlest: bool
) -> None:
    found = Obstruction(
        place="reach", label=0, point_lps=np.zeros(3), limit="radius", radius_mm=radius_mm, proved=True,
        direction_rad=0.5, straight_mm=20.0,
    )  # fmt: skip
    systems = re.findall(r"--system ([\w-]+)", reason_in_words(found))
    assert bool(systems) == gentlest
    for name in systems:
        assert load_system(name).require_needle("it").min_radius_of_curvature_mm <= radius_mm
