"""`NoPlan` tells the truth: constructed causes are named, and what it advises gives a plan."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, OUTSIDE, VESSEL
from lungaccess.planning.coupled import explanation
from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.no_plan import NoPlan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, point_target
from lungaccess.problem.task import Task
from stages.scope import prover_of
from tests.lungaccess.points import FAR_TARGET
from tests.stages.scenes import lung_of

# The check compares a system that has the name of a preset with the preset.
SYSTEM = replace(la.load_system("ultrathin"), name="changed")
# Already bends most tightly, needs much clearance: what is left to advise is a thinner needle, or a fissure.
THICK = replace(
    SYSTEM,
    needle=replace(SYSTEM.needle, max_curvature_per_mm=1 / 30, diameter_mm=1.0),
    margins=replace(SYSTEM.margins, segmentation_margin_mm=0.8),
)

COARSE: dict[str, Any] = {"rotations": 12, "stop_spacing_mm": 4.0}


@pytest.fixture(scope="module")
def atlas_of(small_lung: Lung) -> Callable[[System], la.Atlas]:
    """Atlases of the small lung, each made once."""
    made: dict[str, la.Atlas] = {}

    def atlas(system: System) -> la.Atlas:
        key = repr(system)
        if key not in made:
            made[key] = la.build_atlas(small_lung, system, **COARSE)
        return made[key]

    return atlas


def explained(lung: Lung, system: System, target: Target, **options: Any) -> NoPlan:
    with pytest.raises(la.NoPlan) as caught:
        list(la.plan(lung, system, target, **{"iterations": 60, "goal": "default", **options}))
    return caught.value


def random_targets(lung: Lung, count: int, seed: int) -> list[Target]:
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        point: Float = lung.grid.lps(rng.uniform(0, np.array(lung.grid.shape) - 1))
        clear = lung.fields["obstacle_fissure"].lower_bound_mm(point)[0]
        if lung.label_at(point) & (AIRWAY | VESSEL | OUTSIDE) == 0 and clear > 1.5:
            found.append(point_target(lung, point))
    return found


BENDS_WIDELY = {"min_bending_radius_mm": 20.0, "min_shaft_radius_mm": 20.0}
"""No scope bends tighter than half its diameter."""


class TestScope:
    """The bronchoscope does not fit."""

    THICK_SCOPE = replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=15.0, **BENDS_WIDELY))

    def test_it_fits_nowhere(self, small_lung: Lung) -> None:
        error = explained(small_lung, self.THICK_SCOPE, la.resolve_target(small_lung))
        assert "the scope (15 mm) fits nowhere" in str(error)
        assert error.reasons["scope: tips with a proved motion"] == 0
        generation = int(re.search(r"too narrow at generation (\d+)", str(error))[1])
        closed = next(count for reason, count in error.reasons.items() if "too narrow" in reason)
        assert generation == 0 and closed == small_lung.tree.n_points
        assert error.reasons["scope: points of the airways that it passes, none from the target"] == 0

    def test_the_advised_diameter_has_a_place_and_a_larger_one_has_none(self, small_lung: Lung) -> None:
        advice = explained(small_lung, self.THICK_SCOPE, la.resolve_target(small_lung)).advice
        widest = float(re.search(r"of ([\d.]+) mm or less", advice)[1])
        for diameter, fits in ((widest, True), (widest + 0.11, False)):
            scope = replace(SYSTEM.scope, outer_diameter_mm=diameter, **BENDS_WIDELY)
            atlas = la.build_atlas(
                small_lung, replace(SYSTEM, scope=scope), rotations=1, stop_spacing_mm=20.0
            )
            assert (atlas.motions.count > 0) == fits

    @pytest.mark.slow
    def test_no_airway_in_lung_tissue(self, small_lung: Lung) -> None:
        """The lung is far from every airway: a thinner scope is no help, and none is advised."""
        labels = small_lung.labels.copy(order="F")
        labels[labels & AIRWAY == 0] |= OUTSIDE
        target = la.resolve_target(small_lung)
        where = tuple(np.rint(small_lung.grid.ijk(target.lps_mm)).astype(int))
        labels[where] = 0
        lung = lung_of(labels, small_lung.grid, small_lung.tree)
        error = explained(lung, replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=1.8)), target)
        assert "fits nowhere" in str(error)
        assert error.reasons["scope: tips with a proved motion"] == 0 and error.advice == ""


@pytest.mark.slow
def test_tubes_that_never_leave(small_lung: Lung) -> None:
    system = replace(SYSTEM, tubes=replace(SYSTEM.tubes, min_wall_angle_deg=90.0))
    error = explained(small_lung, system, la.resolve_target(small_lung))
    assert "the tubes cannot leave the airway safely" in str(error)
    assert error.reasons["scope: tips with a proved motion"] > 0
    refused = {k: v for k, v in error.reasons.items() if k.startswith("tube: the tube")}
    assert sum(refused.values()) == error.reasons["tube: deployments looked at"]
    assert refused["tube: the tube meets the airway wall at too flat an angle"] > 0


def test_the_nearest_airway_and_the_nearest_that_the_scope_passes_are_told(small_lung: Lung) -> None:
    target = la.resolve_target(small_lung)
    task = Task(lung=small_lung, system=SYSTEM, target=target)
    away = np.linalg.norm(small_lung.tree.points_lps - target.lps_mm, axis=1)
    passable = away > np.median(away)
    motions = SimpleNamespace(count=3, passages=SimpleNamespace(passable=passable, narrowest=(2, 0.4)))
    atlas = SimpleNamespace(motions=motions, deployments=SimpleNamespace(candidates=7))
    reasons = explanation._scope_reasons(task, atlas)
    nearest, passed = away.min(), away[passable].min()
    assert reasons[f"masks: points of the airways, the nearest {nearest:.0f} mm from the target"] == len(away)
    key = f"scope: points of the airways that it passes, the nearest {passed:.0f} mm from the target"
    assert passed > nearest + 1.0 and reasons[key] == np.count_nonzero(passable)


@pytest.mark.parametrize(("inside", "told"), [(9, "for 991 of 1000 deployments"), (10, "every path tried")])
def test_a_few_deployments_far_off_do_not_hide_that_the_needle_bends_too_little(
    inside: int, told: str
) -> None:
    arcs = SimpleNamespace(
        in_workspace=np.arange(inside), atlas=SimpleNamespace(deployments=SimpleNamespace(count=1000))
    )
    said = explanation._main_reason(arcs, Counter({"the pleura": 3, "nothing": 5}))
    assert told in said and said.endswith("blocked, mostly by the pleura")
    assert ("outside the needle's workspace" in said) == (inside < 10)


class TestNeedle:
    """The needle does not get there."""

    @pytest.mark.slow
    def test_outside_the_workspace(self, small_lung: Lung, atlas_of: Any) -> None:
        atlas = atlas_of(SYSTEM)
        error = explained(small_lung, SYSTEM, la.resolve_target(small_lung, FAR_TARGET), atlas=atlas)
        assert "outside the needle's workspace" in str(error)
        outside = error.reasons["needle: deployments whose workspace does not hold the target"]
        assert outside == atlas.deployments.count > 0

    @pytest.mark.slow
    def test_walled_in_by_a_vessel(self, small_lung: Lung) -> None:
        """A shell of vessel about a target that was reached before."""
        target = la.resolve_target(small_lung)
        centres = small_lung.grid.lps(np.argwhere(small_lung.labels >= 0)).reshape(
            *small_lung.labels.shape, 3
        )
        distance = np.linalg.norm(centres - target.lps_mm, axis=-1)
        labels = small_lung.labels.copy(order="F")
        labels[(distance > 3.0) & (distance < 5.5)] = VESSEL
        walled = lung_of(labels, small_lung.grid, small_lung.tree)
        error = explained(walled, SYSTEM, target, atlas=la.build_atlas(walled, SYSTEM, **COARSE))
        assert "is blocked, mostly by a vessel" in str(error)
        stopped = {k: v for k, v in error.reasons.items() if k.startswith("needle: arcs stopped by")}
        assert set(stopped) <= {
            "needle: arcs stopped by a vessel", "needle: arcs stopped by the needle's limits",
        }  # fmt: skip
        assert stopped["needle: arcs stopped by a vessel"] > 0
        assert "reaches it" in error.advice

    def test_a_search_cut_short_says_so(self, small_lung: Lung, atlas_of: Any) -> None:
        target = la.resolve_target(small_lung)
        error = explained(
            small_lung, SYSTEM, target, atlas=atlas_of(SYSTEM), method="kuntz2015", iterations=1
        )
        assert "too short" in error.advice
        assert next(la.plan(small_lung, SYSTEM, target, atlas=atlas_of(SYSTEM), goal="default")) is not None


@pytest.mark.slow
class TestAdvice:
    """What is advised gives a plan that the check accepts."""

    @staticmethod
    def accepted(lung: Lung, system: System, target: Target, atlas: la.Atlas) -> bool:
        try:
            found = next(la.plan(lung, system, target, atlas=atlas, iterations=0, goal="default"))
        except la.NoPlan:
            return False
        report = la.check(found, lung, system)
        assert report.accepted, [f.name for f in report.findings if not f.ok]
        return True

    def test_the_least_tightening_and_no_less(self, small_lung: Lung, atlas_of: Any) -> None:
        """Three targets: a plan with the named radius, none with a radius 3 mm larger."""
        seen = 0
        for target in random_targets(small_lung, 25, 0):
            try:
                list(
                    la.plan(small_lung, SYSTEM, target, atlas=atlas_of(SYSTEM), iterations=0, goal="default")
                )
            except la.NoPlan as error:
                named = [
                    (float(re.search(r"curvature of (\d+) mm instead of 121 mm", change)[1]), made)
                    for change, made in error.counterfactuals.items()
                    if "curvature" in change
                ]
                if not named:
                    continue
                radius, made = named[0]
                assert la.check(made, small_lung).accepted
                assert made.system.needle.min_radius_of_curvature_mm == pytest.approx(radius)
                for r, reaches in ((radius, True), (radius + 3.0, False)):
                    needle = replace(SYSTEM.needle, max_curvature_per_mm=1 / r)
                    system = replace(SYSTEM, needle=needle)
                    assert self.accepted(small_lung, system, target, atlas_of(SYSTEM)) == reaches
                seen += 1
                if seen == 3:
                    break
        assert seen == 3

    def test_thinner_needles_and_scopes_and_crossing_a_fissure(self, small_lung: Lung, atlas_of: Any) -> None:
        seen = set()
        for target in random_targets(small_lung, 60, 0):
            if seen >= {"needle", "fissure"}:
                break
            try:
                list(la.plan(small_lung, THICK, target, atlas=atlas_of(THICK), iterations=0, goal="default"))
            except la.NoPlan as error:
                for change, made in error.counterfactuals.items():
                    seen.add("needle" if "needle" in change else "scope")
                    assert la.check(made, small_lung).accepted, change
                    assert made.system != THICK
                if "--allow-fissures" in error.advice:
                    seen.add("fissure")
                    system = replace(THICK, fissures_allowed=True)
                    assert self.accepted(small_lung, system, target, atlas_of(system))
        assert seen >= {"needle", "fissure"}

    def test_a_thinner_scope(self, small_lung: Lung) -> None:
        """The named diameter gives a plan, whose motion a scope a tenth thicker cannot follow."""
        thick = replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=4.5))
        atlas = la.build_atlas(small_lung, thick, **COARSE)
        for target in random_targets(small_lung, 40, 1):
            try:
                list(la.plan(small_lung, thick, target, atlas=atlas, iterations=0, goal="default"))
            except la.NoPlan as error:
                changes = [change for change in error.counterfactuals if "bronchoscope" in change]
                if not changes:
                    continue
                made = error.counterfactuals[changes[0]]
                assert la.check(made, small_lung).accepted
                needed = made.system.scope.outer_diameter_mm
                assert f"diameter of {needed:g} mm instead of 4.5 mm" in changes[0]
                motion = scope_motion(made)
                assert isinstance(prover_of(small_lung, made.system.scope).prove(motion), float)
                thicker = replace(thick.scope, outer_diameter_mm=needed + 0.11)
                assert isinstance(prover_of(small_lung, thicker).prove(motion), str)
                return
        raise AssertionError("no target needed a thinner scope")

    def test_changes_are_named_smallest_first(self, small_lung: Lung, atlas_of: Any) -> None:
        for target in random_targets(small_lung, 25, 0):
            try:
                list(
                    la.plan(small_lung, SYSTEM, target, atlas=atlas_of(SYSTEM), iterations=0, goal="default")
                )
            except la.NoPlan as error:
                shares = []
                for change in error.counterfactuals:
                    needed, present = map(float, re.findall(r"([\d.]+) mm", change))
                    shares.append(abs(needed - present) / present)
                assert shares == sorted(shares)
                first = next(iter(error.counterfactuals), "")
                assert not first or error.advice.lower().startswith(first)


def test_reasons_cannot_be_changed() -> None:
    error = NoPlan("nothing found", reasons={"a": 1}, advice="wait")
    with pytest.raises(TypeError):
        error.reasons["a"] = 2  # type: ignore[index]
    assert str(error) == "nothing found. wait."
