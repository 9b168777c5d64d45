"""Surface meshes of masks, and exact distances to them with FCL.

Two kinds of mesh, each with a stated bound of its distance from the mask, whose voxels are solid boxes:

`box_surface`
    The faces between voxels inside and outside the mask.  It is the boundary of the mask: bound 0.
`smooth_surface`
    Marching cubes at level 0.5, for pictures.  It cuts corners: its bound is half the diagonal of a voxel.
    Every vertex is the middle of an edge between an inner and an outer voxel centre, which is the middle of
    the face they share.  A triangle stays in one cell of eight voxel centres; the middle of such a cell is a
    corner of all eight voxels, some inside and some outside, hence on the boundary of the mask; no point of
    the cell is farther from its middle than half a diagonal.  The other way, a point of the boundary in the
    cell lies on a quarter of a face whose middle is a vertex, so it is nearer than that.

A surface is hollow: what lies wholly inside touches nothing.  Test containment as well.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Mask
from anatomy.grid import Grid, Volume, read_only
from anatomy.morphology import bounds, window

_RING = ((0, 0), (1, 0), (1, 1), (0, 1))


@frozen_record
class SurfaceMesh:
    """A triangle mesh, closed, its faces turned outwards.

    Vertices are `(V, 3)` LPS mm, faces `(F, 3)` of their indices.  No point of the mesh is farther than
    `bound_mm` from the boundary of the mask, nor the boundary from the mesh.
    """

    vertices_lps: Float
    faces: Int
    bound_mm: float

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_lps, dtype=np.float64).reshape(-1, 3)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64).reshape(-1, 3)
        object.__setattr__(self, "vertices_lps", read_only(vertices))
        object.__setattr__(self, "faces", read_only(faces))

    def to_trimesh(self) -> Any:
        """Return the mesh as a `trimesh.Trimesh`, unprocessed."""
        import trimesh

        return trimesh.Trimesh(vertices=self.vertices_lps, faces=self.faces, process=False)


def box_surface(mask: Mask, grid: Grid, *, beyond: bool = False) -> SurfaceMesh:
    """Return the exact boundary of the voxels of a mask `(ni, nj, nk)` as solid boxes, which may be none.

    `Grid.crop` serves for a region of interest.  With `beyond` all that lies beyond the grid belongs to the
    mask, too.
    """
    if beyond:
        rest = box_surface(~np.asarray(mask, dtype=bool), grid)
        return replace(rest, faces=rest.faces[:, ::-1])
    padded = np.pad(np.asarray(mask, dtype=bool), 1)
    corners = np.concatenate([_faces_of(padded, axis, side) for axis in range(3) for side in (0, 1)])
    shape = np.asarray(mask.shape) + 1
    flat = np.ravel_multi_index(tuple(corners.reshape(-1, 3).T), tuple(shape))
    used, index = np.unique(flat, return_inverse=True)
    quad = index.reshape(-1, 4)
    lattice = np.stack(np.unravel_index(used, tuple(shape)), axis=-1).astype(np.float64)
    return SurfaceMesh(
        vertices_lps=grid.lps(lattice - 0.5),
        faces=np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]),
        bound_mm=0.0,
    )


def _faces_of(padded: Mask, axis: int, side: int) -> Int:
    """Return the `(F, 4, 3)` corner indices of the faces towards one side, counted outwards."""
    inner = padded[1:-1, 1:-1, 1:-1]
    window = [slice(1, -1)] * 3
    window[axis] = slice(2, None) if side else slice(0, -2)
    voxels = np.argwhere(inner & ~padded[tuple(window)])
    first, second = (axis + 1) % 3, (axis + 2) % 3
    offsets = np.zeros((4, 3), dtype=np.int64)
    for n, (a, b) in enumerate(_RING if side else _RING[::-1]):
        offsets[n, [axis, first, second]] = side, a, b
    return np.asarray(voxels[:, None, :] + offsets, dtype=np.int64)


def smooth_surface(volume: Volume) -> SurfaceMesh:
    """Return a marching cubes surface of a bool volume, for pictures and prints.

    Raises AnatomyError if the mask is empty.
    """
    from skimage.measure import marching_cubes

    if not volume.array.any():
        raise AnatomyError("An empty mask has no surface", expected="a mask with at least one voxel")
    low, high = bounds(volume.array)
    padded = np.pad(volume.array[window(low, high)], 1).astype(np.float32)
    vertices, faces, _, _ = marching_cubes(padded, level=0.5, gradient_direction="ascent")
    return SurfaceMesh(
        vertices_lps=volume.grid.lps(vertices + low - 1.0),
        faces=faces,
        bound_mm=0.5 * float(np.linalg.norm(volume.grid.spacing_mm)),
    )


class MeshDistance:
    """Distances from segments, the axes of capsules, to a mesh (an FCL bounding volume hierarchy).

    A capsule (a ball of radius r swept along a segment) touches the mesh if and only if the segment is
    not farther than r from it.  Segments enter as flat triangles: FCL compares triangles in closed form
    (error about 1e-14 mm), but capsules by iteration (error about 1e-5 mm).  All is infinitely far from
    an empty mesh.
    """

    def __init__(self, mesh: SurfaceMesh) -> None:
        self._mesh = _fcl_object(mesh.vertices_lps, mesh.faces) if len(mesh.faces) else None

    def segment_distance_mm(self, starts_lps: ArrayLike, ends_lps: ArrayLike) -> Float:
        """Return `(N,)` distances in mm of segments, ends `(N, 3)` LPS mm, from the surface, 0 if crossed."""
        starts = np.asarray(starts_lps, dtype=np.float64).reshape(-1, 3)
        ends = np.asarray(ends_lps, dtype=np.float64).reshape(-1, 3)
        if self._mesh is None:
            return np.full(len(starts), np.inf)
        return np.array([self._distance(a[None], b[None]) for a, b in zip(starts, ends, strict=True)])

    def polyline_distance_mm(self, points_lps: ArrayLike) -> float:
        """Return the distance in mm from a polyline `(N, 3)`, LPS mm, to the surface, 0 where it crosses it.

        All segments enter as one mesh, several times faster than one by one.  One point is a polyline, too.
        """
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        if self._mesh is None:
            return math.inf
        last = max(len(points) - 1, 1)
        return self._distance(points[:last], points[-last:])

    def _distance(self, starts: Float, ends: Float) -> float:
        import fcl

        count = np.arange(len(starts))
        triangles = np.stack([count, count + len(starts), count + 2 * len(starts)], axis=1)
        segments = _fcl_object(np.concatenate([starts, ends, 0.5 * (starts + ends)]), triangles)
        found = fcl.distance(self._mesh, segments, fcl.DistanceRequest(), fcl.DistanceResult())
        return max(float(found), 0.0)


def point_distances_mm(mesh: SurfaceMesh, points_lps: ArrayLike, at_most_mm: float) -> Float:
    """Return the exact `(N,)` distances in mm from points `(N, 3)`, LPS mm, to a surface, up to a bound.

    Without FCL, and for many points at once much faster: the nearest triangle is among those whose middle is
    nearer than it plus the largest reach of a triangle; neighbours are added until that is sure.
    """
    from scipy.spatial import cKDTree
    from trimesh.triangles import closest_point

    points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
    # Nearest triangles asked for at first: mostly enough to be sure of the nearest.
    out, left, count = np.full(len(points), at_most_mm), np.arange(len(points)), 16
    if not len(mesh.faces):
        return out
    corners = mesh.vertices_lps[mesh.faces]
    middles = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0
    reach = float(np.sqrt(((corners - middles[:, None]) ** 2).sum(axis=2).max()))
    # For a few hundred queries a rough tree is made and asked faster than a good one is made.
    tree = cKDTree(middles, balanced_tree=False, compact_nodes=False)
    while len(left):
        count = min(count, len(middles))
        away, index = tree.query(points[left], k=np.arange(1, count + 1))
        places = np.repeat(points[left], count, axis=0)
        nearest = closest_point(corners[index.ravel()], places)
        gap = np.linalg.norm(nearest - places, axis=1).reshape(-1, count).min(axis=1)
        out[left] = np.minimum(out[left], gap)
        left = left[(away[:, -1] - reach < out[left]) & (count < len(middles))]
        count *= 4
    return out


def _fcl_object(vertices: Float, faces: Int) -> Any:
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return fcl.CollisionObject(model, fcl.Transform())
