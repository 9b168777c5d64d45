"""Random targets, devices and obstacles: plans keep every rule, and the check notices what does not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import lungaccess as la
from anatomy.lung import Lung
from anatomy.structures import LUMEN, VESSEL
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import point_target
from stages.needle import TERMS
from tests.lungaccess.resample import needle_walk, problems, put_vessel, tube_walk
from tests.stages.scenes import lung_of

PRESET = la.load_system("ultrathin")
SYSTEM = replace(PRESET, name="changed", needle=replace(PRESET.needle, max_curvature_per_mm=1 / 50))
ANY = settings(max_examples=8, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])


@pytest.fixture(scope="module")
def atlas(small_atlas: la.Atlas) -> la.Atlas:
    return replace(small_atlas, system=SYSTEM)


def some_plans(lung: Lung, atlas: la.Atlas, seed: int, **options: Any) -> list[Plan]:
    """Plans to the first of ten random points that has any."""
    rng = np.random.default_rng(seed)
    options["counterfactuals"] = False
    for _ in range(10):
        point = lung.grid.lps(rng.uniform(0, np.array(lung.grid.shape) - 1))
        try:
            target = point_target(lung, point)
            return list(
                la.plan(lung, atlas.system, target, atlas=atlas, seed=seed, **{"goal": "default", **options})
            )
        except (la.NoPlan, la.LungaccessError):
            continue
    return []


@given(
    seed=st.integers(0, 10**6),
    goal=st.sampled_from([term.key for term in TERMS]),
    iterations=st.sampled_from([0, 40]),
)
@ANY
def test_every_plan_keeps_every_rule(
    small_lung: Lung, atlas: la.Atlas, seed: int, goal: str, iterations: int
) -> None:
    plans = some_plans(small_lung, atlas, seed, goal=goal, iterations=iterations)
    assume(plans)
    for plan in (plans[0], plans[-1]):
        assert problems(plan, small_lung) == []
    report = la.check(plans[-1], small_lung, SYSTEM)
    assert report.accepted, [f.name for f in report.findings if not f.ok]


@pytest.mark.slow
@given(seed=st.integers(0, 10**6), share=st.floats(0.0, 1.0), stage=st.sampled_from(["needle", "tube"]))
@ANY
def test_a_vessel_put_on_the_way_is_noticed(
    small_lung: Lung, atlas: la.Atlas, seed: int, share: float, stage: str
) -> None:
    """By the check, by walking again, and by a new search, which goes elsewhere."""
    plans = some_plans(small_lung, atlas, seed, iterations=0)
    assume(plans)
    plan = plans[-1]
    walk = needle_walk(plan) if stage == "needle" else tube_walk(plan)
    points = walk.points if stage == "needle" else walk.points[walk.s > plan.tube.exit.arc_length_mm + 0.2]
    point = points[int(share * (len(points) - 1))]
    crossed = put_vessel(small_lung, point)
    assert problems(plan, crossed)
    report = la.check(plan, crossed, SYSTEM)
    assert not report.accepted
    assert any(not f.ok and ("vessel" in f.name or "contain" in f.name) for f in report.findings)


@pytest.mark.slow
@given(seed=st.integers(0, 10**6))
@settings(max_examples=1)
def test_a_new_search_goes_around_what_was_put_in_the_way(
    small_lung: Lung, atlas: la.Atlas, seed: int
) -> None:
    """The lung is made anew with a vessel ball in the middle of the best needle path."""
    plans = some_plans(small_lung, atlas, seed, iterations=0)
    assume(plans)
    points = needle_walk(plans[-1]).points
    middle = points[len(points) // 2]
    assume(np.linalg.norm(middle - plans[-1].target_lps) > 5.0)
    labels = small_lung.labels.copy(order="F")
    centres = small_lung.grid.lps(np.argwhere(labels >= 0)).reshape(*labels.shape, 3)
    near = np.linalg.norm(centres - middle, axis=-1) < 2.5
    labels[near & (labels & LUMEN == 0)] |= VESSEL
    crossed = lung_of(labels, small_lung.grid, small_lung.tree)
    target = point_target(crossed, plans[-1].target_lps)
    try:
        around = list(la.plan(crossed, SYSTEM, target, iterations=40, goal="default"))
    except la.NoPlan:
        return
    for plan in (around[0], around[-1]):
        assert problems(plan, crossed) == []


@pytest.mark.slow
@given(
    seed=st.integers(0, 10**6),
    moved=st.sampled_from(["route", "tube", "needle", "target"]),
    axis=st.integers(0, 2),
)
@ANY
def test_a_stage_moved_by_a_voxel_is_noticed(
    small_lung: Lung, atlas: la.Atlas, seed: int, moved: str, axis: int
) -> None:
    plans = some_plans(small_lung, atlas, seed, iterations=0)
    assume(plans)
    plan, shift = plans[-1], np.zeros(3)
    shift[axis] = small_lung.grid.spacing_mm[axis]

    def at(frame: np.ndarray) -> np.ndarray:
        out = frame.copy()
        out[:3, 3] += shift
        return out

    if moved == "route":
        scope = replace(plan.scope, lps_from_scope_tip=at(plan.scope.lps_from_scope_tip))
        broken = replace(plan, scope=scope)
    elif moved == "tube":
        broken = replace(plan, tube=replace(plan.tube, lps_from_tip=at(plan.tube.lps_from_tip)))
    elif moved == "needle":
        broken = replace(plan, needle=replace(plan.needle, lps_from_start=at(plan.needle.lps_from_start)))
    else:
        broken = replace(plan, target_lps=plan.target_lps + shift)
    assert problems(broken, small_lung)
    assert not la.check(broken, small_lung, SYSTEM).accepted


@pytest.mark.slow
@pytest.mark.parametrize("preset", la.preset_names())
def test_every_preset_plans_on_an_adult(preset: str) -> None:
    """Many targets in one synthetic adult; plans are checked, the others are explained."""
    from anatomy.build import build_lung
    from anatomy.phantom import make_phantom

    lung = build_lung(make_phantom(seed=2, spacing_mm=1.25).images)
    system = la.load_system(preset)
    made = la.build_atlas(lung, system)
    found = 0
    for seed in range(12):
        plans = some_plans(lung, made, seed, iterations=30)
        if plans:
            found += 1
            assert problems(plans[-1], lung) == []
            report = la.check(plans[-1], lung, system)
            assert report.accepted, [f.name for f in report.findings if not f.ok]
    assert found >= 6
