"""Reference mode: its collisions are those of the voxels, its plans those that the check accepts."""

from __future__ import annotations

import json
import math
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lungaccess as la
from anatomy import poses
from anatomy.base.errors import SettingsError
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, OUTSIDE, VESSEL
from experiments import noplan_attack
from lungaccess.planning.coupled.kuntz2015_fcl.needle import (
    SAGITTA_MM,
    NeedleRRT,
    Obstacles,
    Solid,
    chord_mm,
    sample_ahead,
)
from lungaccess.planning.coupled.kuntz2015_fcl.search import (
    FOUND,
    OUT_OF_WORKSPACE,
    ReferenceSearch,
    TubeValidator,
    frame_at,
    line_between,
    obstacles_for,
    path_of,
)
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle.device import Needle
from stages.tube import Deployment, DeploymentValidator, TubeShape, design_arrays, longest_mm, shape_or_reason
from tests.lungaccess.planning.coupled.planning import SYSTEM
from tests.lungaccess.resample import problems

EASY_TARGET = "lps:69.7,21.8,-72.6"
"""One that the first twenty thousand random placements reach several times."""
ITERATIONS = 20_000
SPACING_MM = np.array([0.55, 0.6, 0.7])


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung, EASY_TARGET)


def task_for(atlas: la.Atlas, target: Target, seed: int = 1) -> Task:
    return Task(lung=atlas.lung, system=atlas.system, target=target, method="reference", seed=seed)


@pytest.fixture(scope="module")
def obstacles(atlas: la.Atlas, target: Target) -> Obstacles:
    return obstacles_for(task_for(atlas, target))


def searched(search: ReferenceSearch, iterations: int = ITERATIONS) -> list[Any]:
    """Return the better and better candidates, with costs and iterations."""
    out = []
    for step in search.steps():
        if step.candidate is not None:
            out.append(step)
        if step.iteration == iterations:
            return out
    return out


@pytest.fixture(scope="module")
def plans(small_lung: Lung, atlas: la.Atlas, target: Target) -> dict[str, list[Plan]]:
    """Plans with line 8, the same once more, without line 8, and of another seed."""

    def of(method: str, seed: int) -> list[Plan]:
        options = {"atlas": atlas, "method": method, "seed": seed, "iterations": ITERATIONS}
        return list(la.plan(small_lung, SYSTEM, target, **options, goal="default"))

    return {
        "once": of("reference", 1),
        "again": of("reference", 1),
        "without": of("reference-without-rejection", 1),
    }


@pytest.mark.slow
class TestPlans:
    """What `plan` yields with this method."""

    def test_they_are_better_and_better_and_accepted(
        self, plans: dict[str, list[Plan]], small_lung: Lung
    ) -> None:
        found = plans["once"]
        costs = [plan.costs["inverse_clearance"] for plan in found]
        # The last is the best once more, by the simplest motion of the scope.
        assert len(found) >= 2 and costs == sorted(costs, reverse=True) and costs[-1] == costs[-2]
        for plan in found:
            assert plan.method == "reference"
            report = la.check(plan, small_lung, SYSTEM)
            assert report.accepted, [f.name for f in report.findings if not f.ok]
            assert problems(plan, small_lung) == []

    def test_the_same_seed_gives_the_same_bytes(self, plans: dict[str, list[Plan]]) -> None:
        assert [p.digest for p in plans["once"]] == [p.digest for p in plans["again"]]

    def test_line_8_rejects_only_what_leads_nowhere(self, plans: dict[str, list[Plan]]) -> None:
        def choices(plan: Plan) -> dict[str, Any]:
            return {k: v for k, v in json.loads(plan.to_json()).items() if k in ("scope", "tube", "needle")}

        assert {p.method for p in plans["without"]} == {"reference-without-rejection"}
        assert [choices(p) for p in plans["once"]] == [choices(p) for p in plans["without"]]


class TestSearch:
    """What the search counts."""

    @pytest.mark.slow
    def test_counts_add_up(self, atlas: la.Atlas, target: Target, obstacles: Obstacles) -> None:
        counts: list[Counter[str]] = []
        for rejects in (True, False):
            search = ReferenceSearch(
                task_for(atlas, target), atlas, rejects=rejects, obstacles=obstacles, rrt_iterations=15
            )
            searched(search)
            assert sum(search.counts.values()) == ITERATIONS
            assert set(search.spent_s) == {"placement", "tubes", "needle", "proof"}
            counts.append(search.counts)
        assert counts[0][FOUND] == counts[1][FOUND] >= 2
        assert counts[0][OUT_OF_WORKSPACE] > ITERATIONS / 2 and counts[1][OUT_OF_WORKSPACE] == 0

    @pytest.mark.slow
    def test_what_the_proof_refuses_is_kept_and_not_yielded(
        self, atlas: la.Atlas, target: Target, obstacles: Obstacles, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        search = ReferenceSearch(task_for(atlas, target), atlas, obstacles=obstacles)
        monkeypatch.setattr(CandidateEvaluator, "proves", lambda *_: False)
        assert searched(search) == []
        assert len(search.refused_by_proof) == search.counts[FOUND] >= 2
        assert {refusal.stage for refusal in search.refused_by_proof} == {"needle"}

    @pytest.mark.slow
    def test_an_rrt_without_time_finds_nothing(
        self, atlas: la.Atlas, target: Target, obstacles: Obstacles
    ) -> None:
        search = ReferenceSearch(task_for(atlas, target), atlas, obstacles=obstacles, rrt_time_s=1e-12)
        assert searched(search) == [] and search.counts[FOUND] == 0

    @pytest.mark.parametrize("budget", [{"rrt_iterations": 0}, {"rrt_time_s": 0.0}, {"rrt_time_s": math.nan}])
    def test_an_rrt_needs_a_budget(self, atlas: la.Atlas, target: Target, budget: dict[str, Any]) -> None:
        with pytest.raises(SettingsError, match="budget"):
            ReferenceSearch(task_for(atlas, target), atlas, **budget)


class TestTubes:
    """The validator with meshes and the planner's proof with fields are different code for one rule."""

    @pytest.mark.slow
    def test_they_agree(self, atlas: la.Atlas, small_lung: Lung, obstacles: Obstacles) -> None:
        validator, design = TubeValidator(SYSTEM, obstacles), design_arrays(SYSTEM.tubes)
        proof = DeploymentValidator(
            small_lung, SYSTEM.tubes, SYSTEM.margins, with_fissures=atlas.with_fissures
        )
        tips = np.flatnonzero(~atlas.motions.turned)
        rng = np.random.default_rng(0)
        both, only_meshes, only_proof = 0, 0, 0
        for _ in range(2500):
            frame = atlas.motions.tip(int(rng.choice(tips))).lps_from_scope_tip
            rotation = float(rng.uniform(0.0, 2.0 * math.pi))
            inserted = np.sort(rng.uniform(0.0, longest_mm(SYSTEM.tubes), 2))
            made = shape_or_reason(design, inserted[::-1], np.zeros(2))
            ours = made if isinstance(made, str) else validator.validate(frame, rotation, made)
            theirs = proof.validate(frame, rotation, inserted)
            if isinstance(ours, Deployment) and isinstance(theirs, Deployment):
                both += 1
                np.testing.assert_allclose(ours.lps_from_tip, theirs.lps_from_tip, atol=1e-9)
                assert ours.branch == theirs.branch and ours.lateral_sweep_mm == theirs.lateral_sweep_mm
                assert ours.exit_mm == pytest.approx(theirs.exit_mm, abs=0.002)
                assert ours.wall_angle_rad == pytest.approx(theirs.wall_angle_rad, abs=0.05)
            only_meshes += isinstance(ours, Deployment) and isinstance(theirs, str)
            only_proof += isinstance(ours, str) and isinstance(theirs, Deployment)
        # Chords are padded by 0.01 mm.
        assert both >= 20 and only_proof <= 1 and only_meshes <= 0.25 * both

    def test_lines_follow_their_curves(self) -> None:
        frame = poses.pose([1.0, 2.0, 3.0], [0.2, 0.4, 1.0])
        made = shape_or_reason(design_arrays(SYSTEM.tubes), np.array([25.0, 6.0]), np.zeros(2))
        assert isinstance(made, TubeShape)
        shape = path_of(frame, 0.7, made)
        dense, at_mm = shape.sample(0.01)
        line = line_between(shape, 2.5, 21.0)
        np.testing.assert_allclose(line[0], frame_at(shape, 2.5)[:3, 3])
        np.testing.assert_allclose(frame_at(shape, 25.0), shape.frames()[-1])
        part = dense[(at_mm > 2.5) & (at_mm < 21.0)]
        a, b = line[:-1], line[1:]
        along = np.clip(((part[:, None] - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1), 0.0, 1.0)
        gap = np.linalg.norm(part[:, None] - a - along[..., None] * (b - a), axis=-1).min(axis=1)
        assert gap.max() <= SAGITTA_MM


def toy_lung(labels: np.ndarray, spacing_mm: np.ndarray = SPACING_MM) -> Any:
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ np.diag(spacing_mm)
    matrix[:3, 3] = [3.0, -20.0, 100.0]
    return SimpleNamespace(grid=Grid(shape=labels.shape, lps_from_ijk=matrix), labels=labels)


def box_distance(lung: Any, mask: np.ndarray, points_lps: np.ndarray) -> np.ndarray:
    """Return exact distances to the voxels of a mask as boxes, of which there is at least one."""
    spacing = lung.grid.spacing_mm
    gap = np.maximum(np.abs(lung.grid.ijk(points_lps)[:, None] - np.argwhere(mask)) - 0.5, 0.0) * spacing
    return np.asarray(np.sqrt((gap**2).sum(axis=-1)).min(axis=1))


class TestSolids:
    """Collisions of capsules."""

    @settings(max_examples=80)
    @given(
        start=st.tuples(*[st.floats(0.0, 11.0)] * 3),
        step=st.tuples(*[st.floats(-4.0, 4.0)] * 3),
        radius=st.floats(0.01, 3.0),
        share=st.sampled_from([0.01, 0.1, 0.6]),
        seed=st.integers(0, 3),
    )
    def test_capsules_against_the_voxels(
        self,
        start: tuple[float, float, float],
        step: tuple[float, float, float],
        radius: float,
        share: float,
        seed: int,
    ) -> None:
        mask = np.random.default_rng(seed).random((12, 12, 12)) < share
        lung = toy_lung(np.where(mask, VESSEL, 0).astype(np.uint16))
        ends = lung.grid.lps(np.clip([start, np.add(start, step)], 0.0, 11.0))
        line = ends[0] + np.linspace(0.0, 1.0, 400)[:, None] * (ends[1] - ends[0])
        least = float(box_distance(lung, mask, line).min())
        spacing = float(np.linalg.norm(line[1] - line[0]))
        near = Solid(lung, lambda labels: (labels & VESSEL) != 0).is_near(ends, radius)
        assert near or least > radius - 1e-9
        assert not near or least - 0.5 * spacing <= radius + 1e-9

    def test_what_lies_wholly_inside_collides(self) -> None:
        labels = np.zeros((40, 40, 40), dtype=np.uint16)
        labels[5:35, 5:35, 5:35] = VESSEL
        lung = toy_lung(labels)
        solid = Solid(lung, lambda labels: (labels & VESSEL) != 0)
        line = lung.grid.lps([[18.0, 20.0, 20.0], [22.0, 20.0, 20.0]])
        assert solid.is_near(line, 0.5)
        assert solid.depth_mm(line[0]) == pytest.approx(13.5 * 0.55)
        far = lung.grid.lps([[1.0, 1.0, 1.0], [1.0, 2.0, 1.0]])
        assert not solid.is_near(far, 0.5) and solid.depth_mm(far[0]) == 0.0

    def test_beyond_the_grid_all_is_outside(self) -> None:
        labels = np.zeros((20, 20, 20), dtype=np.uint16)
        labels[0] = OUTSIDE
        lung = toy_lung(labels)
        solid = Obstacles(lung, with_fissures=False, reach_mm=5.0).tissue
        assert solid.is_near(lung.grid.lps([[10.0, 10.0, 25.0], [10.0, 10.0, 27.0]]), 0.1)
        assert solid.is_near(lung.grid.lps([[10.0, 10.0, 10.0], [10.0, 10.0, 25.0]]), 0.1)
        assert solid.is_near(lung.grid.lps([[1.0, 10.0, 10.0], [3.0, 10.0, 10.0]]), 0.4)
        assert not solid.is_near(lung.grid.lps([[9.0, 10.0, 10.0], [12.0, 10.0, 10.0]]), 0.4)

    def test_only_other_branches(self) -> None:
        labels = np.zeros((40, 20, 20), dtype=np.uint16)
        labels[10:14] = AIRWAY | (1 << BRANCH_SHIFT)
        labels[24:28] = AIRWAY | (2 << BRANCH_SHIFT)
        lung = toy_lung(labels)
        obstacles = Obstacles(lung, with_fissures=False, reach_mm=6.0)
        wall = lung.grid.lps([[12.0, 10.0, 10.0], [16.0, 10.0, 10.0]])
        towards = lung.grid.lps([[16.0, 10.0, 10.0], [22.0, 10.0, 10.0]])
        assert not obstacles.other_airways(0).is_near(wall, 0.5)
        assert obstacles.other_airways(1).is_near(wall, 0.5)
        assert obstacles.other_airways(0).is_near(towards, 0.9)
        assert not obstacles.other_airways(0).is_near(towards, 0.7)


NEEDLE = Needle(diameter_mm=1.0, max_curvature_per_mm=1.0 / 30.0, exit_exemption_mm=5.0)
START = poses.pose([0.0, 0.0, 4.0], [0.0, 0.0, 1.0])
WALL_TOP_MM = 4.5
GOAL_LPS = np.array([0.5, 0.0, 56.0])


def block_lung(*, blocked: bool) -> Any:
    """A cube of tissue on an airway's wall, with or without a vessel between start and goal."""
    labels = np.zeros((80, 80, 80), dtype=np.uint16)
    labels[:, :, :2] = AIRWAY | LUMEN | (1 << BRANCH_SHIFT)
    labels[:, :, 2:5] = AIRWAY | (1 << BRANCH_SHIFT)
    if blocked:
        labels[38:42, 30:50, 28:31] = VESSEL
    matrix = np.eye(4)
    matrix[:3, 3] = [-40.0, -40.0, 0.0]
    return SimpleNamespace(grid=Grid(shape=labels.shape, lps_from_ijk=matrix), labels=labels)


def rrt(lung: Any) -> NeedleRRT:
    return NeedleRRT(NEEDLE, 1.0, Obstacles(lung, with_fissures=False, reach_mm=20.0))


class TestNeedle:
    """The RRT of the paper."""

    def test_in_the_open_it_takes_the_direct_arc(self) -> None:
        path = rrt(block_lung(blocked=False)).plan(
            START, GOAL_LPS, 0, np.random.default_rng(0), iterations=50
        )
        assert path is not None
        np.testing.assert_allclose(path.frames()[-1][:3, 3], GOAL_LPS, atol=1e-9)
        # In pieces of 20 mm, unless a sample lay nearer to the goal on the way.
        assert path.length_mm < 1.2 * float(np.linalg.norm(GOAL_LPS - START[:3, 3]))

    def test_paths_around_a_vessel_keep_every_limit(self) -> None:
        lung = block_lung(blocked=True)
        planner, found = rrt(lung), 0
        for seed in range(6):
            path = planner.plan(START, GOAL_LPS, 0, np.random.default_rng(seed), iterations=300)
            if path is None:
                continue
            found += 1
            points, at_mm = path.sample(0.1)
            np.testing.assert_allclose(points[-1], GOAL_LPS, atol=1e-6)
            assert path.arcs[:, 2].max() <= NEEDLE.max_curvature_per_mm
            assert path.max_angle_from_start_rad() <= math.radians(90.0) + 1e-9
            assert path.accumulated_turn_rad <= math.radians(180.0) + 1e-9
            assert box_distance(lung, lung.labels == VESSEL, points).min() >= 1.0
            assert points[at_mm >= 5.0, 2].min() >= WALL_TOP_MM + 1.0
        assert found >= 2

    def test_from_inside_a_vessel_leads_no_path(self) -> None:
        lung = block_lung(blocked=False)
        lung.labels[10:70, 10:70, 20:70] = VESSEL
        start = poses.pose([0.0, 0.0, 40.0], [0.0, 0.0, 1.0])
        goal = np.array([1.0, 0.0, 55.0])
        assert rrt(lung).plan(start, goal, 0, np.random.default_rng(0), iterations=20) is None

    def test_a_goal_out_of_reach(self) -> None:
        planner = rrt(block_lung(blocked=False))
        beside = np.array([20.0, 0.0, 14.0])
        assert planner.plan(START, beside, 0, np.random.default_rng(0), iterations=50) is None

    @given(seed=st.integers(0, 1000), ahead=st.floats(5.0, 90.0))
    def test_samples_lie_in_the_trumpet(self, seed: int, ahead: float) -> None:
        goal = START[:3, 3] + ahead * START[:3, 2]
        point = sample_ahead(START, goal, NEEDLE, np.random.default_rng(seed)) - START[:3, 3]
        rho, h = math.hypot(point[0], point[1]), float(point[2])
        assert 0.0 <= h <= 1.2 * ahead + 1e-9 and rho <= h + 1e-9
        assert rho**2 + h**2 >= 2.0 * 30.0 * rho - 1e-9

    def test_chords_stay_near_their_arc(self) -> None:
        for curvature in (0.0, 1.0 / 121.0, 0.02, 0.2):
            assert curvature * chord_mm(curvature) ** 2 / 8.0 <= SAGITTA_MM + 1e-12


@pytest.mark.slow
def test_the_attack_reports_what_the_planner_missed(
    atlas: la.Atlas, target: Target, obstacles: Obstacles, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gives_up(*_arguments: Any, **_options: Any) -> Any:
        raise la.NoPlan("Nothing was tried", reasons={})

    monkeypatch.setattr(noplan_attack.la, "plan", gives_up)
    attack = noplan_attack.Attack(atlas, 0.0, math.inf, 1, obstacles)
    record, plan = attack.result(target.lps_mm)
    assert "Nothing was tried" in record["planner"] and record["reference"] == noplan_attack.MISSED
    assert record["found"] >= 1 and la.check(plan, atlas.lung, SYSTEM).accepted
    targets = {"0": record | {"plan": "p.json"}, "1": {"planner": "plan"}}
    assert "missed by the planner: 1\n" in noplan_attack.summary(targets)
