"""A CT rendered from the masks of a patient, so that the truth about every voxel is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float, Float32, Mask
from anatomy.grid import Grid, Volume
from anatomy.patient import PatientImages

AIR_HU, LUMEN_HU, FAT_HU, TISSUE_HU, WALL_HU, NODULE_HU, FISSURE_HU = (
    -1000.0,
    -990.0,
    -90.0,
    40.0,
    0.0,
    30.0,
    0.0,
)
FAT_MM, BODY_MM, AROUND_BODY_MM = 10.0, 25.0, 8.0
"""Thickness of the outer layer of the body, of all of it around the lungs, and of the air about it."""
CENTRAL_RADIUS_MM, MEDIASTINUM_MM = 4.5, 3.0
"""Airways of a greater radius lie in the mediastinum, with this much tissue around them."""
LEAST_HU, GREATEST_HU = -1024, 3071
HALF = np.float32(0.5)


@frozen_value
class CtLook:
    """How a rendered CT looks.

    Args:
        spacing_mm: Edge of the cubic voxels.
        vessel_hu: Blood: 40 without contrast medium, 150 to 450 with it.
        parenchyma_hu: Mean of the lung's tissue.
        texture_hu, texture_mm: Standard deviation of the tissue's own variation, and the sigma of the
            Gaussian that correlates it.
        psf_mm: Sigma of the Gaussian point spread.
        noise_hu: Standard deviation of the noise at the full dose.
        noise_voxels: Sigma of the Gaussian that correlates the noise, in voxels.
        dose: Share of the full dose; the noise goes with 1 / sqrt(dose).
        wall_mm: Thickness of airway walls where the patient has no mask of them.
        fissure_mm: Thickness of the sheet between lobes.
        convex: The body is convex in every axial slice; for lungs too far apart for the tissue around them to
            meet.
        seed: Of noise and texture.

    Raises:
        SettingsError: If a length, a deviation or the dose is not possible.
    """

    spacing_mm: float = 0.7
    vessel_hu: float = 40.0
    parenchyma_hu: float = -865.0
    texture_hu: float = 20.0
    texture_mm: float = 2.0
    psf_mm: float = 0.6
    noise_hu: float = 25.0
    noise_voxels: float = 0.5
    dose: float = 1.0
    wall_mm: float = 0.8
    fissure_mm: float = 0.5
    convex: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("spacing_mm", "dose", "wall_mm"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise SettingsError(f"{name} is {getattr(self, name)}", expected="a positive number")
        for name in ("texture_hu", "texture_mm", "psf_mm", "noise_hu", "noise_voxels", "fissure_mm"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise SettingsError(
                    f"{name} is {getattr(self, name)}", expected="a number that is not negative"
                )


@frozen_record
class SyntheticCt:
    """A rendered CT (int16 HU) and its truth on the same grid, bool `(ni, nj, nk)`.

    `lung` is filled and without trachea and main bronchi; a voxel belongs to a structure that fills half of
    it.
    """

    ct: Volume
    lung: Mask
    lumen: Mask
    wall: Mask
    vessels: Mask
    fissures: Mask


def render_ct(images: PatientImages, look: CtLook | None = None) -> SyntheticCt:
    """Render the CT that a scanner would make of a patient's masks.

    Every voxel mixes the Hounsfield units of what it holds by their shares, in the order tissue, lung,
    fissure, airway wall, nodule, vessel, lumen; then come point spread and noise.
    Same patient and look, same bits.

    Raises:
        AnatomyError: If the lung mask is empty.
    """
    from scipy.ndimage import gaussian_filter

    look = look or CtLook()
    if not images.lung.array.any():
        raise AnatomyError("The lung mask is empty", expected="at least one voxel of lung")
    grid, scale, offset = _target(images, look.spacing_mm)
    rng = np.random.default_rng(look.seed)

    def share(mask: Mask) -> Float32:
        return _resampled(mask, grid, scale, offset)

    lumen_mask, spacing = images.lumen.array, images.grid.spacing_mm
    lung_share = share(images.lung.array & ~_central(lumen_mask, spacing))
    lung = lung_share >= HALF
    image = _body(lung, look.spacing_mm, convex=look.convex)
    tissue = look.parenchyma_hu + _texture(rng, grid.shape, look)
    _mix(image, lung_share, tissue)
    del tissue, lung_share
    fissures = np.zeros(grid.shape, dtype=np.bool_, order="F")
    if images.fissures is not None:
        sheet = middle_sheet(images.fissures.array & images.lung.array, spacing)
        thickness = np.float32(min(1.0, look.fissure_mm / float(spacing.mean())))
        _mix(image, thickness * share(sheet), FISSURE_HU)
        fissures = share(sheet) >= HALF
    around = _within(lumen_mask, spacing, look.wall_mm)
    if images.wall is not None:
        around = images.wall.array | lumen_mask
    airway = share(around)
    _mix(image, airway, WALL_HU)
    if images.nodules is not None:
        _mix(image, share(images.nodules.array), NODULE_HU)
    vessel = share(images.vessels.array)
    _mix(image, vessel, look.vessel_hu)
    lumen = share(lumen_mask)
    _mix(image, lumen, LUMEN_HU)
    gaussian_filter(image.T, look.psf_mm / look.spacing_mm, output=image.T, mode="nearest", truncate=3.0)
    image += _noise(rng, grid.shape, look.noise_hu / np.sqrt(look.dose), look.noise_voxels)
    np.clip(np.rint(image, out=image), LEAST_HU, GREATEST_HU, out=image)
    return SyntheticCt(
        ct=Volume(grid=grid, array=image.astype(np.int16)),
        lung=lung,
        lumen=lumen >= HALF,
        wall=(airway >= HALF) & ~(lumen >= HALF) & ~(vessel >= HALF),
        vessels=vessel >= HALF,
        fissures=fissures,
    )


def _target(images: PatientImages, spacing_mm: float) -> tuple[Grid, Float, Float]:
    """Return the grid of the CT, and scale and offset from its indices to those of the masks.

    It reaches around the body along i and j, and along k as far as the masks.
    """
    source = images.grid
    inside = [np.flatnonzero(images.lung.array.any(axis=axes)) for axes in ((1, 2), (0, 2))]
    around = (BODY_MM + AROUND_BODY_MM) / source.spacing_mm
    low = np.array([inside[0][0] - around[0], inside[1][0] - around[1], 0.0])
    high = np.array([inside[0][-1] + around[0], inside[1][-1] + around[1], source.shape[2] - 1.0])
    scale = spacing_mm / source.spacing_mm
    shape = np.floor((high - low) / scale).astype(np.int64) + 1
    matrix = source.lps_from_ijk.copy()
    matrix[:3, :3] *= scale
    matrix[:3, 3] = source.lps(low)
    return Grid(shape=(int(shape[0]), int(shape[1]), int(shape[2])), lps_from_ijk=matrix), scale, low


def _resampled(mask: Mask, grid: Grid, scale: Float, offset: Float) -> Float32:
    """Return the share of each voxel within `mask`: linear interpolation along each axis.

    Voxels larger than those of the mask take the mean of several samples.
    """
    part: Float32 = mask.astype(np.float32, order="F")
    for axis in (2, 1, 0):
        samples = max(1, int(np.ceil(scale[axis])))
        size, n = part.shape[axis], grid.shape[axis]
        taken = np.zeros(part.shape[:axis] + (n,) + part.shape[axis + 1 :], dtype=np.float32, order="F")
        target, source = np.moveaxis(taken, axis, 0), np.moveaxis(part, axis, 0)
        for sample in range(samples):
            within = (sample + 0.5) / samples - 0.5
            where = offset[axis] + scale[axis] * (np.arange(n) + within)
            first = np.floor(where).astype(np.int64)
            for to, (below, weight) in enumerate(zip(first, where - first, strict=True)):
                if 0 <= below < size:
                    target[to] += np.float32((1.0 - weight) / samples) * source[below]
                if 0 <= below + 1 < size and weight > 0.0:
                    target[to] += np.float32(weight / samples) * source[below + 1]
        part = taken
    return part


def _mix(image: Float32, share: Float32, hu: float | Float32) -> None:
    """Replace a share of each voxel of `image` by `hu`, in place."""
    image += share * (np.float32(hu) - image if isinstance(hu, float) else hu - image)


def _body(lung: Mask, spacing_mm: float, *, convex: bool) -> Float32:
    """Return tissue around the lungs, fat around it, and air; between the lungs is tissue alone."""
    from scipy.ndimage import binary_fill_holes
    from skimage.morphology import convex_hull_image

    distance = _distance_mm(~lung, (spacing_mm,) * 3)
    image = np.full(lung.shape, TISSUE_HU, dtype=np.float32, order="F")
    for k in range(lung.shape[2]):
        near = distance[:, :, k] <= BODY_MM - FAT_MM
        outside = ~(convex_hull_image(near) if convex and near.any() else binary_fill_holes(near))
        image[:, :, k][outside] = FAT_HU
        image[:, :, k][outside & (distance[:, :, k] > BODY_MM)] = AIR_HU
    return image


def _central(lumen: Mask, spacing: Float) -> Mask:
    """Return trachea and main bronchi with the tissue around them: where balls of 4.5 mm fit in."""
    wide = _distance_mm(lumen, spacing) > CENTRAL_RADIUS_MM
    if not wide.any():
        return wide
    return _within(wide, spacing, CENTRAL_RADIUS_MM + MEDIASTINUM_MM)


def _within(mask: Mask, spacing: Float, reach_mm: float) -> Mask:
    """Return the voxels within `reach_mm` of `mask`."""
    return np.asarray(_distance_mm(~mask, spacing) <= reach_mm)


def _distance_mm(mask: Mask, spacing_mm: ArrayLike) -> Float32:
    """Return the distance from each voxel of `mask` to the nearest that is not; the image's end is none."""
    import edt

    sides = tuple(np.asarray(spacing_mm, dtype=np.float64))
    writable = np.array(mask, order="F")
    return np.asarray(edt.edt(writable, anisotropy=sides, order="F", black_border=False, parallel=2))


def middle_sheet(mask: Mask, spacing: Float) -> Mask:
    """Return the middle of a thick mask of a sheet: voxels as deep as all their neighbours."""
    from scipy.ndimage import maximum_filter

    depth = _distance_mm(mask, spacing)
    return np.asarray(mask & (depth >= maximum_filter(depth.T, size=3).T - np.float32(0.25 * spacing.min())))


def _texture(rng: np.random.Generator, shape: tuple[int, int, int], look: CtLook) -> Float32:
    return _noise(rng, shape, look.texture_hu, look.texture_mm / look.spacing_mm)


def _noise(
    rng: np.random.Generator, shape: tuple[int, int, int], deviation: float, sigma_voxels: float
) -> Float32:
    """Return Gaussian noise of a standard deviation, correlated by a Gaussian."""
    from scipy.ndimage import gaussian_filter

    noise = rng.standard_normal(shape[::-1], dtype=np.float32)
    if sigma_voxels > 0.0:
        gaussian_filter(noise, sigma_voxels, output=noise, mode="wrap", truncate=3.0)
    noise *= np.float32(deviation) / noise.std(dtype=np.float64)
    return noise.T
