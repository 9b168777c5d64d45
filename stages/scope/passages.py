"""Where a bronchoscope passes along the medial axis, and where an airway can be left ahead of it."""

import math

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Labels
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, OUTSIDE
from stages.scope.device import Bronchoscope


@frozen_record
class Passages:
    """How far a ball as thick as the scope gets along the medial axis; N tree points.

    Args:
        lumen_radius_mm ((N,) float64): For each tree point, the smallest radius of the lumen on the route to
            it from the root, proved for every point of the route and not only for the tree points.
        passable ((N,) bool): Whether the scope fits at each tree point and on the whole route to it.
        exits_ahead ((N,) bool): Whether an airway lying in lung tissue, not in the mediastinum, is within
            reach ahead.
        narrowest (tuple of (int, float)): Generation at which the most branches become too narrow, and by how
            much the scope's radius exceeds that of the lumen there, in mm (median); (-1, 0) if every branch
            is passable.
        widest_scope_mm: Outer diameter of the thickest scope that would pass a place with an exit ahead; 0 if
            none does.
    """

    lumen_radius_mm: Float
    passable: Bool
    exits_ahead: Bool
    narrowest: tuple[int, float]
    widest_scope_mm: float


def find_passages(lung: Lung, scope: Bronchoscope, *, reach_mm: float) -> Passages:
    """Find where a scope passes, and where an airway in lung tissue is within `reach_mm` ahead of its tip.

    Airways in the mediastinum do not count: leaving them pierces the pleura [Kuntz2015, fig. 5].
    """
    tree = lung.tree
    needed = scope.radius_mm + scope.lumen_margin_mm
    narrowest = _narrowest_on_the_route(lung)
    passable = narrowest >= needed
    ahead = _distance_to_exit(tree, _in_lung_tissue(lung)) <= reach_mm
    widest = float(narrowest[ahead].max(initial=0.0))
    return Passages(
        lumen_radius_mm=narrowest,
        passable=passable,
        exits_ahead=ahead,
        narrowest=_where_too_narrow(tree, passable, narrowest, needed),
        widest_scope_mm=max(2.0 * (widest - scope.lumen_margin_mm), 0.0),
    )


PROOF_STEP_MM = 0.05
"""Spacing of the samples of a proof along the medial axis; half of it is lost, far less than a voxel."""


def _narrowest_on_the_route(lung: Lung) -> Float:
    """Return the proved lumen radius of the narrowest place between the root and each point.

    The depth in the lumen is 1-Lipschitz: between two samples it is at most half their distance less.
    """
    tree = lung.tree
    parent = np.maximum(tree.parent_point, 0)
    step = tree.points_lps - tree.points_lps[parent]
    count = max(1, math.ceil(float(np.linalg.norm(step, axis=1).max()) / PROOF_STEP_MM))
    share = np.linspace(0.0, 1.0, count + 1)
    samples = tree.points_lps[parent][:, None] + share[:, None] * step[:, None]
    depth = lung.lumen_depth.lower_bound_mm(samples.reshape(-1, 3)).reshape(len(step), -1)
    narrowest = np.maximum(depth.min(axis=1) - np.linalg.norm(step, axis=1) / (2 * count), 0.0)
    for point in range(1, tree.n_points):
        narrowest[point] = min(narrowest[point], narrowest[tree.parent_point[point]])
    return np.asarray(narrowest, dtype=np.float64)


WALL_PROBE_MM = 2.5
"""Tissue is looked for so far beyond the lumen's radius: beyond the walls of the airways that tubes leave."""
PROBE_DIRECTIONS = 8
"""Directions across the airway in which tissue is looked for; at 2 to 6 mm they are a few voxels apart."""


def _in_lung_tissue(lung: Lung) -> Bool:
    """Tell at which tree points free lung tissue lies beside the airway, in some direction."""
    tree = lung.tree
    helper = np.eye(3)[np.argmin(np.abs(tree.tangents), axis=1)]
    first = np.cross(tree.tangents, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tree.tangents, first)
    nowhere = np.ones(tree.n_points, dtype=bool)
    for phi in np.arange(PROBE_DIRECTIONS) * (2 * math.pi / PROBE_DIRECTIONS):
        direction = math.cos(phi) * first + math.sin(phi) * second
        probe = tree.points_lps + (tree.radius_mm + WALL_PROBE_MM)[:, None] * direction
        nowhere &= (_labels_at(lung, probe) & (OUTSIDE | AIRWAY)) != 0
    return ~nowhere


def _labels_at(lung: Lung, points: Float) -> Labels:
    ijk = np.floor(lung.grid.ijk(points) + 0.5).astype(np.int64)
    inside = ((ijk >= 0) & (ijk < lung.grid.shape)).all(axis=1)
    labels = np.full(len(points), OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(ijk[inside].T)]
    return labels


def _distance_to_exit(tree: AirwayTree, in_tissue: Bool) -> Float:
    """Return the distance from each point down the tree to the next point in lung tissue."""
    distance_mm = np.where(in_tissue, 0.0, np.inf)
    for point in range(tree.n_points - 1, 0, -1):
        parent = tree.parent_point[point]
        step = tree.distance_from_root_mm[point] - tree.distance_from_root_mm[parent]
        distance_mm[parent] = min(distance_mm[parent], distance_mm[point] + step)
    return distance_mm


def _where_too_narrow(
    tree: AirwayTree, passable: Bool, radius_mm: Float, needed_mm: float
) -> tuple[int, float]:
    """Say at which generation most routes end, and by how much (median)."""
    ends = np.flatnonzero(~passable[1:] & passable[tree.parent_point[1:]]) + 1
    if not len(ends):
        return (-1, 0.0) if passable[0] else (0, float(needed_mm - radius_mm[0]))
    generation = tree.generation[tree.branch_of_point[ends]]
    worst = int(np.argmax(np.bincount(generation)))
    shortfall = needed_mm - radius_mm[ends[generation == worst]]
    return worst, float(np.median(shortfall))
