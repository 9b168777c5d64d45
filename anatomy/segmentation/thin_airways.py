"""Follow airways on from the ends of a grown lumen, where they are too thin for the map of minima."""

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int, Int16, Mask, UInt8
from anatomy.poses import spread_directions
from anatomy.segmentation.kernels import lumen_ends, tube_stretch
from anatomy.segmentation.kernels import thin_airways as kernel
from anatomy.segmentation.kernels.neighbours import box_offsets

RING_VOXELS = (1.4, 2.0)
"""Radii of the ring about a line.  A wall thinner than a voxel appears so far from its middle."""
N_PLACES = 400
"""In so many places of the lung it is learnt how much of a tube appears where there is none."""
LOOKED_AT = 100
"""This many voxels are looked at for each place."""
FAR_MM = 4.0
"""They lie so far from the lumen."""
BRIGHT_HU = 80.0
"""It is learnt anywhere, and beside voxels this much above the lung, as airways lie; the greater counts."""
DEVIATIONS = 3.0
"""An airway has a contrast so many standard deviations above that of such places."""
WALL_HU = 60.0
"""The wall of an airway is this much brighter than the lung."""


@frozen_value
class Tubes:
    """What was followed: the number of voxels of the lumen now, and of tubes."""

    count: int
    n_tubes: int


def follow_thin_airways(
    hu: Int16, smooth: Int16, state: UInt8, lung: Mask, spacing_mm: Float, lumen: Int, known: int, count: int
) -> Tubes:
    """Add to the lumen the thin airways that go on from its ends.

    Parameters
    ----------
    hu, smooth, state, lung : (nk, nj, ni) int16, int16, uint8, bool
        The CT, the CT with less noise, what is lumen and what is banned (changed), and the lung; with a
        border of two voxels or more that is not lung.
    spacing_mm : (3,) float64
    lumen : (V,) int64
        Its first `count` entries are the flat indices of the lumen, the first `known` of them of trachea and
        main bronchi; what is added follows.
    """
    per_mm = 1.0 / spacing_mm
    voxel_mm = float(np.prod(spacing_mm) ** (1.0 / 3.0))
    # Over the sphere: one every 13 degrees, 1.1 mm at the end of a stretch.
    directions, radii_mm = spread_directions(260)[:, ::-1].copy(), voxel_mm * np.array(RING_VOXELS)
    # An airway has some hundred ends, each with six places behind it.
    starts = np.zeros((3, 4096, 3))
    n_starts = _find_starts(state, lung, spacing_mm, lumen[:count], known, starts)
    if n_starts == 0:
        return Tubes(count=count, n_tubes=0)
    tissue_hu = float(np.median(smooth[lung]))
    noise = [
        _false_contrast(hu, smooth, state, lung, spacing_mm, bright, directions, radii_mm)
        for bright in (-np.inf, tissue_hu + BRIGHT_HU)
    ]
    least = max(noise)
    if least <= 0.0:
        return Tubes(count=count, n_tubes=0)
    count, n_tubes = kernel.follow_tubes(
        hu, state, lung, per_mm, spacing_mm, directions, radii_mm, least, tissue_hu + WALL_HU,
        starts[0], starts[1], starts[2], n_starts, lumen, count,
    )  # fmt: skip
    return Tubes(count=count, n_tubes=n_tubes)


def _false_contrast(
    hu: Int16,
    smooth: Int16,
    state: UInt8,
    lung: Mask,
    spacing_mm: Float,
    bright_hu: float,
    directions: Float,
    radii_mm: Float,
) -> float:
    """Return the contrast that hardly any place beside something so bright has; 0 if there are none."""
    distance = np.ceil(FAR_MM / spacing_mm).astype(np.int64)
    stride = max(int(np.count_nonzero(lung)) // (LOOKED_AT * N_PLACES), 1)
    places = np.zeros((LOOKED_AT * N_PLACES, 3), dtype=np.int64)
    count = tube_stretch.places_beside_bright(smooth, state, lung, stride, distance, bright_hu, places)
    # From fewer places no spread can be told.
    if count < 50:
        return 0.0
    places = places[np.linspace(0, count - 1, min(count, N_PLACES)).astype(np.int64)]
    contrast = np.zeros(len(places))
    # The direction at each place lies so far behind that of the last in the list of all.
    about = directions[(7 * np.arange(len(places))) % len(directions)]
    tube_stretch.best_contrasts(
        hu, state, lung, 1.0 / spacing_mm, places * spacing_mm, about, directions, radii_mm, contrast
    )
    np.maximum(contrast, 0.0, out=contrast)
    middle = float(np.median(contrast))
    # The standard deviation of normal values over their median distance from the median.
    return middle + DEVIATIONS * 1.4826 * float(np.median(np.abs(contrast - middle)))


def _find_starts(state: UInt8, lung: Mask, spacing_mm: Float, lumen: Int, known: int, starts: Float) -> int:
    """Fill `starts`, `(3, M, 3)`, with the ends of the lumen in the lung and places behind them."""
    shape = np.array(state.shape, dtype=np.int64)
    far = np.zeros(state.shape, dtype=np.int32)
    queue, parent = lumen.copy(), np.zeros(len(lumen), dtype=np.int64)
    near = box_offsets(shape, 1)
    count = lumen_ends.walk_lumen(state.reshape(-1), near, queue, known, parent, far.reshape(-1))
    # No lumen so near to an end is farther from the trachea.
    reach = np.ceil(2.0 / spacing_mm).astype(np.int64)
    return int(
        lumen_ends.find_ends(
            far, lung, queue, known, count, parent, reach, spacing_mm, starts[0], starts[1], starts[2]
        )
    )
