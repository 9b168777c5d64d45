"""Deployments drawn between those of the atlas: proved, near them, and sometimes the only ones that reach."""

from __future__ import annotations

import math

import numpy as np
import pytest

import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from anatomy.settings import override
from lungaccess.coupled.search import AtlasSearch
from lungaccess.coupled.search.local_sampling import SPREADS, Scatter, nearly_reaching
from lungaccess.coupled.search.local_search import Climber
from lungaccess.plans.assemble import Task
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from stages.needle import Objective

SYSTEM = override(la.load_system("ultrathin"), {"name": "own", "fissures_allowed": True})
MOST = 200


@pytest.fixture(scope="module")
def searches() -> list[AtlasSearch]:
    """Searches in an atlas with wide gaps."""
    lung = build_lung(make_phantom(seed=1, size="small").images)
    atlas = la.build_atlas(lung, SYSTEM, rotations=3, stop_spacing_mm=12.0, site_spacing_mm=8.0)
    return [
        AtlasSearch(
            Task(
                lung=lung, system=SYSTEM, target=point_target(lung, point),
                objective=Objective(inverse_clearance=1.0), with_fissures=atlas.with_fissures,
                method="atlas", seed=seed,
            ),
            atlas,
        )
        for seed, point in enumerate(peripheral_targets(lung, 16, 3))
    ]  # fmt: skip


def scatter_of(search: AtlasSearch) -> tuple[Scatter, np.ndarray]:
    target, needle = search.task.target.lps_mm, SYSTEM.needle
    outside = nearly_reaching(search.atlas, needle, target, MOST)
    chosen = np.concatenate([search.in_workspace[:MOST], outside])
    climber = Climber(search.desk, search.judge, search.atlas.sites, search.rng)
    return Scatter(climber, search.judge, search.atlas, chosen, search.rng), chosen


def test_what_is_drawn_is_proved_and_near_the_atlas(searches: list[AtlasSearch]) -> None:
    seen = 0
    for search in searches:
        scatter, chosen = scatter_of(search)
        entries, dearest = search.atlas.deployments, math.inf
        for _ in range(30):
            found = scatter.draw(dearest)
            if found is None:
                continue
            seen += 1
            step = search.desk.finished(1, "draw", found)
            assert step.candidate is not None and step.cost < 1.03 * dearest
            own = found.deployment
            turn = np.abs(np.angle(np.exp(1j * (entries.rotation_rad[chosen] - own.rotation_rad))))
            inserted = np.abs(entries.inner_mm[chosen] - own.inner_mm)
            assert ((turn <= SPREADS[0] + 1e-9) & (inserted <= 2.0 * SPREADS[1] + 1e-9)).any()
            dearest = step.cost
    assert seen >= 4


def test_a_target_between_all_workspaces_is_reached(searches: list[AtlasSearch]) -> None:
    """Not one entry has these targets in its workspace; a deployment between the entries has."""
    between = [search for search in searches if not len(search.in_workspace)]
    reached = [s for s in between if any(scatter_of(s)[0].draw(math.inf) is not None for _ in range(30))]
    assert reached
    search = reached[0]
    steps = (step for step in search.steps() if step.candidate is not None or step.iteration >= 500)
    assert next(steps).candidate is not None


def test_those_that_miss_by_least_come_first(searches: list[AtlasSearch]) -> None:
    search = searches[0]
    target, entries = search.task.target.lps_mm, search.atlas.deployments
    order = nearly_reaching(search.atlas, SYSTEM.needle, target, entries.count)
    outside = order[: entries.count - len(search.in_workspace)]
    assert not set(outside.tolist()) & set(search.in_workspace.tolist())
    away = target - entries.positions[outside]
    leans = np.arccos((away * entries.tangents[outside]).sum(axis=1) / np.linalg.norm(away, axis=1))
    assert leans[:20].mean() < leans[-20:].mean()
