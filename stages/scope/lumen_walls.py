"""A scope and the walls of a lung's lumen as the kernels of scope motions take them."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from anatomy.fields import corner_geometry
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.structures import LUMEN, OUTSIDE
from stages.scope.device import Bronchoscope
from stages.scope.kernels.body import Walls
from stages.scope.kernels.growth import Device

_WALLS: WeakKeyDictionary[Lung, Walls] = WeakKeyDictionary()
"""The walls of each lung: to make them takes as long as to prove a hundred motions."""


def walls_of(lung: Lung) -> Walls:
    """Return the walls around the lumen of a lung, made once."""
    if lung not in _WALLS:
        _WALLS[lung] = _walls(lung)
    return _WALLS[lung]


def _walls(lung: Lung) -> Walls:
    inside = (lung.labels & LUMEN) != 0
    low, high = np.zeros(3, dtype=np.int64), np.array(lung.grid.shape)
    for axis in range(3):
        others = tuple(k for k in range(3) if k != axis)
        filled = np.flatnonzero(inside.any(axis=others))
        if len(filled):
            low[axis], high[axis] = max(filled[0] - 1, 0), min(filled[-1] + 2, high[axis])
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    solid = np.asfortranarray(np.where(inside[box], np.uint16(0), np.uint16(OUTSIDE)))
    return Walls(
        solid=read_only(solid),
        geometry=corner_geometry(lung.grid.crop(low, high)),
        depth=lung.lumen_depth.corners,
        depth_geometry=lung.lumen_depth.geometry,
    )


def kernel_device(scope: Bronchoscope, max_curvature_per_mm: float) -> Device:
    """Return a scope whose body may have a largest curvature that the tubes in its channel can stand."""
    least, most = scope.bends_rad
    return Device(
        radius=scope.radius_mm + scope.lumen_margin_mm,
        length=scope.bending_length_mm,
        laying=min(scope.laying_curvature_per_mm, max_curvature_per_mm),
        least_bend=least,
        most_bend=most,
    )
