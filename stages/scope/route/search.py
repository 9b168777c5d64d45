"""The global planner of [Li2021]: breadth-first search (BFS) along the nodes of a centreline."""

import numpy as np

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Int
from anatomy.grid import read_only
from stages.scope.route.centreline import Centreline
from stages.scope.route.kernels.search import breadth_first

DEFAULT_NEIGHBOURS = 8
"""Nearest nodes that are linked: two along a tube, and those of a fork, with some to spare."""


class NoRouteError(LungaccessError):
    """There is no route, or none was found; the message says where and why."""


@frozen_record
class Links:
    """Which nodes the search may go to from a node, as a compressed list.

    Parameters
    ----------
    start : (N + 1,) int64
        The links of node n are `nodes[start[n]:start[n + 1]]`.
    nodes : (L,) int64
        Nearest first.
    """

    start: Int
    nodes: Int


def nearest_links(centreline: Centreline, neighbours: int = DEFAULT_NEIGHBOURS) -> Links:
    """Link each node with its nearest ones, and with those it shares an edge with.

    A nearest node counts only if the balls around both overlap: otherwise it may lie behind a wall, in a
    tube that runs past.

    Parameters
    ----------
    neighbours : int
        Number of nearest nodes, k of [Li2021].

    Raises
    ------
    SettingsError
        If `neighbours` is less than 1.
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
    order = np.lexsort((gap, pairs[:, 0]))
    start = np.searchsorted(pairs[order, 0], np.arange(n + 1))
    return Links(start=read_only(start), nodes=read_only(np.ascontiguousarray(pairs[order, 1])))


def fewest_hops(links: Links, source: int, goal: int) -> Int:
    """Return the nodes from `source` to `goal` with the fewest hops, by the BFS of [Li2021].

    The path with the fewest hops is not always the shortest.

    Raises
    ------
    NoRouteError
        If no chain of links joins them.
    """
    path: Int = breadth_first(links.start, links.nodes, source, goal)
    if not len(path):
        raise NoRouteError(
            "The centreline does not join start and goal",
            expected="one connected tree of tubes",
            remedy="Look at the gaps in the segmentation, or choose points in the same tree",
        )
    return path
