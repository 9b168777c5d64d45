"""The study of decided targets: outcomes that are made once, and what is counted."""

from __future__ import annotations

from pathlib import Path

import pytest

import experiments.decided_targets as study
import lungaccess as la
from anatomy.lung import Lung
from experiments.support.results import Result
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import require_own_name


@pytest.mark.slow
def test_a_target_is_decided_once(small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "PLAN_S", 1.0)
    monkeypatch.setattr(study, "DECIDE_S", 2.0)
    _label, system = next(iter(study.systems("ultrathin")))
    atlas = la.build_atlas(small_lung, system, rotations=8, stop_spacing_mm=4.0)
    points = peripheral_targets(small_lung, 1, 0)
    file = tmp_path / "kept" / "records.json"
    made = study.Records(file).of(atlas, system, points, 0)
    assert {record["outcome"] for record in made} <= {study.PLANNED, study.PROVED, study.OPEN}
    monkeypatch.setattr(study.Decider, "record", None)
    assert study.Records(file).of(atlas, system, points, 0) == made


def test_systems_have_names_of_their_own() -> None:
    for _label, system in study.systems("lung-default"):
        require_own_name(system)


def test_every_outcome_is_counted() -> None:
    result = Result(name="decided_targets", title="")
    records = [
        {"outcome": study.PLANNED, "seconds": 1.0, "share_ruled_out": 0.0},
        {"outcome": study.OPEN, "seconds": 60.0, "share_ruled_out": 0.9},
        {"outcome": study.PROVED, "seconds": 5.0, "share_ruled_out": 1.0},
        {"outcome": study.PLANNED, "seconds": 2.0, "share_ruled_out": 0.0},
    ]
    study.add_rows(result, "a patient", records)
    assert [row.ours for row in result.rows] == [50.0, 25.0, 25.0, 3.5, 90.0]
