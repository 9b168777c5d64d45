"""Centrelines with radii: what a route follows, and the lumen as a union of cones."""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.fields import CENTRES, SOLID, DistanceField, corner_geometry, distance_field
from anatomy.grid import Grid, Volume, read_only
from anatomy.kernels.field import exact_at
from anatomy.lung import Lung
from stages.scope.route.kernels import lumen as kernel

LONGEST_EDGE_MM = 0.75
"""The longest edge is about a voxel of a CT, so that radii follow the wall."""
TINY_MM = 1e-9
"""The rounding of lengths is less."""


@frozen_record
class Centreline:
    """A graph of centred points with radii; N nodes, E edges.

    The lumen is the union of round cones along the edges: all balls with a centre on an edge and the radius
    interpolated between its ends.  With `from_lung` and `from_mask` that union is proved to lie in the mask.
    Raises AnatomyError if there are no edges, or the arrays do not fit together or hold no finite numbers.

    Args:
        nodes_mm ((N, 3) float64): LPS mm; for a drawing, z = 0.
        radius_mm: (N,) float64.
        edges ((E, 2) int64): Pairs of nodes that follow each other along a tube.
    """

    nodes_mm: Float
    radius_mm: Float
    edges: Int

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes_mm, dtype=np.float64)
        radius = np.array(self.radius_mm, dtype=np.float64)
        edges = np.array(self.edges, dtype=np.int64)
        fits = nodes.ndim == 2 and nodes.shape[1] == 3 and radius.shape == (len(nodes),)
        fits = fits and edges.ndim == 2 and edges.shape[1] == 2 and len(edges) > 0
        if not fits or not np.isfinite(nodes).all() or not np.isfinite(radius).all() or (radius < 0).any():
            raise AnatomyError(
                f"A centreline has nodes {nodes.shape}, radii {radius.shape} and edges {edges.shape}",
                expected="finite (N, 3) points, (N,) radii of at least 0 and (E, 2) edges, E > 0",
            )
        if edges.min() < 0 or edges.max() >= len(nodes):
            raise AnatomyError("An edge of a centreline names a node that is not there")
        for name, array in (("nodes_mm", nodes), ("radius_mm", radius), ("edges", edges)):
            object.__setattr__(self, name, read_only(array))

    @property
    def n_nodes(self) -> int:
        """Number of nodes, N."""
        return len(self.nodes_mm)

    @cached_property
    def cones(self) -> Float:
        """The round cones of the lumen, `(E, 8)`: point, radius, point, radius."""
        a, b = self.edges.T
        parts = (self.nodes_mm[a], self.radius_mm[a, None], self.nodes_mm[b], self.radius_mm[b, None])
        return read_only(np.ascontiguousarray(np.hstack(parts)))

    @cached_property
    def cells(self) -> tuple[Float, Int, Int]:
        """A grid of cells with the cones that touch each: origin, size and shape (7,); starts; cones."""
        margin = self.radius_mm[:, None]
        low, high = (self.nodes_mm - margin).min(axis=0), (self.nodes_mm + margin).max(axis=0)
        # Smallest cell of the grid of cones: smaller ones hold the same cones and only cost memory.
        size = max(2.0 * float(np.median(self.radius_mm)), 1.0)
        while True:
            shape = np.floor((high - low) / size) + 1.0
            # A larger number of cells would cost more memory than it saves time.
            if shape.prod() <= 2_000_000:
                break
            size *= 1.5
        index = np.concatenate((low, (size,), shape))
        start, listed = kernel.list_cells(self.cones, index)
        return read_only(index), read_only(start), read_only(listed)

    def depth_mm(self, points_mm: ArrayLike) -> Float:
        """Return how deep points `(N, 3)` lie in the lumen, `(N,)` mm; negative outside."""
        points = np.ascontiguousarray(np.asarray(points_mm, dtype=np.float64).reshape(-1, 3))
        out = np.zeros(len(points))
        kernel.depths_at(self.cones, *self.cells, points, out)
        return out

    def nearest_node(self, point_mm: ArrayLike) -> int:
        """Return the node nearest to a point `(3,)` in mm."""
        offset = self.nodes_mm - np.asarray(point_mm, dtype=np.float64)
        return int(np.argmin(np.einsum("ij,ij->i", offset, offset)))

    def require_inside(self, point_mm: Float, needed_mm: float, name: str) -> None:
        """Raise `TargetError` unless a point lies at least `needed_mm` deep in the lumen."""
        depth = float(self.depth_mm(point_mm)[0])
        if not depth >= needed_mm:
            where = f"{depth:.2f} mm inside the lumen"
            if depth < 0:
                nearest = self.nodes_mm[self.nearest_node(point_mm)]
                near, away = ", ".join(f"{x:.1f}" for x in nearest), np.linalg.norm(nearest - point_mm)
                where = f"outside the lumen; the centreline's nearest point, ({near}), is {away:.1f} mm away"
            raise TargetError(
                f"The {name} of the route lies {where}",
                expected=f"at least {needed_mm:g} mm inside it, the radius of the device with its margin",
                remedy="Choose another point, or a thinner device",
            )


def from_tree(tree: AirwayTree) -> Centreline:
    """Return the centreline of a tree as it is; where a gap was bridged the radius is 0."""
    edges = np.stack((tree.parent_point[1:], np.arange(1, tree.n_points)), axis=1)
    return Centreline(nodes_mm=tree.points_lps, radius_mm=tree.radius_mm, edges=edges)


def from_graph(points_lps: ArrayLike, radius_mm: ArrayLike, edges: ArrayLike) -> Centreline:
    """Return the centreline of lines that need not be an airway, as a file holds them; points in LPS mm.

    Points that coincide to 0.001 mm become one, with the larger radius: files often begin each branch with a
    copy of the point that it hangs on.
    """
    points, radius = np.asarray(points_lps, dtype=np.float64), np.asarray(radius_mm, dtype=np.float64)
    # Points of a file that are nearer are one point, written twice with rounding.
    _same, first, merged = np.unique(np.round(points / 1e-3), axis=0, return_index=True, return_inverse=True)
    widest = np.zeros(len(first))
    np.maximum.at(widest, merged.ravel(), radius)
    pairs = np.unique(np.sort(merged.ravel()[np.asarray(edges, dtype=np.int64)], axis=1), axis=0)
    return Centreline(nodes_mm=points[first], radius_mm=widest, edges=pairs[pairs[:, 0] != pairs[:, 1]])


def from_lung(lung: Lung) -> Centreline:
    """Return the centreline of the airway with radii proved against the lumen mask."""
    base = from_tree(lung.tree)
    walls = _Walls(lung.mask("lumen").array, lung.grid, SOLID, lung.lumen_depth)
    return _proved(*_refined(base.nodes_mm, base.edges), walls)


def from_mask(mask: Volume, *, rounded: bool = False) -> Centreline:
    """Return the centreline of any branching tube, not zero in a mask: vein, artery or airway, no root.

    It is the skeleton of the largest piece of the mask, smoothed, with radii proved against the mask (voxels
    as solid boxes).  Raises AnatomyError if the mask is empty, or too small for a line.
    """
    from anatomy.tree.lumen import prepare_lumen
    from anatomy.tree.skeleton import prune, spanning_tree, thin

    prepared = prepare_lumen(mask, 0.0)
    grid = prepared.grid
    ijk = thin(prepared.solid)
    depth = prepared.solid_depth_mm[tuple(ijk.T)].astype(np.float64)
    skeleton, _rings = spanning_tree(ijk, prepared.lumen, depth, grid.spacing_mm)
    prune(skeleton, grid.spacing_mm)
    pairs = [(a, b) for a, near in enumerate(skeleton.neighbours) for b in near if a < b]
    if not pairs:
        raise AnatomyError(
            "The skeleton of the mask is a single point",
            expected="a tube longer than wide",
            remedy="Give a mask of vessels or airways",
        )
    walls = _Walls(prepared.lumen, grid, CENTRES if rounded else SOLID)
    used, edges = np.unique(np.array(pairs), return_inverse=True)
    return _of_skeleton(grid.lps(skeleton.ijk[used]), edges.reshape(-1, 2), walls)


def from_image(drawing: Bool, *, pixel_mm: float) -> Centreline:
    """Return the centreline of a drawing of vessels, true inside one, in the plane z = 0.

    The pixel in row i and column j is centred at x = j, y = i times the size of a pixel.

    Raises:
        AnatomyError: If the drawing is empty or not two-dimensional.
    """
    picture = np.asarray(drawing, dtype=bool)
    if picture.ndim != 2 or not picture.any():
        raise AnatomyError(
            f"A drawing of the shape {picture.shape} shows no vessel",
            expected="a picture of rows and columns, true inside the vessels",
            remedy="Draw vessels dark on white, or choose another picture",
        )
    from scipy import ndimage
    from scipy.spatial import KDTree
    from skimage.morphology import skeletonize

    framed = np.pad(picture.T, 1)
    # Three equal layers: in the middle one only the walls of the drawing are near.
    slab = np.repeat(framed[:, :, None], 3, axis=2)
    grid = Grid.from_spacing(slab.shape, (pixel_mm, pixel_mm, pixel_mm), np.full(3, -pixel_mm))
    walls = _Walls(slab, grid, SOLID)
    labels, _count = ndimage.label(framed, np.ones((3, 3), dtype=bool))
    ij = np.argwhere(skeletonize(labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))))
    edges = KDTree(ij).query_pairs(1.5, output_type="ndarray").astype(np.int64)
    if not len(edges):
        raise AnatomyError(
            "The skeleton of the drawing is a single point",
            expected="vessels longer than wide",
            remedy="Draw vessels as lines, or choose another picture",
        )
    return _of_skeleton(grid.lps(np.column_stack((ij, np.ones(len(ij))))), edges, walls)


def _of_skeleton(nodes: Float, edges: Int, walls: "_Walls") -> Centreline:
    return _proved(*_refined(_smoothed(nodes, edges, walls), edges), walls)


def _refined(nodes: Float, edges: Int) -> tuple[Float, Int]:
    """Divide edges evenly until none is longer than `LONGEST_EDGE_MM`."""
    begin, end = nodes[edges[:, 0]], nodes[edges[:, 1]]
    count = np.ceil(np.linalg.norm(end - begin, axis=1) / LONGEST_EDGE_MM - 1e-9)
    parts = np.maximum(count, 1).astype(np.int64)
    which = np.repeat(np.arange(len(edges)), parts)
    number = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts) + 1
    # The node at the end of each part: that of the edge, or the next of those that are added.
    inner = number < parts[which]
    ends = np.where(inner, len(nodes) + np.cumsum(inner) - 1, edges[which, 1])
    begins = np.where(number == 1, edges[which, 0], np.roll(ends, 1))
    share, which = (number / parts[which])[inner, None], which[inner]
    added = begin[which] * (1.0 - share) + end[which] * share
    return np.vstack((nodes, added)), np.stack((begins, ends), axis=1)


def _smoothed(nodes: Float, edges: Int, walls: "_Walls") -> Float:
    """Draw each node towards the middle of its neighbours as long as it stays about as deep."""
    # Smoothing never takes a point of a skeleton to less than this share of the depth it had.
    floor = 0.9 * walls.depth_mm(nodes)
    degree = np.bincount(edges.ravel(), minlength=len(nodes))
    free = degree == 2
    current = nodes.copy()
    for _ in range(30):
        total = np.zeros_like(current)
        np.add.at(total, edges[:, 0], current[edges[:, 1]])
        np.add.at(total, edges[:, 1], current[edges[:, 0]])
        wanted = np.where(free[:, None], 0.5 * (current + total / degree[:, None]), current)
        current = np.where((walls.depth_mm(wanted) >= floor)[:, None], wanted, current)
    return current


def _proved(nodes: Float, edges: Int, walls: "_Walls") -> Centreline:
    """Give every node the largest radius with which the cones are proved to lie in the lumen.

    The depth is 1-Lipschitz: between two places `h` apart where it is `d` and `e`, it is nowhere less than
    `max(d - x, e - (h - x))`, `x` from the first.  The radius is linear there, so that it exceeds this bound
    most where the parts cross, or at one of the places.  Where it does, the radii at both ends of the edge
    are reduced, and again where one of them has become 0 and could not be reduced by as much.
    """
    radius = np.maximum(walls.depth_mm(nodes), 0.0)
    begin, end = nodes[edges[:, 0]], nodes[edges[:, 1]]
    length = np.linalg.norm(end - begin, axis=1)
    # Spacing of the places at which a cone is compared with the mask.
    count = max(1, int(np.ceil(float(length.max()) / 0.05)))
    step, places = length / count, np.arange(count + 1)[:, None] / count
    depth = np.stack([walls.depth_mm(begin * (1.0 - share) + end * share) for share in places])
    crossing = np.clip(0.5 * (depth[:-1] - depth[1:] + step), 0.0, step)
    shares = np.vstack((places + np.zeros(len(edges)), places[:-1] + crossing / np.maximum(length, TINY_MM)))
    bound = np.vstack((depth, np.maximum(depth[:-1] - crossing, depth[1:] - (step - crossing))))
    while True:
        first, last = radius[edges].T
        excess = (first * (1.0 - shares) + last * shares - bound).max(axis=0)
        lowered = np.zeros(len(nodes))
        for side in range(2):
            np.maximum.at(lowered, edges[:, side], excess)
        if not (lowered[radius > 0.0] > 0.0).any():
            return Centreline(nodes_mm=nodes, radius_mm=radius, edges=edges)
        radius = np.maximum(radius - np.where(lowered > 0.0, lowered + TINY_MM, 0.0), 0.0)


class _Walls:
    """The distance to the voxels that are not lumen: exact in thin tubes, a lower bound in thick ones.

    Args:
        lumen (bool array): With at least one layer that is not lumen all around.
        half_voxels: Whether walls are solid boxes, or the centres of their voxels; then half of the smallest
            voxel edge is taken off, so that a flat wall stays where it is and only steps are rounded.
    """

    def __init__(
        self, lumen: Bool, grid: Grid, half_voxels: float, field: DistanceField | None = None
    ) -> None:
        wall = ~np.asarray(lumen)
        self._field = field or distance_field("wall", wall, grid, half_voxels)
        self._labels = np.asfortranarray(wall.astype(np.uint16))
        self._geometry = corner_geometry(grid, half_voxels)
        self._lost = float(np.linalg.norm(grid.spacing_mm)) + 1.0 / 256.0
        # Below so many edges of a voxel the distance is searched exactly: the bound loses up to half.
        self._thin_mm = 6.0 * float(grid.spacing_mm.min())
        self._taken_off = 0.0 if half_voxels == SOLID else 0.5 * float(grid.spacing_mm.min())

    def depth_mm(self, points: Float) -> Float:
        """Return depths `(N,)` in mm."""
        bound = self._field.lower_bound_mm(points)
        thin = np.flatnonzero(bound < self._thin_mm)
        exact = np.zeros(len(thin))
        cap = self._thin_mm + self._lost
        exact_at(self._labels, self._geometry, np.ascontiguousarray(points[thin]), 1, -1, cap, exact)
        bound[thin] = exact
        return np.asarray(bound - self._taken_off)
