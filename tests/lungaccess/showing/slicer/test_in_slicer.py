"""3D Slicer's own classes load what is exported: places, sides, names, colours; a mirror image is seen."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh

from anatomy.io.centerlines import read_centerlines
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer.export import PROVED_COLOUR, STEP_MM, STRUCTURES, TRIED_COLOUR
from lungaccess.showing.slicer.models import SEGMENTS, TARGET_COLOUR, label_map
from lungaccess.uncertainty.breathing.moving import Moving
from tests.lungaccess.showing.slicer.slicer_scene import (
    SlicerScene,
    control_points_lps,
    model_points_lps,
    moved_lps,
    rotations_lps,
    segments,
)

pytestmark = pytest.mark.skipif(
    find_spec("slicer") is None, reason="slicer-core, 3D Slicer's own classes, is not installed"
)
TOLERANCE_MM = 1e-3
DEVICES = ("scope", "tubes", "needle")
BODIES = {"start region proved": PROVED_COLOUR, "start region tried": TRIED_COLOUR}


@pytest.fixture(scope="module")
def scene(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> SlicerScene:
    return SlicerScene(exported / "scene.mrml", tmp_path_factory.mktemp("scratch"))


@pytest.fixture(scope="module")
def breathing(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> SlicerScene:
    return SlicerScene(exported / "breathing.mrml", tmp_path_factory.mktemp("breathing"))


def curves_lie_where_planned(scene: SlicerScene, plan: Plan, lung: Lung, folder: Path) -> None:
    for name, curve in zip(DEVICES, plan.curves(STEP_MM), strict=True):
        node = scene.node(name, "MarkupsCurve")
        assert np.abs(control_points_lps(node) - curve.points_lps).max() < TOLERANCE_MM, name
        assert np.abs(rotations_lps(node) - curve.lps_from_device[:, :3, :3]).max() < 1e-6, name
        assert abs(node.GetCurveLengthWorld() - curve.arc_length_mm[-1]) < 0.02, name


def points_lie_where_planned(scene: SlicerScene, plan: Plan, lung: Lung, folder: Path) -> None:
    node = scene.node("points", "MarkupsFiducial")
    labels = [node.GetNthControlPointLabel(n) for n in range(node.GetNumberOfControlPoints())]
    found = dict(zip(labels, control_points_lps(node), strict=True))
    expected = {
        "scope tip": plan.scope.lps_from_scope_tip[:3, 3],
        "tube tip": plan.tube.lps_from_tip[:3, 3],
        "exit through the wall": plan.tube.exit.point_lps,
        "target": plan.target_lps,
    }
    assert set(found) == set(expected)
    for label, place in expected.items():
        assert np.abs(found[label] - place).max() < TOLERANCE_MM, label


def models_lie_where_written(scene: SlicerScene, plan: Plan, lung: Lung, folder: Path) -> None:
    names = {f"{name} surface": f"{name}.ply" for name in DEVICES} | {n: f"{n}.ply" for n in STRUCTURES}
    for name, file in names.items():
        vertices = trimesh.load(folder / file, process=False).vertices
        points = model_points_lps(scene.node(name, "Model"))
        assert np.abs(points.mean(axis=0) - vertices.mean(axis=0)).max() < TOLERANCE_MM, name
        assert np.abs(points.max(axis=0) - vertices.max(axis=0)).max() < TOLERANCE_MM, name
    tree = scene.node("airway tree", "Model")
    points = model_points_lps(tree)
    assert np.abs(points.max(axis=0) - lung.tree.points_lps.max(axis=0)).max() < TOLERANCE_MM
    assert np.abs(points.min(axis=0) - lung.tree.points_lps.min(axis=0)).max() < TOLERANCE_MM
    data = tree.GetPolyData().GetPointData()
    assert {"Radius", "Generation", "Branch"} <= {
        data.GetArrayName(n) for n in range(data.GetNumberOfArrays())
    }
    assert data.GetArray("Radius").GetRange()[1] == pytest.approx(float(lung.tree.radius_mm.max()), rel=1e-5)
    assert len(read_centerlines(folder / "airway_tree.vtp").points_lps) == len(lung.tree.points_lps)


def segments_hold_their_voxels(scene: SlicerScene, plan: Plan, lung: Lung, folder: Path) -> None:
    labels, found = label_map(lung), segments(scene.node("anatomy", "Segmentation"))
    written = {each.name: each for each in SEGMENTS if (labels.array == each.value).any()}
    assert set(found) == set(written)
    for name, (_segment, centres) in found.items():
        expected = lung.grid.lps(np.argwhere(labels.array == written[name].value))
        assert len(centres) == len(expected), name
        for of in (np.min, np.max, np.mean):
            assert np.abs(of(centres, axis=0) - of(expected, axis=0)).max() < TOLERANCE_MM, name


PLACES = (
    curves_lie_where_planned,
    points_lie_where_planned,
    models_lie_where_written,
    segments_hold_their_voxels,
)


@pytest.mark.parametrize("compared", PLACES)
def test_3d_slicer_has_everything_in_its_place(
    compared: Callable[..., None], scene: SlicerScene, exported: Path, small_plan: Plan, breathing_lung: Lung
) -> None:
    compared(scene, small_plan, breathing_lung, exported)


def test_a_mirrored_export_is_seen(
    exported: Path, small_plan: Plan, breathing_lung: Lung, tmp_path: Path
) -> None:
    """The same numbers, said to be RAS, are the mirror image that the comparisons have to find."""
    folder = tmp_path / "mirrored"
    shutil.copytree(exported, folder)
    for path in folder.iterdir():
        content = path.read_bytes()
        content = content.replace(b'"coordinateSystem": "LPS"', b'"coordinateSystem": "RAS"')
        content = content.replace(b"comment SPACE=LPS", b"comment SPACE=RAS")
        content = content.replace(b"space: left-posterior-superior", b"space: right-anterior-superior")
        path.write_bytes(content)
    mirrored = SlicerScene(folder / "scene.mrml", tmp_path / "scratch")
    for compared in PLACES:
        with pytest.raises(AssertionError):
            compared(mirrored, small_plan, breathing_lung, folder)


def test_the_patients_left_is_on_the_left_of_the_screen(
    scene: SlicerScene, breathing_lung: Lung, small_plan: Plan
) -> None:
    """3D Slicer's R grows to the right: what lies at x > 0 in LPS has a negative R."""
    side = np.sign(small_plan.target_lps[0])
    node = scene.node("points", "MarkupsFiducial")
    shown = node.GetNthControlPointPosition(node.GetNumberOfControlPoints() - 1)
    assert np.sign(shown[0]) == -side != 0.0
    centres = segments(scene.node("anatomy", "Segmentation"))["nodule"][1]
    assert np.linalg.norm(centres - small_plan.target_lps, axis=1).min() < 2.0


def test_names_colours_and_units(scene: SlicerScene, small_plan: Plan) -> None:
    import vtk

    colours = dict(zip(DEVICES, (c.colour for c in small_plan.curves()), strict=True)) | {
        "points": TARGET_COLOUR
    }
    for name, colour in colours.items():
        node = scene.node(name, "Markups")
        assert node.GetDisplayNode().GetSelectedColor() == pytest.approx(colour, abs=1e-6), name
        assert node.GetLocked() == 1
    for name, curve in zip(DEVICES, small_plan.curves(STEP_MM), strict=True):
        radius = scene.node(name, "MarkupsCurve").GetMeasurement("Radius")
        assert radius.GetUnits() == "mm"
        values = radius.GetControlPointValues()
        assert [values.GetValue(n) for n in range(values.GetNumberOfTuples())] == pytest.approx(
            curve.radius_mm.tolist()
        )
    models = {**{name: colour for name, (colour, _opacity) in STRUCTURES.items()}, **BODIES}
    names = scene.names("Model")
    assert {f"{name} surface" for name in DEVICES} | set(STRUCTURES) | {"airway tree"} <= names
    for name in names & set(models):
        assert scene.node(name, "Model").GetDisplayNode().GetColor() == pytest.approx(models[name], abs=1e-6)
    terms = {each.name: each for each in SEGMENTS}
    for name, (segment, _centres) in segments(scene.node("anatomy", "Segmentation")).items():
        assert segment.GetColor() == pytest.approx(terms[name].colour, abs=1e-6), name
        stored = vtk.reference("")
        assert segment.GetTag("TerminologyEntry", stored)
        assert str(stored) == terms[name].terminology, name


def test_the_breath_moves_tissue_and_devices(
    breathing: SlicerScene, small_plan: Plan, breathing_lung: Lung
) -> None:
    moving = Moving.of(small_plan, breathing_lung)
    for name in ("tissue", "devices"):
        sequence = breathing.node(f"breathing of the {name}", "Sequence")
        count = sequence.GetNumberOfDataNodes()
        assert [float(sequence.GetNthIndexValue(n)) for n in range(count)] == list(range(0, 101, 10))
        assert (sequence.GetIndexName(), sequence.GetIndexUnit()) == ("phase", "%")
    (name,) = breathing.names("SequenceBrowser")
    assert re.match("Breathing: ", name)
    browser = breathing.node(name, "SequenceBrowser")
    assert browser.GetNumberOfSynchronizedSequenceNodes(True) == 2
    phase, places = 0.3, breathing_lung.tree.points_lps[::150]
    item = breathing.node("breathing of the tissue", "Sequence").GetNthDataNode(3)
    expected = moving.moved(places, phase)
    assert np.linalg.norm(expected - places, axis=1).max() > 1.0
    # The field is stored every few millimetres and turned round by iteration.
    assert np.abs(moved_lps(item, places) - expected).max() < 0.1
    item = breathing.node("breathing of the devices", "Sequence").GetNthDataNode(3)
    points = small_plan.curves().needle.points_lps[::10]
    assert np.abs(moved_lps(item, points) - moving.carried(points, phase)).max() < TOLERANCE_MM
    tissue, devices = (breathing.node(f"breathing {each}") for each in ("tissue", "devices"))
    moved = {"vessel": tissue, "scope surface": tissue, "needle surface": devices, "tubes": devices}
    for name, transform in moved.items():
        node = breathing.node(name, "Model" if name in breathing.names("Model") else "Markups")
        assert node.GetParentTransformNode().GetID() == transform.GetID(), name
