"""What a plan costs, evaluated exactly: 1 / clearance, the cost map by mm and by voxel, length, tissue."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Int
from anatomy.fields import corner_geometry
from anatomy.grid import Grid, Volume
from anatomy.kernels import field as field_kernel
from stages.needle.kernels import cost as kernel
from stages.needle.kernels.proof import Obstacles
from stages.needle.objective import TERMS, Term
from stages.needle.path import ArcPath, kernel_arcs


def obstacle_clearance_mm(obstacles: Obstacles, points: Float) -> Float:
    """Return the distances `(N,)` in mm from points `(N, 3)`, LPS mm, to the nearest obstacle."""
    field, labels, geometry, bits = obstacles
    places = np.array(points, dtype=np.float64, order="C")
    clearance = np.zeros(len(places))
    field_kernel.bounds_at(field, geometry, places, clearance)
    # Nearer than so many of the longest voxel sides, distances are exact; farther, the clearance field's
    # lower bound is less than 0.6 % off.
    exact_below_mm = 8.0 * math.sqrt(geometry[:, 4].max())
    near = np.flatnonzero(clearance < exact_below_mm)
    found = np.zeros(len(near))
    field_kernel.exact_at(labels, geometry, places[near], bits, -1, 1.2 * exact_below_mm, found)
    clearance[near] = np.maximum(found, clearance[near])
    return clearance


def inverse_clearance(obstacles: Obstacles, path: ArcPath) -> float:
    """Return the integral of 1 / clearance over the length of a path [Kuntz2015, eq. 1].

    By the trapezoid rule with steps of at most 0.1 mm; clearance is that of the needle's axis, no less than
    0.1 mm.
    """
    # Greatest step of the trapezoid rule, as long as the least clearance that counts.
    points, lengths = path.sample(0.1)
    clearance = np.maximum(obstacle_clearance_mm(obstacles, points), kernel.CLEARANCE_FLOOR_MM)
    return float(np.trapezoid(1.0 / clearance, lengths))


def map_integral(cost_map: Volume | None, path: ArcPath) -> float:
    """Return the exact line integral of the cost map along a path, mm; 0 without one, inf off its grid."""
    if cost_map is None:
        return 0.0
    voxels, lengths = _crossings(cost_map.grid, path)
    costs = _costs_of(cost_map, voxels)
    return float((costs * lengths).sum()) if np.isfinite(costs).all() else math.inf


def voxel_sum(cost_map: Volume | None, path: ArcPath) -> float:
    """Return the sum of the cost map over the set of voxels that a path crosses [Fu2018, eq. 1].

    Each voxel counts once, however often the path meets it.  The sum depends on the voxel size.  It is 0
    without a map, and infinite if the path meets a voxel of infinite cost or leaves the grid.
    """
    if cost_map is None:
        return 0.0
    voxels, _lengths = _crossings(cost_map.grid, path)
    return float(_costs_of(cost_map, np.unique(voxels)).sum())


class InTissue(NamedTuple):
    """A part of the devices that lies in tissue: its axis, and its outer diameter in mm all along it."""

    path: ArcPath
    width_mm: float


def tissue(obstacles: Obstacles, cost_map: Volume | None, parts: Sequence[InTissue]) -> float:
    """Return the integral over all in tissue of width times the sum of 1 / clearance and the cost map, mm.

    Clearance is that of `inverse_clearance`, in mm.  The map, whose costs are per mm, counts as much as
    1 / clearance: a mm in a thin vessel as one at 1 mm from an obstacle.  Without a map it is left out.  The
    integral is infinite if a part meets a voxel of infinite cost or leaves the grid of the map.
    """
    each = (
        part.width_mm * (inverse_clearance(obstacles, part.path) + map_integral(cost_map, part.path))
        for part in parts
    )
    return sum(each, 0.0)


Evaluation = Callable[[Obstacles, Volume | None, ArcPath, Sequence[InTissue]], float]
_EVALUATED: dict[str, Evaluation] = {
    "inverse_clearance": lambda obstacles, _map, path, _parts: inverse_clearance(obstacles, path),
    "cost_map": lambda _arrays, cost_map, path, _parts: map_integral(cost_map, path),
    "voxel_sum": lambda _arrays, cost_map, path, _parts: voxel_sum(cost_map, path),
    "length_mm": lambda _arrays, _map, path, _parts: path.length_mm,
    "tissue": lambda obstacles, cost_map, _path, parts: tissue(obstacles, cost_map, parts),
}


def path_costs(
    obstacles: Obstacles,
    cost_map: Volume | None,
    path: ArcPath,
    parts: Sequence[InTissue],
    terms: Iterable[Term] = TERMS,
) -> dict[str, float]:
    """Return costs of a path by their keys, exactly; see `stages.needle.objective.TERMS`.

    `parts` are all that lies in tissue: the tubes beyond the wall, and the path of the needle.  Without a map
    its costs are 0.
    """
    return {term.key: _EVALUATED[term.key](obstacles, cost_map, path, parts) for term in terms}


def _crossings(grid: Grid, path: ArcPath) -> tuple[Int, Float]:
    """Return the voxels of all arcs one after the other, and the length in each, see the kernel."""
    geometry = corner_geometry(grid)
    found = [
        kernel.voxels_on_arc(grid.shape, geometry, pose, bend, length)[:2]
        for pose, bend, length in kernel_arcs(path)
    ]
    return np.concatenate([voxels for voxels, _ in found]), np.concatenate([lengths for _, lengths in found])


def _costs_of(cost_map: Volume, voxels: Int) -> Float:
    inside = voxels != kernel.OFF_GRID
    costs = np.full(len(voxels), math.inf)
    costs[inside] = cost_map.array.ravel(order="F")[voxels[inside]]
    return costs
