"""A small patient of tubes, ellipsoids and balls: a forked airway with wall, two lungs, vessels, a nodule."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Grid, Volume
from anatomy.patient import PatientImages
from tests.anatomy.tubes import Y, distance_to_segment

SPACING_MM = (2.0, 2.0, 2.0)
LEFT_LUNG, RIGHT_LUNG = (40.0, 0.0, -30.0), (-40.0, 0.0, -30.0)
NODULE = (48.0, 8.0, -20.0)
VESSEL = ((30.0, -15.0, -60.0), (50.0, -15.0, 0.0))
VESSEL_RADIUS_MM = 3.0
WALL_MM = 2.0
FISSURE_Z = -50.0


@cache
def _points() -> tuple[Grid, Float]:
    low, high = np.array([-75.0, -33.0, -80.0]), np.array([75.0, 33.0, 90.0])
    grid = Grid.from_spacing(np.ceil((high - low) / SPACING_MM).astype(int), SPACING_MM, low)
    return grid, grid.lps(np.stack(np.indices(grid.shape), axis=-1))


def grid() -> Grid:
    return _points()[0]


def ball(centre: Any, radius_mm: float) -> Mask:
    return np.asarray(np.linalg.norm(_points()[1] - centre, axis=-1) <= radius_mm)


def capsule(a: Any, b: Any, radius_mm: float) -> Mask:
    return np.asarray(distance_to_segment(_points()[1], np.array(a), np.array(b)) <= radius_mm)


def lungs() -> Mask:
    """Two ellipsoids, 20 mm apart."""
    both = [
        (((_points()[1] - centre) / (30.0, 28.0, 44.0)) ** 2).sum(axis=-1) <= 1.0
        for centre in (LEFT_LUNG, RIGHT_LUNG)
    ]
    return np.asarray(both[0] | both[1])


def volume(array: Array) -> Volume:
    return Volume(grid=grid(), array=np.asfortranarray(array))


@cache
def _toy() -> PatientImages:
    lumen = np.logical_or.reduce([capsule(a, b, r) for a, b, r in Y])
    thick = np.logical_or.reduce([capsule(a, b, r + WALL_MM) for a, b, r in Y])
    lung = lungs()
    start = np.eye(4)
    start[:3, 3] = (20.0, 0.0, -20.0)
    cost = np.where(lung, 0.25, np.inf).astype(np.float32)
    return PatientImages(
        name="Toy",
        kind="masks",
        grid=grid(),
        lumen=volume(lumen),
        wall=volume(thick & ~lumen),
        vessels=volume(capsule(*VESSEL, VESSEL_RADIUS_MM)),
        lung=volume(lung),
        fissures=volume(lung & (np.abs(_points()[1][..., 2] - FISSURE_Z) <= 1.0)),
        nodules=volume(ball(NODULE, 4.0)),
        cost=volume(cost),
        starts=(start,),
        targets_lps=(np.array(NODULE),),
        breath_hold="inspiration",
        sources={"airway.nii.gz": "a" * 64, "lung.nii.gz": "b" * 64},
        warnings=("The toy is hand-made.",),
    )


def toy(**changes: Any) -> PatientImages:
    """Return the patient, with other values for some fields; arrays become volumes."""
    volumes = {
        name: volume(value) if isinstance(value, np.ndarray) else value for name, value in changes.items()
    }
    return replace(_toy(), **volumes)
