"""Targets that tubes from turned scope tips reach."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import lungaccess as la
from anatomy.errors import TargetError
from anatomy.lung import Lung
from lungaccess.coupled.search import AtlasSearch
from lungaccess.plans.assemble import Candidate, Task
from lungaccess.problem.target import point_target, require_free
from stages.needle import Objective
from stages.needle.environment import direct_arcs

AHEAD_MM = 25.0
ASIDE_MM = 3.0


def turned_candidates(lung: Lung, atlas: la.Atlas) -> Iterator[tuple[AtlasSearch, Candidate]]:
    """Yield searches for points ahead of tubes from turned tips, each with the direct arc from there."""
    entries, rng = atlas.deployments, np.random.default_rng(0)
    turned = np.flatnonzero(atlas.sites.turned[entries.site])
    for entry in rng.permutation(turned):
        point = entries.positions[entry] + AHEAD_MM * entries.tangents[entry]
        point = point + rng.uniform(-ASIDE_MM, ASIDE_MM, 3)
        try:
            target = point_target(lung, point)
            require_free(lung, point)
        except TargetError:
            continue
        task = Task(
            lung=lung, system=atlas.system, target=target, objective=Objective(inverse_clearance=1.0),
            with_fissures=atlas.with_fissures, method="atlas", seed=0,
        )  # fmt: skip
        search, one = AtlasSearch(task, atlas), slice(int(entry), int(entry) + 1)
        blockers, _lengths, _costs = direct_arcs(
            search.desk.environment, entries.positions[one], entries.tangents[one], entries.branch[one], point
        )
        candidate = search.finished(int(entry)) if blockers[0] == 0 else None
        if candidate is not None:
            yield search, candidate
