"""The closed form of a straight outer tube and an inner one with one bend: the truth for the mechanics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float
from anatomy.margins import Margins
from anatomy.poses import bending_directions
from stages.tube import ConcentricTubes, kernels, tube_constants


def centreline(
    tubes: ConcentricTubes, frame: Float, rotation: float, outer: float, inner: float, at_mm: ArrayLike
) -> Float:
    """Return points `(N, 3)` at arc lengths `(N,)` from a scope tip `(4, 4)`."""
    numbers = tube_constants(tubes, Margins())
    at = np.array(at_mm, dtype=np.float64, ndmin=1)
    flat = np.array([kernels.planar_point(numbers, float(outer), float(inner), s) for s in at.tolist()])
    bend = bending_directions(frame, rotation)[0]
    return np.asarray(frame[:3, 3] + flat[:, :1] * bend + flat[:, 1:] * frame[:3, 2])


def pieces(tubes: ConcentricTubes, outer: float, inner: float) -> list[tuple[float, float, float, float]]:
    """Return the arcs of the centreline that are not empty: begin and end in mm, curvature, radius."""
    straight = max(inner - tubes.inner.curved_length_mm, 0.0)
    radii = tubes.outermost.radius_mm, tubes.inner.radius_mm
    every = (
        (0.0, min(straight, outer), 0.0, radii[0]),
        (min(straight, outer), outer, tubes.overlap_curvature_per_mm, radii[0]),
        (outer, max(straight, outer), 0.0, radii[1]),
        (max(straight, outer), inner, tubes.free_curvature_per_mm, radii[1]),
    )
    return [piece for piece in every if piece[1] > piece[0]]
