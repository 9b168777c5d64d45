"""The study of tube designs: 25 systems that hold together."""

from __future__ import annotations

import experiments.tube_designs as study
from lungaccess.problem.system import system_fingerprint


def test_all_designs_obey_their_own_limits() -> None:
    found = dict(study.designs())
    assert len(found) == 25
    systems = [system for system in found.values() if system is not None]
    assert len({system_fingerprint(system) for system in systems}) == len(systems) == 25
    assert sum(system.tubes.outer is None for system in systems) == len(study.ALONE)
    assert sum(not system.tubes.planar for system in systems) == len(study.TURNED) - 1
