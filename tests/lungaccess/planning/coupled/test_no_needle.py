"""A system without a needle: the tip of its tubes is at the target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.settings import override, parse, to_mapping
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.reach_scans import reach_scan
from lungaccess.plans.parts import NeedleArc, NeedlePath
from lungaccess.problem.preset_order import invasiveness
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import point_target
from stages.needle import DIRECT, UNREACHED

OFF_MM = np.array([0.7, -0.9, 0.5])
"""So far from tips of the atlas lie the targets: not where the enumeration ends."""


@pytest.fixture(scope="module")
def system() -> System:
    """Scope and tubes of a preset, the scope thin enough for a child's airways."""
    loaded = load_system("ultrathin")
    scope = replace(loaded.scope, outer_diameter_mm=2.0)
    return replace(loaded, name="tubes", scope=scope, needle=None, fissures_allowed=True)


@pytest.fixture(scope="module")
def atlas(small_lung: Lung, system: System) -> la.Atlas:
    return la.build_atlas(small_lung, system, rotations=12, stop_spacing_mm=4.0)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System, atlas: la.Atlas) -> list[list[la.Plan]]:
    """The better and better plans to points near some tips of the atlas."""
    found = []
    for entry in np.linspace(0, atlas.deployments.count - 1, 12).astype(int):
        try:
            target = point_target(small_lung, atlas.deployments.positions[entry] + OFF_MM)
            found.append(
                list(
                    la.plan(
                        small_lung,
                        system,
                        target,
                        atlas=atlas,
                        iterations=5,
                        counterfactuals=False,
                        goal="default",
                    )
                )
            )
        except la.LungaccessError:
            continue
    return found


def test_the_tip_of_the_tubes_is_at_the_target(
    small_lung: Lung, system: System, plans: list[list[la.Plan]]
) -> None:
    assert len(plans) >= 6
    for found in plans:
        plan = found[-1]
        assert plan.needle is None and set(plan.clearance_mm) == {"tube"}
        assert plan.tube.lps_from_tip[:3, 3] == pytest.approx(plan.target_lps, abs=1e-6)
        assert plan.costs["length_mm"] == pytest.approx(plan.tissue_mm)
        poses, lengths = plan.costed_poses()
        assert poses[0, :3, 3] == pytest.approx(plan.tube.exit.point_lps, abs=1e-6)
        assert poses[-1, :3, 3] == pytest.approx(plan.target_lps, abs=1e-6)
        assert lengths[-1] == pytest.approx(plan.tissue_mm)
        report = la.check(plan, small_lung, system=system, target_lps=plan.target_lps)
        assert report.accepted, report.refusals


@pytest.mark.slow
def test_plans_become_better_and_are_the_same_again(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    assert any(len(found) > 1 for found in plans)
    for found in plans:
        costs = [plan.cost for plan in found]
        assert costs == sorted(costs, reverse=True)
    last = plans[0][-1]
    again = la.plan(
        small_lung,
        system,
        point_target(small_lung, last.target_lps),
        atlas=atlas,
        iterations=5,
        goal="default",
    )
    assert [plan.digest for plan in again] == [plan.digest for plan in plans[0]]


def test_a_plan_is_the_same_after_it_was_saved(tmp_path: Path, plans: list[list[la.Plan]]) -> None:
    plan = plans[0][0]
    plan.save(tmp_path / "plan.json")
    assert la.Plan.load(tmp_path / "plan.json").digest == plan.digest
    assert '"needle": null' in (tmp_path / "plan.json").read_text()


def test_a_wrong_end_and_a_wrong_needle_are_refused(small_lung: Lung, plans: list[list[la.Plan]]) -> None:
    plan = plans[0][0]

    def refusals(changed: la.Plan) -> set[str]:
        return {finding.name for finding in la.check(changed, small_lung).refusals}

    aside = plan.tube.lps_from_tip[:3, 0]
    missed = replace(plan, target_lps=plan.target_lps + 0.01 * aside)
    assert refusals(missed) == {"target.reached", "tube.at_target"}
    shorter = replace(plan, tube=replace(plan.tube, inner_insertion_mm=plan.tube.inner_insertion_mm - 0.01))
    assert {"tube.arcs.length"} <= refusals(shorter)
    arc = NeedleArc(length_mm=1.0, roll_rad=0.0, curvature_per_mm=0.0)
    needle = NeedlePath(
        lps_from_start=plan.tube.lps_from_tip,
        arcs=(arc,),
        end_lps=plan.target_lps,
        length_mm=1.0,
        max_angle_from_start_rad=0.0,
        accumulated_turn_rad=0.0,
    )
    assert "needle.present" in refusals(replace(plan, needle=needle))
    exempt = replace(plan, exemption=replace(plan.exemption, needle_length_mm=5.0))
    assert "exemption.length" in refusals(exempt)
    cheaper = replace(plan, costs={**plan.costs, "inverse_clearance": 0.5 * plan.costs["inverse_clearance"]})
    assert "costs.inverse_clearance" in refusals(cheaper)
    with_needle = replace(plan, system=replace(plan.system, needle=load_system("ultrathin").needle))
    assert "needle.present" in refusals(with_needle)


@pytest.mark.slow
def test_no_plan_says_how_near_the_tip_comes(small_lung: Lung, system: System, atlas: la.Atlas) -> None:
    tips = atlas.deployments.positions
    free = np.argwhere(small_lung.labels == 0)[::97]
    points = small_lung.grid.lps(free)
    away = np.array([np.linalg.norm(tips - point, axis=1).min() for point in points])
    far = points[np.argsort(away)[-len(points) // 4]]
    nearest = np.linalg.norm(tips - far, axis=1).min()
    with pytest.raises(la.NoPlan, match=f"within {nearest:.1f} mm of the target") as caught:
        next(
            la.plan(
                small_lung,
                system,
                point_target(small_lung, far),
                atlas=atlas,
                counterfactuals=False,
                goal="default",
            )
        )
    assert "needle" in caught.value.advice
    assert caught.value.reasons["tube: scope tips with a deployment that ends near the target"] == 0


def test_what_needs_a_needle_says_so(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    target = point_target(small_lung, plans[0][0].target_lps)
    for options in ({"method": "kuntz2015"}, {"method": "reference"}, {"needle_planner": "rrt"}):
        with pytest.raises(SettingsError, match="needs a needle"):
            la.plan(small_lung, system, target, atlas=atlas, goal="default", **options)


def test_straight_or_single_tubes_need_a_needle(system: System) -> None:
    with pytest.raises(SettingsError, match=r"the table \[needle\]"):
        replace(load_system("stylet-needle"), needle=None)
    mapping = {**to_mapping(system), "needle": {"diameter": 1.0}}
    with pytest.raises(SettingsError, match="did you mean diameter_mm"):
        parse(System, mapping, "my.toml")
    assert override(system, {"name": "again"}).needle is None


def test_the_track_of_a_system_without_a_needle_is_that_of_its_inner_tube(system: System) -> None:
    with_needle = replace(system, needle=load_system("ultrathin").needle)
    assert invasiveness(with_needle) < invasiveness(system)
    assert system.stages == ("scope", "tube") and with_needle.stages == ("scope", "tube", "needle")


def test_a_point_is_reached_where_there_is_a_plan(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    scan = reach_scan(atlas)
    points = np.array([found[0].target_lps for found in plans])
    found = scan.reach(points, np.zeros(len(points), dtype=np.uint64))
    assert (found.kinds == DIRECT).all()
    assert (found.clearance_mm > 0.0).all() and (found.cost > 0.0).all()
    far = small_lung.grid.lps(np.argwhere(small_lung.labels == 0)[:1])
    if np.linalg.norm(atlas.deployments.positions - far, axis=1).min() > 10.0:
        assert scan.reach(far, np.zeros(1, dtype=np.uint64)).kinds[0] >= UNREACHED


def test_alternatives_are_separated_and_accepted(
    small_lung: Lung, system: System, atlas: la.Atlas, plans: list[list[la.Plan]]
) -> None:
    target = point_target(small_lung, plans[0][0].target_lps)
    found = la.alternatives(
        small_lung, system, target, atlas=atlas, count=3, separation_mm=1.0, goal="default"
    )
    lines = [each.plan.costed_poses()[0][:, :3, 3] for each in found]
    for n, line in enumerate(lines):
        assert la.check(found[n].plan, small_lung).accepted
        for other in lines[:n]:
            away = np.linalg.norm(line[:, None] - other[None], axis=2)
            assert max(away.min(axis=0).max(), away.min(axis=1).max()) > 0.9


def test_the_risk_has_only_errors_of_scope_tubes_and_target(
    small_lung: Lung, plans: list[list[la.Plan]]
) -> None:
    plan = plans[0][-1]
    report = la.assess(plan, small_lung, samples=500)
    assert not any(name.startswith("needle") for name in report.alone)
    none = la.ErrorModel()
    exact = la.assess(plan, small_lung, model=none, samples=20)
    assert exact.miss_mm[0.95] < 1e-6 and exact.succeeds.value == 1.0
    assert exact.miss_mm[0.5] < report.miss_mm[0.5]
