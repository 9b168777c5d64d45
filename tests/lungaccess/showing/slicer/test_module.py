"""The module for 3D Slicer, with its own classes of a scene; the widgets are stubs."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from anatomy.grid import Volume
from anatomy.io.images import read_volume, write_volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import shipped_names
from tests.lungaccess.showing.slicer.slicer_scene import SlicerScene

pytestmark = pytest.mark.slow
slicer: Any = pytest.importorskip("slicer")
FILE = Path(__file__).parents[4] / "packaging" / "slicer" / "LungAccess" / "LungAccess.py"


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Any:
    base = ModuleType("slicer.ScriptedLoadableModule")
    for name in ("ScriptedLoadableModule", "ScriptedLoadableModuleWidget", "ScriptedLoadableModuleLogic"):
        setattr(base, name, type(name, (), {"__init__": lambda self, *_: None}))
    monkeypatch.setitem(sys.modules, "slicer.ScriptedLoadableModule", base)
    spec = importlib.util.spec_from_file_location("LungAccess", FILE)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.fixture
def logic(module: Any, tmp_path: Path) -> Iterator[Any]:
    opened = SlicerScene(None, tmp_path / "scratch")
    yield module.LungAccessLogic(opened.scene, tmp_path / "session")


@pytest.fixture(autouse=True, scope="module")
def conversions() -> None:
    """Register what 3D Slicer registers at its start: how a labelmap is made and copied."""
    rules = slicer.vtkSegmentationConverterFactory.GetInstance()
    rules.RegisterConverterRule(slicer.vtkBinaryLabelmapToClosedSurfaceConversionRule())


def target(logic: Any, point_lps: np.ndarray) -> Any:
    node = logic.scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "nodule")
    node.AddControlPoint((point_lps * [-1.0, -1.0, 1.0]).tolist())
    return node


def anatomy(logic: Any, lung: Lung, folder: Path) -> Any:
    """Return a segmentation whose lungs hold vessels and airways, as those of 3D Slicer do."""
    lumen = lung.mask("lumen").array
    masks = {
        "Lungs": ~lung.mask("outside").array,
        "Airway lumen": lumen,
        "airway wall": lung.mask("airway").array & ~lumen,
        "vessels": lung.mask("vessel").array,
    }
    node = logic.scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "anatomy")
    for number, (name, mask) in enumerate(masks.items()):
        path = folder / f"{number}.seg.nrrd"
        write_volume(path, Volume(grid=lung.grid, array=mask))
        read = slicer.vtkMRMLSegmentationNode()
        storage = slicer.vtkMRMLSegmentationStorageNode()
        storage.SetFileName(str(path))
        assert storage.ReadData(read) == 1
        part = read.GetSegmentation()
        part.GetNthSegment(0).SetName(name)
        node.GetSegmentation().AddSegment(part.GetNthSegment(0), name)
    return node


def test_a_segmentation_becomes_a_plan_in_the_open_scene(
    logic: Any, small_lung: Lung, small_plan: Plan, tmp_path: Path
) -> None:
    logic.folder.mkdir()
    logic.scene.SetURL("/somewhere/own.mrml")
    said: list[str] = []
    text = logic.plan(
        volume=None,
        segmentation=anatomy(logic, small_lung, tmp_path),
        target=target(logic, small_plan.target_lps),
        device=small_plan.system.name,
        seconds=3,
        tell=said.append,
    )
    assert "Estimated to succeed in" in text and "advance" in text
    assert any("first clear plan" in line for line in said)
    found = Plan.load(logic.folder / "plan" / "plan.json")
    np.testing.assert_allclose(found.target_lps, small_plan.target_lps, atol=1e-3)
    nodes = [logic.scene.GetNthNode(n) for n in range(logic.scene.GetNumberOfNodes())]
    names = {node.GetName() for node in nodes if node.IsA("vtkMRMLMarkupsCurveNode")}
    assert {"scope", "tubes", "needle"} <= names
    assert logic.scene.GetURL() == "/somewhere/own.mrml"


def test_a_volume_is_written_as_the_ct_it_is(
    logic: Any, small_phantom: Phantom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logic.folder.mkdir()
    write_volume(tmp_path / "ct.nrrd", small_phantom.ct)
    node = logic.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "ct")
    storage = slicer.vtkMRMLVolumeArchetypeStorageNode()
    storage.SetFileName(str(tmp_path / "ct.nrrd"))
    assert storage.ReadData(node) == 1
    run: list[Any] = []
    monkeypatch.setattr(logic, "_run", lambda words, *_: run.append(words))
    assert logic._patient(node, None, print) == logic.folder / "patient"
    (words,) = run
    assert words[0] == "segment"
    written = read_volume(words[1])
    assert written.grid.is_close(small_phantom.ct.grid, 1e-3)
    np.testing.assert_array_equal(written.array, small_phantom.ct.array)


def test_what_is_missing_is_said(logic: Any, module: Any, small_lung: Lung, tmp_path: Path) -> None:
    logic.folder.mkdir()
    points = target(logic, np.zeros(3))
    with pytest.raises(ValueError, match="CT or a segmentation"):
        logic.plan(volume=None, segmentation=None, target=points, device="lung-default", seconds=1)
    node = anatomy(logic, small_lung, tmp_path)
    node.GetSegmentation().RemoveSegment(node.GetSegmentation().GetSegmentIdBySegmentName("vessels"))
    with pytest.raises(ValueError, match="no segment for vessels"):
        logic.plan(volume=None, segmentation=node, target=points, device="lung-default", seconds=1)
    assert set(module.DEVICES) <= set(shipped_names())


def test_the_panel_hands_on_what_is_chosen(module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    panel = module.LungAccessWidget()
    chosen = SimpleNamespace(currentNode=lambda: None)
    panel.volume = panel.segmentation = panel.target = chosen
    panel.button, panel.seconds = SimpleNamespace(enabled=True), SimpleNamespace(value=7)
    panel.device, panel.wheel = SimpleNamespace(currentText="ultrathin"), SimpleNamespace(text="")
    shown: list[str] = []
    panel.answer = SimpleNamespace(setPlainText=shown.append, append=shown.append)
    panel.logic = SimpleNamespace(
        install=lambda _w: None, plan=lambda **words: asked.append(words) or "a plan"
    )
    panel.plan()
    assert shown[-1] == "a plan" and panel.button.enabled
    assert asked[0]["device"] == "ultrathin" and asked[0]["seconds"] == 7

    def refuse(**_words: object) -> str:
        raise RuntimeError("no mask of vessels")

    panel.logic.plan = refuse
    panel.plan()
    assert shown[-1] == "no mask of vessels" and panel.button.enabled
