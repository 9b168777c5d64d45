"""Whether an image is a CT of the chest with air at -1000 HU: refused, mended or warned of if not."""

from typing import Self

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Array, Float32, Mask
from anatomy.grid import Volume
from anatomy.morphology import distance_mm
from anatomy.segmentation.coarse import CoarseCt

AIR_HU = -1000.0
"""The scale defines air so."""
GREATEST_OFFSET_HU = 25.0
"""Scanners keep air around the patient within 10 HU; more is another scale."""
GREATEST_SCATTER_HU = 45.0
"""Scatter and contrast medium raise the air in the trachea by up to 40 HU, so it tells less where it is
alone."""
AROUND_HU = (-1199.0, -880.0)
"""Air around the patient, shifted or not: lower values are padding, higher ones table and clothes."""

MUSCLE_HU = (10.0, 80.0)
"""Most soft tissue of a chest measures this, whatever a contrast medium does to its vessels."""
GAS_HU, TISSUE_HU = -700.0, (-200.0, 200.0)
"""Air of lungs and outside lies below, and soft tissue between the two others."""
LEAST_SHARE = 0.002
"""Air and soft tissue each fill at least this share of a CT of the chest."""
LEAST_SIZE_MM = 100.0
"""The lung of a small child is about so large."""
SPACING_MM = (0.2, 2.5)
"""Sizes of voxels within a slice that are not doubted."""
FINE_SLICE_MM = 1.5
"""Thinner slices show segmental bronchi nearly as wide as they are."""
THICK_SLICE_MM = 3.0
"""Segmental bronchi are 3 to 4 mm wide: thicker slices lose them."""
THICKEST_SLICE_MM = 10.0
"""Slices of routine scans end here; beyond, not even lobar bronchi are to be seen."""


def slice_mm(ct: Volume) -> float:
    """Return the distance of the slices: the largest of the three voxel sizes."""
    return float(ct.grid.spacing_mm.max())


def has_thick_slices(ct: Volume) -> bool:
    """Tell whether the slices are too far apart for small airways and vessels."""
    return slice_mm(ct) > THICK_SLICE_MM


def require_chest_ct(ct: Volume, *, thick_slices: bool = False) -> tuple[str, ...]:
    """Refuse images that cannot be a CT of the chest in Hounsfield units; return warnings.

    Slices of more than 3 mm are accepted with `thick_slices` alone.  Raises AnatomyError if a voxel is not a
    number, the values are no Hounsfield units, air or tissue are missing, the image is too small, or its
    slices are too thick.
    """
    _require_numbers(ct.array)
    _require_hounsfield(ct.array)
    warnings, greatest = _require_size(ct, thick_slices), float(ct.array.max())
    # Metal reaches the 3071 HU of most scanners; more than this is another scale.
    if greatest > 5000.0:
        warnings.append(f"The image reaches {greatest:g} HU: metal, or not Hounsfield units.")
    return tuple(warnings)


def _require_numbers(values: Array) -> None:
    if values.dtype.kind not in "iuf":
        raise AnatomyError(f"The image has voxels of the type {values.dtype}", expected="numbers in HU")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        count = int(np.count_nonzero(~np.isfinite(values)))
        raise AnatomyError(
            f"The image holds {count} voxels that are not a number (NaN or infinite)",
            expected="Hounsfield units in every voxel",
            remedy="Replace them by -1024, the value for nothing measured",
        )


def _require_hounsfield(values: Array) -> None:
    least, greatest = float(values.min()), float(values.max())
    if least == greatest:
        raise AnatomyError(
            f"Every voxel of the image is {least:g}",
            expected="a CT in Hounsfield units",
            remedy="Export the image again",
        )
    # The lowest value of an image whose offset of -1000 is missing is about 0, and above this.
    if not least <= -400.0:
        raise AnatomyError(
            f"The lowest value of the image is {least:g}: its offset of about -1000 HU seems to be missing",
            expected="Hounsfield units, where air is about -1000 and water 0",
            remedy="Apply the rescale intercept (often -1024) when exporting, or give the DICOM folder",
        )
    count = values.size
    air = np.count_nonzero(values < GAS_HU) / count
    tissue = np.count_nonzero((values > TISSUE_HU[0]) & (values < TISSUE_HU[1])) / count
    if not (air >= LEAST_SHARE and tissue >= LEAST_SHARE):
        missing = "air (below -700 HU)" if air < LEAST_SHARE else "soft tissue (-200 to 200 HU)"
        raise AnatomyError(
            f"The image, {least:g} to {greatest:g}, holds hardly any {missing}",
            expected="a CT of the chest in Hounsfield units, with lungs and the body around them",
            remedy="Choose the series of the chest, and check that its values are Hounsfield units",
        )


def _require_size(ct: Volume, thick_slices: bool) -> list[str]:
    spacing = ct.grid.spacing_mm
    extent = spacing * np.asarray(ct.grid.shape)
    if not extent.min() >= LEAST_SIZE_MM:
        raise AnatomyError(
            f"The image measures {' x '.join(f'{e:.0f}' for e in extent)} mm",
            expected=f"at least {LEAST_SIZE_MM:g} mm in every direction, to hold a lung",
            remedy="Give the whole scan; check the voxel size in the header",
        )
    thickness = slice_mm(ct)
    if thickness > THICKEST_SLICE_MM or (thickness > THICK_SLICE_MM and not thick_slices):
        or_accept = "; or accept the loss with --thick-slices" if thickness <= THICKEST_SLICE_MM else ""
        raise AnatomyError(
            f"The slices are {thickness:.1f} mm apart",
            expected=f"at most {THICK_SLICE_MM:g} mm: small airways and vessels are lost between such slices",
            remedy=f"Reconstruct thinner slices{or_accept}",
        )
    warnings = []
    if thickness > THICK_SLICE_MM:
        warnings.append(
            f"The slices are {thickness:.1f} mm apart: small airways and vessels are missing, "
            "so a path that looks free may not be."
        )
    if not SPACING_MM[0] <= spacing.min() <= SPACING_MM[1]:
        warnings.append(
            f"The smallest voxel size is {spacing.min():.2f} mm; {SPACING_MM[0]:g} to {SPACING_MM[1]:g} mm "
            "are usual."
        )
    return warnings


@frozen_value
class Scale:
    """How the values of a CT become Hounsfield units.

    `offset_hu` is taken from each, and the difference from air at -1000 HU is then multiplied by `gain`.
    """

    offset_hu: float = 0.0
    gain: float = 1.0

    @classmethod
    def of(cls, coarse: CoarseCt, offset_hu: float) -> Self:
        """Return the scale of a CT whose air is off by so much: its soft tissue tells a shift from a gain."""
        if not offset_hu:
            return cls()
        low, high = MUSCLE_HU[0] + min(0.0, offset_hu), MUSCLE_HU[1] + max(0.0, offset_hu)
        counts, edges = np.histogram(coarse.hu, bins=np.arange(low, high + 2.0, 2.0))
        most = float(edges[int(np.argmax(np.convolve(counts, np.ones(5), mode="same")))]) + 1.0
        moved = most - offset_hu
        usual = moved if MUSCLE_HU[0] <= moved <= MUSCLE_HU[1] else float(np.clip(most, *MUSCLE_HU))
        return cls(offset_hu=offset_hu, gain=(usual - AIR_HU) / (moved - AIR_HU))

    def on(self, values: Array) -> Float32:
        """Return values in Hounsfield units."""
        moved = values - np.float32(self.offset_hu)
        if self.gain == 1.0:
            return moved
        return (moved - np.float32(AIR_HU)) * np.float32(self.gain) + np.float32(AIR_HU)

    def image(self, ct: Volume) -> Volume:
        """Return an image in Hounsfield units; the image itself if it has them."""
        if self == Scale():
            return ct
        whole = np.rint(self.on(ct.array)).astype(np.float32)
        return Volume(grid=ct.grid, array=np.clip(whole, -32768, 32767).astype(np.int16))

    def warnings(self) -> tuple[str, ...]:
        """Say what was done to an image that does not have Hounsfield units."""
        if self == Scale():
            return ()
        done = f"{-self.offset_hu:+.0f} HU were added to every voxel"
        if self.gain != 1.0:
            done = (
                f"air was set to {AIR_HU:.0f} HU and every difference from it multiplied by {self.gain:.3f}, "
                "as soft tissue tells"
            )
        return (
            f"Air measures {AIR_HU + self.offset_hu:.0f} HU instead of {AIR_HU:.0f}: {done}. Vessels are "
            "told apart by their HU: if the scale is wrong in other ways, too many or too few are obstacles.",
        )


def air_in_hu(coarse: CoarseCt, airway: Mask) -> float:
    """Return what air measures in the middle of the airway."""
    depth = distance_mm(np.asfortranarray(airway), coarse.spacing_mm)
    # At this share of the airway's greatest depth nothing but air is measured.
    return float(np.median(coarse.hu[depth >= 0.6 * depth.max()]))


def air_offset_hu(coarse: CoarseCt, airway: Mask) -> float:
    """Return by how much air, in the airway and around the patient, differs from -1000 HU; 0 if as usual."""
    inside = air_in_hu(coarse, airway) - AIR_HU
    around = offset_around_hu(coarse)
    if around is None:
        return inside if abs(inside) > GREATEST_SCATTER_HU else 0.0
    # Noise of the difference: scatter only ever raises the air in the trachea.
    if -10.0 <= inside - around <= GREATEST_SCATTER_HU:
        return around if abs(around) > GREATEST_OFFSET_HU else 0.0
    smaller = inside if abs(inside) < abs(around) else around
    return smaller if inside * around > 0.0 and abs(smaller) > GREATEST_OFFSET_HU else 0.0


def offset_around_hu(coarse: CoarseCt) -> float | None:
    """Return by how much air at the sides of the image differs from -1000 HU; None if there is hardly any."""
    hu = coarse.hu
    sides = np.concatenate([side.ravel() for side in (hu[0], hu[-1], hu[:, 0], hu[:, -1])])
    air = sides[(sides > AROUND_HU[0]) & (sides < AROUND_HU[1])]
    # Air over less than this share of the image's sides may be lung that the image cuts off.
    return float(np.median(air)) - AIR_HU if air.size >= 0.01 * sides.size else None
