"""The search over devices: its front, its order, its memory, and what it writes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.files import require_writable_folder, write_text
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.problem.system import load_system
from lungaccess.running.design.search import chosen, front_of, run_design
from lungaccess.running.design.settings import Contender, Design, Number, design_of, device, near, value_at
from lungaccess.running.study.results import ResultsFile
from tests.lungaccess.cli.killing import START, require_gone, started
from tests.lungaccess.running.design.conftest import BENT, TARGETS, TURN, ToyWorkers, design_content


def test_the_front_is_that_of_the_formula(tmp_path: Path, design: Design, workers: ToyWorkers) -> None:
    found = run_design(design, tmp_path)
    assert found.counted[0].reached.count(True) == 2, "1/121 mm suffices for two targets"
    assert found.front[0].values[0] == 100.0 * found.front[0].reached.count(True) / TARGETS > 80.0
    for each in found.front:
        n = each.reached.count(True)
        assert len(each.reached) == TARGETS
        assert n == 0 or 0.004 * n <= each.system.require_needle("it").max_curvature_per_mm
    reached, radii = zip(*(each.values for each in found.front), strict=True)
    assert list(reached) == sorted(set(reached), reverse=True) and list(radii) == sorted(set(radii))
    assert found.front[0].values == max(each.values for each in found.counted)


def test_most_devices_are_tried_on_few_targets(tmp_path: Path, design: Design, workers: ToyWorkers) -> None:
    """In each round 18 devices on one target, 6 on three, 2 on all nine; and the base on all."""
    found = run_design(design, tmp_path)
    assert (found.tried, len(found.counted)) == (3 * 18, 1 + 3 * 2)
    a_round = 18 * 1 + 6 * (3 - 1) + 2 * (9 - 3)
    assert len(workers.asked) == len(set(workers.asked)) == TARGETS + 3 * a_round


def test_a_search_that_is_stopped_goes_on_and_ends_the_same(
    tmp_path: Path, design: Design, workers: ToyWorkers
) -> None:
    whole = run_design(design, tmp_path / "whole")
    made = list(workers.asked)
    workers.asked.clear()

    class StoppedError(Exception):
        pass

    def stop(_words: str, share: float | None) -> None:
        if share is not None and len(workers.asked) >= 20:
            raise StoppedError

    with pytest.raises(StoppedError):
        run_design(design, tmp_path / "stopped", progress=stop)
    assert not (tmp_path / "stopped" / "design.json").exists()
    assert run_design(design, tmp_path / "stopped") == whole
    assert sorted(set(workers.asked)) == sorted(made)
    assert len(workers.asked) - len(made) <= 1, "the run that was being stored may be made again"
    assert run_design(design, tmp_path / "stopped") == whole and len(workers.asked) - len(made) <= 1
    texts = [(tmp_path / name / "design.json").read_bytes() for name in ("whole", "stopped")]
    assert texts[0] == texts[1]


def test_another_seed_tries_other_devices(tmp_path: Path, design: Design, workers: ToyWorkers) -> None:
    one, other = (run_design(replace(design, seed=seed), tmp_path / str(seed)) for seed in (0, 1))
    assert one.counted[0].values == other.counted[0].values
    assert not {each.system.name for each in one.counted[1:]} & {
        each.system.name for each in other.counted[1:]
    }


def test_the_chance_counts_targets_without_a_plan_as_failures(tmp_path: Path, workers: ToyWorkers) -> None:
    asked = design_content(design={"make_large": ["chance", "median-chance"]}, case={"errors": "gated-ct"})
    base = run_design(design_of(asked), tmp_path).counted[0]
    assert base.values == (pytest.approx(100.0 * 2 * 0.75 / TARGETS), 0.0)


def test_what_is_written_is_the_device_that_was_counted(
    tmp_path: Path, design: Design, workers: ToyWorkers
) -> None:
    write_text(require_writable_folder(tmp_path / "front") / "99.toml", "of an earlier search")
    found = run_design(design, tmp_path)
    assert load_system(tmp_path / "device.toml") == found.front[0].system
    files = {path.stem: load_system(path) for path in (tmp_path / "front").iterdir()}
    assert files == {str(n): each.system for n, each in enumerate(found.front, start=1)}
    first, second, *rest = found.front[0].system.sources
    assert (
        first.startswith(f"{BENT} = {value_at(found.front[0].system, BENT)}: assumption") and "0.025" in first
    )
    assert second.startswith(f"{TURN} = ") and "assumption" in second
    old = [line for line in rest if "max_curvature_per_mm = 1 / (121 mm)" in line]
    assert old and all(line.startswith("`ultrathin`: ") for line in old)


def test_what_the_validator_refuses_is_counted_and_not_tried(tmp_path: Path, workers: ToyWorkers) -> None:
    """The needle has to fit the bore of 1.05 mm, and a thick one does not pass the bend."""
    asked = design_of(
        design_content(design={"make_large": ["reach"], "vary": {"needle": {"diameter_mm": [0.7, 2.2]}}})
    )
    found = run_design(asked, tmp_path)
    count, words = found.refused["needle.diameter_mm"]
    assert count > 9 and "tubes.inner.inner_diameter_mm = 1.05" in words
    assert all(each.system.require_needle("it").diameter_mm < 1.05 for each in found.counted)
    written = json.loads((tmp_path / "design.json").read_text())["refused"]
    assert written == {"needle.diameter_mm": [count, words]}


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ({"needle.diameter_mm": [1.5, 2.0]}, "No device within the ranges is possible: needle.diameter_mm"),
        ({"needle.max_curvature_per_m": [0.01, 0.02]}, "did you mean max_curvature_per_mm"),
        ({"needel.diameter_mm": [0.5, 0.6]}, "needel is not a setting"),
        ({"tubes.inner.slotted_segments.7.stiffness_factor": [0.1, 0.2]}, "is not a setting"),
        ({"tubes.inner.slotted_segments.first.stiffness_factor": [0.1, 0.2]}, "is not a setting"),
    ],
)
def test_keys_and_ranges_without_any_device_are_refused_before_any_run(
    vary: dict[str, Any], said: str, tmp_path: Path, workers: ToyWorkers
) -> None:
    with pytest.raises(SettingsError) as error:
        run_design(design_of(design_content(design={"vary": vary})), tmp_path)
    assert said in str(error.value) and not workers.asked


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"design": {"vary": {}}}, "at least one number"),
        ({"design": {"vary": {TURN: [0.02, 0.01]}}}, "[least, larger]"),
        ({"design": {"vary": {TURN: {"range": [0.01, 0.02], "one_of": [1]}}}}, "or else one_of"),
        ({"design": {"vary": {TURN: {"one_of": [0.01], "allso": []}}}}, "design.vary"),
        ({"design": {"make_large": ["raech"]}}, "one of reach, chance"),
        ({"design": {"make_large": ["chance"]}}, "errors in every case"),
        ({"design": {"make_large": ["reach", "reach"]}}, "each only once"),
        ({"design": {"vary": {TURN: {"range": [0.01, 0.02], "also": [TURN]}}}}, "each only once"),
        ({"design": {"vary": {TURN: 0.01}}}, f"{TURN}: range = 0.01. Expected: range: a list of two finite"),
        ({"design": {"designs": 0.5}}, "a whole number at least 1"),
        ({"folder": "elsewhere"}, "folder is not a setting"),
        ({"seeds": [0, 1]}, "one alone"),
        ({"planner": [{"name": "a"}, {"name": "b"}]}, "one alone"),
        ({"budget": {"iterations": 2, "time_s": 1.0}}, "repeated exactly"),
        ({"buget": {}}, "did you mean budget"),
    ],
)
def test_a_wrong_file_is_explained(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(SettingsError) as error:
        design_of(design_content() | design_content(**changes))
    assert said in str(error.value)


def test_a_study_is_no_design() -> None:
    values = design_content()
    del values["design"]
    with pytest.raises(SettingsError, match=r"no \[design.vary\]"):
        design_of(values)


def test_linked_numbers_and_entries_of_arrays() -> None:
    """Slots soften both tubes alike, or the validator refuses the pair."""
    key = "tubes.{}.slotted_segments.0.stiffness_factor"
    number = Number(key=key.format("inner"), range=(0.1, 0.2), also=(key.format("outer"),))
    made = device(load_system("ultrathin"), [number], [0.5])
    assert [tube.slotted_segments[0].stiffness_factor for tube in made.tubes.nested] == [0.15, 0.15]
    assert near(made, [number], [0.5], 0.25) == [pytest.approx(0.5)]
    assert near(load_system("ultrathin"), [number], [0.5], 0.25) == [0.0], "0.04 lies below the range"


def test_points_near_a_device_stay_near_and_inside() -> None:
    numbers = [Number(key=TURN, range=(0.01, 0.02)), Number(key="scope.name", one_of=("a", "b", "c"))]
    made = device(load_system("ultrathin"), numbers, [0.9, 0.5])
    kept = 0
    for x in np.linspace(0.0, 1.0, 64):
        at, choice = near(made, numbers, [x, x], 0.25)
        assert 0.65 - 1e-9 <= at <= 1.0
        kept += value_at(device(made, numbers, [at, choice]), "scope.name") == "b"
    assert 48 <= kept < 64, "three of four keep what they have, and a third of the others finds it again"


def contender(name: str, *values: float) -> Contender:
    return Contender(system=replace(load_system("ultrathin"), name=name), values=values)


def test_the_front_and_the_order() -> None:
    devices = [
        contender("low", 1.0, 1.0), contender("end", 0.0, 9.0), contender("crowded", 4.0, 5.5),
        contender("middle", 5.0, 5.0), contender("top", 9.0, 0.0), contender("twin", 9.0, 0.0),
    ]  # fmt: skip

    def names(found: list[Contender]) -> list[str]:
        return [each.system.name for each in found]

    assert names(front_of(devices)) == ["end", "crowded", "middle", "top", "twin"]
    assert names(chosen(devices, 3)) == ["top", "middle", "end"], "the first, both alike, the second"
    assert names(chosen(devices[::-1], 1)) == ["twin"], "the first found of equal ones"
    assert names(chosen([contender(f"{n}", n % 3) for n in range(5)], 3)) == ["2", "1", "4"]


def test_the_command(
    tmp_path: Path, workers: ToyWorkers, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["design", "--out", "found"]) == ExitCode.OK
    said = capsys.readouterr().out
    written = (tmp_path / "found" / "device.toml").read_text()
    assert written in said and "Written to found" in said
    assert (tmp_path / "found" / "front.png").read_bytes().startswith(b"\x89PNG")
    assert cli.main(["design", "--out", "found", "--json"]) == ExitCode.OK
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads((tmp_path / "found" / "design.json").read_text())
    assert record["best"] == record["front"][0] and record["best"] in written
    assert cli.main(["design", "none.toml"]) == ExitCode.BAD_INPUT


@pytest.mark.slow
def test_killed_and_started_again(tmp_path: Path) -> None:
    """A search on a coarse synthetic patient ends the same after every process was killed at once."""
    file = tmp_path / "design.toml"
    file.write_text(DESIGN)
    words = ["design", str(file), "--workers", "1", "--cache", str(tmp_path / "c"), "--out"]

    def stored(folder: Path) -> int:
        with contextlib.suppress(LungaccessError), ResultsFile(folder / "results.db") as results:
            return len(results.finished_keys())
        return 0

    killed, quiet = tmp_path / "killed", tmp_path / "quiet"
    with started([*words, str(killed)]) as process:
        while process.poll() is None and stored(killed) < 4:
            time.sleep(0.05)
        assert process.poll() is None
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        require_gone(process.pid)
    left = stored(killed)
    for folder in (killed, quiet):
        subprocess.run([sys.executable, "-c", START, *words, str(folder)], check=True)
    assert (killed / "design.json").read_bytes() == (quiet / "design.json").read_bytes()
    assert 4 <= left < stored(killed) == stored(quiet)
    record = json.loads((quiet / "design.json").read_text())
    assert record["devices"][record["best"]]["reached"] >= 1


DESIGN = """
name = "small"
budget = {iterations = 1, first_plan = true}
atlas = {rotations = 8, stop_spacing_mm = 8, site_spacing_mm = 4}
[[case]]
name = "coarse"
anatomy = "phantom"
phantom = {seed = 2, spacing_mm = 2.5}
system = "ultrathin"
fissures_allowed = true
targets = ["lps:-81.25,51,-33.5"]
peripheral = {per_lung = 1}
[design]
make_large = ["reach"]
designs = 3
rounds = 1
vary.tubes.inner.precurvature_per_mm = [0.02, 0.06]
"""
