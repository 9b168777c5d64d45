"""The tightest place of the states that a proof of no path has left."""

import math
from collections.abc import Sequence

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from stages.needle.infeasibility.path_bounds import PathBounds
from stages.needle.infeasibility.plane import Plane


@frozen_value
class Passage:
    """Where every path leads through, if there is one.

    It is the plane whose states are the narrowest beside what is wide enough for all paths without obstacles.

    Parameters
    ----------
    point_lps : (3,) tuple of float
        Its middle, LPS mm.
    width_mm : float
        Diameter of a disc of its area; the area is taken too large, by the cells along its edge.
    from_start_mm : float
        Distance of its plane from the start.
    cell_mm, slope_cell : float
        Resolution at which the query is open: sides of the cells of position in mm, and of direction as a
        slope (1 is 45 degrees).
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

    Parameters
    ----------
    depth_mm : float
        Distance of the planes.
    paths : PathBounds
        Where paths can be without obstacles.
    kappa : float
        Greatest curvature, 1/mm.
    line : tuple of arrays
        The start (3,), what a mm of depth moves the first cell (3,), and the axes of cells (2, 3), LPS mm.
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
