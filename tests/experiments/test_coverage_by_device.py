"""The study of devices: systems that obey their own limits, and counts that are made once."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

import experiments.coverage_by_device as study
import lungaccess as la
from anatomy.lung import Lung
from experiments.support import reached
from lungaccess.problem.system import System, load_system, system_fingerprint


def test_devices_differ_and_hold_together() -> None:
    found = {(name, words): system for name in study.DEVICES for words, system in study.systems(name)}
    assert len({system_fingerprint(each) for each in found.values()}) == len(found) == 4 * len(study.DEVICES)
    weak = [system for (name, _), system in found.items() if "4 %" in name]
    assert weak and all(system.tubes.max_strain == 0.04 for system in weak)


@pytest.mark.slow
def test_a_count_is_made_once(small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def counted(atlas: object, system: System, per_lung: int, seed: int) -> int:
        made.append(seed)
        return 7

    def atlas_of(lung: Lung, system: System) -> SimpleNamespace:
        return SimpleNamespace(lung=lung, system=system, with_fissures=False)

    monkeypatch.setattr(reached, "reached_of", counted)
    monkeypatch.setattr(la, "build_atlas", atlas_of)
    system = load_system("ultrathin", fissures_allowed=True)
    file = tmp_path / "kept" / "counts.json"
    assert reached.FinishedCounts(file).count(small_lung, system, 3, 0) == 7
    assert reached.FinishedCounts(file).count(small_lung, system, 3, 0) == 7
    assert reached.FinishedCounts(file).count(small_lung, system, 3, 1) == 7
    assert made == [0, 1]


@pytest.mark.slow
def test_the_reached_are_those_with_a_free_arc(small_lung: Lung) -> None:
    system = load_system("ultrathin", fissures_allowed=True)
    atlas = la.build_atlas(small_lung, system, rotations=8, stop_spacing_mm=4.0)
    assert 0 < reached.reached_of(atlas, system, 3, 0) <= 6
