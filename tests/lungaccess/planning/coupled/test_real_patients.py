"""The main job on real anatomy: plans that the check accepts, or reasons that are true."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy import structures
from anatomy.grid import transform_points
from anatomy.lung import Lung
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from stages.needle.path import ArcPath

pytestmark = [pytest.mark.data, pytest.mark.slow]

ITERATIONS = 300
RESAMPLE_MM = 0.02


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lungs")


@pytest.fixture(scope="module")
def patient2(data_dir: Path, cache: Path) -> Lung:
    return la.load_patient(data_dir / "med-rad" / "Patient2", cache=cache)


@pytest.fixture(scope="module")
def plan2(patient2: Lung) -> la.Plan:
    *_, best = la.plan(
        patient2,
        la.load_system("thin-scope"),
        la.resolve_target(patient2),
        iterations=ITERATIONS,
        goal="default",
    )
    return best


def moved(plan: la.Plan, lps_from_lps: Any) -> la.Plan:
    """Return a plan whose every point and pose is mapped by a 4x4 matrix."""
    point, pose = (lambda p: transform_points(lps_from_lps, p)), (lambda t: lps_from_lps @ t)
    return replace(
        plan,
        target_lps=point(plan.target_lps),
        scope=replace(
            plan.scope,
            lps_from_entry=pose(plan.scope.lps_from_entry),
            lps_from_scope_tip=pose(plan.scope.lps_from_scope_tip),
        ),
        tube=replace(
            plan.tube,
            lps_from_tip=pose(plan.tube.lps_from_tip),
            exit=replace(plan.tube.exit, point_lps=point(plan.tube.exit.point_lps)),
        ),
        needle=replace(
            plan.needle, lps_from_start=pose(plan.needle.lps_from_start), end_lps=point(plan.needle.end_lps)
        ),
        exemption=replace(plan.exemption, exit_point_lps=point(plan.exemption.exit_point_lps)),
    )


def needle_samples(plan: la.Plan) -> tuple[Any, Any]:
    """Return points and path lengths of the needle, 0.02 mm apart."""
    arcs = [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in plan.needle.arcs]
    return ArcPath(lps_from_start=plan.needle.lps_from_start, arcs=np.array(arcs)).sample(RESAMPLE_MM)


def test_patient2_nodule_has_a_plan_that_the_check_accepts(patient2: Lung, plan2: la.Plan) -> None:
    report = la.check(
        plan2, patient2, la.load_system("thin-scope"), target_lps=la.resolve_target(patient2).lps_mm
    )
    assert report.accepted, str(report)
    nodule = patient2.mask("nodule")
    voxel = np.floor(nodule.grid.ijk(plan2.needle.end_lps) + 0.5).astype(int)
    assert nodule.array[tuple(voxel)]


def test_patient2_needle_keeps_its_clearance_at_every_fiftieth_of_a_millimetre(
    patient2: Lung, plan2: la.Plan
) -> None:
    points, lengths = needle_samples(plan2)
    required = plan2.required_clearance_mm["needle"]
    everything = structures.OBSTACLES | structures.FISSURE
    exempt = lengths < plan2.exemption.needle_length_mm
    for part, branch in ((exempt, plan2.exemption.branch), (~exempt, -1)):
        found = patient2.exact_clearance_mm(points[part], everything, cap_mm=2.0, exempt_branch=branch)
        assert found.min() >= required


def test_patient2_plan_in_another_place_is_refused(patient2: Lung, plan2: la.Plan) -> None:
    for axis in range(3):
        for sign in (1.0, -1.0):
            shift = np.eye(4)
            shift[:3, 3] = sign * patient2.grid.lps_from_ijk[:3, axis]
            assert not la.check(moved(plan2, shift), patient2).accepted
    assert not la.check(moved(plan2, np.diag([-1.0, 1.0, 1.0, 1.0])), patient2).accepted


def test_patient2_plan_is_refused_where_a_vessel_is_put_back(patient2: Lung, plan2: la.Plan) -> None:
    points, _ = needle_samples(plan2)
    for point in (points[0], points[len(points) // 2]):
        labels = np.array(patient2.labels, order="F")
        i, j, k = np.floor(patient2.grid.ijk(point) + 0.5).astype(int)
        labels[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2] |= structures.VESSEL
        assert not la.check(plan2, replace(patient2, labels=labels)).accepted


@pytest.mark.slow
def test_patient2_plan_is_the_same_again(patient2: Lung, plan2: la.Plan) -> None:
    *_, again = la.plan(
        patient2,
        la.load_system("thin-scope"),
        la.resolve_target(patient2),
        iterations=ITERATIONS,
        goal="default",
    )
    assert again.digest == plan2.digest
    assert replace(again, timing={}).to_json() == replace(plan2, timing={}).to_json()


def test_patient2_lies_in_its_frame(patient2: Lung) -> None:
    tree = patient2.tree
    left, right = sorted(tree.children(0), key=lambda b: -tree.points_lps[tree.branch_start[b + 1] - 1][0])
    carina = tree.carina_lps
    assert tree.points_lps[tree.branch_start[left + 1] - 1][0] > carina[0] + 20.0
    assert tree.points_lps[tree.branch_start[right + 1] - 1][0] < carina[0] - 10.0
    assert tree.branch_length_mm[left] > tree.branch_length_mm[right]


@pytest.mark.slow
@pytest.mark.parametrize("fissures_allowed", [False, True])
def test_patient1_nodule_is_reached_around_fissures_and_through_them(
    data_dir: Path, cache: Path, fissures_allowed: bool
) -> None:
    lung = la.load_patient(data_dir / "med-rad" / "Patient1", cache=cache)
    system = replace(la.load_system("thin-scope"), name="own", fissures_allowed=fissures_allowed)
    target = la.resolve_target(lung)
    *_, found = la.plan(lung, system, target, iterations=ITERATIONS, goal="default")
    assert la.check(found, lung, system, target_lps=target.lps_mm).accepted
    assert found.fissures_are_obstacles is not fissures_allowed
    least = found.least_required_clearance_mm("needle")
    assert fissures_allowed or found.clearance_mm["needle"]["fissure"] >= least


@pytest.mark.slow
@pytest.mark.parametrize("patient", ["Patient1", "Patient2"])
def test_random_peripheral_targets(data_dir: Path, cache: Path, patient: str) -> None:
    lung = la.load_patient(data_dir / "med-rad" / patient, cache=cache)
    system = la.load_system("thin-scope")
    atlas = la.build_atlas(lung, system)
    reached = 0
    for point in peripheral_targets(lung, 15, seed=1):
        try:
            plans = la.plan(
                lung, system, point_target(lung, point), atlas=atlas, iterations=50, goal="default"
            )
            for found in plans:
                report = la.check(found, lung, system, target_lps=point)
                assert report.accepted, str(report)
            reached += 1
        except la.NoPlan as failure:
            assert failure.reasons
    assert reached >= 10
