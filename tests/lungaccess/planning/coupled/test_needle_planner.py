"""The planner of the needle by its name, inside the coupled planner."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace

import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.planning.coupled.search import needle_planner
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import preset_names
from lungaccess.problem.target import Target
from stages.needle import OUR_PLANNERS, has_ompl
from tests.lungaccess.planning.coupled.planning import (
    KUNTZ_SEED,
    KUNTZ_TARGET,
    SYSTEM,
    TARGET,
    mapped,
    plans_of,
    same_run,
)


class TestNeedlePlanner:
    """The planner of the needle by its name."""

    @pytest.mark.parametrize("name", OUR_PLANNERS)
    @pytest.mark.parametrize("method", ["atlas", "kuntz2015"])
    def test_each_of_ours_serves_and_is_stated(
        self, small_lung: Lung, atlas: la.Atlas, name: str, method: str
    ) -> None:
        lung, target = mapped(small_lung), la.resolve_target(small_lung, KUNTZ_TARGET)
        iterations = 60 if method == "atlas" else 300
        options = {"method": method, "needle_planner": name, "seed": 1, "goal": "cost-map"}
        try:
            plan = plans_of(lung, target, atlas, iterations=iterations, **options)[-1]
        except la.NoPlan:
            assert method == "kuntz2015"
            return
        assert (plan.method, plan.needle_planner) == (method, name)
        assert Plan.from_json(plan.to_json()).digest == plan.digest
        assert la.check(plan, lung).accepted

    def test_by_its_own_name_the_default_plans_the_same(
        self, small_lung: Lung, target: Target, atlas: la.Atlas
    ) -> None:
        plain, named = (
            plans_of(small_lung, target, atlas, iterations=100, **options)[-1]
            for options in ({}, {"needle_planner": "ao-rrt"})
        )
        assert plain.needle_planner == "" and "needle_planner" not in plain.to_json()
        assert replace(named, needle_planner="").digest == plain.digest

    def test_what_cannot_be_is_refused(self, small_lung: Lung, target: Target, atlas: la.Atlas) -> None:
        with pytest.raises(SettingsError, match=r"Did you mean 'control\.RRT'"):
            la.plan(small_lung, SYSTEM, target, atlas=atlas, needle_planner="control.RTT", goal="default")
        with pytest.raises(SettingsError, match="reference mode"):
            la.plan(
                small_lung,
                SYSTEM,
                target,
                atlas=atlas,
                method="reference",
                needle_planner="rrt",
                goal="default",
            )
        with pytest.raises(SettingsError, match=f"with {len(preset_names())} systems"):
            la.plan(small_lung, "auto", target, needle_planner="control.EST")

    @pytest.mark.parametrize("method", ["atlas", "kuntz2015"])
    def test_without_ompl_the_plans_are_the_same_bit_for_bit(
        self, small_lung: Lung, atlas: la.Atlas, method: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        target = la.resolve_target(small_lung, KUNTZ_TARGET if method == "kuntz2015" else TARGET)
        found = []
        for there in (has_ompl(), False):
            monkeypatch.setattr(needle_planner, "has_ompl", lambda there=there: there)
            plans = plans_of(small_lung, target, atlas, iterations=2000, method=method, seed=KUNTZ_SEED)
            found.append(same_run(plans))
        assert found[0] == found[1] and found[0]

    @pytest.mark.ompl
    @pytest.mark.slow
    def test_planners_of_ompl_repeat_in_processes_of_their_own(self) -> None:
        first, again = (
            subprocess.run([sys.executable, "-c", OMPL_SCRIPT], capture_output=True, text=True, check=True)
            for _ in range(2)
        )
        cost, digest, accepted, refused = json.loads(first.stdout.splitlines()[-1])
        assert first.stdout.splitlines()[-1] == again.stdout.splitlines()[-1]
        assert accepted and math.isfinite(cost) and digest and "once in a process" in refused


OMPL_SCRIPT = """
import json
import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom

lung = build_lung(make_phantom(seed=3, size="small").images)
system = la.load_system("ultrathin")
target = la.resolve_target(lung, nodule=1)
asked = dict(iterations=60, seed=3, needle_planner="control.RRT", goal="length", counterfactuals=False)
plan = list(la.plan(lung, system, target, **asked))[-1]
try:
    la.plan(lung, system, target, **asked)
except la.LungaccessError as error:
    print(json.dumps([plan.cost, plan.digest, la.check(plan, lung).accepted, str(error)]))
"""
