"""Exact distances from points and segments to structures, their voxels as solid boxes."""

import numpy as np
from scipy.spatial import cKDTree

from anatomy.base.typed import Bool, Float
from anatomy.meshes import MeshDistance, SurfaceMesh, box_surface
from lungaccess.judging.checking.space import Select, labels_at
from lungaccess.judging.checking.tiles import Cluster, Tiles


class Boxes:
    """One structure of a lung as solid boxes.

    Args:
        reach_mm: What lies farther counts as this far.
    """

    def __init__(self, tiles: Tiles, select: Select, reach_mm: float) -> None:
        self._tiles = tiles
        self._select = select
        self._reach_mm = reach_mm
        self._half_diagonal = 0.5 * float(np.linalg.norm(tiles.spacing_mm))

    def holds(self, points_lps: Float) -> Bool:
        """Tell which points lie in a voxel of the structure."""
        return self._select(labels_at(self._tiles.lung, points_lps))

    def distance_mm(self, points_lps: Float) -> Float:
        """Return the `(N,)` exact distances from points to the nearest box, 0 inside, at most the reach."""
        points = np.asarray(points_lps, dtype=np.float64).reshape(-1, 3)
        local = self._tiles.local_mm(points)
        out = np.where(self.holds(points), 0.0, self._reach_mm)
        clusters = self._tiles.near(self._select, local, self._reach_mm)
        bounds = [_to_bounding_box(cluster, local) for cluster in clusters]
        for n in sorted(range(len(clusters)), key=lambda each: float(bounds[each].min())):
            left = np.flatnonzero(bounds[n] < out)
            if len(left):
                out[left] = self._nearer(clusters[n], local[left], out[left])
        return out

    def _nearer(self, cluster: Cluster, local: Float, known: Float) -> Float:
        """Return the distances to the boxes of a cluster where they are less than the known ones.

        The nearest box is among the boxes whose centres are nearer than it plus half a diagonal:
        neighbours are added until that is sure.
        """
        out = known.copy()
        # Nearest centres asked for at first: mostly enough to be sure of the nearest box.
        left, count = np.arange(len(local)), min(16, len(cluster.voxels))
        centres = np.vstack([cluster.centres_mm, np.full(3, np.inf)])
        while len(left):
            within = float(out[left].max()) + self._half_diagonal
            distance, index = cluster.tree.query(
                local[left], k=np.arange(1, count + 1), distance_upper_bound=within
            )
            gap = np.maximum(np.abs(local[left, None, :] - centres[index]) - cluster.half_mm, 0.0)
            out[left] = np.minimum(out[left], np.sqrt((gap**2).sum(axis=-1)).min(axis=1))
            sure = (distance[:, -1] - self._half_diagonal >= out[left]) | (count == len(cluster.voxels))
            left, count = left[~sure], min(4 * count, len(cluster.voxels))
        return out

    def surface_near(self, points: Float, within_mm: float) -> SurfaceMesh:
        """Return the exact surface of the surface voxels that come nearer than `within_mm` to a point."""
        local = self._tiles.local_mm(points)
        bound = within_mm + self._half_diagonal
        path = cKDTree(local)
        found = [np.zeros((0, 3), dtype=np.int64)]
        for cluster in self._tiles.near(self._select, local, bound):
            gap, _ = path.query(cluster.centres_mm, distance_upper_bound=bound)
            found.append(cluster.voxels[np.isfinite(gap)])
        voxels = np.concatenate(found)
        low = voxels.min(axis=0) if len(voxels) else np.zeros(3, dtype=np.int64)
        high = voxels.max(axis=0) + 1 if len(voxels) else low + 1
        grid = self._tiles.lung.grid.crop(low, high)
        mask = np.zeros(grid.shape, dtype=bool)
        mask[tuple((voxels - low).T)] = True
        return box_surface(mask, grid)


class PathDistances:
    """Distances from the points of a path, `(N, 3)` LPS mm, and the segments between them to boxes."""

    def __init__(self, boxes: Boxes, path_lps: Float) -> None:
        self._boxes = boxes
        self._points = np.asarray(path_lps, dtype=np.float64).reshape(-1, 3)
        self._at_most, self._at_least = self._bounds_mm()

    def _bounds_mm(self) -> tuple[float, Float]:
        """Return the least distance of some of the points, and lower bounds `(N,)` for all.

        The distance changes no faster than one walks along the path.
        """
        points = self._points
        # Along a path every so manieth point is measured first; the others are skipped where it tells enough.
        chosen = np.unique(np.append(np.arange(0, len(points), 16), len(points) - 1))
        exact = self._boxes.distance_mm(points[chosen])
        walked = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        behind = np.searchsorted(chosen, np.arange(len(points)), side="right") - 1
        ahead = np.minimum(behind + 1, len(chosen) - 1)
        bounds = np.maximum(
            exact[behind] - np.abs(walked - walked[chosen[behind]]),
            exact[ahead] - np.abs(walked - walked[chosen[ahead]]),
        )
        return float(exact.min()), np.maximum(bounds, 0.0)

    def least_mm(self) -> float:
        """Return the smallest of the exact distances from the points."""
        open_points = self._at_least < self._at_most
        if not open_points.any():
            return self._at_most
        return min(self._at_most, float(self._boxes.distance_mm(self._points[open_points]).min()))

    def segments_mm(self, within_mm: float) -> Float:
        """Return the `(N - 1,)` distances from the segments between consecutive points to the boxes.

        Measured with FCL to the exact surface of the boxes nearer than `within_mm`, 0 where an end lies
        inside them, and at most `within_mm`.  FCL overlooks what is nearest to some segments that are
        parallel to faces, so a segment is never farther away than either of its ends.
        """
        points, bounds = self._points, self._at_least
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        out = np.full(len(points) - 1, within_mm)
        near = np.flatnonzero(np.maximum(bounds[:-1], bounds[1:]) - length < within_mm)
        if len(near):
            ends = np.union1d(near, near + 1)
            surface = self._boxes.surface_near(points[ends], within_mm + float(length.max()))
            distance = MeshDistance(surface).segment_distance_mm(points[near], points[near + 1])
            out[near] = np.minimum(distance, within_mm)
            exact = np.full(len(points), within_mm)
            exact[ends] = self._boxes.distance_mm(points[ends])
            out = np.minimum(out, np.minimum(exact[:-1], exact[1:]))
        inside = self._boxes.holds(points)
        out[inside[:-1] | inside[1:]] = 0.0
        return out


def _to_bounding_box(cluster: Cluster, local: Float) -> Float:
    """Return the distances from points to the bounding box of a cluster."""
    gap = np.maximum(np.maximum(cluster.low_mm - local, local - cluster.high_mm), 0.0)
    return np.asarray(np.sqrt((gap**2).sum(axis=1)))
