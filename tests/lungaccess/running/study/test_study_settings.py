"""A study is read strictly: what is wrong in it is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from anatomy.base.errors import FileError, SettingsError
from lungaccess.running.study.settings import read_study, study_of
from tests.lungaccess.running.study.toys import content

TOML = """
name = "two patients"
seeds = [0, 7]
budget = {iterations = 100, time_s = 5.0}

[[case]]
name = "synthetic"
anatomy = "phantom"
phantom = {seed = 2}
targets = ["nodule", "ras:1,2,3"]

[[case]]
name = "real"
anatomy = "PATIENT"
system = "mine.toml"
peripheral = {per_lung = 3}

[[planner]]
name = "atlas"

[[planner]]
name = "Algorithm 1"
method = "kuntz2015"
iterations = 1000
"""


def test_a_file_is_read_with_its_folder(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(TOML)
    study = read_study(tmp_path / "study.toml")
    assert study.folder == str(tmp_path)
    assert [case.name for case in study.case] == ["synthetic", "real"]
    assert study.case[0].phantom.seed == 2
    assert study.case[1].peripheral.per_lung == 3
    assert study.planner[1].iterations == 1000
    assert study.seeds == (0, 7)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sedes": [1]}, "did you mean seeds"),
        ({"case": {"sistem": "x"}}, "did you mean system"),
        ({"case": {"targets": []}}, "at least one target"),
        ({"case": {"objective": "price"}}, "objective"),
        ({"planner": [{"name": "safe", "goal": "success"}]}, "errors in every case"),
        ({"case": {"objective": "success"}}, "errors in every case"),
        ({"planner": [{"name": "a", "method": "success"}]}, "kuntz2015"),
        ({"planner": [{"name": "a", "goal": "sucess"}]}, "success, window"),
        ({"planner": [{"name": "a", "kind": "needle", "method": "rrt", "goal": "length"}]}, "needle alone"),
        ({"case": {"objective": "length=-1"}}, "weights of 0 or more"),
        ({"case": {"peripheral": {"per_lung": -1}}}, "at least 0"),
        ({"planner": [{"name": "a", "method": "atlass"}]}, "kuntz2015"),
        ({"planner": [{"name": "a", "needle_planner": "control.RTT"}]}, "control.RRT"),
        (
            {"planner": [{"name": "a", "kind": "needle", "method": "rrt", "needle_planner": "rrt"}]},
            "none, for a planner of the needle",
        ),
        ({"planner": [{"name": "a", "kind": "needle", "method": "rrt"}]}, "start poses in every case"),
        ({"planner": [{"name": "a"}, {"name": "a"}]}, "each only once"),
        ({"planner": {"name": "a"}}, "not an array of tables"),
        ({"seeds": [1, 1]}, "each only once"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [-1]}, "seeds"),
        ({"budget": {}}, "iterations, time_s or both"),
        ({"budget": {"time_s": 0}}, "above 0"),
        ({"atlas": {"rotations": 0}}, "at least 1"),
    ],
)
def test_what_is_wrong_is_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words) as caught:
        study_of(content(**changes))
    assert "lungaccess template study" in str(caught.value)


def test_an_error_names_the_table(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(TOML.replace("per_lung", "per_long"))
    with pytest.raises(SettingsError, match=r"study.toml, case 2: peripheral.per_long .*mean per_lung"):
        read_study(tmp_path / "study.toml")


def test_no_toml_and_no_file(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text("name = ")
    with pytest.raises(SettingsError, match="not valid TOML"):
        read_study(tmp_path / "study.toml")
    with pytest.raises(FileError, match="no file"):
        read_study(tmp_path / "none.toml")
    (tmp_path / "study.toml").write_text('folder = "/"\n' + TOML)
    with pytest.raises(SettingsError, match="folder is not a setting"):
        read_study(tmp_path / "study.toml")
