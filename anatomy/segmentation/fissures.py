"""Fissures in a CT: thin bright sheets between the lobes, told apart from all other plates by their size.

What is plate-like by the eigenvalues of its Hessian [Wiemker2005, Lassen2013] is noise, the edge of a vessel
or a fissure.  Only a fissure goes on in its plane: around it normals agree, and hundreds of voxels hang
together.
"""

from typing import Self

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Float32, Int, Mask
from anatomy.grid import Grid

EDGE_MM = 1.0
"""About the blur of a CT, and fine enough for fissures, which are 1 to 2 mm wide in it."""

BRIGHTEST_HU = 350.0
"""Above the lung's median; a fissure is below, and vessels are cut to this so that their edges are small."""
BLOCK = 2
"""Normals are compared over blocks of so many voxels."""
NOISE_PERCENTILE = 90.0
"""Fissures fill about 2 % of a lung: below this percentile there is noise alone."""


@frozen_record
class Fissureness:
    """How likely each cubic voxel is of a fissure, `(nk, nj, ni)`.

    Args:
        likelihood (float32): In [0, 1); 0 where no sheet is.
        looked: Where a fissure could be seen: in the lung, away from vessels, airways and the pleura.
        noise: The response that noise gives.
    """

    likelihood: Float32
    looked: Mask
    noise: float

    @property
    def seen(self) -> Mask:
        """The voxels of the sheets."""
        return np.asarray(self.likelihood > 0)


def fissureness(hu: Float32, lung: Mask, barred: Mask) -> Fissureness:
    """Return where sheets like fissures are, on cubic voxels of 1 mm.

    Args:
        hu: (nk, nj, ni) float32.
        lung ((nk, nj, ni) bool): Both lungs, filled.
        barred ((nk, nj, ni) bool): Vessels and airways, whose walls look like plates.
    """
    from scipy import ndimage

    from anatomy.segmentation.kernels.plates import grow_sheets, plate_responses

    inner = ndimage.binary_erosion(lung)
    typical = np.median(hu[inner]) if inner.any() else 0.0
    filled = np.where(inner, np.minimum(hu, typical + BRIGHTEST_HU), typical).astype(np.float32)
    # A fissure is thinner than the blur of a CT: about as wide as this in the image.
    smooth = ndimage.gaussian_filter(filled, 1.0, truncate=3.0)
    # A plate this near to the surface of the lung may be the pleura.
    where = ndimage.binary_erosion(lung, iterations=3) & ~ndimage.binary_dilation(barred)
    strength = np.zeros(hu.shape, dtype=np.float32)
    normal = np.zeros((3, *hu.shape), dtype=np.float32)
    plate_responses(smooth, where, strength, normal)
    response = _in_agreement(strength, normal)
    # An image without noise has rounding errors of about this.
    noise = max(float(np.percentile(response[where], NOISE_PERCENTILE)) if where.any() else 0.0, 0.1)
    # A sheet goes on where the response is so many times the noise: 2 % of a lung's voxels are by chance.
    sheet, least = np.zeros(hu.shape, dtype=np.int32), 2.0 * noise
    stack = np.zeros(np.count_nonzero(response >= least) + 1, dtype=np.int64)
    # Neighbours in a sheet turn by at most 26 degrees: 20 mm of radius at 1 mm voxels would turn by 3.
    sizes = grow_sheets(response, normal, least, 0.9, sheet, stack)
    # About 200 mm^2 of a sheet of 2 to 3 voxels: what hangs together by chance is smaller.
    large = (sizes >= 500)[sheet]
    # Likelihood is one half at so many times the noise.
    likelihood = np.where(large, response / (response + 3.0 * noise), np.float32(0.0))
    return Fissureness(likelihood=likelihood.astype(np.float32), looked=where, noise=noise)


def _in_agreement(strength: Float32, normal: Float32) -> Float32:
    """Return the geometric mean of each plate's strength and of how much of those around lies in its plane.

    The sum of `s n n^T` around a voxel has along `n` what agrees, and across it what does not.
    """
    from scipy import ndimage

    at = np.nonzero(strength)
    sizes = zip(at, strength.shape, strict=True)
    place = tuple(np.minimum(axis // BLOCK, n // BLOCK - 1) for axis, n in sizes)
    along, total = (np.zeros(len(at[0]), dtype=np.float32) for _ in range(2))
    for a in range(3):
        for b in range(a, 3):
            summed = blocks_of(strength * normal[a] * normal[b]).mean(axis=(1, 3, 5), dtype=np.float32)
            # This neighbourhood is wider than a vessel and narrower than folds.
            around = ndimage.gaussian_filter(summed, 3.0 / BLOCK, truncate=2.5)[place]
            along += np.float32(1 if a == b else 2) * normal[a][at] * normal[b][at] * around
            if a == b:
                total += around
    response = np.zeros(strength.shape, dtype=np.float32)
    response[at] = np.sqrt(strength[at] * np.maximum(along - np.float32(0.5) * (total - along), 0))
    return response


def blocks_of(image: Array) -> Array:
    """Return an image as blocks of 2 x 2 x 2 voxels, along the axes 1, 3 and 5; a rest is cut off."""
    nk, nj, ni = (n // BLOCK for n in image.shape)
    return image[: nk * BLOCK, : nj * BLOCK, : ni * BLOCK].reshape(nk, BLOCK, nj, BLOCK, ni, BLOCK)


@frozen_record
class Cubic:
    """Cubic voxels over the box of a CT's grid; their shape and arrays are `(nk, nj, ni)`, C-contiguous."""

    grid: Grid
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, grid: Grid) -> Self:
        """Return the cubic voxels over the box of a grid."""
        sizes = zip(grid.shape, grid.spacing_mm, strict=True)
        ni, nj, nk = (max(1, round(n * h / EDGE_MM)) for n, h in sizes)
        return cls(grid=grid, shape=(nk, nj, ni))

    def mean(self, image: Array) -> Float32:
        """Return the mean of an image `(ni, nj, nk)` over each cubic voxel; linear between larger voxels."""
        out: Array = image.T
        for axis in range(3):
            out = _mean_along(out, axis, self.shape[axis], float(self.grid.spacing_mm[2 - axis]))
        return np.ascontiguousarray(out)

    def sampled(self, image: Array) -> Array:
        """Return what an image `(ni, nj, nk)` holds at the middle of each cubic voxel."""
        nearest = []
        for axis in range(3):
            middles = (np.arange(self.shape[axis]) + 0.5) * EDGE_MM / self.grid.spacing_mm[2 - axis]
            nearest.append(np.minimum(middles.astype(np.int64), self.grid.shape[2 - axis] - 1))
        return np.ascontiguousarray(image.T[np.ix_(*nearest)])

    def back(self, values: Array) -> Array:
        """Return what cubic voxels `(nk, nj, ni)` hold at the voxels of the grid `(ni, nj, nk)`."""
        nearest = []
        for axis in range(3):
            middles = (np.arange(self.grid.shape[2 - axis]) + 0.5) * self.grid.spacing_mm[2 - axis] / EDGE_MM
            nearest.append(np.minimum(middles.astype(np.int64), self.shape[axis] - 1))
        return np.asfortranarray(values[np.ix_(*nearest)].T)

    def index(self, points_lps: Float) -> Int:
        """Return the indices `(N, 3)` along k, j, i of the cubic voxels at points LPS mm, kept in the box."""
        places = (self.grid.ijk(points_lps) + 0.5) * self.grid.spacing_mm / EDGE_MM
        return np.clip(np.floor(places[:, ::-1]).astype(np.int64), 0, np.array(self.shape) - 1)


def _mean_along(image: Array, axis: int, count: int, spacing_mm: float) -> Float32:
    source = np.moveaxis(image, axis, 0)
    made = np.zeros((count, *source.shape[1:]), dtype=np.float32)
    half_mm = 0.5 * max(EDGE_MM, spacing_mm)
    for at in range(count):
        middle_mm = (at + 0.5) * EDGE_MM
        low = max((middle_mm - half_mm) / spacing_mm, 0.0)
        high = min((middle_mm + half_mm) / spacing_mm, float(len(source)))
        for voxel in range(int(low), min(int(np.ceil(high)), len(source))):
            share = (min(voxel + 1.0, high) - max(float(voxel), low)) / (high - low)
            made[at] += np.float32(share) * source[voxel]
    return np.moveaxis(made, 0, axis)
