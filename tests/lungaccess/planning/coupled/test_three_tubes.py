"""Three tubes turned one against the other: from the atlas to a plan, its check, risk, page and export."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.refinement import refine
from lungaccess.plans.assemble import assemble
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task
from lungaccess.showing.report.html import PageOptions, plan_page
from lungaccess.showing.report.html.deployment import packed_plan
from lungaccess.showing.report.pack import unpack
from lungaccess.showing.slicer import export_slicer
from lungaccess.uncertainty.risk import assess
from stages.tube import ConcentricTubes, Tube
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def system() -> System:
    """Two curved tubes in a third, all thin enough for the channel."""
    loaded = two_curved_tubes()

    def tube(outer_mm: float, inner_mm: float, length_mm: float, curved_mm: float, radius_mm: float) -> Tube:
        return Tube(
            outer_diameter_mm=outer_mm,
            inner_diameter_mm=inner_mm,
            length_mm=length_mm,
            curved_length_mm=curved_mm,
            precurvature_per_mm=1.0 / radius_mm,
        )

    tubes = ConcentricTubes(
        outer=tube(1.4, 1.25, 600.0, 20.0, 90.0),
        middle=tube(1.15, 1.0, 640.0, 25.0, 70.0),
        inner=tube(0.9, 0.75, 690.0, 40.0, 50.0),
        max_extension_mm=20.0,
        max_strain=0.08,
    )
    return replace(loaded, name="three curved tubes", tubes=tubes)


@pytest.fixture(scope="module")
def atlas(small_lung: Lung, system: System) -> la.Atlas:
    return la.build_atlas(small_lung, system, **COARSE)


@pytest.fixture(scope="module")
def plan(small_lung: Lung, system: System, atlas: la.Atlas) -> la.Plan:
    """The first plan in which every tube ends at a place of its own."""
    entries = atlas.deployments
    for entry in np.linspace(0, entries.count - 1, 40).astype(int).tolist():
        point = entries.positions[entry] + 15.0 * entries.tangents[entry]
        try:
            found = la.plan(
                small_lung, system, point_target(small_lung, point), atlas=atlas, iterations=40,
                counterfactuals=False, goal="default",
            )  # fmt: skip
            best = list(found)[-1]
        except la.LungaccessError:
            continue
        if np.diff(best.tube.insertions_mm(system.tubes)).min() > 0.5:
            return best
    raise AssertionError("no plan has three tubes of different lengths")


def test_the_check_accepts_it_and_it_may_succeed(small_lung: Lung, system: System, plan: la.Plan) -> None:
    report = la.check(plan, small_lung, system=system)
    assert report.accepted, [str(each) for each in report.findings if not each.ok]
    assert set(plan.tube.shape.relative_rotations_rad) == {"outer", "middle", "inner"}
    risk = assess(plan, small_lung, samples=200, seed=0, each_kind=False)
    assert risk.succeeds.samples == 200 and 0 <= risk.succeeds.count <= 200


def test_refinement_moves_it_and_stays_proved(
    small_lung: Lung, system: System, atlas: la.Atlas, plan: la.Plan
) -> None:
    task = Task(lung=small_lung, system=system, target=point_target(small_lung, plan.target_lps))
    search = AtlasSearch(task, atlas)
    begun = next(step.candidate for step in search.steps() if step.candidate is not None)
    found = refine(task, begun)
    assert found is not None
    assert search.evaluator.evaluate(found) < search.evaluator.evaluate(begun)
    assert la.check(assemble(task, found, iteration=1, timing={}), small_lung).accepted


def test_page_and_export_show_each_tube_in_its_width(
    small_lung: Lung, system: System, plan: la.Plan, tmp_path: Path
) -> None:
    packed = packed_plan(plan, small_lung, "plan")
    tubes, inserted = packed["tubes"], plan.tube.insertions_mm(system.tubes)
    ends = [float(unpack(tubes[name])[-1]) for name in ("outer_mm", "middle_mm", "inner_mm")]
    assert ends == pytest.approx(inserted, abs=1e-4)
    assert [packed["radius_mm"][name] for name in ("outer", "middle", "inner")] == [0.7, 0.575, 0.45]
    assert set(np.unique(plan.curves().tubes.radius_mm)) == {0.45, 0.575, 0.7}
    plan_page(plan, small_lung, tmp_path / "report.html", PageOptions(risk_samples=20))
    assert (tmp_path / "report.html").stat().st_size > 100_000
    written = export_slicer(plan, small_lung, tmp_path / "slicer")
    assert written.report.accepted and (tmp_path / "slicer" / "scene.mrml").exists()
