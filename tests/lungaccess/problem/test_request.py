"""Requests: what composes, what cannot be and why, and which systems are meant."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.lung import Lung
from lungaccess.problem.goals import SUCCESS, WINDOW
from lungaccess.problem.request import (
    AUTO,
    Limits,
    Request,
    StatedPlace,
    require_phases,
    systems_of,
    with_least_clearance,
)
from lungaccess.problem.target import Target
from tests.lungaccess.motions import motion_by

SYSTEM = la.load_system("ultrathin")


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> Target:
    return la.resolve_target(small_lung)


@pytest.fixture(scope="module")
def breathing(small_lung: Lung) -> Lung:
    return replace(small_lung, motion=motion_by(small_lung, lambda at: np.zeros_like(at)))


def depth(plan: la.Plan, _lung: Lung) -> float:
    return plan.tissue_mm


class TestOf:
    """Requests from plain values."""

    def test_success_is_the_goal_of_whoever_states_none(self, small_lung: Lung, target: Target) -> None:
        asked = Request.of(small_lung, "ultrathin", target)
        assert asked.goal is SUCCESS and asked.counts and asked.systems == (SYSTEM,)
        assert asked.limits == Limits() and asked.method == "atlas"

    def test_limits_and_fields_arrive(self, small_lung: Lung, target: Target) -> None:
        asked = Request.of(
            small_lung, SYSTEM, target, goal="length", iterations=3, time_s=1.0, cpu_s=2.0, first_plan_s=0.5,
            seed=7, processes=2, gap=0.1,
        )  # fmt: skip
        assert asked.limits == Limits(iterations=3, time_s=1.0, cpu_s=2.0, first_plan_s=0.5)
        assert (asked.seed, asked.processes, asked.gap) == (7, 2, 0.1) and not asked.counts

    def test_a_function_is_a_goal(self, small_lung: Lung, target: Target) -> None:
        asked = Request.of(small_lung, SYSTEM, target, goal=depth)
        assert (asked.goal.name, asked.goal.of) == ("depth", depth) and asked.counts

    @pytest.mark.parametrize(
        ("asked", "counts", "for_window"),
        [
            ({}, True, False),
            ({"phases": (0.0, 0.3)}, True, True),
            ({"goal": "length"}, False, False),
            ({"goal": "length", "phases": (0.0, 0.3)}, False, True),
            ({"goal": "window"}, False, True),
            ({"goal": "window", "phases": (0.0, 0.3)}, False, True),
            ({"goal": "window", "method": "kuntz2015"}, True, True),
            ({"goal": depth, "phases": (0.2, 0.4)}, True, True),
        ],
    )
    def test_goals_and_phases_compose(
        self, breathing: Lung, target: Target, asked: dict[str, Any], counts: bool, for_window: bool
    ) -> None:
        made = Request.of(breathing, SYSTEM, target, **asked)
        assert (made.counts, made.is_for_window) == (counts, for_window)


class TestRefusals:
    """What cannot be, each with its reason."""

    @pytest.mark.parametrize("goal", ["success", depth])
    def test_a_gap_where_nothing_bounds_the_goal(self, small_lung: Lung, target: Target, goal: Any) -> None:
        with pytest.raises(SettingsError, match="no bound of the best possible") as caught:
            Request.of(small_lung, SYSTEM, target, goal=goal, gap=0.1)
        assert caught.value.expected == "a gap with a cost"

    def test_a_gap_in_a_window(self, breathing: Lung, target: Target) -> None:
        assert Request.of(breathing, SYSTEM, target, goal="length", phases=(0.0, 0.3), gap=0.1).gap == 0.1
        with pytest.raises(SettingsError, match="no bound of the best possible"):
            Request.of(breathing, SYSTEM, target, goal="window", gap=0.1)

    @pytest.mark.parametrize("asked", [{"phases": (0.0, 0.3)}, {"goal": "window"}, {"goal": WINDOW}])
    def test_phases_of_a_patient_who_does_not_breathe(
        self, small_lung: Lung, target: Target, asked: dict[str, Any]
    ) -> None:
        with pytest.raises(AnatomyError, match="How .* breathes is not known"):
            Request.of(small_lung, SYSTEM, target, **asked)

    @pytest.mark.parametrize("phases", [(0.3, 0.3), (0.5, 0.2), (0.0, 1.5), (-0.1, 0.5), (0.1, np.nan)])
    def test_wrong_phases(self, breathing: Lung, target: Target, phases: tuple[float, float]) -> None:
        with pytest.raises(SettingsError, match="phase"):
            Request.of(breathing, SYSTEM, target, phases=phases)

    def test_phases_in_order_are_taken(self) -> None:
        assert require_phases(0, 1) == (0.0, 1.0)

    @pytest.mark.parametrize("processes", [0, -2])
    def test_no_process(self, small_lung: Lung, target: Target, processes: int) -> None:
        with pytest.raises(SettingsError, match="processes"):
            Request.of(small_lung, SYSTEM, target, processes=processes)

    def test_a_needle_planner_that_is_none(self, small_lung: Lung, target: Target) -> None:
        with pytest.raises(SettingsError, match=r"Did you mean 'ao-rrt'"):
            Request.of(small_lung, SYSTEM, target, needle_planner="ao-rtt")

    def test_ompl_with_several_systems(self, small_lung: Lung, target: Target) -> None:
        with pytest.raises(SettingsError, match="seeded once"):
            Request.of(small_lung, AUTO, target, needle_planner="control.EST")

    def test_one_name_for_two_systems(self, small_lung: Lung, target: Target) -> None:
        thin = replace(SYSTEM, needle=replace(SYSTEM.needle, diameter_mm=0.7))
        named = replace(SYSTEM, name="mine")
        with pytest.raises(SettingsError, match="same name"):
            Request.of(small_lung, [named, replace(thin, name="mine")], target)

    @pytest.mark.parametrize("within_mm", [0.0, -1.0, np.inf, np.nan])
    def test_a_place_of_no_extent(self, within_mm: float) -> None:
        with pytest.raises(SettingsError, match="above 0"):
            StatedPlace(kind="exit", lps_mm=np.zeros(3), within_mm=within_mm)

    def test_an_unknown_word(self, small_lung: Lung, target: Target) -> None:
        with pytest.raises(TypeError, match="speed"):
            Request.of(small_lung, SYSTEM, target, speed=1)


class TestSystems:
    """Which systems are meant, in which order."""

    def test_auto_is_all_presets_the_least_invasive_first(self) -> None:
        assert systems_of(AUTO) == la.presets_by_invasiveness()
        crossing = systems_of(AUTO, fissures_allowed=True)
        assert all(each.fissures_allowed for each in crossing)

    def test_several_are_put_in_order(self) -> None:
        names = [each.name for each in la.presets_by_invasiveness()]
        found = systems_of([names[-1], la.load_system(names[0])])
        assert [each.name for each in found] == [names[0], names[-1]]

    def test_one_is_as_it_was_stated(self) -> None:
        assert systems_of(SYSTEM) == systems_of("ultrathin") == (SYSTEM,)
        (crossing,) = systems_of(SYSTEM, fissures_allowed=True)
        assert crossing.fissures_allowed

    def test_a_least_clearance_widens_the_margins_to_just_as_much(self) -> None:
        thinnest = SYSTEM.needle.radius_mm + SYSTEM.margins.total_mm
        assert with_least_clearance(SYSTEM, thinnest) is SYSTEM
        wider = with_least_clearance(SYSTEM, thinnest + 1.0)
        assert wider.margins.total_mm == pytest.approx(SYSTEM.margins.total_mm + 1.0)
        assert wider.name != SYSTEM.name and "mm from obstacles" in wider.name

    @pytest.mark.parametrize("least_mm", [-1.0, np.nan, np.inf])
    def test_an_absurd_least_clearance(self, least_mm: float) -> None:
        with pytest.raises(SettingsError, match="least clearance"):
            systems_of(SYSTEM, least_clearance_mm=least_mm)


class TestLimits:
    """What ends a search."""

    def test_none_never_ends(self) -> None:
        assert not Limits().are_reached(10**9, 1e9, 1e9, found=True)

    @pytest.mark.parametrize("name", ["time_s", "cpu_s"])
    def test_a_limit_waits_for_the_direct_arcs_or_a_plan(self, name: str) -> None:
        limits, spent = Limits(**{name: 1.0}), (2.0, 0.0) if name == "time_s" else (0.0, 2.0)
        assert limits.are_reached(0, *spent, found=True)
        assert not limits.are_reached(0, *spent, found=False)
        assert limits.are_reached(1, *spent, found=False)
        assert not limits.are_reached(1, 0.5, 0.5, found=True)

    def test_the_first_plan_has_a_limit_of_its_own(self) -> None:
        limits = Limits(time_s=10.0, first_plan_s=1.0)
        assert limits.are_reached(1, 2.0, 0.0, found=False)
        assert not limits.are_reached(1, 2.0, 0.0, found=True)
