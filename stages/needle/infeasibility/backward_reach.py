"""Where every path to a target may come from, whatever its start: the backward reachable set of the target.

docs/explanation/unreachable.md derives it.
"""

import math

import numpy as np

from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.kernels.backward_reach import SHELL_MM, BackwardReach, fill_backward_reach

CELL = 0.008
"""Side of a cell of the plane of directions: 0.016 rad in the middle, 0.8 mm at 50 mm."""
HALF_WIDTH = 1.2
"""The window in this plane holds directions up to 100 degrees from the middle."""

NOT_BOUNDED = BackwardReach(
    frame=np.zeros((4, 3)), cell=CELL, kappa=0.0, angles=np.zeros((0, 1, 1), dtype=np.uint8)
)
"""The backward reach of a needle that may come from everywhere."""


def backward_reach(
    environment: NeedleEnvironment, target_lps: Float, middle: Float, *, cell: float = CELL
) -> BackwardReach:
    """Return from which directions paths of a needle may come to a target, at every distance from it.

    What is left out holds no point of a path that keeps its clearance from there to the target.  A needle
    that is longer than half a circle of its least radius may come from everywhere.

    Parameters
    ----------
    target_lps : (3,) float64
        LPS mm.
    middle : (3,) float64
        Direction from the target to where needles start; directions far from it are not looked at.
    cell : float
        Side of a cell of the plane of directions, half an angle in rad.
    """
    limits = environment.limits
    if limits.max_length_mm * limits.kappa > math.pi:
        return NOT_BOUNDED
    shells = int(min(limits.max_length_mm + SHELL_MM, 2.0 / limits.kappa) / SHELL_MM)
    count = 2 * int(HALF_WIDTH / cell) + 1
    axis = np.asarray(middle, dtype=np.float64) / max(float(np.linalg.norm(middle)), 1e-300)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    reach = BackwardReach(
        frame=np.stack([across, np.cross(axis, across), axis, np.asarray(target_lps, dtype=np.float64)]),
        cell=cell,
        kappa=limits.kappa,
        angles=np.zeros((shells, count, count), dtype=np.uint8),
    )
    # A path that ends beside the target, moved onto it, keeps less.
    required = limits.required_mm - environment.goal_tolerance_mm
    fill_backward_reach(environment.obstacles, required, reach)
    return reach
