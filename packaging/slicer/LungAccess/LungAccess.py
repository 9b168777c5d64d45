"""Plan access to a lung nodule inside 3D Slicer: a module whose panel runs lungaccess in its own process.

Add the folder of this file in *Edit, Application Settings, Modules, Additional module paths*, and restart.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import slicer
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleWidget,
)

PACKAGE = "lungaccess"
SEGMENTS = {
    "lumen": ("airway lumen", "airways", "lung_airways", "airway", "bronchi"),
    "wall": ("airway wall", "lung_airways_wall"),
    "vessels": ("vessel", "vessels", "lung_vessels", "pulmonary vessels"),
    "lung": ("lungs", "lung", "lung tissue", "right lung", "left lung"),
    "fissures": ("fissure", "fissures"),
    "nodule": ("nodule", "nodules", "lesion"),
}
"""Names of segments that stand for a mask, in lower case; a mask may have several segments."""
NEEDED = ("lumen", "vessels", "lung")
DEVICES = (
    "lung-default", "thin-scope", "ultrathin", "flexure-needle", "stylet-needle", "therapeutic-scope",
    "tubes-only",
)  # fmt: skip


class LungAccess(ScriptedLoadableModule):
    """What 3D Slicer shows of the module in its lists."""

    def __init__(self, parent: Any) -> None:
        super().__init__(parent)
        parent.title = "Lung access"
        parent.categories = ["Planning"]
        parent.contributors = ["the lungaccess authors"]
        parent.helpText = (
            "Plans bronchoscope, concentric tubes and steerable needle to a lung nodule. "
            "Research software: no medical device."
        )


class LungAccessWidget(ScriptedLoadableModuleWidget):
    """The panel: volume or segmentation, target, device and time in; curves, models, chance and steps out."""

    def setup(self) -> None:
        """Build the panel."""
        import qt

        super().setup()
        self.logic = LungAccessLogic()
        form = qt.QFormLayout()
        self.volume = self._selector("vtkMRMLScalarVolumeNode", "The CT, segmented if no masks are given")
        self.segmentation = self._selector("vtkMRMLSegmentationNode", "Airway, vessels and lungs, by name")
        self.target = self._selector("vtkMRMLMarkupsFiducialNode", "A point in the nodule")
        self.device, self.seconds, self.wheel = qt.QComboBox(), qt.QSpinBox(), qt.QLineEdit()
        self.device.addItems(list(DEVICES))
        self.device.setEditable(True)
        self.seconds.setRange(1, 600)
        self.seconds.setValue(10)
        self.wheel.setPlaceholderText("a wheel of lungaccess, if this machine is offline")
        for words, widget in (
            ("CT", self.volume), ("Segmentation", self.segmentation), ("Target", self.target),
            ("Device", self.device), ("Seconds", self.seconds), ("Wheel", self.wheel),
        ):  # fmt: skip
            form.addRow(words, widget)
        self.button, self.answer = qt.QPushButton("Plan"), qt.QTextEdit()
        self.answer.setReadOnly(True)
        self.button.connect("clicked()", self.plan)
        form.addRow(self.button)
        form.addRow(self.answer)
        frame = qt.QWidget()
        frame.setLayout(form)
        self.layout.addWidget(frame)

    def _selector(self, kind: str, words: str) -> Any:

        found = slicer.qMRMLNodeComboBox()
        found.nodeTypes = [kind]
        found.noneEnabled = True
        found.setMRMLScene(slicer.mrmlScene)
        found.setToolTip(words)
        return found

    def plan(self) -> None:
        """Plan, and show what was found; a refusal is shown in its own words."""
        self.button.enabled = False
        try:
            self.answer.setPlainText("")
            self.logic.install(self.wheel.text)
            text = self.logic.plan(
                volume=self.volume.currentNode(),
                segmentation=self.segmentation.currentNode(),
                target=self.target.currentNode(),
                device=self.device.currentText,
                seconds=self.seconds.value,
                tell=self._tell,
            )
        except (RuntimeError, ValueError) as error:
            text = str(error)
        finally:
            self.button.enabled = True
        self.answer.setPlainText(text)

    def _tell(self, line: str) -> None:
        self.answer.append(line)
        slicer.app.processEvents()


class LungAccessLogic(ScriptedLoadableModuleLogic):
    """What the panel does, without the panel.

    Args:
        scene (vtkMRMLScene): The scene that results are added to; the open one if not given.
        folder: Where patients and plans are kept; a temporary folder of this session if not given.
    """

    def __init__(self, scene: Any = None, folder: Path | None = None) -> None:
        super().__init__()
        self.scene = slicer.mrmlScene if scene is None else scene
        self.folder = Path(tempfile.mkdtemp(prefix="lungaccess-")) if folder is None else folder

    def install(self, wheel: str = "") -> None:
        """Install the package into 3D Slicer's Python if it is not there, from a wheel if one is named."""
        import importlib.util

        if importlib.util.find_spec(PACKAGE) is not None:
            return
        packaging = getattr(slicer, "packaging", slicer.util)  # A module of its own since 3D Slicer 5.10.
        packaging.pip_install(wheel or PACKAGE)

    def plan(
        self,
        *,
        volume: Any,
        segmentation: Any,
        target: Any,
        device: str,
        seconds: float,
        tell: Callable[[str], object] = print,
    ) -> str:
        """Plan to the first point of a list, add the plan to the scene, and return chance, verdict and steps.

        Args:
            volume (vtkMRMLScalarVolumeNode or None): The CT; without a segmentation it is segmented first.
            segmentation (vtkMRMLSegmentationNode or None): Masks by the names of their segments, see
                `SEGMENTS`.
            target: vtkMRMLMarkupsFiducialNode.
            device: A preset, or the path of a device file.

        Raises:
            ValueError: If something is not chosen.
            RuntimeError: If lungaccess refuses, with its words.
        """
        if target is None or not target.GetNumberOfControlPoints():
            raise ValueError("Choose a list with a point in the nodule")
        point = [0.0, 0.0, 0.0]
        target.GetNthControlPointPositionWorld(0, point)
        patient = self._patient(volume, segmentation, tell)
        plan = self.folder / "plan"
        wanted = f"ras:{','.join(f'{value:.4f}' for value in point)}"
        words = ["--target", wanted, "--system", device, "--budget", seconds, "--out", plan]
        code, said = self._run(["plan", patient, *words], tell, (0, 1))
        if code == 1:
            return "\n".join(said)
        exported = self.folder / "scene"
        self._run(["export", plan / "plan.json", patient, "--slicer", exported], tell)
        self._add(exported / "scene.mrml")
        _code, steps = self._run(["steps", plan / "plan.json", patient])
        summary = json.loads((plan / "summary.json").read_text(encoding="utf-8"))
        return "\n".join([summary["headline"]["text"], "", *steps])

    def _add(self, path: Path) -> None:
        """Add the nodes of a scene to the open one, which is still saved where it was."""
        before = self.scene.GetURL(), self.scene.GetRootDirectory()
        self.scene.SetURL(str(path))
        added = self.scene.Import()
        self.scene.SetURL(before[0])
        self.scene.SetRootDirectory(before[1])
        if added != 1:
            raise RuntimeError(f"3D Slicer could not read {path}")

    def _patient(self, volume: Any, segmentation: Any, tell: Callable[[str], object]) -> Path:
        """Write the patient's folder: from the segments, or by segmenting the CT."""
        if segmentation is None and volume is None:
            raise ValueError("Choose a CT or a segmentation")
        if segmentation is None:
            image = self.folder / "ct.nrrd"
            self._store(volume, slicer.vtkMRMLVolumeArchetypeStorageNode(), image)
            self._run(["segment", image, "--out", self.folder / "patient", "--force"], tell)
            return self.folder / "patient"
        folder = self.folder / "masks"
        folder.mkdir(exist_ok=True)
        lines = []
        for role, numbers in self._roles(segmentation).items():
            files = [f"{role}{number}.seg.nrrd" for number in numbers]
            for number, file in zip(numbers, files, strict=True):
                self._store_segment(segmentation, number, folder / file)
            lines.append(f"{role} = {json.dumps(files)}")
        (folder / "patient.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
        return folder

    def _roles(self, node: Any) -> dict[str, list[int]]:
        """Return the numbers of the segments that stand for each mask."""
        held = node.GetSegmentation()
        names = [held.GetNthSegment(n).GetName() for n in range(held.GetNumberOfSegments())]
        found = {
            role: [n for n, name in enumerate(names) if name.lower() in known]
            for role, known in SEGMENTS.items()
        }
        lacking = [role for role in NEEDED if not found[role]]
        if lacking:
            raise ValueError(
                f"The segmentation has no segment for {', '.join(lacking)}. It has {', '.join(names)}; "
                f"known names are {', '.join(name for role in lacking for name in SEGMENTS[role])}"
            )
        return {role: numbers for role, numbers in found.items() if numbers}

    def _store_segment(self, node: Any, number: int, path: Path) -> None:
        """Write one segment into a file of its own: segments may overlap, and a file has one layer."""
        held, alone = node.GetSegmentation(), slicer.vtkMRMLSegmentationNode()
        alone.GetSegmentation().CopySegmentFromSegmentation(held, held.GetNthSegmentID(number))
        self._store(alone, slicer.vtkMRMLSegmentationStorageNode(), path)

    def _store(self, node: Any, storage: Any, path: Path) -> None:
        storage.SetFileName(str(path))
        if storage.WriteData(node) != 1:
            raise RuntimeError(f"{node.GetName()} could not be written to {path}")

    def _run(
        self,
        words: Sequence[object],
        tell: Callable[[str], object] = lambda _line: None,
        allowed: tuple[int, ...] = (0,),
    ) -> tuple[int, list[str]]:
        """Run a command of lungaccess in its own process, and return its exit code and what it printed."""
        said = []
        process = self._process([str(word) for word in words])
        for line in process.stdout:
            said.append(line.rstrip())
            tell(said[-1])
        code = int(process.wait())
        if code not in allowed:
            raise RuntimeError("\n".join(said) or f"lungaccess ended with {code}")
        return code, said

    def _process(self, words: list[str]) -> Any:
        python = shutil.which("PythonSlicer") or sys.executable
        command = [python, "-m", PACKAGE, *words]
        if hasattr(slicer.util, "launchConsoleProcess") and shutil.which("PythonSlicer"):
            return slicer.util.launchConsoleProcess(command)
        environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        return subprocess.Popen(command, text=True, encoding="utf-8", env=environment, **pipes)
