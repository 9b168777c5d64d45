"""`lungaccess tubes`: what it prints agrees with the planner's shape; bad input is explained."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.one_stage.tubes import (
    BareTubes,
    compare_sequences,
    deploy_tubes,
    design_choices,
    load_tubes,
)
from lungaccess.problem.system import load_system
from tests.stages.tube.closed_form import centreline

PNG = b"\x89PNG\r\n\x1a\n"
CURVED_PAIR = """
name = "curved pair"
[[tubes]]
outer_diameter_mm = 1.5
inner_diameter_mm = 1.3
length_mm = 680.0
curved_length_mm = 40.0
precurvature_per_mm = {curvature}
[[tubes]]
outer_diameter_mm = 1.9
inner_diameter_mm = 1.65
length_mm = 640.0
curved_length_mm = 40.0
precurvature_per_mm = {curvature}
"""
# Bent one way and then the other: it turns over while it is inserted.
SNAPPING = """
name = "double bend"
[[tubes]]
outer_diameter_mm = 1.5
inner_diameter_mm = 1.3
length_mm = 680.0
bent_pieces = [
    { length_mm = 34.0, precurvature_per_mm = 0.041 },
    { length_mm = 24.0, precurvature_per_mm = 0.018, direction_deg = 195.0 },
]
[[tubes]]
outer_diameter_mm = 1.9
inner_diameter_mm = 1.65
length_mm = 640.0
curved_length_mm = 39.0
precurvature_per_mm = 0.022
"""

pytestmark = pytest.mark.usefixtures("wide_terminal")


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the picture out where a test does not look at it."""
    monkeypatch.setattr("lungaccess.cli.commands.devices._draw", lambda *_: None)


def run(tmp_path: Path, *words: str) -> int:
    return cli.main(["tubes", *words, "--out", str(tmp_path / "tubes.png")])


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


def test_tables_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--outer", "30", "--inner", "50", "--propose") == ExitCode.NEGATIVE
    text = capsys.readouterr().out
    assert "3.893 mm  EXCEEDS" in text and "Not allowed by this device" in text
    assert "The tubes sweep 3.893 mm sideways, more than max_lateral_sweep_mm = 1." in text
    for words in ("stable", "largest sideways sweep", "3.893 mm", "at most 1 mm", "follow-the-leader", "tip"):
        assert words in text
    assert "alternating by 5 mm" in text and "inner first: refused" in text and "proposal" in text
    assert (tmp_path / "tubes.png").read_bytes()[:8] == PNG


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(
    ("rotate", "outer", "inner"), [(0.0, 20.0, 35.0), (50.0, 25.0, 55.0), (-120.0, 40.0, 40.0)]
)
def test_the_tip_is_that_of_the_planner(
    rotate: float, outer: float, inner: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--outer", f"{outer}", "--inner", f"{inner}", "--rotate", f"{rotate}", "--json"]
    code, found = run(tmp_path, *words), printed(capsys)
    assert code == ExitCode.of(found["allowed"]) and found["allowed"] == (found["lateral_sweep_mm"] <= 1.0)
    tubes = load_system("lung-default").tubes
    s = [inner, inner - 1e-4]
    tip, before = centreline(tubes, np.eye(4), math.radians(rotate), outer, inner, s)
    assert np.allclose(found["tip_mm"], tip, atol=1e-6)
    assert np.allclose(found["tip_direction"], (tip - before) / 1e-4, atol=1e-5)
    assert found["stable"] and found["snap"] is None
    assert "proposals" not in found


@pytest.mark.usefixtures("no_picture")
def test_json_with_proposals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--outer", "30", "--inner", "50", "--propose", "--json") == ExitCode.NEGATIVE
    found = printed(capsys)
    assert not found["allowed"] and "sideways" in found["refusals"][0]
    assert found["sequences"][0]["name"] == "together"
    assert "inner first" in found["refused_sequences"]
    assert found["proposals"][0]["lateral_sweep_mm"] == 0.0
    assert found["proposals"][0]["inner"]["curved_length_mm"] == 50.0


@pytest.mark.usefixtures("no_picture")
def test_relative_rotation_of_two_curved_tubes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "pair.toml"
    file.write_text(CURVED_PAIR.format(curvature=0.0045))
    common = ["--system", str(file), "--outer", "40", "--inner", "60", "--json"]
    tips = []
    for relative in ("0", "120"):
        assert run(tmp_path, *common, "--relative", relative) == ExitCode.OK
        found = printed(capsys)
        tips.append(found["tip_angles_rad"])
    assert np.ptp(tips[0]) == pytest.approx(0.0, abs=1e-9)
    assert 1.5 < np.ptp(tips[1]) < math.radians(120.0), "the tips turn less than the bases"
    assert found["lateral_sweep_mm"] > 0.5


@pytest.mark.slow
def test_a_snap_exits_1_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "snapping.toml"
    file.write_text(SNAPPING)
    words = ["--system", str(file), "--outer", "60", "--inner", "80", "--relative", "75"]
    assert run(tmp_path, *words, "--propose") == ExitCode.NEGATIVE
    text = capsys.readouterr().out
    assert "SNAPS" in text and "insert all tubes" in text
    assert (tmp_path / "tubes.png").read_bytes()[:8] == PNG
    assert run(tmp_path, *words, "--json") == ExitCode.NEGATIVE
    found = printed(capsys)
    assert found["snap"]["move"] == "insert all tubes"
    assert 24.0 < found["snap"]["insertions_mm"][0] < 58.0
    assert found["lateral_sweep_mm"] is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--outer", "50", "--inner", "30"], "0 <= outer <= inner"),
        (["--outer", "5", "--inner", "50"], "difference of their lengths"),
        (["--outer", "0", "--inner", "0"], "above 0"),
        (["--outer", "nan", "--inner", "30"], "finite"),
        (["--outer", "10", "--inner", "30", "--rotate", "inf"], "--rotate is inf. expected a finite number"),
        (["--outer", "10", "--inner", "30", "--system", "no-such-system"], "no-such-system"),
        (["--outer", "10", "--inner", "30", "--system", "no-such-file.toml"], "no-such-file.toml"),
        (["--outer", "10"], "--inner"),
    ],
)
def test_bad_input_exits_2(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, *words) == ExitCode.BAD_INPUT
    captured = capsys.readouterr()
    assert message in " ".join(captured.err.replace("│", "").split()) and "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


def test_the_picture_must_be_a_png(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["tubes", "--outer", "10", "--inner", "30", "--out", str(tmp_path / "tubes.jpg")]
    assert cli.main(words) == ExitCode.BAD_INPUT
    assert ".png" in capsys.readouterr().err


class TestFiles:
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ('name = "x"\ntubes = []\n', "one to three tables"),
            (CURVED_PAIR.format(curvature=0.01).replace("1.65", "1.45"), "tubes"),
            (CURVED_PAIR.format(curvature=0.01).replace("length_mm = 680.0", "length_mm = 600.0"), "tubes"),
            (CURVED_PAIR.format(curvature=-1.0), "precurvature_per_mm"),
            (CURVED_PAIR.format(curvature=0.01) + "colour = 3\n", "colour"),
            ("name = ", "not valid TOML"),
            ('name = "x"\n', "missing"),
        ],
    )
    def test_wrong_files(self, content: str, message: str, tmp_path: Path) -> None:
        file = tmp_path / "tubes.toml"
        file.write_text(content)
        with pytest.raises(SettingsError, match=message):
            load_tubes(str(file))

    def test_a_system_and_a_pair(self, tmp_path: Path) -> None:
        file = tmp_path / "tubes.toml"
        file.write_text(CURVED_PAIR.format(curvature=0.01))
        pair = load_tubes(file)
        assert isinstance(pair, BareTubes) and pair.tubes[0].precurvature_per_mm == 0.01
        assert load_tubes("ultrathin") == load_system("ultrathin")


def test_choices_reach_as_far_where_they_can() -> None:
    answer = deploy_tubes(load_system("thin-scope"), 30.0, 50.0)
    present, choices = design_choices(answer)
    lengths = [each.tubes.inner.curved_length_mm for each in choices]
    assert len(set(lengths)) == len(lengths)
    assert [each.lateral_sweep_mm for each in choices] == sorted(each.lateral_sweep_mm for each in choices)
    assert choices[0].lateral_sweep_mm == 0.0
    assert choices[0].tip_offset_mm >= 0.95 * present.tip_offset_mm
    assert answer.deployed is not None
    assert present.lateral_sweep_mm == pytest.approx(answer.deployed.lateral_sweep_mm, abs=5e-3)


def test_choices_need_the_limits_of_a_system(tmp_path: Path) -> None:
    file = tmp_path / "tubes.toml"
    file.write_text(CURVED_PAIR.format(curvature=0.004))
    answer = deploy_tubes(load_tubes(file), 20.0, 40.0, relative_rad=1.0)
    assert answer.acceptable
    assert "together, then turned in place" in [
        each.sequence.name for each in compare_sequences(answer).deployed
    ]
    with pytest.raises(SettingsError, match="without a system"):
        design_choices(answer)


def test_help_explains_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == ExitCode.OK
    assert "tubes" in capsys.readouterr().out
    assert cli.main(["tubes", "--help"]) == ExitCode.OK
    text = capsys.readouterr().out
    for option in ("outer", "inner", "system", "rotate", "relative", "propose", "out", "json"):
        assert f"--{option}" in text
