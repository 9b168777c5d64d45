"""Image volumes of a page: structures and CT as bytes, coarse everywhere and fine around the devices."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError, FileError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Array, Float, Int, UInt8
from anatomy.grid import Grid, Volume
from anatomy.kept_records import kept
from anatomy.lung import Lung
from anatomy.morphology import window
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OUTSIDE, VESSEL
from lungaccess.showing.report.pack import TYPES, Packed, pack

CODES = {"outside": 0, "lung": 1, "airway wall": 2, "lumen": 3, "vessel": 4, "fissure": 5, "nodule": 6}
LABELS_VERSION = 2
COARSE_VOXELS, FINE_VOXELS = 3_000_000, 3_000_000
"""Voxels at most of the coarse and the fine volume, so that the page stays small."""
AROUND_MM = 28.0
"""Border around the devices that is shown in fine voxels."""
HU_RANGES = ((-1024, 8), (-200, 5), (300, 24))
"""From each HU on a CT is stored in steps of so many HU: coarse in lung and bone, fine in soft tissue."""
HU_OF_BYTE: Int = np.concatenate(
    [np.arange(low, stop, step) for (low, step), stop in zip(HU_RANGES, (-200, 300, 1548 + 1), strict=True)]
)
"""The HU for which each byte of a stored CT stands, `(256,)`, from -1024 to 1548."""
STORED_CT = ("ct.nii.gz", "ct.nii", "ct.nrrd", "ct.mha")


@frozen_value
class CtFile:
    """A CT on disk, to be shown beside the masks of a patient.

    Args:
        path: An image file or a folder of DICOM slices.
        series: UID of the DICOM series, where the folder holds several.
        digest: The `digest_of_ct` of the CT that was segmented; empty if the CT was chosen by a person.
    """

    path: Path
    series: str | None = None
    digest: str = ""

    def read(self) -> Volume:
        """Return the CT in HU.

        Raises FileError if it cannot be read, or is not the one that was segmented.
        """
        from anatomy.io.dicom import read_dicom
        from anatomy.io.images import read_volume
        from anatomy.segmentation.folder import digest_of_ct

        volume = read_dicom(self.path, self.series) if self.path.is_dir() else read_volume(self.path)
        if self.digest and digest_of_ct(volume) != self.digest:
            raise FileError(
                f"{self.path} is not the CT that was segmented",
                expected="the CT whose masks the patient's folder holds",
                remedy="Give the CT that the slices are to show with --ct",
            )
        return volume


def find_ct(patient: Path) -> CtFile | None:
    """Return the CT of a patient's folder: one named ct, or the one that was segmented, if it is recorded."""
    from anatomy.segmentation.folder import segmented_ct

    for name in STORED_CT:
        if (patient / name).is_file():
            return CtFile(path=patient / name)
    source = segmented_ct(patient)
    return None if source is None else CtFile(**source)


def page_image(lung: Lung, device_lps: Float, ct: Volume | None = None) -> Packed:
    """Return the voxels that the slices of a page show: structures, and a CT if there is one.

    Raises AnatomyError if the CT does not hold the devices.
    """
    labels = _label_volumes(lung, device_lps)
    return _image(lung, labels, ct, None if ct is None else ct_volumes(ct, lung, device_lps))


def fine_image(lung: Lung, device_lps: Float, ct: Volume | None = None) -> Packed:
    """Return the fine voxels of `page_image` alone, which takes a tenth of the time.

    Raises AnatomyError if the CT does not hold the devices.
    """
    fine = page_grids(lung.grid, device_lps)[1]
    if ct is not None:
        _require_holds(ct, device_lps)
    found = None if ct is None else [packed_volume(fine, _ct_bytes(ct, fine), differences=True)]
    return _image(lung, [_fine_labels(lung, fine)], ct, found)


def _image(lung: Lung, labels: list[Packed], ct: Volume | None, voxels: list[Packed] | None) -> Packed:
    grid = lung.grid if ct is None else ct.grid
    return {
        "codes": CODES, "labels": labels, "ct": voxels, "hounsfield": HU_OF_BYTE.tolist(),
        "grid": {"shape": list(grid.shape), "lps_from_ijk": grid.lps_from_ijk.tolist()},
    }  # fmt: skip


def image_words(image: Packed) -> str:
    """Say how finely a page holds its voxels, and for a CT which values it can show."""
    coarse, fine = (each["spacing_mm"] for each in image["ct"] or image["labels"])
    held = f"voxels of {coarse:.1f} mm, of {fine:.1f} mm within {AROUND_MM:.0f} mm of the devices"
    if image["ct"] is None:
        return held
    steps = "; ".join(
        f"{step} HU from {low} to {stop} HU"
        for (low, step), stop in zip(
            HU_RANGES, (*(low for low, _ in HU_RANGES[1:]), HU_OF_BYTE[-1]), strict=True
        )
    )
    return f"{held}, in steps of {steps}; what is beyond is shown as the first or last of these"


def label_codes(lung: Lung, low: ArrayLike, high: ArrayLike) -> Volume:
    """Return one of `CODES` for the voxels from `low` to before `high`, `(3,)` each.

    Of several structures a voxel has the code of the last of the list.
    """
    box = window(np.asarray(low), np.asarray(high))
    labels = lung.labels[box]
    codes = np.full(labels.shape, CODES["lung"], dtype=np.uint8, order="F")
    for bit, name in (
        (OUTSIDE, "outside"), (FISSURE, "fissure"), (AIRWAY, "airway wall"), (LUMEN, "lumen"),
        (VESSEL, "vessel"),
    ):  # fmt: skip
        codes[(labels & bit) != 0] = CODES[name]
    if lung.nodules is not None:
        codes[lung.nodules.array[box] & (codes == CODES["lung"])] = CODES["nodule"]
    return Volume(grid=lung.grid.crop(low, high), array=codes)


def _label_volumes(lung: Lung, device_lps: Float) -> list[Packed]:
    """Return the structures, coarse and fine, for a page; the coarse ones are kept with the lung."""
    coarse, fine = page_grids(lung.grid, device_lps)
    shape = np.array(lung.grid.shape)
    return [
        kept(lung, "labels", LABELS_VERSION, lambda: _labels_on(lung, coarse, np.zeros(3, np.int64), shape)),
        _fine_labels(lung, fine),
    ]


def _fine_labels(lung: Lung, fine: Grid) -> Packed:
    shape = np.array(lung.grid.shape)
    places = np.floor(lung.grid.ijk(fine.corners_lps)).astype(np.int64)
    low = np.clip(places.min(axis=0) - 2, 0, shape - 1)
    high = np.clip(places.max(axis=0) + 4, low + 1, shape)
    return _labels_on(lung, fine, low, high)


def _labels_on(lung: Lung, grid: Grid, low: Int, high: Int) -> Packed:
    """Return the structures on another grid, from the voxels from `low` to before `high`."""
    return packed_volume(grid, resampled(label_codes(lung, low, high), grid, 0, 0))


def ct_volumes(ct: Volume, lung: Lung, device_lps: Float) -> list[Packed]:
    """Return a CT, coarse and fine, for a page: as coarse as it must be to stay small.

    Raises AnatomyError if the CT does not hold the devices.
    """
    _require_holds(ct, device_lps)
    factor = 1.0
    while True:
        found = [
            packed_volume(grid, _ct_bytes(ct, grid), differences=True)
            for grid in page_grids(lung.grid, device_lps, factor)
        ]
        # Text of a stored CT at most: a page of 10 MB still opens at once and can be sent.
        if sum(len(each["voxels"]["data"]) for each in found) <= 8_500_000:
            return found
        factor *= 1.2


def _require_holds(ct: Volume, device_lps: Float) -> None:
    if not ct.grid.contains(device_lps).all():
        raise AnatomyError(
            "The CT does not hold all points of the plan",
            expected=f"an image in the patient's frame, this one is {ct.grid.describe()}",
            remedy="Give the CT from which the masks were made",
        )


def page_grids(grid: Grid, device_lps: Float, factor: float = 1.0) -> tuple[Grid, Grid]:
    """Return a coarse grid of the whole box and a fine one around points, both along the LPS axes.

    Args:
        device_lps: (N, 3) float64, LPS mm.
        factor: Makes both voxels larger.
    """
    steps = np.stack(np.meshgrid(*[(-0.5, n - 0.5) for n in grid.shape], indexing="ij"), axis=-1)
    corners = grid.lps(steps.reshape(-1, 3))
    low, high = corners.min(axis=0), corners.max(axis=0)
    near_low = np.maximum(device_lps.min(axis=0) - AROUND_MM, low)
    near_high = np.minimum(device_lps.max(axis=0) + AROUND_MM, high)
    least = float(grid.spacing_mm.min())
    return (
        # Finest voxels of the whole lung on a page, so that the page stays small.
        _grid(low, high, max(least, 1.5) * factor, COARSE_VOXELS),
        _grid(near_low, near_high, max(least, 0.6) * factor, FINE_VOXELS),
    )


def _grid(low: Float, high: Float, spacing_mm: float, most: int) -> Grid:
    spacing = max(spacing_mm, float(np.prod(high - low) / most) ** (1.0 / 3.0))
    shape = np.maximum(np.ceil((high - low) / spacing - 1e-6), 1).astype(int)
    return Grid.from_spacing(shape, [spacing] * 3, low + 0.5 * spacing)


def resampled(volume: Volume, grid: Grid, order: int, beyond: float) -> Array:
    """Return the values `[i, j, k]` of a volume at the voxels of another grid: nearest (0) or linear (1)."""
    from scipy.ndimage import affine_transform

    matrix = volume.grid.ijk_from_lps @ grid.lps_from_ijk
    moved = affine_transform(
        volume.array, matrix[:3, :3], offset=matrix[:3, 3], output_shape=grid.shape, order=order,
        mode="constant", cval=beyond,
    )  # fmt: skip
    return np.asarray(moved)


def _ct_bytes(ct: Volume, grid: Grid) -> UInt8:
    from scipy.ndimage import uniform_filter

    places = np.rint(ct.grid.ijk(grid.corners_lps)).astype(np.int64)
    size = np.maximum(np.floor(grid.spacing_mm.mean() / ct.grid.spacing_mm + 0.3), 1).astype(int)
    start = np.clip(places.min(axis=0) - 4, 0, np.array(ct.grid.shape) - 1)
    stop = np.clip(places.max(axis=0) + 5, start + 1, ct.grid.shape)
    box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
    part = np.asarray(ct.array[box], dtype=np.float32)
    if (size > 1).any():
        part = uniform_filter(part, tuple(size.tolist()), mode="nearest")
    values = resampled(Volume(grid=ct.grid.crop(start, stop), array=part), grid, 1, float(HU_OF_BYTE[0]))
    return np.searchsorted(0.5 * (HU_OF_BYTE[1:] + HU_OF_BYTE[:-1]), values).astype(np.uint8)


def packed_volume(grid: Grid, values: ArrayLike, kind: str = "u1", *, differences: bool = False) -> Packed:
    """Return a volume; with `differences` each voxel is stored as its difference from the one before in i."""
    array = np.asarray(values, dtype=TYPES[kind]).transpose(2, 1, 0)
    stored = np.diff(array, axis=2, prepend=array.dtype.type(0)) if differences else array
    return {
        "first_lps": grid.lps_from_ijk[:3, 3].tolist(),
        "spacing_mm": float(grid.spacing_mm[0]),
        "differences": differences,
        "voxels": pack(stored, kind),
    }
