"""Grow airway and wall through a map of local minima [Fu2018, III-A.2], and on where they are too thin."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int, Int16, Mask, UInt8
from anatomy.poses import spread_directions
from anatomy.segmentation.kernels import growing as growth
from anatomy.segmentation.kernels import lumen_edge, thin_airways, tube_stretch
from anatomy.segmentation.kernels import thin_airways as kernel
from anatomy.segmentation.kernels.neighbours import box_offsets, face_offsets
from anatomy.segmentation.kernels.states import BANNED, LUMEN

N_PLACES = 400
"""In so many places of the lung it is learnt how much of a tube appears where there is none."""
LOOKED_AT = 100
"""This many voxels are looked at for each place."""
FAR_MM = 4.0
"""They lie so far from the lumen."""
WALL_HU = 60.0
"""The wall of an airway is this much brighter than the lung."""

AIR_HU = -1024
"""Around the image is air, which is neither wall nor, for want of depth, lumen."""
FIRST_LEVEL_HU = 600.0
"""Only the trachea and main bronchi are darker than their walls by this much."""
LEVEL_RATIO = 0.92
"""Each level of the growth lies this much below the one before."""
FRONT_FACTOR, FRONT_SLACK_MM2 = 3.0, 200.0
"""A piece has burst whose front is this much larger than where it began."""
WIDE_MM2 = 20.0
"""A bronchus of this cross-section or more is dark inside."""
RIM_MM = 1.5
"""A place that is not dark, and this near to a wider one, is its rim."""

EDGE_MM = 1.2
"""The edge of a lumen is blurred over about so much."""

GAP_MM = 3.0
"""Gaps in the open lumen are as thick as a slice: none accepted without a word is thicker."""

WALL_MM = 2.0
"""The wall reaches no farther than this beyond its first layer."""

_MARGIN = 3
"""Border of the padded arrays: nothing grows into it, and no kernel looks farther than this from a voxel."""


@frozen_record
class Ground:
    """What the airway grows in; arrays `(nk, nj, ni)`, C-contiguous.

    Args:
        hu, smooth, depth (int16): The CT, the CT with less noise, and its map of local minima.
        lung: Where thin airways may go on.
        spacing_mm ((3,) float64): Voxel size along these axes.
        lung_hu, dark_hu: The tissue of the lung, and half-way between air and it.
        least_depth: Shallower minima are noise.
    """

    hu: Int16
    smooth: Int16
    depth: Int16
    lung: Mask
    spacing_mm: Float
    lung_hu: float
    dark_hu: float
    least_depth: float


@frozen_record
class Grown:
    """Lumen and wall, bool `(nk, nj, ni)`, and the number of voxels that were grown and undone."""

    lumen: Mask
    wall: Mask
    undone: int


def grow(ground: Ground, start: Mask) -> Grown:
    """Grow lumen and wall from the lumen `(nk, nj, ni)` that is certain: trachea and main bronchi."""
    state = _padded(start.astype(np.uint8))
    hu, smooth = _padded(ground.hu, AIR_HU), _padded(ground.smooth, AIR_HU)
    shape = np.array(state.shape, dtype=np.int64)
    flat = state.reshape(-1)
    seeds = np.flatnonzero(flat)
    count = len(seeds)
    # No patient's airways hold as much; what would make more is a leak.
    most = min(flat.size, 2 * count + int(1000.0 * 400.0 / float(np.prod(ground.spacing_mm))))
    lumen = np.zeros(most, dtype=np.int64)
    lumen[:count] = seeds
    pixel_mm2 = float(np.prod(ground.spacing_mm) ** (2 / 3))
    queue = np.zeros(2 * most, dtype=np.int64)
    parent = np.zeros(most, dtype=np.int64)
    behind = np.zeros((2, most), dtype=np.int64)
    layer_ends = np.zeros(most, dtype=np.int64)
    wide, rim = max(WIDE_MM2 / pixel_mm2, 2.0), max(round(RIM_MM / float(np.sqrt(pixel_mm2))), 1)
    # A piece of fewer layers is too short to tell a leak from a fork.
    least_layers = 4
    # The edge of a lumen is where the map is half as deep as inside.
    skin_share = 0.5
    count, undone = growth.grow_airway(
        _padded(ground.depth).reshape(-1), smooth.reshape(-1), flat, shape, lumen, count,
        levels(ground.least_depth), least_layers, FRONT_FACTOR, FRONT_SLACK_MM2 / pixel_mm2, wide, rim,
        ground.dark_hu, skin_share, queue, parent, behind, layer_ends,
    )  # fmt: skip
    banned = np.flatnonzero(flat == BANNED)
    flat[flat != LUMEN] = 0
    known = len(seeds)
    edged, count = _to_its_edge(ground, hu.reshape(-1), smooth.reshape(-1), flat, shape, lumen[:count])
    # Thin airways are as wide as a voxel: the edge of something so narrow is not to be seen.
    flat[banned[flat[banned] == 0]] = BANNED
    count, _n_tubes = follow_thin_airways(
        hu, smooth, state, _padded(ground.lung), ground.spacing_mm, edged, known, count
    )
    flat[flat != LUMEN] = 0
    _join_and_wall(ground, hu.reshape(-1), smooth.reshape(-1), flat, shape, edged, count)
    return Grown(lumen=_inner(state == LUMEN), wall=_inner(state == lumen_edge.WALL), undone=int(undone))


def _to_its_edge(
    ground: Ground, hu: Int16, smooth: Int16, state: UInt8, shape: Int, grown: Int
) -> tuple[Int, int]:
    """Bring the lumen in `state` to its edge, and fill its gaps.

    All arrays are padded and flat.  Returns its voxels and their count.
    """
    faces, count = face_offsets(shape), len(grown)
    # A voxel joins a list once, when its state changes: no list can be longer than the image.  Memory that
    # is not written to is not taken.
    lumen = np.zeros(state.size, dtype=np.int64)
    lumen[:count] = grown
    for _ in range(max(round(EDGE_MM / float(ground.spacing_mm.mean())), 1)):
        count = lumen_edge.refine_edge(
            hu, state, faces, int(shape[2]), int(ground.least_depth), ground.lung_hu, lumen, count
        )
    reach = np.ceil(GAP_MM / ground.spacing_mm).astype(np.int64) + 1
    count = lumen_edge.fill_gaps(smooth, state, shape, reach, ground.dark_hu, lumen, count)
    return lumen, int(count)


def _join_and_wall(
    ground: Ground, hu: Int16, smooth: Int16, state: UInt8, shape: Int, lumen: Int, count: int
) -> None:
    """Join the first `count` voxels of `lumen` by faces and put the wall around them; as above."""
    count = lumen_edge.join_corners(hu, state, shape, lumen, count)
    layers = int(np.ceil(WALL_MM / ground.spacing_mm.mean()))
    near, wall = box_offsets(shape, 1), np.zeros(state.size, dtype=np.int64)
    # T_abs of the paper: what is darker is lung or air, not wall.
    # T_dif of the paper: from one layer of the wall to the next the CT falls by more than noise.
    lumen_edge.grow_wall(smooth, state, near, lumen, count, layers, -600.0, 10.0, wall)


def levels(least_depth: float) -> Int:
    """Return the falling levels of the growth, HU."""
    count = max(int(np.log(least_depth / FIRST_LEVEL_HU) / np.log(LEVEL_RATIO)), 0) + 1
    return np.asarray(FIRST_LEVEL_HU * LEVEL_RATIO ** np.arange(count)).astype(np.int64)


def _padded(values: Array, border: int = 0) -> Array:
    return np.pad(values, _MARGIN, constant_values=border)


def _inner(values: Mask) -> Mask:
    inner = slice(_MARGIN, -_MARGIN)
    return values[inner, inner, inner]


def follow_thin_airways(
    hu: Int16, smooth: Int16, state: UInt8, lung: Mask, spacing_mm: Float, lumen: Int, known: int, count: int
) -> tuple[int, int]:
    """Add to the lumen the thin airways that go on from its ends; return its voxels, and the tubes followed.

    Args:
        hu, smooth, state, lung ((nk, nj, ni) int16, int16, uint8, bool): The CT, the CT with less noise, what
            is lumen and what is banned (changed), and the lung; with a border of two voxels or more that is
            not lung.
        spacing_mm: (3,) float64.
        lumen ((V,) int64): Its first `count` entries are the flat indices of the lumen, the first `known` of
            them of trachea and main bronchi; what is added follows.
    """
    per_mm = 1.0 / spacing_mm
    voxel_mm = float(np.prod(spacing_mm) ** (1.0 / 3.0))
    # Over the sphere: one every 13 degrees, 1.1 mm at the end of a stretch.
    # Radii of the ring about a line. A wall thinner than a voxel appears so far from its middle.
    directions, radii_mm = spread_directions(260)[:, ::-1].copy(), voxel_mm * np.array((1.4, 2.0))
    # An airway has some hundred ends, each with six places behind it.
    starts = np.zeros((3, 4096, 3))
    n_starts = _find_starts(state, lung, spacing_mm, lumen[:count], known, starts)
    if n_starts == 0:
        return count, 0
    tissue_hu = float(np.median(smooth[lung]))
    # It is learnt anywhere, and beside voxels this much above the lung, as airways lie; the greater counts.
    noise = [
        _false_contrast(hu, smooth, state, lung, spacing_mm, bright, directions, radii_mm)
        for bright in (-np.inf, tissue_hu + 80.0)
    ]
    least = max(noise)
    if least <= 0.0:
        return count, 0
    count, n_tubes = kernel.follow_tubes(
        hu, state, lung, per_mm, spacing_mm, directions, radii_mm, least, tissue_hu + WALL_HU,
        starts[0], starts[1], starts[2], n_starts, lumen, count,
    )  # fmt: skip
    return count, n_tubes


def _false_contrast(
    hu: Int16, smooth: Int16, state: UInt8, lung: Mask, spacing_mm: Float, bright_hu: float,
    directions: Float, radii_mm: Float,
) -> float:  # fmt: skip
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
    # An airway has a contrast so many standard deviations above that of such places.
    return middle + 3.0 * 1.4826 * float(np.median(np.abs(contrast - middle)))


def _find_starts(state: UInt8, lung: Mask, spacing_mm: Float, lumen: Int, known: int, starts: Float) -> int:
    """Fill `starts`, `(3, M, 3)`, with the ends of the lumen in the lung and places behind them."""
    far, near = np.zeros(state.shape, dtype=np.int32), box_offsets(np.array(state.shape, dtype=np.int64), 1)
    queue, parent = lumen.copy(), np.zeros(len(lumen), dtype=np.int64)
    count = thin_airways.walk_lumen(state.reshape(-1), near, queue, known, parent, far.reshape(-1))
    # No lumen so near to an end is farther from the trachea.
    reach = np.ceil(2.0 / spacing_mm).astype(np.int64)
    given = (far, lung, queue, known, count, parent, reach, spacing_mm)
    return int(thin_airways.find_ends(*given, starts[0], starts[1], starts[2]))
