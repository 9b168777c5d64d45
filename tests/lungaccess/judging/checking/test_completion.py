"""Bare motions of another planner: completed by the check, accepted if sound, refused if tampered with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lungaccess.judging.checking import Checker, Motions
from lungaccess.judging.checking.wall_exit import WALL_ANGLE_TOLERANCE_RAD
from lungaccess.plans.plan import Plan

Change = Callable[[Motions], Motions]


def _moved(pose: Any, by_mm: float) -> Any:
    other = np.array(pose)
    other[0, 3] += by_mm
    return other


def _longer(motions: Motions) -> Motions:
    first = motions.arcs[0]
    return replace(motions, arcs=(replace(first, length_mm=first.length_mm + 0.5), *motions.arcs[1:]))


TAMPERED: dict[str, tuple[Change, str]] = {
    "needle start": (
        lambda m: replace(m, lps_from_tube_tip=_moved(m.lps_from_tube_tip, 0.5)), "tube.tip.position",
    ),
    "scope tip": (
        lambda m: replace(m, lps_from_scope_tip=_moved(m.lps_from_scope_tip, 0.5)), "scope.tip.position",
    ),
    "longer arc": (_longer, "target.reached"),
    "turned tubes": (lambda m: replace(m, rotation_rad=m.rotation_rad + 1.0), "tube.tip"),
    "tubes out too far": (
        lambda m: replace(m, inner_insertion_mm=m.inner_insertion_mm + 70.0), "tube.extension",
    ),
    "outer beyond inner": (
        lambda m: replace(m, outer_insertion_mm=m.inner_insertion_mm + 5.0), "record.lengths",
    ),
    "entry elsewhere": (lambda m: replace(m, lps_from_entry=_moved(m.lps_from_entry, 9.0)), "scope.start"),
}  # fmt: skip


def motions_of(plan: Plan) -> Motions:
    """Return what a plan does, without what it states."""
    assert plan.needle is not None
    return Motions(
        lps_from_entry=plan.scope.lps_from_entry,
        states=plan.scope.states,
        lps_from_scope_tip=plan.scope.lps_from_scope_tip,
        rotation_rad=plan.tube.rotation_rad,
        outer_insertion_mm=plan.tube.outer_insertion_mm,
        inner_insertion_mm=plan.tube.inner_insertion_mm,
        shape=plan.tube.shape,
        lateral_sweep_mm=plan.tube.lateral_sweep_mm,
        follow_the_leader_error_mm=plan.tube.follow_the_leader_error_mm,
        lps_from_tube_tip=plan.tube.lps_from_tip,
        arcs=plan.needle.arcs,
    )


def test_bare_motions_of_a_plan_make_a_plan_that_is_accepted(lung: Any, plan: Plan) -> None:
    checker = Checker(lung)
    made = checker.completed(motions_of(plan), plan.system, plan.target_lps, method="stranger")
    report = checker.check(made, plan.system, target_lps=plan.target_lps)
    assert report.accepted, str(report)
    assert made.costs["inverse_clearance"] == pytest.approx(plan.costs["inverse_clearance"], rel=0.02)
    assert made.tube.exit.arc_length_mm == pytest.approx(plan.tube.exit.arc_length_mm, abs=0.02)


@pytest.mark.parametrize("name", TAMPERED)
def test_tampered_motions_are_refused_and_it_says_why(lung: Any, plan: Plan, name: str) -> None:
    change, finding = TAMPERED[name]
    checker = Checker(lung)
    made = checker.completed(change(motions_of(plan)), plan.system, plan.target_lps, method="stranger")
    report = checker.check(made, plan.system, target_lps=plan.target_lps)
    assert not report.accepted
    assert any(each.name.startswith(finding) for each in report.refusals), [
        str(each) for each in report.refusals
    ]


@pytest.mark.parametrize(("more_rad", "accepted"), [(0.1 * WALL_ANGLE_TOLERANCE_RAD, True), (0.06, False)])
def test_an_angle_to_the_wall_is_judged_as_exactly_as_the_check_knows_it(
    lung: Any, plan: Plan, more_rad: float, accepted: bool
) -> None:
    """Who states no angle is refused only where the planner's own angle would be, whatever it was."""
    checker = Checker(lung)
    made = checker.completed(motions_of(plan), plan.system, plan.target_lps, method="stranger")
    least_deg = float(np.rad2deg(made.tube.exit.wall_angle_rad + more_rad))
    tubes = replace(plan.system.tubes, min_wall_angle_deg=least_deg)
    system = replace(plan.system, name="steep exits alone", tubes=tubes)
    steep = checker.completed(motions_of(plan), system, plan.target_lps, method="stranger")
    report = checker.check(steep, system, target_lps=plan.target_lps)
    assert report.accepted == accepted, str(report)
    if not accepted:
        assert any(each.name.startswith("tube.exit.angle") for each in report.refusals)
