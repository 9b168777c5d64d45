"""Vessels of the lung from a CT: large ones, which a needle must never meet, and all others [Fu2018]."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError, GridMismatchError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Float32, Int16, Mask, UInt8
from anatomy.grid import Volume
from anatomy.machine_code.ahead import usable_cores
from anatomy.morphology import Window, bounds, closed, window

if TYPE_CHECKING:
    from anatomy.segmentation.airway import Airways

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
        """Cut the box around the lung, where responses are wanted, out of a CT in any memory order.

        The CT in Hounsfield units and the lung are `(ni, nj, nk)`; 0 threads are all processors that this
        process may use.  Raises GridMismatchError if the shapes differ, and AnatomyError if the lung is
        empty, or the CT is not of a real type.
        """
        import edt

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
        threads = threads or usable_cores()
        # The end of the image is no surface of the lung.
        inside, sides = np.array(lung[box], order="F"), tuple(spacing)
        depth = edt.edt(inside, anisotropy=sides, order="F", black_border=False, parallel=threads).T
        n_scales = np.zeros(depth.shape, dtype=np.uint8)
        for limit in DEEPER_THAN_MM:
            n_scales += depth > limit
        return cls(
            box=box, spacing_mm=spacing, hu=np.ascontiguousarray(image), n_scales=n_scales, threads=threads
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
        _share_axis(work, self.hu.shape[axis], self.threads)

    def whole(self, part: Array, shape: tuple[int, ...]) -> Array:
        """Return an image of the whole grid, `[i, j, k]`, 0 outside the box."""
        image = np.zeros(shape, dtype=part.dtype, order="F")
        image[self.box] = part.T
        return image


def _share_axis(work: Callable[[int, int], None], length: int, threads: int) -> None:
    """Call `work(first, last)` for parts of `range(length)`, in threads if there are more than one."""
    parts = np.linspace(0, length, 4 * threads + 1).astype(np.int64) if threads > 1 else np.array([0, length])
    spans = [(int(a), int(b)) for a, b in zip(parts, parts[1:], strict=False) if b > a]
    if threads == 1:
        for span in spans:
            work(*span)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda span: work(*span), spans))


def discrete_gaussian(variance: float) -> Float32:
    """Return the weights of the discrete Gaussian [Lindeberg1990], centre first: exp(-t) I_n(t).

    The variance is t, in squared voxels.  The weights are cut where they lose `LOST_WEIGHT`, and scaled to
    the sum 1.
    """
    from scipy.special import ive

    weights = ive(np.arange(int(8.0 * math.sqrt(variance)) + 8), variance)
    total = weights[0] + 2.0 * np.cumsum(weights[1:])
    n = 1 + int(np.argmax(total >= 1.0 - LOST_WEIGHT)) if total[-1] >= 1.0 - LOST_WEIGHT else weights.size - 1
    weights = weights[: n + 1]
    return np.asarray(weights / (weights[0] + 2.0 * weights[1:].sum()), dtype=np.float32)


VESSEL_THRESHOLD = 0.25
"""Fixed on made cylinders and the phantom, see docs/explanation/segmentation.md."""
LARGE_RADIUS_MM = 2.0 * math.sqrt(2.0)
"""One of the paper's scales: from this radius on vessels are obstacles, thinner ones are costs."""
LARGE_RADII_MM = (1.0, 4.0)
"""The least and the greatest of the scales: R_L tells no other radii."""
HILUM_MM, HILUM_REACH_MM = 7.0, 20.0
"""Ten voxels of 0.7 mm, as the authors' own code closes lungs; soft tissue in between, near airways."""
HILUM_STEP = 2
"""It lies outside the lung, where voxels are obstacles anyway: every other one tells enough."""
REFERENCE_HU, BRIGHTEST_HU = 300.0, 200.0
"""I_ref and I_max of R_L."""
BLOOD_HU = 40.0
"""Blood without contrast medium."""
SOLID_SHARE, EDGE_SHARE = 0.5, 0.25
"""Way from the lung's median to blood: where a voxel counts as solid, and as the edge of a vessel.  A vessel
of half a voxel's radius gives no more; chosen on phantoms."""


@frozen_record
class Vessels:
    """Vessels of both lungs on the grid of the CT, all `(ni, nj, nk)`.

    Vesselness is 1 in large vessels and in those of the hilum, 0 in airways and their walls and elsewhere
    outside the lung; `mask` are the voxels that reach `threshold`, which is fixed on other data.
    """

    vesselness: Float32
    large: Mask
    mask: Mask
    threshold: float
    warnings: tuple[str, ...] = ()


def segment_vessels(
    ct: Volume,
    lungs: Mask,
    airways: Airways,
    *,
    large_radius_mm: float = LARGE_RADIUS_MM,
    threads: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Vessels:
    """Find the vessels inside the lungs; those of `large_radius_mm` or more are `large`.

    The CT has Hounsfield units; `lungs` `(ni, nj, nk)` are both lungs, filled; lumen and wall of the airways
    never become vessel.  The result does not depend on the threads, 0 for all processors.  Raises
    GridMismatchError if the shapes differ, AnatomyError if the lung is empty, and SettingsError if the radius
    is none of `LARGE_RADII_MM` or between.
    """
    require_large_radius(large_radius_mm)
    shape = ct.array.shape
    for name, mask in (("lung", lungs), ("lumen", airways.lumen), ("wall", airways.wall)):
        if mask.shape != shape:
            raise GridMismatchError(
                f"The {name} has the shape {mask.shape}", expected=f"that of the CT, {shape}"
            )
    space = ScaleSpace.of(ct.array, lungs, ct.grid.spacing_mm, threads=threads)
    airway = np.ascontiguousarray((airways.lumen[space.box] | airways.wall[space.box]).T)
    lung_hu = space.hu[space.n_scales > 0]
    solid = space.hu >= _towards_blood(lung_hu, SOLID_SHARE)
    best, response, at_scale = _responses(space, solid & ~airway, progress)
    large = _large(space, solid, airway, response, at_scale, large_radius_mm)
    del response, at_scale
    warnings = () if large.any() else ("No large vessel was found: is the CT one of the chest?",)
    large |= _hilum(space, solid, airways)
    best[airway] = 0.0
    edges = (space.hu >= _towards_blood(lung_hu, EDGE_SHARE)) & ~airway & (space.n_scales > 0)
    # How far the response of a vessel's core carries to its edge.
    for _ in range(2):
        raised = best.copy()
        space.share(partial(_raise_at_edges, best, edges, raised))
        best = raised
    best[large] = 1.0
    found = space.whole(best, shape)
    return Vessels(
        vesselness=found,
        large=space.whole(large, shape),
        mask=found >= np.float32(VESSEL_THRESHOLD),
        threshold=VESSEL_THRESHOLD,
        warnings=warnings,
    )


def _towards_blood(lung_hu: Int16 | Float32, share: float) -> float:
    """Return HU a share of the way from lung median to blood without contrast (with it: the safe side)."""
    median = float(np.median(lung_hu))
    return median + share * (BLOOD_HU - median)


def _responses(
    space: ScaleSpace, solid: Mask, progress: Callable[[str], None] | None
) -> tuple[Float32, Float32, UInt8]:
    """Return vesselness, R_L of solid voxels, and the scale of the greatest R_L."""
    best = np.zeros(space.hu.shape, dtype=np.float32)
    response = np.zeros_like(best)
    at_scale = np.zeros(best.shape, dtype=np.uint8)
    settings = np.array([ALPHA, BETA, C_HU])
    limits = (np.float64(REFERENCE_HU), np.float64(BRIGHTEST_HU))
    solid_scales = space.n_scales * solid
    for scale, (sigma, image) in enumerate(space.images()):
        if progress is not None:
            progress(f"vessels: scale {sigma:.1f} mm")
        _add_vesselness_of(space, scale, sigma, image, settings, best)
        # R_L is raised where `solid_scales` lets this scale apply, and the scale is noted.
        given = (solid_scales, np.int64(scale), space.hessian_factors(sigma), *limits, response, at_scale)
        space.share(partial(_add_large, image, space.hu, given))
    return best, response, at_scale


def _add_large(image: Float32, hu: Int16 | Float32, given: tuple[Any, ...], first: int, last: int) -> None:
    from anatomy.segmentation.kernels.hessian import add_large_response

    add_large_response(image, hu, first, last, *given)


def require_large_radius(radius_mm: float) -> None:
    """Raise SettingsError unless vessels of a radius can be told by their response."""
    least, most = LARGE_RADII_MM
    if not least <= radius_mm <= most:
        raise SettingsError(
            f"The radius from which vessels are obstacles is {radius_mm:g} mm",
            expected=f"{least:g} to {most:g} mm, the scales at which vessels are sought",
            remedy='To avoid all vessels, write vessels = "all_vessels.nii.gz" into patient.toml',
        )


def border_mm(large_radius_mm: float, slice_mm: float) -> tuple[float, float]:
    """Return how far true vessels reach out of the mask `large`: mean and standard deviation over its border.

    They are those of the thinnest vessels in the mask, within 3 mm of it, on CT rendered from phantoms
    (`experiments.vessel_border`); those of wider ones are as great or less.  What thick slices do not show
    at all is not in them.
    """
    thin = np.clip(2.0 - large_radius_mm / (0.5 * LARGE_RADIUS_MM), 0.0, 1.0)
    return 0.33 + 0.11 * slice_mm, float(0.35 + 0.15 * thin + (0.12 - 0.04 * thin) * slice_mm)


def _hilum(space: ScaleSpace, solid: Mask, airways: Airways) -> Mask:
    """Return the solid voxels of the hilum: between the lung and its closing, near airways, in neither."""
    sides = space.spacing_mm[::-1]
    few = (slice(None, None, HILUM_STEP),) * 3
    lung, lumen = space.n_scales[few] > 0, airways.lumen[space.box].T[few]
    if not lumen.any():
        return np.zeros_like(solid)
    coarse = sides * HILUM_STEP
    beyond = closed(lung, HILUM_MM, coarse) & ~lung
    beyond &= _distance_mm(~lumen, coarse, space.threads) <= HILUM_REACH_MM
    for axis in range(3):
        beyond = np.repeat(beyond, HILUM_STEP, axis=axis).take(range(solid.shape[axis]), axis=axis)
    airway = (airways.lumen[space.box] | airways.wall[space.box]).T
    return np.asarray(beyond & solid & (space.n_scales == 0) & ~airway)


def _large(
    space: ScaleSpace, solid: Mask, airway: Mask, response: Float32, at_scale: UInt8, radius_mm: float
) -> Mask:
    """Return the large vessels in the box: solid voxels within `radius_mm` of what tells their inside.

    That is a great R_L at a large scale, or the centre of a solid ball of that radius: where vessels are
    wider than the greatest scale R_L has faded, and at their edges smaller scales respond most.  The ball
    must have its centre in the lung and in no airway, but may reach beyond: at the hilum the lung's mask cuts
    through vessels, and masks of walls reach into the vessels beside them.
    """
    from scipy.ndimage import label

    tissue = (space.n_scales > 0) & ~airway
    # Rounding of scales that are given as decimals.
    first = next(n for n, sigma in enumerate(SIGMAS_MM) if sigma >= radius_mm - 1e-6)
    sides, h = space.spacing_mm[::-1], float(space.spacing_mm.mean())
    # R_T for R_L with min(I, I_max), calibrated on made cylinders.
    inside = (response >= 0.3) & (at_scale >= first)
    inside |= tissue & (_distance_mm(solid, sides, space.threads) >= radius_mm + 0.5 * h)
    if not inside.any():
        return inside
    found = solid & tissue & (_distance_mm(~inside, sides, space.threads) <= radius_mm)
    pieces, _ = label(found, structure=np.ones((3, 3, 3), dtype=np.bool_))
    # A piece with fewer than 1000 voxels of 0.7 mm is dropped.  The voxels of the pieces are few beside those
    # of the image, whose numbers bincount would copy.
    keep = np.bincount(pieces[found], minlength=1) >= 350.0 / float(np.prod(sides))
    keep[0] = False
    return np.asarray(keep[pieces])


def _distance_mm(mask: Mask, sides: Float, threads: int) -> Float32:
    """Return the distance from each voxel of `mask` to the nearest that is not; the image's end is none."""
    import edt

    return np.asarray(
        edt.edt(np.array(mask, order="C"), anisotropy=tuple(sides), black_border=False, parallel=threads)
    )


def _raise_at_edges(best: Float32, edges: Mask, raised: Float32, first: int, last: int) -> None:
    """Give the voxels of `edges` the greatest vesselness of their 26 neighbours: vessels keep their width."""
    from anatomy.segmentation.kernels.neighbours import take_greatest_neighbour

    take_greatest_neighbour(best, first, last, edges, raised)


ALPHA, BETA, C_HU = 0.5, 0.5, 70.0
"""Sensitivity to plates and to blobs; Hessian of 39 % of the greatest response [Fu2018]."""


def vesselness(hu: Int16 | Float32, lung: Mask, spacing_mm: ArrayLike, *, threads: int = 0) -> Float32:
    """Return the greatest response over the scales that apply at each voxel [Fu2018, eqs. 3-5].

    The CT `hu` in Hounsfield units and the lungs with their vessels, whose depth decides which scales apply,
    are `(ni, nj, nk)`.  So is what is returned, in [0, 1] and 0 outside the lung.  Raises GridMismatchError
    or AnatomyError if the shapes differ; if the lung is empty.
    """
    space = ScaleSpace.of(hu, lung, spacing_mm, threads=threads)
    best = np.zeros(space.hu.shape, dtype=np.float32)
    settings = np.array([ALPHA, BETA, C_HU])
    for scale, (sigma, image) in enumerate(space.images()):
        _add_vesselness_of(space, scale, sigma, image, settings, best)
    return space.whole(best, hu.shape)


def _add_vesselness_of(
    space: ScaleSpace, scale: int, sigma: float, image: Float32, settings: Float, best: Float32
) -> None:
    """Raise `best` to the response at one scale; `settings` are alpha, beta, c."""
    from anatomy.segmentation.kernels.hessian import add_vesselness

    factors, index = space.hessian_factors(sigma), np.int64(scale)
    space.share(lambda a, b: add_vesselness(image, a, b, space.n_scales, index, factors, settings, best))
