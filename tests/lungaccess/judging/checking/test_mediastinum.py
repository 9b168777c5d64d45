"""Plans of a planner that does not know of the mediastinum: the check must refuse their exits."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import LungaccessError
from anatomy.lung import Lung
from lungaccess.judging.checking import Checker
from lungaccess.planning.coupled import DirectArcs
from lungaccess.plans.assemble import assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from stages.needle import SHORTEST

AHEAD_MM = 5.0
WANTED = 3


def plans_through(lung: Lung, branches: np.ndarray) -> list[Plan]:
    """Return plans straight ahead of tubes that leave one of these branches."""
    atlas = la.build_atlas(lung, la.load_system("ultrathin"), rotations=8, stop_spacing_mm=4.0)
    entries, plans = atlas.deployments, list[Plan]()
    leaving = np.flatnonzero(np.isin(entries.branch, branches))
    for entry in np.random.default_rng(0).permutation(leaving)[:300].tolist():
        with contextlib.suppress(LungaccessError):
            point = entries.positions[entry] + AHEAD_MM * entries.tangents[entry]
            task = Task(lung=lung, system=atlas.system, target=point_target(lung, point), objective=SHORTEST)
            found = DirectArcs(task, atlas).proved(entry)
            if found is not None:
                plans.append(assemble(task, found, iteration=0, timing={}))
        if len(plans) == WANTED:
            break
    return plans


@pytest.mark.slow
def test_an_exit_from_a_main_bronchus_is_refused_for_that_alone(small_lung: Lung) -> None:
    tree = replace(small_lung.tree)
    vars(tree)["mediastinal"] = np.zeros(tree.n_branches, dtype=bool)
    naive = replace(small_lung, tree=tree)
    plans = plans_through(naive, np.flatnonzero(small_lung.tree.mediastinal))
    assert len(plans) == WANTED
    knows, does_not = Checker(small_lung), Checker(naive)
    for plan in plans:
        assert does_not.check(plan).accepted
        assert {finding.name for finding in knows.check(plan).refusals} == {"tube.exit.not_mediastinal"}
