"""Vessels of the lung from a CT: large ones, which a needle must never meet, and all others [Fu2018]."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, Int16, Mask, UInt8
from anatomy.grid import Volume
from anatomy.segmentation.closing import closed
from anatomy.segmentation.scale_space import SIGMAS_MM, ScaleSpace

if TYPE_CHECKING:
    from anatomy.segmentation.airway import Airways


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
    """Find the vessels inside the lungs.

    Args:
        ct: Hounsfield units.
        lungs ((ni, nj, nk) bool): Both lungs, filled.
        airways: Its lumen and wall never become vessel.
        large_radius_mm: Vessels of this radius or more are `large`.
        threads: 0 for all processors; the result does not depend on it.
        progress: Gets what is being done.

    Raises:
        GridMismatchError: If the shapes differ.
        AnatomyError: If the lung is empty.
        SettingsError: If the radius is none of `LARGE_RADII_MM` or between.
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
    solid = space.hu >= towards_blood(lung_hu, SOLID_SHARE)
    best, response, at_scale = _responses(space, solid & ~airway, progress)
    large = _large(space, solid, airway, response, at_scale, large_radius_mm)
    del response, at_scale
    warnings = () if large.any() else ("No large vessel was found: is the CT one of the chest?",)
    large |= _hilum(space, solid, airways)
    best[airway] = 0.0
    edges = (space.hu >= towards_blood(lung_hu, EDGE_SHARE)) & ~airway & (space.n_scales > 0)
    # How far the response of a vessel's core carries to its edge.
    for _ in range(2):
        best = _raised_at_edges(space, best, edges)
    best[large] = 1.0
    found = space.whole(best, shape)
    everywhere = np.zeros(shape, dtype=np.bool_, order="F")
    everywhere[space.box] = large.T
    mask = found >= np.float32(VESSEL_THRESHOLD)
    return Vessels(
        vesselness=found, large=everywhere, mask=mask, threshold=VESSEL_THRESHOLD, warnings=warnings
    )


def towards_blood(lung_hu: Int16 | Float32, share: float) -> float:
    """Return what lies a share of the way from the lung's median to blood without contrast medium, in HU.

    With contrast medium the edge of a vessel so lies a little outside the true one: the safe side.
    """
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
    solid_scales = space.n_scales * solid
    for scale, (sigma, image) in enumerate(space.images()):
        if progress is not None:
            progress(f"vessels: scale {sigma:.1f} mm")
        add_vesselness_of(space, scale, sigma, image, settings, best)
        _add_large(space, scale, sigma, image, solid_scales, response, at_scale)
    return best, response, at_scale


def _add_large(
    space: ScaleSpace,
    scale: int,
    sigma: float,
    image: Float32,
    scales: UInt8,
    response: Float32,
    at_scale: UInt8,
) -> None:
    """Raise `response` to R_L at one scale where `scales` lets it apply, and note the scale in `at_scale`."""
    from anatomy.segmentation.kernels.hessian import add_large_response

    index, limits = np.int64(scale), (np.float64(REFERENCE_HU), np.float64(BRIGHTEST_HU))
    given = (scales, index, space.hessian_factors(sigma), *limits, response, at_scale)
    space.share(lambda first, last: add_large_response(image, space.hu, first, last, *given))


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
    # 1000 voxels of 0.7 mm.
    return _without_small(found, 350.0 / float(np.prod(sides)))


def _without_small(mask: Mask, least_voxels: float) -> Mask:
    """Drop the connected pieces (26 neighbours) with fewer voxels."""
    from scipy.ndimage import label

    pieces, _ = label(mask, structure=np.ones((3, 3, 3), dtype=np.bool_))
    # The voxels of the pieces are few beside those of the image, whose numbers bincount would copy.
    keep = np.bincount(pieces[mask], minlength=1) >= least_voxels
    keep[0] = False
    return np.asarray(keep[pieces])


def _distance_mm(mask: Mask, sides: Float, threads: int) -> Float32:
    """Return the distance from each voxel of `mask` to the nearest that is not; the image's end is none."""
    import edt

    return np.asarray(
        edt.edt(np.array(mask, order="C"), anisotropy=tuple(sides), black_border=False, parallel=threads)
    )


def _raised_at_edges(space: ScaleSpace, best: Float32, edges: Mask) -> Float32:
    """Give the voxels of `edges` the greatest vesselness of their 26 neighbours: vessels keep their width.

    The response fades before the vessel ends.
    """
    from anatomy.segmentation.kernels.neighbours import take_greatest_neighbour

    raised = best.copy()
    space.share(lambda first, last: take_greatest_neighbour(best, first, last, edges, raised))
    return raised


ALPHA, BETA, C_HU = 0.5, 0.5, 70.0
"""Sensitivity to plates and to blobs; Hessian of 39 % of the greatest response [Fu2018]."""


def vesselness(hu: Int16 | Float32, lung: Mask, spacing_mm: ArrayLike, *, threads: int = 0) -> Float32:
    """Return the greatest response over the scales that apply at each voxel [Fu2018, eqs. 3-5].

    Args:
        hu ((ni, nj, nk) int16 or float32): The CT in Hounsfield units.
        lung ((ni, nj, nk) bool): Lungs with their vessels; the distance to its surface decides which scales
            apply.
        spacing_mm ((3,) float64): Voxel size along i, j, k.
        threads: 0 for all processors; the result does not depend on it.

    Returns:
        (ni, nj, nk) float32: In [0, 1], Fortran-contiguous; 0 outside the lung.

    Raises:
        GridMismatchError, AnatomyError: If the shapes differ; if the lung is empty.
    """
    space = ScaleSpace.of(hu, lung, spacing_mm, threads=threads)
    best = np.zeros(space.hu.shape, dtype=np.float32)
    settings = np.array([ALPHA, BETA, C_HU])
    for scale, (sigma, image) in enumerate(space.images()):
        add_vesselness_of(space, scale, sigma, image, settings, best)
    return space.whole(best, hu.shape)


def add_vesselness_of(
    space: ScaleSpace, scale: int, sigma: float, image: Float32, settings: Float, best: Float32
) -> None:
    """Raise `best` to the response at one scale; `settings` are alpha, beta, c."""
    from anatomy.segmentation.kernels.hessian import add_vesselness

    factors, index = space.hessian_factors(sigma), np.int64(scale)
    space.share(lambda a, b: add_vesselness(image, a, b, space.n_scales, index, factors, settings, best))
