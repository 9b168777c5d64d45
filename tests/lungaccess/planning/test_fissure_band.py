"""Plans keep clear of the band of a fissure, or cross it with a stated chance; unknown is amber."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from scipy.special import ndtr

import lungaccess as la
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.build import build_lung
from anatomy.grid import Volume
from anatomy.lobes import LEAST_CHANCE, RIGHT_LOWER, RIGHT_UPPER, UNKNOWN
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from lungaccess.judging.appraisal.headline import Grade, Headline
from lungaccess.judging.checking import check
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import with_fissure_chance

SYSTEM = la.load_system("ultrathin")
SIGMA_MM, AHEAD_MM = 4.0, 3.0
"""Spread of the fissure's place, and how far beyond the target its border lies."""


def outward_from(target_lps: np.ndarray) -> np.ndarray:
    away = target_lps + [0.0, 0.0, 20.0]
    return np.asarray(away / np.linalg.norm(away))


def lung_with(
    phantom: Phantom, target_lps: np.ndarray, ahead_mm: float = AHEAD_MM, *, unknown: bool = False
) -> Lung:
    """Return the small lung with a flat border beyond the target and its band, or nothing known."""
    images = phantom.images
    grid = images.grid
    points = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3))
    height_mm = ((points - target_lps) @ outward_from(target_lps) - ahead_mm).reshape(grid.shape)
    chance = np.rint(100.0 * ndtr(-np.abs(height_mm) / SIGMA_MM))
    band = np.where(np.abs(height_mm) <= 1.96 * SIGMA_MM, np.clip(chance, LEAST_CHANCE, 49), 0)
    band = np.where(images.lung.array, UNKNOWN if unknown else band, 0).astype(np.uint8)
    lobes = np.where(height_mm > 0.0, RIGHT_UPPER, RIGHT_LOWER).astype(np.uint8)
    border = np.abs(height_mm) < 0.7
    return build_lung(
        replace(
            images,
            fissures=Volume(grid=grid, array=border & images.lung.array & (not unknown)),
            lobes=Volume(grid=grid, array=lobes),
            fissure_band=Volume(grid=grid, array=band),
        )
    )


@pytest.fixture(scope="module")
def target(small_lung: Lung) -> la.Target:
    return la.resolve_target(small_lung)


@pytest.fixture(scope="module")
def banded(small_phantom: Phantom, target: la.Target) -> Lung:
    return lung_with(small_phantom, target.lps_mm)


@pytest.fixture(scope="module")
def crossing(banded: Lung, target: la.Target) -> Plan:
    return planned(banded, target, max_fissure_chance=0.5)


def planned(lung: Lung, target: la.Target, **asked: float | bool | None) -> Plan:
    *_, best = la.plan(lung, SYSTEM, target, iterations=6, goal="length", **asked)  # type: ignore[arg-type]
    return best


def test_a_straight_path_crosses_with_the_chance_of_where_it_ends(banded: Lung, target: la.Target) -> None:
    """The border lies beyond the target: a path to there passes it if it lies nearer by that."""

    def chance(first_mm: float, last_mm: float) -> float | None:
        steps = np.linspace(first_mm, last_mm, 400)[:, None]
        return banded.fissure_chance(target.lps_mm + steps * outward_from(target.lps_mm))

    voxel = 0.1  # of a voxel of 1.25 mm, by which chances differ between neighbours
    for last_mm in (-4.0, 0.0, 2.0):
        exact = NormalDist().cdf((last_mm - AHEAD_MM) / SIGMA_MM)
        assert chance(-12.0, last_mm) == pytest.approx(exact, abs=voxel)
    assert chance(-12.0, AHEAD_MM + 12.0) == 1.0
    assert chance(-12.0, -6.0) == 0.0
    from_within = NormalDist().cdf(-1.0 / SIGMA_MM) - NormalDist().cdf(-5.0 / SIGMA_MM)
    assert chance(AHEAD_MM - 5.0, AHEAD_MM - 1.0) == pytest.approx(from_within, abs=voxel)


def test_a_fissure_may_be_crossed_with_a_chance_that_plan_and_check_state(
    banded: Lung, target: la.Target, crossing: Plan
) -> None:
    assert crossing.system.max_fissure_chance == 0.5 and not crossing.fissures_are_obstacles
    exact = NormalDist().cdf(-AHEAD_MM / SIGMA_MM)
    assert crossing.fissure_chance == pytest.approx(exact, abs=0.1)
    report = check(crossing, banded, target_lps=target.lps_mm)
    assert report.accepted, str(report)
    found = {each.name: each for each in report.findings}
    assert found["fissure.chance"].value == pytest.approx(crossing.fissure_chance, abs=0.03)
    assert found["fissure.chance"].limit == 0.5
    assert dict(crossing.figures())["chance of crossing a fissure"].endswith(" %")
    assert "fissure crossed in" in Headline.of(report, None).geometry_words
    assert Plan.from_json(crossing.to_json()).fissure_chance == crossing.fissure_chance


def test_the_check_refuses_a_chance_that_is_not_true_and_one_that_is_too_great(
    banded: Lung, crossing: Plan
) -> None:
    def refused(plan: Plan) -> set[str]:
        return {each.name for each in check(plan, banded).refusals}

    assert "fissure.chance.stated" in refused(replace(crossing, fissure_chance=0.01))
    assert "fissure.chance.known" in refused(replace(crossing, fissure_chance=None))
    strict = with_fissure_chance(SYSTEM, 0.05)
    assert "fissure.chance" in refused(replace(crossing, system=strict))


def test_no_plan_crosses_with_more_chance_than_is_allowed(banded: Lung, target: la.Target) -> None:
    with pytest.raises(la.NoPlan):
        planned(banded, target, max_fissure_chance=0.04)


def test_without_permission_the_band_is_kept_clear_of(
    small_phantom: Phantom, banded: Lung, target: la.Target
) -> None:
    """A target in the band is not reached, and one that is 6 mm before it is."""
    with pytest.raises(la.NoPlan):
        planned(banded, target)
    far = lung_with(small_phantom, target.lps_mm, 14.0)
    plan = planned(far, target)
    assert plan.fissures_are_obstacles and plan.fissure_chance == 0.0
    assert check(plan, far).accepted and plan.fissure_words == "under 3 %"


def test_lung_of_which_no_fissure_is_known_is_never_accepted_alone(
    small_phantom: Phantom, target: la.Target
) -> None:
    unknown = lung_with(small_phantom, target.lps_mm, unknown=True)
    plan = planned(unknown, target)
    assert plan.fissure_chance is None
    report = check(plan, unknown)
    assert report.accepted and "patient.fissures" in [each.name for each in report.unchecked]
    headline = Headline.of(report, None)
    assert headline.geometry_grade == Grade.UNKNOWN and "nobody knows" in headline.geometry_words
    with pytest.raises(la.NoPlan):
        planned(unknown, target, max_fissure_chance=1.0)


def test_a_chance_needs_a_band_and_the_permission_to_cross(small_lung: Lung, target: la.Target) -> None:
    with pytest.raises(AnatomyError, match="segment the CT again"):
        planned(small_lung, target, max_fissure_chance=0.2)
    with pytest.raises(SettingsError, match="max_fissure_chance"):
        replace(with_fissure_chance(SYSTEM, 0.2), fissures_allowed=False)
