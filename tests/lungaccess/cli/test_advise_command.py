"""`lungaccess advise`: instructions, files and exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.one_stage.scope import advise_scope
from lungaccess.problem.system import System, load_system
from stages.scope.advisor.path import instructions_along


@pytest.fixture(scope="module")
def system() -> System:
    """A scope thin enough for a child."""
    from dataclasses import replace

    loaded = load_system("ultrathin")
    scope = replace(loaded.scope, outer_diameter_mm=2.0, channel_diameter_mm=1.7)
    return replace(loaded, scope=scope)


def main_bronchus(lung: Lung) -> np.ndarray:
    """Return a point in the middle of the widest branch below the carina."""
    children = lung.tree.children(0)
    branch = max(children, key=lambda b: lung.tree.branch_mean_radius_mm[b])
    points = lung.tree.branch_points(int(branch))
    return np.array(lung.tree.points_lps[points[len(points) // 2]])


def test_the_advice_leads_to_a_place_in_the_airways(small_lung: Lung, system: System) -> None:
    place = main_bronchus(small_lung)
    advice = advise_scope(small_lung, system, place, 1.0)
    assert advice.path.reached
    assert advice.thinner == ()
    assert advice.why_stopped == ""
    assert np.linalg.norm(advice.path.lps_from_tip[:3, 3] - place) < 1.5
    stored = json.loads(json.dumps(advice.as_json()))
    assert stored["frame"] == "LPS mm"
    assert len(stored["states"]) == advice.path.count
    assert [one["text"] for one in stored["instructions"]] == [
        one.text() for one in instructions_along(advice.path, small_lung.tree)
    ]
    assert stored["lps_from_tip"] == advice.path.lps_from_tip.tolist()


def test_a_lesion_out_of_reach_is_answered_with_reasons(small_lung: Lung, system: System) -> None:
    advice = advise_scope(small_lung, system, small_lung.targets_lps[0], 2.0)
    assert not advice.path.reached
    assert advice.why_stopped
    assert advice.thinner
    assert advice.as_json()["thinner_scopes"]


@pytest.mark.slow
def test_the_command_writes_what_it_shows(
    tmp_path: Path, small_phantom: Phantom, small_lung: Lung, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "patient"
    folder.mkdir()
    write_phantom(small_phantom, folder)
    place = ",".join(f"{value:.2f}" for value in main_bronchus(small_lung))
    out = tmp_path / "advice"
    arguments = [
        "advise",
        str(folder),
        "--system",
        "ultrathin",
        "--out",
        str(out),
        "--cache",
        str(tmp_path / "c"),
    ]
    code = main([*arguments, "--target", f"lps:{place}"])
    shown = capsys.readouterr().out
    advice = json.loads((out / "advice.json").read_text())
    assert code == (0 if advice["reached"] else 1)
    assert "bronchoscope" in shown
    assert "Generation 0" in shown
    camera = json.loads((out / "camera.mrk.json").read_text())
    assert camera["markups"][0]["coordinateSystem"] == "LPS"
    assert main([*arguments]) == ExitCode.BAD_INPUT
    assert main([*arguments, "--target", "1,2,3"]) == ExitCode.BAD_INPUT
