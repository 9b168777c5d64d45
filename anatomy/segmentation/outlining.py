"""A nodule outlined from one point in it: grown by density, then cut off from vessels and chest wall.

A threshold half-way between lung and nodule, and an opening as wide as it takes to cut the nodule off, are
those of [Kuhnigk2006]; [Kostis2003] opens by the width of vessels.  At the chest wall a smooth surface
through the pleura around the nodule takes the place of their convex hull and plane, because it also fits
the diaphragm, which bulges into the lung.
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Float32, Int, Mask
from anatomy.base.words import point_in_words
from anatomy.grid import Grid, Volume
from anatomy.morphology import distance_mm, grown_by_one, window

CUBES = ((0.75, 24.0, 8.0), (1.25, 40.0, 18.0))
"""The cubes around the point that are tried in turn, all mm: edge of a voxel, half the side of the cube, and
the greatest radius of a nodule in it."""
LUNG_BELOW_HU = -600.0
"""Lung that holds air is below this."""
SNAP_MM = 2.0
"""Nobody clicks more exactly: the densest place within this distance is meant."""
GREATEST_HU = 100.0
"""Denser nodules, calcified or enhanced, count as this: half-way to them lies within their edge."""
SOLID_HU = -300.0
"""Ground glass is below this."""
LEAST_CONTRAST_HU, LEAST_HALO_HU = 120.0, 170.0
"""Tissue that differs less from the lung around it is no nodule; most of what is around a core must differ by
the second to be ground glass, since the spikes of real nodules raise it by up to 150 HU."""
HALO_VOXELS = (1.6, 3.2)
"""Ground glass around a core is looked for between these distances from it, beyond the core's own blur."""
LEAST_RADIUS_MM = 1.2
"""Radius of the largest ball in the smallest nodule that can be told from a vessel."""
CELL_MM = 1.5
"""Spacing of the points of the pleura."""
SURFACE_STEPS, BELOW_WEIGHT = 30, 0.15
"""Steps of the fit, and the weight of points below the surface: nodules and vessels at the pleura."""


def outline_nodule(ct: Volume, lungs: Mask, point_lps: ArrayLike) -> Mask:
    """Outline the nodule at a point `(3,)` LPS mm; return its voxels `(ni, nj, nk)` on those of the CT.

    `lungs` `(ni, nj, nk)` are both lungs, which may leave the nodule out.  Raises AnatomyError if there is no
    lung around the point, nothing there is denser than lung, or what is there cannot be told from a vessel or
    the chest wall.
    """
    point = np.asarray(point_lps, dtype=np.float64)
    for voxel_mm, reach_mm, radius_mm in CUBES:
        cube = _Cube(ct, lungs, point, voxel_mm, reach_mm)
        inside = cube.outlined(radius_mm)
        if inside is not None:
            return cube.on(ct.grid, inside)
    raise _no_nodule(point, "that can be told from a vessel or the chest wall")


def _no_nodule(point: Float, what: str) -> AnatomyError:
    return AnatomyError(
        f"At {point_in_words(point)} there is no nodule {what}",
        expected="a point in a nodule of 3 to 40 mm with lung around it",
        remedy="Point at its middle with --nodule, or give it with --nodule-mask or --nodule-contours",
    )


class _Cube:
    """Cubic voxels around a point, their HU, and which are lung; places are mm from the point."""

    def __init__(self, ct: Volume, lungs: Mask, point: Float, voxel_mm: float, reach_mm: float) -> None:
        n = 2 * int(reach_mm / voxel_mm) + 1
        self.point, self.voxel_mm, self.reach_mm = point, voxel_mm, reach_mm
        if not ct.grid.contains(point):
            raise _no_nodule(point, "in the image")
        self.grid = Grid.from_spacing((n,) * 3, (voxel_mm,) * 3, point - 0.5 * (n - 1) * voxel_mm)
        side = voxel_mm * (np.arange(n) - 0.5 * (n - 1)).astype(np.float32)
        self.places = np.asfortranarray(np.stack(np.meshgrid(side, side, side, indexing="ij")))
        self.apart = np.linalg.norm(self.places, axis=0)
        self.hu = _interpolated(ct.array, ct.grid, self.grid)
        self.lung = _interpolated(lungs, ct.grid, self.grid) > 0.5
        self.air = self.lung & (self.hu < LUNG_BELOW_HU)

    def on(self, grid: Grid, inside: Mask) -> Mask:
        """Return voxels of the cube on another grid."""
        box = grid.window(self.grid.corners_lps, 0.0)
        part = grid.crop([each.start for each in box], [each.stop for each in box])
        whole = np.zeros(grid.shape, dtype=np.bool_, order="F")
        whole[box] = _interpolated(inside, self.grid, part) > 0.5
        return whole

    @cached_property
    def smooth(self) -> Float32:
        """HU without most of the noise."""
        from scipy.ndimage import gaussian_filter

        # Standard deviation of the Gaussian that takes the noise from ground glass.
        return np.asarray(gaussian_filter(self.hu, 0.6 / self.voxel_mm))

    def outlined(self, most_mm: float) -> Mask | None:
        """Return the nodule, or None if it has a greater radius or does not come free."""
        if np.count_nonzero(self.air) < 100:
            raise _no_nodule(self.point, "in a lung")
        lung_hu = float(np.median(self.hu[self.air]))
        near = np.where(self.apart <= SNAP_MM, self.smooth, -np.inf)
        seed = np.array(np.unravel_index(int(np.argmax(near)), near.shape))
        nodule_hu = min(float(near[tuple(seed)]), GREATEST_HU)
        if nodule_hu < lung_hu + LEAST_CONTRAST_HU:
            raise _no_nodule(self.point, "denser than the lung around it")
        allowed = self.lung | self._below_pleura()
        image = self.hu if nodule_hu > SOLID_HU else self.smooth
        found = self._cut_off((image > 0.5 * (lung_hu + nodule_hu)) & allowed, seed, most_mm)
        if found is None:
            return None
        # Ground glass around a core lowers the threshold.
        beyond = distance_mm(~found, self.grid.spacing_mm) / self.voxel_mm
        shell = (beyond > HALO_VOXELS[0]) & (beyond <= HALO_VOXELS[1]) & allowed
        halo_hu = float(np.median(self.smooth[shell])) if shell.any() else lung_hu
        if halo_hu < lung_hu + LEAST_HALO_HU:
            return found
        return self._cut_off((self.smooth > 0.5 * (lung_hu + halo_hu)) & allowed, seed, most_mm)

    def _cut_off(self, dense: Mask, seed: Int, most_mm: float) -> Mask | None:
        """Return the dense voxels around a seed that the least opening cuts off, if one does."""
        from scipy.ndimage import label

        depth = distance_mm(dense, self.grid.spacing_mm)
        middle = self._deepest(depth, seed)
        radius = float(depth[tuple(middle)])
        if not LEAST_RADIUS_MM <= radius <= most_mm:
            return None
        from_middle = np.linalg.norm(self.places - self.places[:, *middle][:, None, None, None], axis=0)
        # Of these shares of the radius of the largest ball the first opening that cuts it off is used.
        for share in (0.35, 0.45, 0.55, 0.65, 0.75):
            pieces = label(depth > share * radius)[0]
            core = pieces == pieces[tuple(middle)]
            # A nodule reaches this many of its radii from its middle; a vessel runs on farther.
            if from_middle[core].max() + share * radius > 2.2 * radius:
                continue
            found = (distance_mm(~core, self.grid.spacing_mm) <= share * radius + 0.5 * self.voxel_mm) & dense
            ring = grown_by_one(found) & ~found
            # Least share of the surface that borders on lung: half a ball on the pleura has more, a leak into
            # the chest wall or the diaphragm less.
            if np.count_nonzero(ring & self.lung & ~dense) >= 0.45 * np.count_nonzero(ring):
                return np.asfortranarray(found)
        return None

    def _deepest(self, depth: Float32, start: Int) -> Int:
        """Climb from a voxel to the middle of the largest ball that overlaps one around it."""
        while True:
            n = int(np.ceil(max(SNAP_MM, float(depth[tuple(start)])) / self.voxel_mm))
            low = np.maximum(start - n, 0)
            box = depth[window(low, start + n + 1)]
            best = low + np.unravel_index(int(np.argmax(box)), box.shape)
            if depth[tuple(best)] <= depth[tuple(start)]:
                return start
            start = best

    def _below_pleura(self) -> Mask:
        """Return what lies below a surface of second order through the pleura, if there is one near by."""
        none = np.zeros_like(self.lung)
        ball = self.apart <= self.reach_mm
        wall = ball & ~self.lung & (self.hu > LUNG_BELOW_HU)
        if np.count_nonzero(wall) * self.voxel_mm**3 < 100.0:
            return none
        air = self.places[:, ball & self.air]
        up = self.places[:, wall].mean(axis=1) - air.mean(axis=1)
        up /= np.linalg.norm(up)
        axes = np.vstack([np.linalg.svd(up[None])[2][1:], up])
        u, v, w = _top(axes @ air)
        # Where the lung ends with the ball there is no pleura.
        rest = self.reach_mm**2 - u**2 - v**2
        seen = (rest > 0.0) & (w < np.sqrt(np.maximum(rest, 0.0)) - 2.0 * CELL_MM)
        if np.count_nonzero(seen) < 60:
            return none
        u, v, w = u[seen], v[seen], w[seen]
        # Share of half the cube's side within which the pleura counts most.
        near = np.exp(-(u**2 + v**2) / (0.55 * self.reach_mm) ** 2)
        terms, weight = _second_order(u, v), near
        for _ in range(SURFACE_STEPS):
            # By the normal equations, which are six for thousands of points.
            weighted = (terms * (weight**2)[:, None]).T
            factors = np.linalg.lstsq(weighted @ terms, weighted @ w, rcond=None)[0]
            above = w - terms @ factors
            weight = near * np.where(above > 0.0, 1.0, BELOW_WEIGHT) / np.sqrt(1.0 + above**2)
        u, v, w = np.tensordot(axes.astype(np.float32), self.places, axes=1)
        level = sum(f * t for f, t in zip(factors.astype(np.float32), _second_order(u, v).T, strict=True)).T
        return np.asarray((w <= level + 0.5 * self.voxel_mm) & ball)


def _second_order(u: Float, v: Float) -> Float:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _top(uvw: Float) -> tuple[Float, Float, Float]:
    """Return the highest of the points `(3, N)` in each cell of a plane, as u and v of the cell and w."""
    cells = np.floor(uvw[:2] / CELL_MM).astype(np.int64)
    low = cells.min(axis=1, keepdims=True)
    width = int(np.ptp(cells[1])) + 1
    flat = (cells[0] - low[0]) * width + cells[1] - low[1]
    top = np.full(int(flat.max()) + 1, -np.inf)
    np.maximum.at(top, flat, uvw[2])
    used = np.flatnonzero(np.isfinite(top))
    u, v = (np.stack(np.divmod(used, width)) + low + 0.5) * CELL_MM
    return u, v, top[used]


def _interpolated(array: Mask | Float32, grid: Grid, at: Grid) -> Float32:
    """Return an image at the voxels of another grid, linear between its own; it goes on as it ends."""
    from scipy.ndimage import affine_transform

    box = grid.window(at.corners_lps, float(grid.spacing_mm.max()))
    part = grid.crop([each.start for each in box], [each.stop for each in box])
    matrix = part.ijk_from_lps @ at.lps_from_ijk
    values = array[box].astype(np.float32)
    found = affine_transform(values, matrix[:3, :3], matrix[:3, 3], at.shape, order=1, mode="nearest")
    return np.asfortranarray(found)
