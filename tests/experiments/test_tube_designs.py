"""The study of tube designs: 20 systems that hold together, and counts that are made once."""

from __future__ import annotations

from pathlib import Path

import pytest

import experiments.tube_designs as study
from anatomy.lung import Lung
from lungaccess.problem.system import load_system, system_fingerprint


def test_there_are_twenty_designs_that_obey_their_own_limits() -> None:
    found = dict(study.designs())
    assert len(found) == 20
    systems = [system for system in found.values() if system is not None]
    assert len({system_fingerprint(system) for system in systems}) == len(systems) == 20
    assert sum(system.tubes.outer is None for system in systems) == len(study.ALONE)


def test_a_count_is_made_once(small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def counted(lung: Lung, system: object, per_lung: int, seed: int) -> int:
        made.append(seed)
        return 7

    monkeypatch.setattr(study, "reached_of", counted)
    system = load_system("ultrathin")
    file = tmp_path / "kept" / "counts.json"
    assert study.Finished(file).count(small_lung, system, 3, 0) == 7
    assert study.Finished(file).count(small_lung, system, 3, 0) == 7
    assert study.Finished(file).count(small_lung, system, 3, 1) == 7
    assert made == [0, 1]
