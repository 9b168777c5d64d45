"""Deployments sampled between those of the atlas: proved, near them, sometimes the only ones that reach."""

from __future__ import annotations

import math

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.settings import override
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from lungaccess.planning.coupled.search.atlas_search import (
    SPREADS,
    AtlasSearch,
    LocalSampling,
    nearly_reaching,
)
from lungaccess.planning.coupled.search.local_search import LocalSearch
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task

SYSTEM = override(la.load_system("ultrathin"), {"name": "own", "fissures_allowed": True})
MOST = 200


@pytest.fixture(scope="module")
def searches() -> list[AtlasSearch]:
    """Searches in an atlas with wide gaps."""
    lung = build_lung(make_phantom(seed=1, size="small").images)
    atlas = la.build_atlas(lung, SYSTEM, rotations=4, stop_spacing_mm=8.0, site_spacing_mm=8.0)
    return [
        AtlasSearch(Task(lung=lung, system=SYSTEM, target=point_target(lung, point), seed=seed), atlas)
        for seed, point in enumerate(peripheral_targets(lung, 16, 3))
    ]


def sampling_of(search: AtlasSearch) -> tuple[LocalSampling, np.ndarray]:
    target, needle = search.task.target.lps_mm, SYSTEM.needle
    outside = nearly_reaching(search.atlas, needle, target, MOST)
    chosen = np.concatenate([search.arcs.in_workspace[:MOST], outside])
    rng = np.random.default_rng(search.task.seed)
    local_search = LocalSearch(search.evaluator, rng)
    return LocalSampling(local_search, search.arcs, chosen, rng), chosen


@pytest.mark.slow
def test_what_is_sampled_is_proved_and_near_the_atlas(searches: list[AtlasSearch]) -> None:
    seen = 0
    for search in searches:
        sampling, chosen = sampling_of(search)
        entries, limit = search.atlas.deployments, math.inf
        for _ in range(30):
            found = sampling.sample(limit)
            if found is None:
                continue
            seen += 1
            cost = search.evaluator.evaluate(found)
            assert cost < 1.03 * limit
            own = found.deployment
            turn = np.abs(np.angle(np.exp(1j * (entries.rotation_rad[chosen] - own.rotation_rad))))
            inserted = np.abs(entries.inner_mm[chosen] - own.inner_mm)
            assert ((turn <= SPREADS[0] + 1e-9) & (inserted <= 2.0 * SPREADS[1] + 1e-9)).any()
            limit = cost
    assert seen >= 4


@pytest.mark.slow
def test_a_target_between_all_workspaces_is_reached(searches: list[AtlasSearch]) -> None:
    """Not one entry has these targets in its workspace; a deployment between the entries has."""
    between = [search for search in searches if not len(search.arcs.in_workspace)]
    reached = [s for s in between if any(sampling_of(s)[0].sample(math.inf) is not None for _ in range(30))]
    assert reached
    search = reached[0]
    steps = (step for step in search.steps() if step.candidate is not None or step.iteration >= 500)
    assert next(steps).candidate is not None


@pytest.mark.slow
def test_those_that_miss_by_least_come_first(searches: list[AtlasSearch]) -> None:
    search = searches[0]
    target, entries = search.task.target.lps_mm, search.atlas.deployments
    order = nearly_reaching(search.atlas, SYSTEM.needle, target, entries.count)
    outside = order[: entries.count - len(search.arcs.in_workspace)]
    assert not set(outside.tolist()) & set(search.arcs.in_workspace.tolist())
    away = target - entries.positions[outside]
    leans = np.arccos((away * entries.tangents[outside]).sum(axis=1) / np.linalg.norm(away, axis=1))
    assert leans[:20].mean() < leans[-20:].mean()
