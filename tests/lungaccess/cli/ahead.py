"""Targets that tubes from turned scope tips reach."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import lungaccess as la
from anatomy.base.errors import TargetError
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task

AHEAD_MM = 25.0
ASIDE_MM = 3.0


def turned_candidates(lung: Lung, atlas: la.Atlas) -> Iterator[tuple[AtlasSearch, Candidate]]:
    """Yield searches for points ahead of tubes from turned tips, each with the direct arc from there."""
    entries, rng = atlas.deployments, np.random.default_rng(0)
    turned = np.flatnonzero(atlas.motions.turned[entries.site])
    for entry in rng.permutation(turned):
        point = entries.positions[entry] + AHEAD_MM * entries.tangents[entry]
        point = point + rng.uniform(-ASIDE_MM, ASIDE_MM, 3)
        try:
            target = point_target(lung, point)
        except TargetError:
            continue
        task = Task(lung=lung, system=atlas.system, target=target)
        search = AtlasSearch(task, atlas)
        clear = search.arcs.blockers(np.array([entry]))[0] == 0
        candidate = search.arcs.proved(int(entry)) if clear else None
        if candidate is not None:
            yield search, candidate
