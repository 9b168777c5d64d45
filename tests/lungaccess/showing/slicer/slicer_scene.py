"""A scene as 3D Slicer's own classes load and save it, and what is compared with the plan in LPS mm.

3D Slicer's classes are imported where they are used: that takes seconds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

RAS = np.array([-1.0, -1.0, 1.0])
"""What takes a point of 3D Slicer's to LPS and back."""


class SlicerScene:
    """A scene that 3D Slicer's classes have loaded.

    Args:
        path: A `.mrml`; None for an empty scene.
        scratch: Where bundles are unpacked.
    """

    def __init__(self, path: Path | None, scratch: Path) -> None:
        import slicer

        self.scene = slicer.vtkMRMLScene()
        cache, files = slicer.vtkCacheManager(), slicer.vtkDataIOManager()
        scratch.mkdir(exist_ok=True)
        cache.SetRemoteCacheDirectory(str(scratch))
        files.SetCacheManager(cache)
        self.scene.SetCacheManager(cache)
        self.scene.SetDataIOManager(files)
        application = slicer.vtkMRMLApplicationLogic()
        application.SetMRMLScene(self.scene)
        self._kept = [cache, files, application]
        for logic in (slicer.vtkSlicerMarkupsLogic(), slicer.vtkSlicerSequencesLogic()):
            logic.SetMRMLApplicationLogic(application)
            logic.SetMRMLScene(self.scene)
            self._kept.append(logic)
        if path is not None:
            self.scene.SetURL(str(path))
            assert self.scene.Connect() == 1, f"3D Slicer does not load {path}"

    def node(self, name: str, kind: str = "") -> Any:
        """Return the node of a name, and of a class without `vtkMRML` and `Node` where several have it."""
        nodes = [self.scene.GetNthNode(n) for n in range(self.scene.GetNumberOfNodes())]
        found = [each for each in nodes if each.GetName() == name and each.IsA(f"vtkMRML{kind}Node")]
        assert len(found) == 1, f"{len(found)} nodes are called {name!r}"
        return found[0]

    def names(self, kind: str) -> set[str]:
        """Return the names of all nodes of a class."""
        nodes = self.scene.GetNodesByClass(f"vtkMRML{kind}Node")
        return {nodes.GetItemAsObject(n).GetName() for n in range(nodes.GetNumberOfItems())}

    def save(self, folder: Path, *markups: Any) -> Path:
        """Save the scene and markups into a folder, as 3D Slicer does; return the scene's file."""
        folder.mkdir(exist_ok=True)
        for node in markups:
            node.AddDefaultStorageNode()
            storage = node.GetStorageNode()
            storage.SetFileName(str(folder / f"{node.GetName()}.mrk.json"))
            assert storage.WriteData(node) == 1
        path = folder / "scene.mrml"
        self.scene.SetRootDirectory(str(folder))
        self.scene.SetURL(str(path))
        assert self.scene.Commit(str(path)) == 1
        return path


def control_points_lps(node: Any) -> np.ndarray:
    """Return the control points of markups, where 3D Slicer shows them."""
    points = np.zeros((node.GetNumberOfControlPoints(), 3))
    for number in range(len(points)):
        place = [0.0, 0.0, 0.0]
        node.GetNthControlPointPositionWorld(number, place)
        points[number] = place
    return points * RAS


def rotations_lps(node: Any) -> np.ndarray:
    """Return the orientations of control points."""
    count = node.GetNumberOfControlPoints()
    turns = np.array([node.GetNthControlPointOrientationMatrix(n) for n in range(count)]).reshape(-1, 3, 3)
    return RAS[:, None] * turns


def model_points_lps(node: Any) -> np.ndarray:
    """Return the vertices of a model."""
    from vtk.util.numpy_support import vtk_to_numpy

    return np.asarray(vtk_to_numpy(node.GetPolyData().GetPoints().GetData()), dtype=np.float64) * RAS


def segments(node: Any) -> dict[str, tuple[Any, np.ndarray]]:
    """Return each segment by its name, with the centres of its voxels, LPS mm."""
    import slicer
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    found, segmentation = {}, node.GetSegmentation()
    for number in range(segmentation.GetNumberOfSegments()):
        identity, segment = segmentation.GetNthSegmentID(number), segmentation.GetNthSegment(number)
        image = slicer.vtkOrientedImageData()
        node.GetBinaryLabelmapRepresentation(identity, image)
        matrix = vtk.vtkMatrix4x4()
        image.GetImageToWorldMatrix(matrix)
        ras_from_ijk = np.array([[matrix.GetElement(r, c) for c in range(4)] for r in range(4)])
        low = np.array(image.GetExtent())[::2]
        array = vtk_to_numpy(image.GetPointData().GetScalars())
        array = array.reshape(image.GetDimensions()[::-1]).transpose(2, 1, 0)
        ijk = np.argwhere(array) + low
        found[segment.GetName()] = segment, (ijk @ ras_from_ijk[:3, :3].T + ras_from_ijk[:3, 3]) * RAS
    return found


def moved_lps(transform: Any, points_lps: np.ndarray) -> np.ndarray:
    """Return where a transform shows points."""
    import vtk

    to_world = vtk.vtkGeneralTransform()
    transform.GetTransformToWorld(to_world)
    return np.array([to_world.TransformPoint((point * RAS).tolist()) for point in points_lps]) * RAS
