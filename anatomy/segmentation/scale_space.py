"""The lung of a CT smoothed to rising scales, one image in memory at a time."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.base.typed import Float, Float32, Int16, Mask, UInt8
from anatomy.machine_code.ahead import usable_cores
from anatomy.morphology import Window, bounds, window

SIGMAS_MM = (1.0, math.sqrt(2.0), 2.0, 2.0 * math.sqrt(2.0), 4.0)
DEEPER_THAN_MM = (0.0, 1.0, 1.0, 2.0, 2.0 * math.sqrt(2.0))
"""How deep below the lung's surface a voxel must lie for each scale to apply [Fu2018, eq. 4]."""
LEAST_HU = -1024
"""Scanners write lower values where they measured nothing."""
LOST_WEIGHT = 1e-5
"""Share of a Gaussian's weight that its ends may lose."""


@dataclass(kw_only=True, eq=False)
class ScaleSpace:
    """The box around a lung; arrays are `(nk, nj, ni)` and C-contiguous: the transposes of images.

    Args:
        box (3 slices): The voxels of the whole image, along i, j, k.
        spacing_mm ((3,) float64): Voxel size along i, j, k.
        hu ((nk, nj, ni) int16 or float32): The CT, not below -1024.
        n_scales ((nk, nj, ni) uint8): How many of `SIGMAS_MM` apply at a voxel; 0 outside the lung.
        threads: Threads that share the planes; the results do not depend on it.
    """

    box: Window
    spacing_mm: Float
    hu: Int16 | Float32
    n_scales: UInt8
    threads: int

    @classmethod
    def of(cls, hu: Int16 | Float32, lung: Mask, spacing_mm: ArrayLike, *, threads: int = 0) -> Self:
        """Cut the box around the lung out of a CT.

        Args:
            hu ((ni, nj, nk) int16 or float32): Hounsfield units, in any memory order.
            lung ((ni, nj, nk) bool): Where responses are wanted.
            spacing_mm ((3,) float64): Voxel size along i, j, k.
            threads: 0 for all processors this process may use.

        Raises:
            GridMismatchError: If the shapes differ.
            AnatomyError: If the lung is empty, or the CT is not of a real type.
        """
        if hu.shape != lung.shape or hu.ndim != 3:
            raise GridMismatchError(
                f"The CT has the shape {hu.shape}, the lung {lung.shape}", expected="two images of one grid"
            )
        if hu.dtype.kind not in "if":
            raise AnatomyError(
                f"The CT has the type {hu.dtype}", expected="Hounsfield units, int16 or float32"
            )
        spacing = np.asarray(spacing_mm, dtype=np.float64)
        if not lung.any():
            raise AnatomyError("The lung mask is empty", expected="at least one voxel of lung")
        # How many of the greatest sigma the image around the lung is kept.
        box = window(*bounds(lung, np.ceil(3.0 * SIGMAS_MM[-1] / spacing).astype(np.int64)))
        kind = np.float32 if hu.dtype.kind == "f" else np.int16
        image = np.maximum(np.asfortranarray(hu[box]).T, LEAST_HU).astype(kind, copy=False)
        return cls(
            box=box,
            spacing_mm=spacing,
            hu=np.ascontiguousarray(image),
            n_scales=_scales_that_apply(np.array(lung[box], order="F"), spacing, threads or usable_cores()),
            threads=threads or usable_cores(),
        )

    def images(self) -> Iterator[tuple[float, Float32]]:
        """Yield each scale and the CT smoothed to it: one image, changed in place from scale to scale.

        Smoothing is incremental, sigma_2^2 = sigma_1^2 + d^2, by the discrete analogue of the Gaussian
        [Lindeberg1990]: of its kernels this holds without error, for voxels of any size.
        """
        from anatomy.segmentation.kernels.smoothing import smooth_across_planes, smooth_in_planes

        image = self.hu.astype(np.float32)
        variance = 0.0
        for sigma in SIGMAS_MM:
            rows, columns, planes = (discrete_gaussian((sigma**2 - variance) / h**2) for h in self.spacing_mm)
            self.share(lambda a, b, r=rows, c=columns: smooth_in_planes(image, a, b, r, c))  # type: ignore[misc]
            self.share(lambda a, b, w=planes: smooth_across_planes(image, a, b, w), axis=1)  # type: ignore[misc]
            variance = sigma**2
            yield sigma, image

    def hessian_factors(self, sigma: float) -> Float:
        """Return sigma^2 / (h_a h_b) for ii, jj, kk, ij, ik, jk [Fu2018, eq. 3 with gamma 1]."""
        h = self.spacing_mm
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        return np.array([sigma**2 / (h[a] * h[b]) for a, b in pairs])

    def share(self, work: Callable[[int, int], None], axis: int = 0) -> None:
        """Call `work(first, last)` for the parts of an axis; each voxel is written by one call alone."""
        share_axis(work, self.hu.shape[axis], self.threads)

    def whole(self, part: Float32, shape: tuple[int, ...]) -> Float32:
        """Return an image of the whole grid, `[i, j, k]`, 0 outside the box."""
        image = np.zeros(shape, dtype=part.dtype, order="F")
        image[self.box] = part.T
        return image


def share_axis(work: Callable[[int, int], None], length: int, threads: int) -> None:
    """Call `work(first, last)` for parts of `range(length)`, in threads if there are more than one."""
    parts = np.linspace(0, length, 4 * threads + 1).astype(np.int64) if threads > 1 else np.array([0, length])
    spans = [(int(a), int(b)) for a, b in zip(parts, parts[1:], strict=False) if b > a]
    if threads == 1:
        for span in spans:
            work(*span)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, *span) for span in spans]:
            done.result()


def discrete_gaussian(variance: float) -> Float32:
    """Return the weights of the discrete analogue of the Gaussian, centre first: exp(-t) I_n(t).

    Args:
        variance: t, in squared voxels.  The weights are cut where they lose `LOST_WEIGHT`, and scaled to the
            sum 1.

    References:
        [Lindeberg1990]
    """
    from scipy.special import ive

    weights = ive(np.arange(int(8.0 * math.sqrt(variance)) + 8), variance)
    total = weights[0] + 2.0 * np.cumsum(weights[1:])
    n = 1 + int(np.argmax(total >= 1.0 - LOST_WEIGHT)) if total[-1] >= 1.0 - LOST_WEIGHT else weights.size - 1
    weights = weights[: n + 1]
    return np.asarray(weights / (weights[0] + 2.0 * weights[1:].sum()), dtype=np.float32)


def _scales_that_apply(lung: Mask, spacing: Float, threads: int) -> UInt8:
    """Return how many scales apply at each voxel of a box, `(nk, nj, ni)`.

    The end of the image is no surface of the lung.
    """
    import edt

    depth = edt.edt(lung, anisotropy=tuple(spacing), order="F", black_border=False, parallel=threads).T
    count = np.zeros(depth.shape, dtype=np.uint8)
    for limit in DEEPER_THAN_MM:
        count += depth > limit
    return count
