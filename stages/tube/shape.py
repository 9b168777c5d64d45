"""The centreline of deployed planar tubes, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float
from anatomy.margins import Margins
from anatomy.poses import bending_directions
from stages.tube import kernels
from stages.tube.device import ConcentricTubes
from stages.tube.environment import tube_constants


def centreline(
    tubes: ConcentricTubes,
    lps_from_scope_tip: Float,
    rotation_rad: float,
    outer_mm: float,
    inner_mm: float,
    arc_lengths_mm: ArrayLike,
) -> Float:
    """Return points `(N, 3)` LPS mm of planar tubes' centreline at arc lengths `(N,)` from the scope tip.

    The deployment is given as to `DeploymentValidator.validate`.
    """
    constants = tube_constants(tubes, Margins())
    at_mm = np.array(arc_lengths_mm, dtype=np.float64, ndmin=1)
    planar = np.zeros((len(at_mm), 2))
    kernels.planar_points(constants, float(outer_mm), float(inner_mm), at_mm, planar)
    bend = bending_directions(lps_from_scope_tip, rotation_rad)[0]
    forward = lps_from_scope_tip[:3, 2]
    return np.asarray(lps_from_scope_tip[:3, 3] + planar[:, :1] * bend + planar[:, 1:] * forward)
