"""Windows, processes, stated places and exits, for systems of every kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError, TargetError
from anatomy.lung import Lung
from lungaccess.planning.coupled.layer_bound import beside_in_window_mm, cost_bound
from lungaccess.planning.coupled.search.base import ParallelSearch, Step
from lungaccess.planning.coupled.search.direct_candidates import direct_candidates
from lungaccess.planning.coupled.search.window_search import random_change, varied, window_search
from lungaccess.planning.driver import holds, place_part
from lungaccess.planning.searches import parallel_steps, planners
from lungaccess.problem.request import Request, StatedPlace
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import Target, point_target
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import require_motion
from stages.needle import Objective
from tests.lungaccess.planning.coupled.planning import KUNTZ_TARGET, SYSTEM, same_run
from tests.lungaccess.planning.coupled.test_window_planner import moving
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

OFF_MM = np.array([0.7, -0.9, 0.5])
"""So far from tips of the atlas lie the targets: not where the enumeration ends."""
KINDS = ["needle", "tubes", pytest.param("twisted", marks=pytest.mark.slow)]
KINDS += [pytest.param("twisted alone", marks=pytest.mark.slow)]
Case = tuple[System, la.Atlas, Target]


def _tubes() -> System:
    loaded = load_system("ultrathin")
    scope = replace(loaded.scope, outer_diameter_mm=2.0)
    return replace(loaded, name="tubes", scope=scope, needle=None, fissures_allowed=True)


@pytest.fixture(scope="module")
def case_of(small_lung: Lung, small_atlas: la.Atlas, target: Target) -> Callable[[str], Case]:
    """Return the system of a kind with its atlas, and the target with most clear ways of some."""
    made: dict[str, Case] = {}

    def find(kind: str) -> Case:
        if kind == "needle":
            return SYSTEM, small_atlas, target
        if kind not in made:
            twisted = two_curved_tubes()
            systems = {"tubes": _tubes(), "twisted": twisted, "twisted alone": replace(twisted, needle=None)}
            system, options = systems[kind], {"rotations": 12, "stop_spacing_mm": 4.0}
            atlas = la.build_atlas(small_lung, system, **(options if kind == "tubes" else COARSE))
            made[kind] = system, atlas, _best_target(small_lung, system, atlas)
        return made[kind]

    return find


def _best_target(lung: Lung, system: System, atlas: la.Atlas) -> Target:
    found: list[tuple[int, Target]] = []
    for entry in np.linspace(0, atlas.deployments.count - 1, 30).astype(int):
        try:
            goal = point_target(lung, atlas.deployments.positions[entry] + OFF_MM)
        except TargetError:
            continue
        task = Task(lung=lung, system=system, target=goal)
        found.append((len(direct_candidates(task, atlas).clear()), goal))
    return max(found, key=lambda each: each[0])[1]


def _accepted(plan: la.Plan, lung: Lung, system: System) -> None:
    report = la.check(plan, lung, system)
    assert report.accepted, [str(each) for each in report.refusals]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phases", [None, (0.2, 0.6)])
def test_any_system_has_plans_for_a_window(
    small_lung: Lung, case_of: Callable[[str], Case], kind: str, phases: Any
) -> None:
    system, atlas, goal = case_of(kind)
    lung = moving(small_lung, 0.05)

    def planned() -> list[la.Plan]:
        options = {"atlas": atlas, "iterations": 6, "counterfactuals": False}
        return list(
            la.plan(lung, system, goal, goal="default" if phases else "window", phases=phases, **options)
        )

    plans = planned()
    last = plans[-1]
    assert last.window is not None and last.aim is not None
    assert (last.needle is None) == (system.needle is None)
    assert last.window.share > 0.0
    if phases is not None:
        held = last.window.phases
        assert ((held[:, 0] <= phases[0]) & (phases[1] <= held[:, 1])).any()
    _accepted(last, lung, system)
    assert same_run(plans) == same_run(planned())


def test_without_a_needle_too_no_plan_says_what_the_breath_does(
    small_lung: Lung, case_of: Callable[[str], Case]
) -> None:
    system, atlas, goal = case_of("tubes")
    with pytest.raises(la.NoPlan, match="miss the moving target between 0 % and 100 %") as caught:
        list(
            la.plan(
                moving(small_lung, 0.6),
                system,
                goal,
                goal="default",
                phases=(0.0, 1.0),
                atlas=atlas,
                iterations=3,
            )
        )
    assert "--phases" in caught.value.advice or "No part" in caught.value.advice


def test_alternatives_of_tubes_have_windows(small_lung: Lung, case_of: Callable[[str], Case]) -> None:
    system, atlas, goal = case_of("tubes")
    lung = moving(small_lung, 0.05)
    found = la.alternatives(
        lung,
        system,
        goal,
        atlas=atlas,
        count=3,
        separation_mm=1.0,
        phases=(0.2, 0.6),
        goal="default",
        counterfactuals=False,
    )
    assert found
    for each in found:
        assert each.plan.window is not None and each.plan.aim is not None
        _accepted(each.plan, lung, system)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tubes", "tubes window", "needle window", "kuntz2015", "reference"])
def test_several_processes_give_the_same_again_and_nothing_worse(
    small_lung: Lung, case_of: Callable[[str], Case], kind: str
) -> None:
    system, atlas, goal = case_of("tubes" if "tubes" in kind else "needle")
    lung = moving(small_lung, 0.05) if "window" in kind else small_lung

    def search() -> ParallelSearch:
        if "window" in kind:
            return window_search(Task(lung=lung, system=system, target=goal), atlas, None, widest=True)
        where = la.resolve_target(small_lung, KUNTZ_TARGET) if kind in planners() else goal
        made = planners()[kind if kind in planners() else "atlas"](
            Task(lung=lung, system=system, target=where), atlas
        )
        assert isinstance(made, ParallelSearch)
        return made

    def costs(steps: Iterator[Step]) -> list[float]:
        return [step.cost for step in steps if step.candidate is not None]

    steps = {"kuntz2015": 20, "reference": 2}.get(kind, 42)
    found = costs(islice(parallel_steps(search(), 2), steps))
    assert found == costs(islice(parallel_steps(search(), 2), steps))
    assert found == sorted(found, reverse=True)
    if "tubes" in kind:
        whole = costs(parallel_steps(search(), 2))
        assert whole[-1] <= costs(search().direct_steps())[-1]


@pytest.mark.parametrize("kind", KINDS)
def test_variations_are_proved_and_end_where_they_are_to(
    small_lung: Lung, case_of: Callable[[str], Case], kind: str
) -> None:
    system, atlas, goal = case_of(kind)
    task = Task(lung=small_lung, system=system, target=goal)
    direct = direct_candidates(task, atlas)
    first = next(made for made in map(direct.proved, direct.clear().tolist()) if made is not None)
    rng, other, proved = np.random.default_rng(3), 0, 0
    beside = goal.lps_mm + np.array([0.3, 0.2, -0.1])
    for _ in range(20):
        turn, *shifts = random_change(rng, 0.3, system.tubes)
        made = varied(direct.evaluator, first, turn, shifts)
        if made is not None:
            other += made.deployment.inner_mm != first.deployment.inner_mm
            proved += direct.evaluator.accepts(made)
        aside = varied(direct.evaluator, first, turn, shifts, beside)
        if aside is not None:
            assert aside.path.frames()[-1][:3, 3] == pytest.approx(beside, abs=1e-5)
    assert other >= 3 and proved >= 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_stated_place_holds_of_atlas_candidate_and_plan(
    small_lung: Lung, case_of: Callable[[str], Case], kind: str
) -> None:
    system, atlas, goal = case_of(kind)
    *_, any_plan = la.plan(small_lung, system, goal, goal="default", atlas=atlas, iterations=0)
    exit_lps = np.asarray(any_plan.tube.exit.point_lps)
    tip_lps = any_plan.scope.lps_from_scope_tip[:3, 3]
    for place in (
        StatedPlace(kind="exit", lps_mm=exit_lps, within_mm=5.0),
        StatedPlace(kind="scope tip", lps_mm=tip_lps, within_mm=1.5),
    ):
        request = Request.of(small_lung, system, goal, goal="default", place=place, iterations=2)
        part = place_part(request, atlas)
        assert 0 < part.deployments.count <= atlas.deployments.count
        *_, last = la.plan(
            small_lung, system, goal, goal="default", place=place, atlas=atlas, iterations=2,
            counterfactuals=False,
        )  # fmt: skip
        assert holds(request, last)
        far = replace(request, place=replace(place, lps_mm=place.lps_mm + np.array([500.0, 0.0, 0.0])))
        assert not holds(far, last)
        with pytest.raises(TargetError, match="No "):
            place_part(far, atlas)
        with pytest.raises(SettingsError, match="above 0"):
            replace(place, within_mm=0.0)


def test_tubes_without_a_needle_have_feasible_exits(small_lung: Lung, case_of: Callable[[str], Case]) -> None:
    system, atlas, goal = case_of("tubes")
    *_, found = la.feasible_exits(small_lung, system, goal, atlas=atlas)
    assert found.is_complete and found.count
    direct = direct_candidates(Task(lung=small_lung, system=system, target=goal), atlas)
    assert set(found.entries.tolist()) == set(direct.clear().tolist())
    for n, entry in enumerate(found.entries[found.best].tolist()):
        made = direct.candidate(entry)
        assert made is not None
        assert found.exit_lps[n] == pytest.approx(made.path.lps_from_start[:3, 3])
        assert made.path.length_mm - 0.1 < found.length_mm[found.best[n]] <= made.path.length_mm + 1e-9
        assert 0.0 <= found.clearance_mm[n] < 50.0


@pytest.mark.parametrize("kind", [each for each in KINDS if each != "needle"])
def test_no_plan_costs_less_than_its_bound(
    small_lung: Lung, case_of: Callable[[str], Case], kind: str
) -> None:
    """Every proved direct way to many targets, and the plans of a search."""
    system, atlas, _goal = case_of(kind)
    seen, shares = 0, []
    for entry in np.linspace(0, atlas.deployments.count - 1, 40).astype(int):
        beyond = 25.0 * atlas.deployments.tangents[entry] if system.needle else 0.0
        try:
            goal = point_target(small_lung, atlas.deployments.positions[entry] + OFF_MM + beyond)
        except TargetError:
            continue
        for objective in ("inverse_clearance", "length=1,inverse-clearance=0.5"):
            task = Task(lung=small_lung, system=system, target=goal, objective=Objective.of(objective))
            bound, direct = cost_bound(task, atlas), direct_candidates(task, atlas)
            bound.start(1.0, 1)
            for made in map(direct.proved, direct.clear()[:20].tolist()):
                if made is not None:
                    seen += 1
                    shares.append(bound.value / direct.evaluator.evaluate(made))
    assert seen > 30
    assert max(shares) <= 1.0
    assert system.needle is not None or np.median(shares) > 0.02


def test_a_gap_is_stated_for_tubes_without_a_needle(small_lung: Lung, case_of: Callable[[str], Case]) -> None:
    system, atlas, goal = case_of("tubes")
    *_, last = la.plan(small_lung, system, goal, atlas=atlas, goal="default", gap=0.0, iterations=3)
    assert last.gap is not None and 0.0 < last.cost_bound < last.cost
    *_, first = la.plan(small_lung, system, goal, atlas=atlas, goal="default", gap=1000.0)
    assert first.iterations <= 2


@pytest.mark.slow
def test_a_bound_for_a_window_holds_where_the_masks_show_one_of_its_phases(
    small_lung: Lung, case_of: Callable[[str], Case]
) -> None:
    for kind in ("needle", "tubes"):
        system, atlas, goal = case_of(kind)
        lung = moving(small_lung, 0.05)
        shown = require_motion(lung).masks_phase
        task = Task(lung=lung, system=system, target=goal)
        with pytest.raises(SettingsError, match="the masks show"):
            beside_in_window_mm(task, (0.0, 0.1) if shown > 0.5 else (0.9, 1.0))
        phases = max(shown - 0.2, 0.0), min(shown + 0.2, 1.0)
        plans = la.plan(lung, system, goal, goal="default", phases=phases, atlas=atlas, iterations=6)
        costs = [each.cost for each in plans]
        bound = cost_bound(task, atlas, beside_in_window_mm(task, phases))
        for _ in range(10):
            bound.start(2.0 * costs[0], 1000)
        assert 0.0 <= bound.value <= costs[-1]
