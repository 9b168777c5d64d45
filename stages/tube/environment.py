"""What the tubes collide with, and the numbers of a pair of tubes, as the kernels take them."""

import math

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import obstacle_bits
from stages.tube import kernels
from stages.tube.device import ConcentricTubes
from stages.tube.kernels import TubeEnvironment

DEFAULT_ROTATIONS = 24
"""Rotations 15 degrees apart: at 30 mm of curve, tips are about 3 mm apart, as far as the stops."""
THREADS = 2
"""The kernels run without the interpreter's lock; more threads would wait for memory."""


def tube_environment(lung: Lung, *, with_fissures: bool) -> TubeEnvironment:
    """Return what the tubes collide with in a lung, its fissures too if they are obstacles."""
    field = lung.obstacle_field(with_fissures=with_fissures)
    bits = obstacle_bits(with_fissures)
    depth = lung.lumen_depth
    return TubeEnvironment(
        field=field.corners,
        labels=lung.labels,
        geometry=field.geometry,
        bits=bits,
        lumen=depth.corners,
        lumen_geometry=depth.geometry,
        mediastinal=lung.tree.mediastinal,
    )


def tube_constants(tubes: ConcentricTubes, margins: Margins) -> Float:
    """Return the `(N_TUBES,)` array of `stages.tube.kernels.planar`, lengths in mm, angles in rad.

    Curvatures and the length of the curve are 0 where the tubes are not planar.
    """
    constants = np.zeros(kernels.N_TUBES)
    inner, outer = tubes.inner, tubes.outermost
    if tubes.planar:
        constants[kernels.OVERLAP_CURVATURE] = tubes.overlap_curvature_per_mm
        constants[kernels.INNER_CURVATURE] = tubes.free_curvature_per_mm
        constants[kernels.CURVED_LENGTH] = inner.curved_length_mm
    constants[kernels.OUTER_RADIUS] = outer.radius_mm
    constants[kernels.INNER_RADIUS] = inner.radius_mm
    constants[kernels.MARGIN] = margins.total_mm
    constants[kernels.MIN_WALL_ANGLE] = math.radians(tubes.min_wall_angle_deg)
    constants[kernels.MAX_SWEEP] = tubes.max_lateral_sweep_mm
    constants[kernels.MAX_EXTENSION] = tubes.max_extension_mm
    constants[kernels.MAX_PROTRUSION] = tubes.max_inner_protrusion_mm
    constants[kernels.MAX_WALL_RUN] = tubes.max_wall_run_mm
    return constants
