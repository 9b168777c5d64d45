"""The box around lungs and trachea, on voxels near to cubes: what a segmentation works on and writes.

The voxels of a box divide those of the CT, whose edges they share.  Each axis along which the CT has larger
voxels than asked is interpolated; the others are taken as they are.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int, Mask
from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, distance_mm, window
from anatomy.segmentation.folder import onto_grid
from anatomy.segmentation.lungs import Lungs

VOXEL_MM = 0.75
"""About the pixel of a chest CT and its blur: finer voxels show no more, and take more memory."""
VOXEL_RANGE_MM = (0.3, 3.0)
"""Finer voxels take gigabytes; coarser ones hold no bronchi."""
LEAST_GAIN = 1.1
"""An axis whose voxels are at most so many times larger than asked is taken as it is."""
NEAR_MM = 12.0
"""Distances between two slices are interpolated near a surface; slices are at most 10 mm apart."""


@frozen_record
class Box:
    """The voxels `low <= ijk < high` of the finer voxels of a CT, of which there are `counts`, all `(3,)`."""

    ct_grid: Grid
    counts: Int
    low: Int
    high: Int

    @classmethod
    def whole(cls, ct_grid: Grid, voxel_mm: float) -> Self:
        """Return the finer voxels of a whole CT.

        Raises SettingsError if the size of the voxels is out of its range.
        """
        if not VOXEL_RANGE_MM[0] <= voxel_mm <= VOXEL_RANGE_MM[1]:
            raise SettingsError(
                f"Voxels of {voxel_mm:g} mm were asked for",
                expected="{:g} to {:g} mm".format(*VOXEL_RANGE_MM),
                remedy=f"Leave the size out, for {VOXEL_MM:g} mm",
            )
        shape, sides = np.array(ct_grid.shape), ct_grid.spacing_mm
        counts = np.where(sides > LEAST_GAIN * voxel_mm, np.rint(shape * sides / voxel_mm), shape)
        counts = counts.astype(np.int64)
        return cls(ct_grid=ct_grid, counts=counts, low=np.zeros(3, dtype=np.int64), high=counts)

    def around(self, lungs: Lungs) -> Self:
        """Return the box of lungs of the CT and central airway, 10 mm wider where the image allows."""
        parts = [bounds(mask) for mask in (lungs.left, lungs.right, lungs.central_airway) if mask.any()]
        # No filter of the segmentation looks farther beyond a voxel of the lung.
        shape, pad = self.ct_grid.shape, np.ceil(10.0 / self.ct_grid.spacing_mm).astype(np.int64)
        low = np.maximum(np.min([low for low, _ in parts], axis=0) - pad, 0)
        high = np.minimum(np.max([high for _, high in parts], axis=0) + pad, shape)
        return self.part(np.floor(low * self.counts / shape), np.ceil(high * self.counts / shape))

    def part(self, low: ArrayLike, high: ArrayLike) -> Self:
        """Return another box on the same finer voxels."""
        return replace(self, low=np.asarray(low, dtype=np.int64), high=np.asarray(high, dtype=np.int64))

    @property
    def ratio(self) -> Float:
        """Size of a voxel of the box over that of the CT, along i, j, k."""
        return np.array(self.ct_grid.shape) / self.counts

    @property
    def _is_ct(self) -> bool:
        return bool((self.counts == self.ct_grid.shape).all())

    @property
    def lattice(self) -> Grid:
        """The finer voxels of the whole CT."""
        if self._is_ct:
            return self.ct_grid
        matrix = self.ct_grid.lps_from_ijk.copy()
        matrix[:3, :3] *= self.ratio
        matrix[:3, 3] = self.ct_grid.lps((self.ratio - 1.0) / 2.0)
        ni, nj, nk = (int(n) for n in self.counts)
        return Grid(shape=(ni, nj, nk), lps_from_ijk=matrix)

    @property
    def grid(self) -> Grid:
        """The grid of the box."""
        return self.lattice.crop(self.low, self.high)

    def image(self, ct: Volume) -> Volume:
        """Return the CT in the box: cubic splines that stay between the two voxels beside them.

        A spline alone swings beyond its voxels at sharp edges, and draws dark rims around vessels; linear
        interpolation flattens thin lumens and walls.
        """
        start, stop = self._span(REACH)
        values = ct.array[window(start, stop)]
        places = [self._middles(axis) - start[axis] for axis in range(3)]
        if self._is_ct:
            return Volume(grid=self.grid, array=between(values, places))
        kind = np.int16 if values.dtype.kind in "iu" else np.float32
        found = between(values.astype(np.float32), places)
        return Volume(grid=self.grid, array=(np.rint(found) if kind is np.int16 else found).astype(kind))

    def sampled(self, array: Array) -> Array:
        """Return what an image on the voxels of the CT holds at the middle of each voxel of the box."""
        nearest = [np.floor(self._middles(axis) + 0.5).astype(np.int64) for axis in range(3)]
        return np.asfortranarray(array[np.ix_(*nearest)])

    def placed(self, volume: Volume, name: str) -> Array:
        """Return an image whose voxels are those of the CT, or its finer ones, on the voxels of the box.

        Raises GridMismatchError if its voxels are neither.
        """
        try:
            return onto_grid(volume, self.grid, name).array
        except GridMismatchError:
            return self.sampled(onto_grid(volume, self.ct_grid, name).array)

    def placed_on_ct(self, volume: Volume, name: str) -> Volume:
        """Return such an image on the voxels of the CT; the finer voxels are looked at in the box alone.

        Raises GridMismatchError if its voxels are neither.
        """
        try:
            return onto_grid(volume, self.ct_grid, name)
        except GridMismatchError:
            if self._is_ct:
                raise
            return Volume(grid=self.ct_grid, array=self.on_ct(onto_grid(volume, self.grid, name).array))

    def on_ct(self, array: Array) -> Array:
        """Return what an image of the box holds at the middle of each voxel of the CT; 0 outside the box."""
        whole = np.zeros(self.ct_grid.shape, dtype=array.dtype, order="F")
        start, stop = self._span(0)
        nearest = []
        for axis in range(3):
            at = np.floor((np.arange(start[axis], stop[axis]) + 0.5) / self.ratio[axis]).astype(np.int64)
            nearest.append(np.clip(at - self.low[axis], 0, array.shape[axis] - 1))
        whole[window(start, stop)] = array[np.ix_(*nearest)]
        return whole

    def lungs(self, lungs: Lungs) -> Lungs:
        """Return lungs of the CT in the box; between slices their surface runs smoothly."""
        right = self._smooth(lungs.right)
        seed = np.floor((lungs.trachea_seed_ijk + 0.5) / self.ratio).astype(np.int64) - self.low
        return replace(
            lungs,
            left=self._smooth(lungs.left) & ~right,
            right=right,
            trachea_seed_ijk=seed,
            central_airway=self._smooth(lungs.central_airway),
        )

    def _smooth(self, mask: Mask) -> Mask:
        """Return a mask of the CT in the box, by its signed distances interpolated [Raya1990]."""
        if self._is_ct or not mask.any():
            return self.sampled(mask)
        # Outside a border of the mask nothing is within it, and nothing tells its distances.
        low, high = bounds(mask, 2)
        low = np.maximum(np.floor(low / self.ratio).astype(np.int64), self.low)
        high = np.minimum(np.ceil(high / self.ratio).astype(np.int64), self.high)
        whole = np.zeros(self.high - self.low, dtype=np.bool_, order="F")
        whole[window(low - self.low, high - self.low)] = self.part(low, high)._between_slices(mask)
        return whole

    def _between_slices(self, mask: Mask) -> Mask:
        start, stop = self._span(1)
        part, sides = np.asfortranarray(mask[window(start, stop)]), self.ct_grid.spacing_mm
        places = [self._middles(axis) - start[axis] for axis in range(3)]
        deep = np.minimum(distance_mm(part, sides), np.float32(NEAR_MM))
        deep -= np.minimum(distance_mm(~part, sides), np.float32(NEAR_MM))
        return np.asfortranarray(between(deep, places, cubic=False) > 0.0)

    def _middles(self, axis: int) -> Float:
        """Return where the middles of the voxels of the box lie along an axis of the CT, in its voxels."""
        return np.asarray((np.arange(self.low[axis], self.high[axis]) + 0.5) * self.ratio[axis] - 0.5)

    def _span(self, margin: int) -> tuple[Int, Int]:
        """Return the voxels of the CT, `start <= ijk < stop`, that the box and a margin cover."""
        start = np.floor(self.low * self.ratio).astype(np.int64) - margin
        stop = np.ceil(self.high * self.ratio).astype(np.int64) + margin
        return np.maximum(start, 0), np.minimum(stop, self.ct_grid.shape)


REACH = 12
"""Voxels farther than so many from a place weigh less than 1e-6 in its spline."""


def between(values: Array, places: Sequence[Float], *, cubic: bool = True) -> Array:
    """Return an image at the nodes of another grid whose axes are parallel, Fortran-contiguous.

    A cubic spline swings beyond its voxels at sharp edges: it draws dark rims around vessels.  It is cut off
    at the values of the two voxels beside a place, axis by axis.  Axes whose places are voxels are copied.

    Args:
        values ((ni, nj, nk)): float32 if any axis is interpolated.
        places (three (N,) float64): Where along each axis, in voxels; beyond the ends the image goes on as it
            ends.
        cubic: Else linear.
    """
    planes = values.T
    across = np.zeros((len(planes), len(places[1]), len(places[0])), dtype=values.dtype)
    for k, plane in enumerate(planes):
        across[k] = _along(_along(plane, places[1], cubic).T, places[0], cubic).T
    return np.asfortranarray(_along(across, places[2], cubic).T)


def _along(values: Array, places: Float, cubic: bool) -> Array:
    last = len(values) - 1
    first = np.clip(np.floor(places), 0, last).astype(np.int64)
    if (first == places).all():
        return values[first]
    second, shares = np.minimum(first + 1, last), np.clip(places - first, 0.0, 1.0)
    terms = values
    if cubic:
        from scipy.ndimage import spline_filter1d

        terms = spline_filter1d(values, 3, axis=0, output=np.float32)
    found = np.zeros((len(places), *values.shape[1:]), dtype=values.dtype)
    for n, (below, above, share) in enumerate(zip(first, second, shares, strict=True)):
        for step, weight in _weights(float(share), cubic):
            at = abs(int(below) + step)
            found[n] += np.float32(weight) * terms[max(2 * last - at, 0) if at > last else at]
        if cubic:
            least, most = np.minimum(values[below], values[above]), np.maximum(values[below], values[above])
            np.clip(found[n], least, most, out=found[n])
    return found


def _weights(t: float, cubic: bool) -> list[tuple[int, float]]:
    """Return steps and weights of voxels, or of coefficients of the spline, a share `t` beyond one."""
    if not cubic:
        return [(0, 1.0 - t), (1, t)]
    s = 1.0 - t
    return [
        (-1, s**3 / 6.0),
        (0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0),
        (1, (4.0 - 6.0 * s**2 + 3.0 * s**3) / 6.0),
        (2, t**3 / 6.0),
    ]
