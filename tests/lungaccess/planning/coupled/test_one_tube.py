"""A system with one straight tube: a stylet through the wall, and the needle beyond it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.settings import override
from anatomy.lung import Lung
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import point_target
from stages.tube import ConcentricTubes, shapes_of


@pytest.fixture(scope="module")
def system() -> System:
    """The preset with a scope for a child's airways."""
    loaded = load_system("stylet-needle")
    scope = replace(loaded.scope, outer_diameter_mm=2.0)
    needle = replace(loaded.needle, max_curvature_per_mm=1.0 / 50.0)
    return replace(loaded, name="stylet", scope=scope, needle=needle, fissures_allowed=True)


@pytest.fixture(scope="module")
def atlas(small_lung: Lung, system: System) -> la.Atlas:
    return la.build_atlas(small_lung, system)


@pytest.fixture(scope="module")
def plans(small_lung: Lung, system: System, atlas: la.Atlas) -> list[la.Plan]:
    """Plans ahead of some deployments, 20 mm and 8 mm aside."""
    found = []
    for entry in np.linspace(0, atlas.deployments.count - 1, 30).astype(int):
        point = atlas.deployments.positions[entry] + 20.0 * atlas.deployments.tangents[entry]
        try:
            target = point_target(small_lung, point)
            made = la.plan(
                small_lung,
                system,
                target,
                atlas=atlas,
                seed=0,
                iterations=10,
                counterfactuals=False,
                goal="default",
            )
            found.append(next(made))
        except la.LungaccessError:
            continue
    return found


@pytest.mark.slow
def test_the_only_tube_goes_through_the_wall_and_the_needle_on(
    small_lung: Lung, system: System, plans: list[la.Plan]
) -> None:
    assert len(plans) >= 3
    for plan in plans:
        assert plan.tube.outer_insertion_mm == 0.0
        assert plan.insertions == f"tube {plan.tube.inner_insertion_mm:.1f} mm"
        along = plan.tube.lps_from_tip[:3, 3] - plan.scope.lps_from_scope_tip[:3, 3]
        assert np.linalg.norm(along) == pytest.approx(plan.tube.inner_insertion_mm, abs=1e-6)
        assert plan.scope.lps_from_scope_tip[:3, 2] @ along == pytest.approx(np.linalg.norm(along), abs=1e-6)
        report = la.check(plan, small_lung, system=system)
        assert report.accepted, report


@pytest.mark.slow
def test_a_plan_with_an_outer_tube_that_is_not_there_is_refused(
    small_lung: Lung, plans: list[la.Plan]
) -> None:
    plan = plans[0]
    report = la.check(replace(plan, tube=replace(plan.tube, outer_insertion_mm=2.0)), small_lung)
    assert "tube.outer_length" in {finding.name for finding in report.refusals}


@pytest.mark.slow
def test_a_plan_is_the_same_after_it_was_saved(tmp_path: Path, plans: list[la.Plan]) -> None:
    plans[0].save(tmp_path / "plan.json")
    assert la.Plan.load(tmp_path / "plan.json").system == plans[0].system


def test_a_straight_tube_is_looked_at_once_a_tip_and_insertion(atlas: la.Atlas) -> None:
    entries = atlas.deployments
    assert (entries.rotation_rad == 0.0).all()
    assert (entries.outer_mm == entries.inner_mm).all()
    assert len(np.unique(np.stack([entries.site, entries.inner_mm]), axis=1).T) == entries.count
    assert not any("protrude" in why for why in entries.refused)
    assert (shapes_of(atlas.system.tubes).least_determinant[entries.shape] > 0.99).all()


def test_a_curved_tube_may_be_alone(system: System) -> None:
    pair = load_system("ultrathin").tubes
    alone = replace(pair, outer=None)
    assert alone.outermost == pair.inner
    assert alone.overlap_curvature_per_mm == pair.inner.precurvature_per_mm
    assert isinstance(system.tubes, ConcentricTubes)


def test_the_only_tube_fits_into_the_channel(system: System) -> None:
    with pytest.raises(SettingsError, match=r"tubes\.inner\.outer_diameter_mm"):
        override(system, {"tubes.inner.outer_diameter_mm": 1.75, "tubes.max_channel_curvature_per_mm": 0.0})
