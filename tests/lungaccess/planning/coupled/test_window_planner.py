"""Plans made for a window of the breath: what they hold, what the check says, and why there is none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.window_search import WindowSearch, window_search
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from tests.lungaccess.motions import motion_by
from tests.lungaccess.planning.coupled.planning import SYSTEM, same_run

STRETCH = 0.09
"""To the feet, a mm of height below the scope: needle and scope go some 5 mm apart."""


def moving(lung: Lung, stretch: float = STRETCH, **changes: Any) -> Lung:
    """The farther from the carina the farther to the feet."""

    def displacement(at: Any) -> Any:
        away = np.linalg.norm(at - lung.tree.carina_lps, axis=-1)
        return away[..., None] * np.array([0.0, -0.3 * stretch, -stretch])

    return replace(lung, motion=motion_by(lung, displacement, **changes))


@pytest.fixture(scope="module")
def breathing(small_lung: Lung) -> Lung:
    return moving(small_lung)


def planned(lung: Lung, target: Target, atlas: la.Atlas, phases: Any = None, **options: Any) -> list[la.Plan]:
    goal = "window" if phases is None else "default"
    options = {"iterations": 3, "atlas": atlas, "counterfactuals": False, "goal": goal} | options
    return list(la.plan(lung, SYSTEM, target, phases=phases, **options))


def window_of(plan: la.Plan) -> la.BreathingWindow:
    assert plan.window is not None
    return plan.window


@pytest.mark.slow
def test_the_widest_window_is_wider_than_that_of_the_least_cost(
    breathing: Lung, target: Target, atlas: la.Atlas
) -> None:
    plans = planned(breathing, target, atlas)
    shares = [window_of(each).share for each in plans]
    assert all(b > a - 0.005 for a, b in zip(shares, shares[1:], strict=False))
    *_, cheapest = la.plan(breathing, SYSTEM, target, iterations=3, atlas=atlas, goal="default")
    assert shares[-1] > la.breathing_window(cheapest, breathing).share + 0.1
    last = plans[-1]
    assert window_of(last).beside_target_mm > 0.1 and np.allclose(last.target_lps, target.lps_mm)
    report = la.check(last, breathing, SYSTEM, target_lps=target.lps_mm)
    assert report.accepted, report.refusals
    again = planned(breathing, target, atlas)
    assert same_run(plans) == same_run(again) and [p.digest for p in plans] == [p.digest for p in again]


@pytest.mark.slow
@pytest.mark.parametrize("phases", [(0.0, 0.5), (0.4, 0.7)])
def test_given_phases_are_held_at_falling_cost(
    breathing: Lung, target: Target, atlas: la.Atlas, phases: tuple[float, float]
) -> None:
    plans = planned(breathing, target, atlas, phases)
    costs = [each.cost for each in plans]
    assert costs == sorted(costs, reverse=True)
    for plan in plans:
        held = window_of(plan).phases
        assert ((held[:, 0] <= phases[0]) & (phases[1] <= held[:, 1])).any()
        assert plan.aim is not None and plan.aim.phases.tolist() == [list(phases)]
    assert la.check(plans[-1], breathing).accepted


@pytest.mark.slow
def test_tissue_that_strays_leaves_less_to_an_aim(
    small_lung: Lung, breathing: Lung, target: Target, atlas: la.Atlas
) -> None:
    straying = moving(small_lung, hysteresis=0.02)
    plain, less = (planned(each, target, atlas, iterations=0)[-1] for each in (breathing, straying))
    assert 0.0 < window_of(less).share < window_of(plain).share
    assert la.check(less, straying).accepted


def test_given_phases_and_the_widest_window_go_together(
    breathing: Lung, target: Target, atlas: la.Atlas
) -> None:
    asked = 0.1, 0.3
    plain, widest = (
        planned(breathing, target, atlas, asked, goal=each)[-1] for each in ("default", "window")
    )
    assert window_of(widest).share >= window_of(plain).share
    assert window_of(widest).phases[0, 0] <= asked[0] and asked[1] <= window_of(widest).phases[-1, 1]


def test_no_place_that_is_ruled_out_has_a_needle_on_target(
    breathing: Lung, target: Target, atlas: la.Atlas
) -> None:
    task = Task(lung=breathing, system=SYSTEM, target=target)
    search = window_search(task, atlas, (0.0, 1.0), widest=False)
    assert isinstance(search, WindowSearch)
    out = np.flatnonzero(search.aims.misses_mm > 0.0)
    assert len(out)
    site = np.isin(atlas.deployments.site[search.arcs.in_workspace], out)
    assert not site.any()


def test_a_reason_for_every_deployment_and_phases_that_have_a_plan(
    small_lung: Lung, target: Target, atlas: la.Atlas
) -> None:
    lung = moving(small_lung, stretch=0.25)
    with pytest.raises(la.NoPlan, match="miss the moving target between 0 % and 100 %") as caught:
        planned(lung, target, atlas, (0.0, 1.0))
    _of, count, *_rest = caught.value.main_reason.split()
    assert sum(caught.value.reasons.values()) == int(count.replace(",", ""))
    first, last = map(float, caught.value.advice.split("--phases ")[1].rstrip(")").split(":"))
    assert planned(lung, target, atlas, (first, last), iterations=0)


def test_what_cannot_be_asked_for(small_lung: Lung, breathing: Lung, target: Target, atlas: la.Atlas) -> None:
    with pytest.raises(AnatomyError, match="breathes is not known"):
        planned(small_lung, target, atlas)
    for phases in ((0.3, 0.3), (0.5, 0.2), (0.0, 1.5)):
        with pytest.raises(SettingsError, match="phase"):
            planned(breathing, target, atlas, phases)


@pytest.mark.parametrize("asked", [{}, {"phases": (0.0, 0.3)}, {"goal": "window"}])
def test_alternatives_have_windows_and_trade_them(
    breathing: Lung, target: Target, atlas: la.Atlas, asked: Any
) -> None:
    found = la.alternatives(
        breathing, SYSTEM, target, atlas=atlas, count=3, counterfactuals=False, **{"goal": "default", **asked}
    )
    for each in found:
        assert each.criteria["window_share"] == window_of(each.plan).share
        assert (each.plan.aim is None) == (not asked)
        if "phases" in asked:
            assert window_of(each.plan).holds(0.0) and window_of(each.plan).holds(0.3)
    shares = [each.criteria["window_share"] for each in found]
    assert found[int(np.argmax(shares))].on_front


def test_a_map_for_phases_holds_what_plans_reach(breathing: Lung, atlas: la.Atlas) -> None:
    phases = 0.0, 0.6
    both = (
        la.map_reach(breathing, SYSTEM, spacing_mm=35.0, atlas=atlas, phases=each) for each in (phases, None)
    )
    during, masks = both
    assert during.window_share is not None and masks.window_share is None
    assert 0 < during.reached.sum() < masks.reached.sum()
    assert (during.window_share.array[during.reached] >= 0.6).all()
    assert not during.window_share.array[~during.reached].any()
    place = during.kinds.grid.lps(np.argwhere(during.reached)[0])
    assert planned(breathing, la.point_target(breathing, place), atlas, phases, iterations=0)
