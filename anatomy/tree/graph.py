"""Check a centreline graph and span it by a tree."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Int
from anatomy.tree.skeleton import SkeletonTree, span
from anatomy.tree_report import LoopOpened, TreeReport

SAME_POINT_MM = 1e-3
"""Files store points in single precision; true neighbours are a hundred times farther apart."""


MOST_RADIUS_MM = 100.0
"""No tube of a body is as wide as this."""


def spanned_graph(
    points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike
) -> tuple[SkeletonTree, TreeReport]:
    """Check the arrays of a graph, unite equal points, keep the largest piece and open its rings."""
    points, radius, pairs = _checked(points_lps, radius_mm, edges)
    points, radius, pairs = _united(points, radius, pairs)
    points, radius, pairs, dropped, left_out = _largest_piece(points, radius, pairs)
    tree, rings = span(points, radius, pairs)
    report = TreeReport(
        loops_opened=tuple(
            LoopOpened(position_lps=(points[a] + points[b]) / 2, length_mm=length) for a, b, length in rings
        ),
        components_dropped=dropped,
        voxels_dropped=left_out,
    )
    return tree, report


def _checked(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> tuple[Float, Float, Int]:
    points = np.asarray(points_lps, dtype=np.float64)
    radius = np.asarray(radius_mm, dtype=np.float64)
    pairs = np.asarray(edges, dtype=np.int64)
    problem = ""
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        problem = f"the points have the shape {points.shape}"
    elif radius.shape != (len(points),):
        problem = f"{len(points)} points have radii of the shape {radius.shape}"
    elif pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) == 0:
        problem = f"the edges have the shape {pairs.shape}"
    elif not np.isfinite(points).all() or not np.isfinite(radius).all() or (radius < 0).any():
        problem = "a coordinate or radius is not finite, or a radius is negative"
    elif radius.max() > MOST_RADIUS_MM:
        problem = f"a radius is {radius.max():.3g} mm"
    elif pairs.min() < 0 or pairs.max() >= len(points):
        problem = f"an edge names the point {pairs.max()} of {len(points)}, or a negative one"
    if problem:
        raise AnatomyError(
            f"A centreline graph is unusable: {problem}",
            expected="points (N, 3) and radii (N,) in mm, edges (E, 2) between them",
            remedy="Check the centreline file",
        )
    return points, radius, pairs


def _united(points: Float, radius: Float, pairs: Int) -> tuple[Float, Float, Int]:
    """Unite points that coincide and drop edges that then lead nowhere or twice to the same point."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    same = KDTree(points).query_pairs(SAME_POINT_MM, output_type="ndarray")
    n = len(points)
    links = coo_array((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(n, n))
    _, label = connected_components(links, directed=False)
    _, first, index = np.unique(label, return_index=True, return_inverse=True)
    # Numbered by first occurrence, so that the order of the file is kept.
    order = np.argsort(first)
    rank = np.argsort(order)
    mapped = np.sort(rank[index][pairs], axis=1)
    mapped = np.unique(mapped[mapped[:, 0] != mapped[:, 1]], axis=0)
    return points[first[order]], radius[first[order]], mapped


def _largest_piece(points: Float, radius: Float, pairs: Int) -> tuple[Float, Float, Int, int, int]:
    """Keep the connected piece with most points; also count the pieces and points left out."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(points)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    keep = label == np.argmax(np.bincount(label))
    new = np.cumsum(keep) - 1
    inner = pairs[keep[pairs[:, 0]]] if len(pairs) else pairs
    return points[keep], radius[keep], new[inner], count - 1, int(n - keep.sum())
