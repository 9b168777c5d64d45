"""The centreline of deployed tubes, in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from anatomy.margins import Margins
from anatomy.poses import bending_directions
from anatomy.typed import Float
from stages.tube.deployments import tube_constants
from stages.tube.device import ConcentricTubes
from stages.tube.kernels import deployment as kernels


class TubeArcs(NamedTuple):
    """The four arcs of N deployed pairs of tubes, in one plane, from the scope tip on.

    They are straight in the outer tube, bent in the outer tube, straight beyond it and bent beyond it; a
    deployment that lacks one of them has it with the length 0.

    Parameters
    ----------
    length_mm : (N, 4) float64
    curvature_per_mm : (4,) float64
        Of the two tubes together, by their bending stiffness, and beyond the outer tube of the inner one.
    radius_mm : (4,) float64
        Radius of the outermost tube.
    """

    length_mm: Float
    curvature_per_mm: Float
    radius_mm: Float


def tube_arcs(tubes: ConcentricTubes, outer_mm: ArrayLike, inner_mm: ArrayLike) -> TubeArcs:
    """Return the arcs for insertions `(N,)` in mm, 0 <= outer <= inner [Kuntz2015, sec. IV-B]."""
    constants = tube_constants(tubes, Margins())
    outer, inner = (np.array(insertion, dtype=np.float64, ndmin=1) for insertion in (outer_mm, inner_mm))
    straight = np.maximum(inner - constants[kernels.CURVED_LENGTH], 0.0)
    ends = np.stack([np.minimum(straight, outer), outer, np.maximum(straight, outer), inner], axis=1)
    return TubeArcs(
        length_mm=np.diff(ends, axis=1, prepend=0.0),
        curvature_per_mm=constants[[kernels.OVERLAP_CURVATURE, kernels.INNER_CURVATURE]].repeat(2)
        * [0.0, 1.0, 0.0, 1.0],
        radius_mm=constants[[kernels.OUTER_RADIUS, kernels.INNER_RADIUS]].repeat(2),
    )


def centreline(
    tubes: ConcentricTubes,
    lps_from_scope_tip: Float,
    rotation_rad: float,
    outer_mm: float,
    inner_mm: float,
    arc_lengths_mm: ArrayLike,
) -> Float:
    """Return points `(N, 3)` LPS mm of the tubes' centreline at arc lengths `(N,)` from the scope tip.

    Parameters
    ----------
    tubes : ConcentricTubes
    lps_from_scope_tip : (4, 4) float64
    rotation_rad : float
        Direction of the bend about +z of the scope tip, counted from its +x.
    outer_mm, inner_mm : float
        Insertions of the two tubes.
    """
    constants = tube_constants(tubes, Margins())
    at_mm = np.array(arc_lengths_mm, dtype=np.float64, ndmin=1)
    planar = np.zeros((len(at_mm), 2))
    kernels.planar_points(constants, float(outer_mm), float(inner_mm), at_mm, planar)
    bend = bending_directions(lps_from_scope_tip, rotation_rad)[0]
    forward = lps_from_scope_tip[:3, 2]
    return np.asarray(lps_from_scope_tip[:3, 3] + planar[:, :1] * bend + planar[:, 1:] * forward)
