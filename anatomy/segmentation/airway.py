"""Lumen and wall of the airways from a CT [Fu2018, III-A.2]."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int16, Mask
from anatomy.grid import Volume, freeze_arrays
from anatomy.morphology import bounds, distance_mm, window
from anatomy.segmentation.growing import Ground, grow
from anatomy.segmentation.kernels.local_minima import depth_slice, smooth_slice

if TYPE_CHECKING:
    from anatomy.segmentation.lungs import Lungs


EDGE_MM = 3.0
"""How far the wall may lie from the rough central airway."""
AROUND_MM, WIDE_MM = 15.0, 2.0
"""So near to it, air in which a ball of this radius fits belongs to it: the middle of a trachea has no walls
around it to be seen by, and the tissue of the lung is nowhere so dark."""
NOISE_PERCENTILE = 97.0
"""This percentage of the lung lies below the shallowest minimum that is followed."""
SAMPLE_STEP = 7
"""Every so many voxels of the lung are looked at to learn its noise."""
LOST_MM, LEAST_LOST_ML = 3.0, 0.1
"""Air of the central airway so far from the lumen is no edge of it; half a slice of it is that much."""
GREATEST_HU = 16_383
"""More, which metal may have, is cut off."""


@frozen_record
class Airways:
    """The airways of both lungs, bool `(ni, nj, nk)` on the grid of the CT.

    The lumen is one piece, connected by faces, from the trachea on; it shares no voxel with the wall.
    `leak_mm3` was grown and taken back as a leak.
    """

    lumen: Mask
    wall: Mask
    leak_mm3: float = 0.0

    def __post_init__(self) -> None:
        freeze_arrays(self, "lumen", "wall")


def segment_airway(ct: Volume, lungs: Lungs, *, progress: Callable[[str], None] | None = None) -> Airways:
    """Segment lumen and wall of the airways [Fu2018, III-A.2] [Aykac2003].

    `lungs` are both lungs, with a seed in the trachea and the rough central airway, on the grid of the CT in
    Hounsfield units.  Raises AnatomyError if there is no air at the seed, and GridMismatchError if `lungs`
    lie on another grid.
    """
    from scipy import ndimage

    tell = progress or (lambda text: None)
    inside = lungs.mask
    if inside.shape != ct.array.shape:
        raise GridMismatchError(
            f"The lungs are of shape {inside.shape}, the CT of {ct.array.shape}",
            expected="lungs segmented in this CT",
        )
    tell("airway: map of local minima")
    # The wall reaches less far beyond the lumen.
    box = window(*bounds(inside | lungs.central_airway, np.ceil(3.0 / ct.grid.spacing_mm).astype(np.int64)))
    values = ct.array[box]
    if values.dtype != np.int16:
        values = np.rint(values.astype(np.float32))
    # Transposed and C-contiguous, as int16: between any two values lies less than 2^15.
    hu = np.ascontiguousarray(np.clip(values, -GREATEST_HU, GREATEST_HU).T, dtype=np.int16)
    lung = np.ascontiguousarray(inside[box].T)
    spacing_mm = np.ascontiguousarray(ct.grid.spacing_mm[::-1])
    blurred = hu.astype(np.float32)
    # Standard deviation of the smoothing that tells a dark voxel from noise.
    ndimage.gaussian_filter(blurred, 0.6 / spacing_mm, output=blurred, truncate=2.0, mode="nearest")
    smooth = np.asarray(np.rint(blurred, out=blurred), dtype=np.int16)
    del blurred
    upright = 2 - int(np.argmax(np.abs(ct.grid.lps_from_ijk[2, :3] / ct.grid.spacing_mm)))
    depth = local_minima_map(hu, spacing_mm, upright)
    # Outside the lungs no bronchus is so thin that its lumen is denser; fat beside bright vessels is.
    depth[(smooth > -250.0) & ~lung] = 0
    rough = np.ascontiguousarray(lungs.central_airway[box].T)
    sample = lung.reshape(-1)[::SAMPLE_STEP]
    lung_hu = float(np.median(smooth.reshape(-1)[::SAMPLE_STEP][sample]))
    dark_hu = (float(np.median(smooth[rough])) + lung_hu) / 2
    noise = float(np.percentile(depth.reshape(-1)[::SAMPLE_STEP][sample], NOISE_PERCENTILE))
    ground = Ground(
        hu=hu,
        lung_hu=lung_hu,
        dark_hu=dark_hu,
        smooth=smooth,
        depth=depth,
        # Below it the map holds only the noise of a low-dose CT.
        least_depth=max(noise, 20.0),
        lung=lung,
        spacing_mm=spacing_mm,
    )
    tell("airway: growth")
    seed = lungs.trachea_seed_ijk - [s.start for s in box]
    grown = grow(ground, _start(ground, rough, (int(seed[2]), int(seed[1]), int(seed[0]))))
    lumen, wall = (np.zeros(inside.shape, dtype=np.bool_, order="F") for _ in range(2))
    solid, inner = grown.lumen, window(*bounds(grown.lumen))
    solid[inner] = ndimage.binary_fill_holes(solid[inner])
    lumen[box] = solid.T
    wall[box] = (grown.wall & ~solid).T
    return Airways(lumen=lumen, wall=wall, leak_mm3=grown.undone * ct.grid.voxel_volume_mm3)


def _start(ground: Ground, rough: Mask, seed: tuple[int, int, int]) -> Mask:
    """Return the air of trachea and wide bronchi up to their walls, the piece with the seed."""
    from scipy import ndimage

    air = ground.smooth < ground.dark_hu
    certain = rough & air
    reach = int(np.ceil(EDGE_MM / ground.spacing_mm.min()))
    inner = window(*bounds(certain, np.ceil(AROUND_MM / ground.spacing_mm).astype(np.int64)))
    wide = distance_mm(air[inner].T, ground.spacing_mm[::-1]).T >= WIDE_MM
    # What reaches a side of the window in its axial section, beside the trachea, is air around the patient,
    # or outside of the image that was scanned.
    in_plane = ndimage.generate_binary_structure(3, 1) & np.array([False, True, False])[:, None, None]
    labels, _ = ndimage.label(wide, structure=in_plane)
    sides = np.concatenate([labels[:, [0, -1]].ravel(), labels[:, :, [0, -1]].ravel()])
    wide &= ~np.isin(labels, np.unique(sides[sides > 0]))
    pieces, count = ndimage.label(wide | certain[inner])
    kept = np.bincount(pieces.ravel(), weights=certain[inner].ravel(), minlength=count + 1) > 0
    kept[0] = False
    certain[inner] = ndimage.binary_dilation(kept[pieces], iterations=reach, mask=air[inner])
    start = _piece_at(certain, seed)
    # What the central airway holds is lumen, also where it is not dark.
    around = window(*bounds(rough, reach))
    # Air of a main bronchus that is blurred or lined with mucus is thinner.
    held = (rough & (ground.smooth < -700.0))[around]
    far = distance_mm(~start[around].T, ground.spacing_mm[::-1]).T > LOST_MM
    if np.count_nonzero(held & far) * float(np.prod(ground.spacing_mm)) >= 1000.0 * LEAST_LOST_ML:
        certain[around] |= held
        start = _piece_at(certain, seed)
    return start


def _piece_at(air: Mask, seed: tuple[int, int, int]) -> Mask:
    """Return the piece of air that a voxel lies in; AnatomyError if it lies in none."""
    from scipy import ndimage

    labels, _ = ndimage.label(air)
    label = int(labels[seed]) if all(0 <= n < m for n, m in zip(seed, labels.shape, strict=True)) else 0
    if label == 0:
        raise AnatomyError(
            f"There is no air at the seed in the trachea, voxel {seed[::-1]} of the box of the lungs",
            expected="a voxel in the lumen of the trachea",
            remedy="Give another seed",
        )
    return np.asarray(labels == label)


_THREADS = 2


def local_minima_map(hu: Int16, spacing_mm: Float, upright: int) -> Int16:
    """Return the local minima map of a volume `(nk, nj, ni)` in HU, C-contiguous; it is nowhere negative.

    Of one direction of slices it is the map of the paper.  Where the voxels are near to cubes, it is the
    median of the maps of all three directions; elsewhere the axis `upright`, along which a CT is sliced, is
    used alone.

    The paper takes the maximum over the scales 1 to N.  A closing with a larger diamond is nowhere lower, nor
    is what is reconstructed from it: the largest scale alone gives that maximum.
    """
    # Slices are used in the directions in which their pixels are squarer than this.
    if spacing_mm.max() > 1.5 * spacing_mm.min():
        return _sliced(hu, upright, spacing_mm)
    first, second, third = (_sliced(hu, axis, spacing_mm) for axis in range(3))
    low = np.minimum(first, second)
    np.maximum(first, second, out=first)
    np.minimum(first, third, out=first)
    return np.maximum(low, first, out=low)


def scale_of(pixel_mm: Float) -> int:
    """Return the reach of the largest structuring element in pixels, for pixels of two sides in mm."""
    # N: the largest structuring element of the paper reaches this many pixels.
    # The closing reaches no farther than this: larger elements would close small lungs.
    return int(np.clip(round(8.0 / float(np.sqrt(pixel_mm.prod()))), 1, 12))


def _sliced(hu: Int16, axis: int, spacing_mm: Float) -> Int16:
    slices = np.moveaxis(hu, axis, 0)
    out = np.zeros_like(hu)
    target = np.moveaxis(out, axis, 0)
    scale = scale_of(np.delete(spacing_mm, axis))
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(partial(_some, slices, scale, target), range(_THREADS)))
    return out


def _some(slices: Int16, scale: int, out: Int16, first: int) -> None:
    """Fill every slice whose number leaves `first` when divided by the number of threads."""
    shape = slices.shape[1:]
    work = np.zeros((4, *shape), dtype=np.int16)
    queue = np.zeros(shape[0] * shape[1] + 1, dtype=np.int32)
    waiting = np.zeros(shape, dtype=np.bool_)
    for n in range(first, len(slices), _THREADS):
        work[0] = slices[n]
        smooth_slice(work[0], work[1])
        depth_slice(work[1], scale, work[2:], queue, waiting, work[0])
        out[n] = work[0]
