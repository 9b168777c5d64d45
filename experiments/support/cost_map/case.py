"""A CT made into what a needle study on its cost map needs: obstacles, costs, and where needles start."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Volume
from anatomy.phantom import make_phantom
from anatomy.segmentation.pipeline import read_ct, segment
from anatomy.segmentation.request import Given, SegmentationRequest
from anatomy.structures import AIRWAY, OUTSIDE, VESSEL
from experiments.support.anatomies import PHANTOM, require_data
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels

NEEDLE = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 121)
SAFETY_MM = 0.4
BORDER_VOXELS = 14
LEAST_HU = -1024.0
GENERATIONS = (4, 9)
"""Generations of the airways beside which needles start."""
CONTOURS = "nodule_contours.json"


@frozen_record
class Case:
    """Both lungs of a CT.

    Args:
        environment: Its cost map is that of [Fu2018]: vesselness, infinite in obstacles.
        intensity: The CT as a map: HU + 1024, infinite in obstacles.
        inner_lps ((N, 3) float64): Points of the centrelines of airways of the generations 4 to 9.
    """

    name: str
    environment: NeedleEnvironment
    intensity: Volume
    inner_lps: Float

    @property
    def costs(self) -> Volume:
        """The cost map."""
        if self.environment.cost_map is None:
            raise TypeError("The environment of a case always has a cost map")
        return self.environment.cost_map


def case_of(name: str, work: Path, seed: int) -> Case:
    """Segment a CT, or take what an earlier run left in `work`.

    Args:
        name: "phantom", the name of a folder below ct of LUNGACCESS_DATA, or a path to a CT.
        work: A patient folder for each CT is kept here.
        seed: Of the phantom.

    Raises:
        anatomy.base.errors.AnatomyError, anatomy.base.errors.FileError: If the CT cannot be read or
            segmented.
    """
    title, ct, given = _input_of(name, seed)
    parts = segment(SegmentationRequest(ct=ct, out=work / title, name=title, given=given)).parts
    ct, tree = parts.ct, parts.tree
    if isinstance(tree, AnatomyError):
        raise tree
    generation = tree.generation[tree.branch_of_point]
    inner = tree.points_lps[(generation >= GENERATIONS[0]) & (generation <= GENERATIONS[1])]
    lung = parts.left | parts.right
    inside = np.argwhere(lung)
    low = np.maximum(inside.min(axis=0) - BORDER_VOXELS, 0)
    high = np.minimum(inside.max(axis=0) + 1 + BORDER_VOXELS, ct.grid.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    grid = ct.grid.crop(low, high)
    labels = np.zeros(grid.shape, dtype=np.uint16, order="F")
    labels[~lung[box]] |= OUTSIDE
    labels[(parts.lumen | parts.wall)[box]] |= AIRWAY
    labels[parts.large_vessels[box]] |= VESSEL
    raw = np.maximum(ct.array[box].astype(np.float32), np.float32(LEAST_HU)) - np.float32(LEAST_HU)
    costs, intensity = (
        Volume(grid=grid, array=np.where(labels != 0, np.float32(math.inf), values))
        for values in (parts.cost[box], raw)
    )
    clearance_mm = NEEDLE.radius_mm + SAFETY_MM
    environment = environment_of_labels(
        labels, grid, NEEDLE, required_clearance_mm=clearance_mm, cost_map=costs
    )
    return Case(
        name=title, environment=environment, intensity=intensity, inner_lps=inner[grid.contains(inner)]
    )


def _input_of(name: str, seed: int) -> tuple[str, Volume, Given]:
    """Return the title of a CT, the CT, and the contours of a nodule if they lie beside it."""
    if name == PHANTOM:
        return f"{PHANTOM}-{seed}", make_phantom(seed=seed, size="small").ct, Given()
    path = Path(name) if Path(name).exists() else require_data(f"ct/{name}/ct.nii.gz")
    ct, _ = read_ct(path)
    if path.is_dir():
        return path.name, ct, Given()
    contours = path.parent / CONTOURS
    has_contours = contours.exists() and _is_contours(contours)
    return path.parent.name, ct, Given(nodule_contours=contours if has_contours else None)


def _is_contours(path: Path) -> bool:
    return "annotations" in json.loads(path.read_text(encoding="utf-8"))
