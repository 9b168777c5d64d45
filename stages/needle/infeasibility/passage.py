"""The tightest place of the states that a proof of no path has left.

The backward reachable set of a target tells where every path to it may come from, whatever its start;
docs/theory/unreachable.md derives it.
"""

import math
from collections.abc import Sequence

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.kernels.backward_reach import SHELL_MM, BackwardReach, fill_backward_reach
from stages.needle.infeasibility.plane import PathBounds, Plane

CELL = 0.008
"""Side of a cell of the plane of directions: 0.016 rad in the middle, 0.8 mm at 50 mm."""

NOT_BOUNDED = BackwardReach(
    frame=np.zeros((4, 3)), cell=CELL, kappa=0.0, angles=np.zeros((0, 1, 1), dtype=np.uint8)
)
"""The backward reach of a needle that may come from everywhere."""


@frozen_value
class Passage:
    """Where every path leads through, if there is one.

    It is the plane whose states are the narrowest beside what is wide enough for all paths without obstacles.

    Args:
        point_lps ((3,) tuple of float): Its middle, LPS mm.
        width_mm: Diameter of a disc of its area; the area is taken too large, by the cells along its edge.
        from_start_mm: Distance of its plane from the start.
        cell_mm, slope_cell: Resolution at which the query is open: sides of the cells of position in mm, and
            of direction as a slope (1 is 45 degrees).
    """

    point_lps: tuple[float, float, float]
    width_mm: float
    from_start_mm: float
    cell_mm: float
    slope_cell: float


def tightest(
    planes: Sequence[Plane],
    depth_mm: float,
    cell_mm: float,
    paths: PathBounds,
    kappa: float,
    line: tuple[Float, Float, Float],
) -> Passage | None:
    """Return the plane on which the states are narrowest for where it lies; None if all are near an end.

    Args:
        depth_mm: Distance of the planes.
        paths: Where paths can be without obstacles.
        kappa: Greatest curvature, 1/mm.
        line (tuple of arrays): The start (3,), what a mm of depth moves the first cell (3,), and the axes of
            cells (2, 3), LPS mm.
    """
    least, found = math.inf, None
    for number, plane in enumerate(planes):
        free_mm = paths.width_mm(number * depth_mm, kappa)
        # Cells; where paths are no wider without obstacles, the states say little.
        if free_mm < 4.0 * cell_mm:
            continue
        cells = plane.places
        width_mm = 2.0 * cell_mm * math.sqrt(len(cells) / math.pi)
        if width_mm < least * free_mm:
            least, found = width_mm / free_mm, (cells, number * depth_mm, width_mm)
    if found is None:
        return None
    cells, from_start_mm, width_mm = found
    start, ahead, across = line
    x, y, z = (start + from_start_mm * ahead + cells.mean(axis=0) * cell_mm @ across).tolist()
    return Passage(
        point_lps=(x, y, z),
        width_mm=width_mm,
        from_start_mm=from_start_mm,
        cell_mm=cell_mm,
        slope_cell=2.0 * cell_mm / depth_mm,
    )


def backward_reach(
    environment: NeedleEnvironment, target_lps: Float, middle: Float, *, cell: float = CELL
) -> BackwardReach:
    """Return from which directions paths of a needle may come to a target, at every distance from it.

    What is left out holds no point of a path that keeps its clearance from there to the target.  A needle
    that is longer than half a circle of its least radius may come from everywhere.

    Args:
        target_lps ((3,) float64): LPS mm.
        middle ((3,) float64): Direction from the target to where needles start; directions far from it are
            not looked at.
        cell: Side of a cell of the plane of directions, half an angle in rad.
    """
    limits = environment.limits
    if limits.max_length_mm * limits.kappa > math.pi:
        return NOT_BOUNDED
    shells = int(min(limits.max_length_mm + SHELL_MM, 2.0 / limits.kappa) / SHELL_MM)
    # The window in this plane holds directions up to 100 degrees from the middle.
    count = 2 * int(1.2 / cell) + 1
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
