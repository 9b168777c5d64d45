"""The breath for 3D Slicer: a second scene, whose sequences of transforms move anatomy and devices.

A sequence is a bundle `.seq.mrb`, a zip archive of a scene and its files.  Transform files follow ITK, and so
does 3D Slicer: from a place in a phase back to that in the masks.
"""

import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from anatomy.base.files import atomic_write, write_text
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.io.motion_files import write_vectors
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer.scene import Item, element, scene
from lungaccess.uncertainty.breathing.moving import Moving

SCENE_FILE = "breathing.mrml"
PHASES = 11
"""Every 10 % of the breath, and the phase of the masks."""
ROUNDED_MM = 0.01
"""Displacements are rounded to this, so that the files deflate well."""
FRAMES_PER_S = 4
"""A breath out and in takes 5 s with this."""


@frozen_value
class Mover:
    """A sequence of transforms.

    Args:
        key: "tissue" or "devices"; its bundle is named after it.
        kind: Node class of its transforms, without `vtkMRML` and `Node`.
        suffix: Of the file of a transform.
    """

    key: str
    kind: str
    suffix: str

    @property
    def bundle(self) -> str:
        """Name of its file."""
        return f"breathing_{self.key}.seq.mrb"

    @property
    def proxy(self) -> str:
        """Node of the scene that shows the chosen phase."""
        return f"vtkMRML{self.kind}Node1"


TISSUE = Mover(key="tissue", kind="GridTransform", suffix=".nrrd")
DEVICES = Mover(key="devices", kind="LinearTransform", suffix=".tfm")
MOVERS = (TISSUE, DEVICES)
RIGID = ("tubes", "needle", "aim")


def write_breathing(plan: Plan, lung: Lung, items: Sequence[Item], folder: Path) -> tuple[str, ...]:
    """Write a scene of items that breathe, beside their files; return the names of what was written.

    Raises FileError if the folder cannot be written.
    """
    moving = Moving.of(plan, lung)
    masks = moving.tissue.masks_phase
    phases = np.unique(np.append(np.linspace(0.0, 1.0, PHASES).round(6), masks))
    _write_bundle(folder, TISSUE, phases, lambda phase, path: _write_field(moving, phase, path))
    _write_bundle(folder, DEVICES, phases, lambda phase, path: write_text(path, _affine(moving.pose(phase))))
    said = "window not computed" if plan.window is None else plan.window.words.partition(" (")[0]
    lines = _sequences(phases, int(np.flatnonzero(phases == masks)[0]), said)
    # The start region holds in the phase of the masks alone, and does not move.
    moved = [item.file for item in items if not item.file.startswith("start_region_")]
    movers = {file: (DEVICES if file.split(".")[0] in RIGID else TISSUE).proxy for file in moved}
    write_text(folder / SCENE_FILE, scene(items, movers, lines))
    return (SCENE_FILE, *(mover.bundle for mover in MOVERS))


def _write_field(moving: Moving, phase: float, path: Path) -> None:
    """Write where places in a phase are in the masks, as displacements at the nodes of the motion."""
    grid = moving.tissue.grid
    places = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
    back = moving.pulled_back(places, phase) - places
    write_vectors(path, grid, ROUNDED_MM * np.rint(back / ROUNDED_MM).reshape(*grid.shape, 3))


def _affine(lps_from_masks: Float) -> str:
    """Return a rigid motion as a transform file of ITK, LPS mm: the way back to the masks."""
    back = np.linalg.inv(lps_from_masks)
    numbers = " ".join(f"{value:.12g}" for value in [*back[:3, :3].ravel(), *back[:3, 3]])
    head = "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    return f"{head}Parameters: {numbers}\nFixedParameters: 0 0 0\n"


def _write_bundle(folder: Path, mover: Mover, phases: Float, write: Callable[[float, Path], None]) -> None:
    """Write a sequence: the transform of each phase, and a scene that lists them."""
    root, lines = mover.bundle.split(".")[0], ['<MRML version="Slicer5" userTags="">']
    with (
        tempfile.TemporaryDirectory() as scratch,
        atomic_write(folder / mover.bundle) as temporary,
        zipfile.ZipFile(temporary, "w") as bundle,
    ):
        for n, phase in enumerate(phases.tolist(), start=1):
            name, storage = f"{mover.key}_{round(1000 * phase):04d}", f"vtkMRMLTransformStorageNode{n}"
            path = Path(scratch) / f"{name}{mover.suffix}"
            write(phase, path)
            # Without the time of day: the same plan gives the same bytes.
            bundle.writestr(zipfile.ZipInfo(f"{root}/Data/{path.name}"), path.read_bytes())
            node = {"id": f"vtkMRML{mover.kind}Node{n}", "name": name, "references": f"storage:{storage};"}
            lines += [
                element("TransformStorage", {"id": storage, "fileName": f"Data/{path.name}"}),
                element(mover.kind, node),
            ]
        index = {"id": "vtkMRMLSequenceNodeSequenceIndex", "singletonTag": "SequenceIndex"}
        lines += [element("Sequence", {**index, **_index(mover, phases)}), "</MRML>", ""]
        bundle.writestr(zipfile.ZipInfo(f"{root}/{root}.mrml"), "\n".join(lines))


def _index(mover: Mover, phases: Float) -> dict[str, str]:
    """Return what says which transform belongs to which phase."""
    values = (f"vtkMRML{mover.kind}Node{n}:{100.0 * phase:g}" for n, phase in enumerate(phases, start=1))
    return {
        "indexName": "phase", "indexUnit": "%", "indexType": "numeric", "numericIndexValueTolerance": "0.001",
        "indexValues": ";".join(values),
    }  # fmt: skip


def _sequences(phases: Float, selected: int, said: str) -> list[str]:
    """Return the nodes of a scene that replay the sequences together, by a browser of the words `said`."""
    lines, references = [], ""
    for n, mover in enumerate(MOVERS, start=1):
        storage, sequence = f"vtkMRMLSequenceStorageNode{n}", f"vtkMRMLSequenceNode{n}"
        named = {"id": sequence, "name": f"breathing of the {mover.key}", "references": f"storage:{storage};"}
        about = {"attributes": f"DataNodeClassName:vtkMRML{mover.kind}Node"}
        lines += [
            element("SequenceStorage", {"id": storage, "fileName": mover.bundle}),
            element("Sequence", {**named, **about, **_index(mover, phases)}),
            element(mover.kind, {"id": mover.proxy, "name": f"breathing {mover.key}"}),
        ]
        references += f"sequenceNodeRef{n}:{sequence};dataNodeRef{n}:{mover.proxy};"
    together = "playback true recording false overwriteProxyName false saveChanges false"
    browser = {
        "id": "vtkMRMLSequenceBrowserNode1", "name": f"Breathing: {said}", "references": references,
        "playbackActive": "false", "playbackRateFps": f"{FRAMES_PER_S}",
        "playbackItemSkippingEnabled": "true", "playbackLooped": "true", "selectedItemNumber": f"{selected}",
        "recordingActive": "false",
        "virtualNodePostfixes": " ".join(str(n) for n in range(1, len(MOVERS) + 1)),
        **{f"SynchronizationPropertiesMap{n}": together for n in range(1, len(MOVERS) + 1)},
    }  # fmt: skip
    return [*lines, element("SequenceBrowser", browser)]
