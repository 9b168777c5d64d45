"""Lumens made by hand for the bronchoscope, and distances in them without any of the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.structures import LUMEN
from stages.scope.advisor.lumen import Lumen, lumen_of_lung, lumen_of_mask
from tests.stages.scenes import Canvas, brute_clearance, forked_tree

WALL = 1
CARINA = np.array([0.0, 0.0, 0.0])
LEFT, RIGHT = np.array([22.0, 6.0, -30.0]), np.array([-24.0, 0.0, -26.0])
LINES = [
    (np.array([0.0, 0.0, 45.0]), CARINA, 7.0, -1),
    (CARINA, LEFT, 5.0, 0),
    (CARINA, RIGHT, 4.0, 0),
    (LEFT, LEFT + np.array([18.0, 0.0, -16.0]), 3.5, 1),
    (LEFT, LEFT + np.array([-2.0, 10.0, -24.0]), 3.0, 1),
]


def forked_lung() -> Lung:
    """A trachea of 7 mm radius, two main bronchi, two more on the left; voxels of 0.7 x 0.7 x 0.8."""
    canvas = Canvas.empty([-34, -10, -60], [50, 26, 52], [0.7, 0.7, 0.8])
    for branch, (a, b, radius, _parent) in enumerate(LINES):
        canvas.airway(canvas.capsule(a, b, radius), canvas.capsule(a, b, radius + 1.0), branch)
    return canvas.lung(forked_tree(LINES))


def tube(radius_mm: float, length_mm: float = 40.0, spacing_mm: Any = 0.5) -> tuple[Lumen, AirwayTree]:
    """Return a straight lumen along -z from the origin, closed by round ends, and its tree."""
    wide = radius_mm + 1.0
    canvas = Canvas.empty([-wide, -wide, -length_mm - wide], [wide, wide, wide], spacing_mm)
    inside = canvas.capsule([0, 0, 0], [0, 0, -length_mm], radius_mm)
    tree = forked_tree([(np.zeros(3), np.array([0, 0, -length_mm]), radius_mm, -1)])
    return lumen_of_mask(Volume(grid=canvas.grid, array=inside), [0, 0, 0]), tree


def wall_mm(lumen: Lumen, points: np.ndarray, cap_mm: float = 12.0) -> np.ndarray:
    """Return exact distances from points to the voxels around a lumen, as boxes; 0 in the wall."""
    solid = np.where(lumen.index < 0, WALL, 0)
    return brute_clearance(solid, lumen.grid, points, WALL, cap_mm)


def lung_and_lumen() -> tuple[Lung, Lumen]:
    """Return the forked lung and its lumen, which is all of one piece."""
    lung = forked_lung()
    lumen = lumen_of_lung(lung)
    assert lumen.count == int(((lung.labels & LUMEN) != 0).sum())
    return lung, lumen
