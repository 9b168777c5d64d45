"""Targets: points with a stated frame, nodules, and every way of being wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import FrameError, TargetError
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from anatomy.structures import OUTSIDE, VESSEL
from lungaccess.problem.nodules import nodules_of as nodules_of_patient
from lungaccess.problem.nodules import target_words
from lungaccess.problem.target import nodule_target, point_target
from tests.stages.scenes import Canvas, nodules_of


@pytest.fixture(scope="module")
def lung() -> Lung:
    return make_lung()


def make_lung(**more: object) -> Lung:
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    canvas.add(canvas.points[..., 0] < -15, OUTSIDE)
    canvas.add(canvas.ball([10, 0, 0], 3.0), VESSEL)
    canvas.airway(canvas.ball([0, 10, 0], 3.0), canvas.ball([0, 10, 0], 4.0), 0)
    nodules = canvas.ball([0, 0, -10], 3.0) | canvas.ball([0, -12, 5], 2.0) | canvas.ball([0, 0, 14.0], 2.5)
    # The core of the third nodule is a vessel.
    canvas.add(canvas.ball([0, 0, 14.0], 1.2), VESSEL)
    return canvas.lung(**{"nodules": nodules_of(canvas, nodules), **more})


def test_a_point_states_its_frame(lung: Lung) -> None:
    assert la.resolve_target(lung, "lps:1,2,3").lps_mm.tolist() == [1.0, 2.0, 3.0]
    assert la.resolve_target(lung, "ras:1,2,3").lps_mm.tolist() == [-1.0, -2.0, 3.0]
    assert la.resolve_target(lung, "ras:1,2,3").origin == "point ras:1,2,3"


@pytest.mark.parametrize("text", ["1,2,3", "xyz:1,2,3", "ras:1,2", "ras:1,2,nan", "ras:a,b,c", ""])
def test_text_that_is_no_point_with_a_frame(lung: Lung, text: str) -> None:
    with pytest.raises(FrameError):
        la.resolve_target(lung, text)


@pytest.mark.parametrize(
    ("point", "where"),
    [
        ((-17.0, 0, 0), "outside the lung"),
        ((500.0, 0, 0), "outside the images"),
        ((10.0, 0, 1), "inside a vessel"),
        ((0.0, 10, 0), "inside an airway"),
        ((0.0, 10, 3.6), "inside an airway"),
    ],
)
def test_points_where_no_needle_may_end(lung: Lung, point: tuple[float, ...], where: str) -> None:
    with pytest.raises(TargetError, match=where):
        point_target(lung, np.array(point))
    with pytest.raises(TargetError, match=where):
        la.resolve_target(lung, "lps:" + ",".join(map(str, point)))


@pytest.mark.parametrize("point", [(np.nan, 0, 0), (np.inf, 0, 0), (1.0, 2.0), ((1.0, 2.0, 3.0),)])
def test_arrays_that_are_no_point(lung: Lung, point: object) -> None:
    with pytest.raises(TargetError, match="not a point"):
        point_target(lung, np.array(point, dtype=float))


@pytest.mark.parametrize(("typed", "meant"), [("lps:-17,0,0", "ras:-17,0,0"), ("ras:17, 0,0", "lps:17, 0,0")])
def test_a_target_in_the_wrong_frame_is_told_the_other_one(lung: Lung, typed: str, meant: str) -> None:
    with pytest.raises(TargetError, match=f"in {meant[:3].upper()} the same numbers lie inside") as caught:
        la.resolve_target(lung, typed)
    assert f"--target {meant}" in caught.value.remedy
    la.resolve_target(lung, meant)


def test_an_array_in_the_wrong_frame_is_told_so_too(lung: Lung) -> None:
    with pytest.raises(TargetError, match="with x and y negated it lies inside") as caught:
        point_target(lung, np.array([-17.0, 0.0, 0.0]))
    assert "LPS (17.0, 0.0, 0.0) = RAS (-17.0, 0.0, 0.0) mm" in caught.value.remedy


def test_a_target_outside_in_both_frames_hears_where_the_lungs_are(lung: Lung) -> None:
    with pytest.raises(TargetError, match="the box of the lung is LPS") as caught:
        la.resolve_target(lung, "lps:0,500,0")
    assert "the same numbers" not in str(caught.value)


def test_a_target_that_came_with_the_patient_has_a_name(lung: Lung) -> None:
    point = np.array([1.0, 2.0, 3.0])
    patient = replace(lung, targets_lps=(point,), target_names=("target1",))
    for text in ("target1", "Target1", "1"):
        assert la.resolve_target(patient, text).lps_mm.tolist() == point.tolist()
    with pytest.raises(TargetError, match="came with no target 'target2'.*one of target1"):
        la.resolve_target(patient, "target2")
    with pytest.raises(TargetError, match="it came without targets"):
        la.resolve_target(lung, "target1")


def test_a_target_is_a_copy_that_cannot_be_written(lung: Lung) -> None:
    point = np.array([1.0, 2.0, 3.0])
    target = point_target(lung, point)
    point[0] = 9.0
    assert target.lps_mm[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        target.lps_mm[0] = 2.0


def test_nodules_are_numbered_by_size(lung: Lung) -> None:
    assert np.linalg.norm(nodule_target(lung, 1).lps_mm - [0, 0, -10]) < 1.0
    assert np.linalg.norm(nodule_target(lung, 3).lps_mm - [0, -12, 5]) < 1.0
    assert nodule_target(lung, 1).origin == "nodule 1"
    assert np.array_equal(la.resolve_target(lung).lps_mm, nodule_target(lung, 1).lps_mm)
    assert la.resolve_target(lung, nodule=3).origin == "nodule 3"


def test_a_nodule_around_a_vessel_is_entered_beside_it(lung: Lung) -> None:
    target = nodule_target(lung, 2)
    assert lung.label_at(target.lps_mm) & VESSEL == 0
    assert lung.mask("nodule").array[tuple(np.rint(lung.grid.ijk(target.lps_mm)).astype(int))]
    assert 1.2 < np.linalg.norm(target.lps_mm - [0, 0, 14.0]) <= 2.6


@pytest.mark.parametrize("number", [-1, 4])
def test_a_nodule_that_is_not_there(lung: Lung, number: int) -> None:
    with pytest.raises(TargetError, match="from 1 to 3"):
        nodule_target(lung, number)


def test_a_patient_without_nodules() -> None:
    empty = Canvas.empty([-5, -5, -5], [5, 5, 5], 1.0)
    for lung in (make_lung(nodules=None), make_lung(nodules=nodules_of(empty, empty.ball([0, 0, 0], -1.0)))):
        with pytest.raises(TargetError, match="no nodule mask"):
            la.resolve_target(lung)


def test_a_nodule_that_is_all_vessel() -> None:
    canvas = Canvas.empty([-8, -8, -8], [8, 8, 8], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 3.0), VESSEL)
    with pytest.raises(TargetError, match="inside a vessel"):
        nodule_target(canvas.lung(nodules=nodules_of(canvas, canvas.ball([0, 0, 0], 2.0))), 1)


def test_the_nodules_of_the_phantom_are_where_it_grew_them(small_lung: Lung, small_phantom: Phantom) -> None:
    by_size = sorted(small_phantom.nodules, key=lambda nodule: -nodule.radius_mm)
    for number, nodule in enumerate(by_size, start=1):
        target = nodule_target(small_lung, number)
        assert np.linalg.norm(target.lps_mm - nodule.centre_lps) < 1.25


def test_a_nodule_is_called_by_its_label(lung: Lung) -> None:
    """Of two nodules that touch, each is one of its own; sizes do not change the labels."""
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    large, small = canvas.ball([0, 0, -10], 4.0), canvas.ball([0, 0, -4], 2.5)
    labels = np.where(large, 7, np.where(small, 2, 0)).astype(np.uint16)
    patient = replace(
        lung, nodules=nodules_of(canvas, large | small), nodule_labels=Volume(grid=lung.grid, array=labels)
    )
    assert [each.number for each in nodules_of_patient(patient)] == [2, 7]
    assert np.linalg.norm(nodule_target(patient, 2).lps_mm - [0, 0, -4]) < 1.5
    assert nodule_target(patient, 7).origin == "nodule 7" == la.resolve_target(patient).origin
    diameters = [each.diameter_mm for each in nodules_of_patient(patient)]
    assert diameters == pytest.approx([5.0, 8.0], rel=0.15)
    with pytest.raises(TargetError, match="one of the labels 2, 7"):
        nodule_target(patient, 1)


def test_a_target_is_put_in_words(lung: Lung) -> None:
    assert target_words(lung, nodule_target(lung, 1).lps_mm) == "nodule 1, 6 mm"
    assert target_words(lung, np.array([0.0, 0.0, 0.0])) == ""
