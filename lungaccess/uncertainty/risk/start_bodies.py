"""The safe start region as bodies for pictures, around the tip of the tubes."""

from __future__ import annotations

import math

import numpy as np

from anatomy.meshes import SurfaceMesh
from stages.needle import StartRegion

AHEAD_MM = 10.0
"""The cone of directions is drawn so far ahead: about as long as a view of the tip is wide."""
SIDES, RINGS = 32, 16
"""Corners of a circle, and circles of a half ball: smooth to the eye at the size of a tube."""
DIRECTIONS_SHARE = 0.5
"""The body of the tried starts holds the places from which at least this share of directions has a path."""


def proved_body(region: StartRegion) -> SurfaceMesh | None:
    """Return where needles of all proved starts begin and are headed; None where nothing is proved.

    It is the ball of places, and ahead of it the cone in which their first directions lie.
    """
    proved = region.proved
    if proved.volume <= 0.0:
        return None
    radius, slope = proved.offset_mm, math.tan(proved.tilt_rad)
    behind = np.linspace(math.pi, 0.5 * math.pi, RINGS + 1)[1:]
    heights = np.concatenate([radius * np.cos(behind), [AHEAD_MM]])
    radii = np.concatenate([radius * np.sin(behind), [radius + AHEAD_MM * slope]])
    around = 2.0 * math.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = np.concatenate(
        [radii[:, None, None] * circle, np.broadcast_to(heights[:, None, None], (len(radii), SIDES, 1))],
        axis=2,
    )
    local = np.vstack([rings.reshape(-1, 3), [[0.0, 0.0, -radius], [0.0, 0.0, AHEAD_MM]]])
    here = np.arange(SIDES)
    after = (here + 1) % SIDES
    back, front, last = len(local) - 2, len(local) - 1, (len(radii) - 1) * SIDES
    faces = [np.stack([np.full(SIDES, back), after, here], axis=1)]
    for low in range(0, last, SIDES):
        high = low + SIDES
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    faces.append(np.stack([np.full(SIDES, front), last + here, last + after], axis=1))
    frame = region.lps_from_start
    return SurfaceMesh(
        vertices_lps=local @ frame[:3, :3].T + frame[:3, 3], faces=np.concatenate(faces), bound_mm=0.0
    )


def tried_body(region: StartRegion, share: float = DIRECTIONS_SHARE) -> SurfaceMesh | None:
    """Return the places from which at least a share of directions has a path; None where there is none.

    The surface lies between the places that were tried, by linear interpolation.
    """
    from skimage.measure import marching_cubes

    tried, frame = region.tried, region.lps_from_start
    low = tried.lattice.min(axis=0) - 1
    field = np.zeros(tried.lattice.max(axis=0) - low + 2, dtype=np.float32)
    field[tuple((tried.lattice - low).T)] = tried.share_by_place
    if field.max() < share:
        return None
    # A level between two possible shares: no vertex falls on a place of the lattice.
    vertices, faces, _, _ = marching_cubes(
        field, level=share - 0.5 / tried.kinds.shape[1], gradient_direction="ascent"
    )
    local = tried.spacing_mm * (vertices + low)
    return SurfaceMesh(
        vertices_lps=local @ frame[:3, :3].T + frame[:3, 3], faces=faces, bound_mm=tried.spacing_mm
    )
