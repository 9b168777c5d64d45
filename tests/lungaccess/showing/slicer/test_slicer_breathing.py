"""The breathing scene for 3D Slicer: transforms that ITK reads back move places where we have them."""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import SimpleITK

from anatomy.lung import Lung
from lungaccess.judging.checking import CheckReport
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer import export, export_slicer
from lungaccess.showing.slicer.breathing import MOVERS
from lungaccess.uncertainty.breathing.moving import Moving

PHASE = 0.3
FILES = {"tissue": "tissue_0300.nrrd", "devices": "devices_0300.tfm"}


@pytest.fixture(scope="module")
def plan(toy_plan: Plan, breathing_lung: Lung) -> Plan:
    return replace(toy_plan, lung_key=breathing_lung.key)


@pytest.fixture(scope="module")
def folder(plan: Plan, breathing_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("breathing") / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(export, "check", lambda *_: CheckReport(accepted=True, findings=()))
        written = export_slicer(plan, breathing_lung, folder)
    assert set(written.files) == {path.name for path in folder.iterdir()}
    for mover in MOVERS:
        with zipfile.ZipFile(folder / mover.bundle) as bundle:
            bundle.extractall(folder.parent)
    return folder


def data(folder: Path, key: str) -> Path:
    return folder.parent / f"breathing_{key}" / "Data"


def test_the_field_leads_from_a_phase_back_to_the_masks(
    folder: Path, plan: Plan, breathing_lung: Lung
) -> None:
    """As ITK has it: the transform takes a place in the phase to that of the masks."""
    image = SimpleITK.ReadImage(str(data(folder, "tissue") / FILES["tissue"]), SimpleITK.sitkVectorFloat64)
    transform = SimpleITK.DisplacementFieldTransform(image)
    places = breathing_lung.tree.points_lps[::7]
    moved = Moving.of(plan, breathing_lung).moved(places, PHASE)
    back = np.array([transform.TransformPoint(each) for each in moved.tolist()])
    assert np.abs(back - places).max() < 0.1
    assert np.linalg.norm(moved - places, axis=1).max() > 1.0


def test_the_devices_go_with_the_tip(folder: Path, plan: Plan, breathing_lung: Lung) -> None:
    transform = SimpleITK.ReadTransform(str(data(folder, "devices") / FILES["devices"]))
    points = plan.curves().needle.points_lps
    carried = Moving.of(plan, breathing_lung).carried(points, PHASE)
    back = np.array([transform.TransformPoint(each) for each in carried.tolist()])
    assert np.abs(back - points).max() < 1e-6


def test_a_sequence_names_a_transform_for_every_phase(folder: Path) -> None:
    for mover in MOVERS:
        root = folder.parent / f"breathing_{mover.key}"
        nodes: dict[str, Any] = {
            each.attrib["id"]: each for each in ElementTree.parse(root / f"{root.name}.mrml").getroot()
        }
        index = nodes["vtkMRMLSequenceNodeSequenceIndex"]
        listed = [each.split(":") for each in index.get("indexValues").split(";")]
        assert [value for _node, value in listed] == [f"{n}" for n in range(0, 101, 10)]
        for node, value in listed:
            storage = nodes[node].get("references").removeprefix("storage:").rstrip(";")
            name = nodes[storage].get("fileName")
            assert (root / name).is_file()
            assert f"_{10 * int(value):04d}." in name


def test_the_scene_moves_what_breathes(folder: Path) -> None:
    """Every reference is to a node of the scene, and only the start region has no transform."""
    nodes = list(ElementTree.parse(folder / "breathing.mrml").getroot())
    known = {node.get("id") for node in nodes}
    for node in nodes:
        for name in re.findall(r":(\w+);", node.get("references") or ""):
            assert name in known
        if node.get("fileName"):
            assert (folder / str(node.get("fileName"))).is_file()
    moved = {str(node.get("name")): str(node.get("references")) for node in nodes if node.tag == "Model"}
    assert "transform:vtkMRMLLinearTransformNode1;" in moved["needle surface"]
    assert "transform:vtkMRMLGridTransformNode1;" in moved["vessel"]
    assert "transform:vtkMRMLGridTransformNode1;" in moved["scope surface"]
    (browser,) = (node for node in nodes if node.tag == "SequenceBrowser")
    assert browser.get("selectedItemNumber") == "10"
    still = ElementTree.parse(folder / "scene.mrml").getroot()
    assert not any("transform:" in (node.get("references") or "") for node in still)
