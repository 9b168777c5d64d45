"""The global planner of [Li2021]: breadth-first search (BFS) along a centreline, and its guide path."""

import numpy as np

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import DEGREE, Curve, interpolate

DEFAULT_NEIGHBOURS = 8
"""Nearest nodes that are linked: two along a tube, and those of a fork, with some to spare."""

WAYPOINT_SPACING_MM = 3.0
"""Denser points give the spline the kinks of a voxel skeleton; sparser ones cut the bends of airways."""


@frozen_record
class GuidePath:
    """P points `(P, 3)` LPS mm from start to goal, no two neighbours in one place, and the lumen's radius."""

    points_mm: Float
    radius_mm: Float

    @property
    def along_mm(self) -> Float:
        """Length of the polyline up to each point, `(P,)`."""
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.points_mm, axis=0), axis=1)))

    @property
    def cones(self) -> Float:
        """Round cones along the guide path, `(P - 1, 8)`; they lead, but are no part of the lumen."""
        with_radius = np.column_stack((self.points_mm, self.radius_mm))
        return np.hstack((with_radius[:-1], with_radius[1:]))

    def curve(self, spacing_mm: float = WAYPOINT_SPACING_MM) -> Curve:
        """Return the cubic B-spline through guide path points `spacing_mm` apart, all if 0 [Li2021]."""
        along = self.along_mm
        if spacing_mm <= 0.0:
            return interpolate(self.points_mm)
        at = np.linspace(0.0, along[-1], max(round(along[-1] / spacing_mm), DEGREE) + 1)
        return interpolate(np.stack([np.interp(at, along, axis) for axis in self.points_mm.T], axis=1))


def guide_path_along(centreline: Centreline, nodes: Int, start_mm: Float, goal_mm: Float) -> GuidePath:
    """Return the guide path over centreline nodes.

    Start and goal take the place of the nodes nearest to them.  Raises SettingsError if start and goal are
    the same point.
    """
    inner = nodes[1:-1]
    points = np.vstack((start_mm, centreline.nodes_mm[inner], goal_mm))
    radius = centreline.radius_mm[np.concatenate((nodes[:1], inner, nodes[-1:]))]
    # Points nearer than this coincide: rounding, far below a voxel.
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
    kept = np.append(True, apart)
    if kept.sum() < 2:
        raise SettingsError(
            "Start and goal of the route are the same point",
            expected="two points apart",
            remedy="Choose another goal or start",
        )
    if not apart[-1]:
        kept[np.flatnonzero(kept)[-1]] = False
        kept[-1] = True
    return GuidePath(points_mm=read_only(points[kept]), radius_mm=read_only(radius[kept]))


class NoRouteError(LungaccessError):
    """There is no route, or none was found; the message says where and why."""


@frozen_record
class Links:
    """The links of node n, nearest first: `nodes[start[n]:start[n + 1]]`, (L,); `start` is (N + 1,)."""

    start: Int
    nodes: Int


def nearest_links(centreline: Centreline, neighbours: int = DEFAULT_NEIGHBOURS) -> Links:
    """Link each node with its nearest ones, k in [Li2021], and with those it shares an edge with.

    A nearest node counts only if the balls around both overlap: otherwise it may lie behind a wall, in a tube
    that runs past.  Raises SettingsError if `neighbours` is less than 1.
    """
    from scipy.spatial import KDTree

    if neighbours < 1:
        raise SettingsError(f"The search looks at {neighbours} neighbours", expected="at least 1")
    nodes, n = centreline.nodes_mm, centreline.n_nodes
    distance, near = KDTree(nodes).query(nodes, k=min(neighbours + 1, n))
    a = np.repeat(np.arange(n), near.shape[1])
    b = near.ravel()
    radius = centreline.radius_mm
    open_between = (a != b) & (distance.ravel() < radius[a] + radius[b])
    pairs = np.vstack((np.stack((a, b), axis=1)[open_between], centreline.edges, centreline.edges[:, ::-1]))
    pairs = np.unique(np.vstack((pairs, pairs[:, ::-1])), axis=0)
    gap = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    sources, targets = pairs[np.lexsort((gap, pairs[:, 0]))].T.copy()
    return Links(start=read_only(np.searchsorted(sources, np.arange(n + 1))), nodes=read_only(targets))


def fewest_hops(links: Links, source: int, goal: int) -> Int:
    """Return the nodes from `source` to `goal` with the fewest hops, by the BFS of [Li2021].

    The path with the fewest hops is not always the shortest.  Raises NoRouteError if no chain of links joins
    them.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    count = len(links.start) - 1
    graph = csr_array((np.ones(len(links.nodes)), links.nodes, links.start), shape=(count, count))
    _order, before = breadth_first_order(graph, source)
    if before[goal] < 0 and goal != source:
        raise NoRouteError(
            "The centreline does not join start and goal",
            expected="one connected tree of tubes",
            remedy="Look at the gaps in the segmentation, or choose points in the same tree",
        )
    path = [goal]
    while path[-1] != source:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1], dtype=np.int64)
