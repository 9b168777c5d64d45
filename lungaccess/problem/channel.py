"""What tubes in the working channel ask of the bronchoscope's handle."""

import math

import numpy as np
from numpy.typing import ArrayLike

from lungaccess.problem.system import System
from stages.tube import straightening


def bend_factor(system: System, *insertions_mm: float) -> float:
    """Return by how much more the handle must bend the section while tubes and needle are in it, 1 or more.

    The tubes are inserted by so much beyond the tip, the outermost first; see `stages.tube.straightening`.
    """
    return _factor(system, insertions_mm, system.scope.bending_length_mm)


def bends_with_tubes_rad(system: System) -> tuple[float, float]:
    """Return the bends farthest down (0 or negative) and up that the section keeps, filled, in rad.

    They hold for every insertion: for each tube the stiffest part counts that may come to lie in the section.
    The handle bends an empty section up to `bend_down_deg` and `bend_up_deg`.
    """
    tubes, scope = system.tubes, system.scope
    reach_mm = scope.bending_length_mm + tubes.max_extension_mm
    factor = _factor(system, np.zeros(len(tubes.nested)), reach_mm)
    down, up = scope.bends_rad
    return (
        max(down, -math.radians(scope.bend_down_deg) / factor),
        min(up, math.radians(scope.bend_up_deg) / factor),
    )


def _factor(system: System, insertions_mm: ArrayLike, length_mm: float) -> float:
    """Return the factor where so much of the tubes behind their insertions may lie in the section."""
    shaft, stiffness = system.tubes.needle_shaft, system.scope.bending_stiffness_n_mm2
    out_mm = 0.0 if system.needle is None else system.needle.max_length_mm
    return 1.0 + straightening(
        system.tubes, insertions_mm, length_mm, stiffness, needle=shaft, needle_out_mm=out_mm
    )
