"""Trachea and main bronchi on coarse voxels: found as a round column of air, followed to the lungs."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Mask
from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, distance_mm, pieces_of, window
from anatomy.segmentation.coarse import CoarseCt

COLUMN_HU = -850.0
"""The inside of a trachea is below this on coarse voxels."""
SHORTEST_COLUMN_MM = 20.0
"""Bowel and emphysema hold shorter columns of air as wide as a trachea."""

GROWTH_HU = tuple(float(t) for t in range(-960, -699, 20))
"""Thresholds of the growth, from pure air to where every airway would leak into the lung."""
NARROW, CLOSED, WIDER = 0.75, 0.6, 1.15
"""Shares of the trachea's cross-section: an open glottis is below the first, a closed one and partial slices
are below the second, and larynx, pharynx or mouth are above the third."""
GREATEST_STEP_SHARE, GREATEST_STEP_ML = 0.5, 12.0
"""Growing by more than both from one threshold to the next is a leak into the lung."""


@frozen_record
class CentralAirway:
    """The large airways on coarse voxels, bool `(Ni, Nj, Nk)`.

    `grown` are trachea and all bronchi that could be followed without a leak, `main` of these trachea and
    main bronchi; the seed `(3,)` int64 is a voxel in the middle of the trachea.
    """

    grown: Mask
    main: Mask
    seed: Int
    warnings: tuple[str, ...] = ()


def central_airways(ct: CoarseCt, outside: Mask, seed_lps: Float | None = None) -> Iterator[CentralAirway]:
    """Find what may be trachea and main bronchi, the largest column of air first.

    An image with much noise is smoothed if nothing else helps.  `outside` `(Ni, Nj, Nk)` is air around the
    patient, and a point in the trachea `seed_lps` `(3,)` LPS mm takes the place of the automatic search.
    Raises AnatomyError if there is no column of air like a trachea, or the point does not lie in air.
    """
    from scipy.ndimage import gaussian_filter

    found, first = False, None
    for sigma in (0.0, 1.0):
        # A standard deviation for images too noisy to follow the trachea in: smoothed, it is air throughout.
        smooth = gaussian_filter(ct.hu, sigma, mode="nearest") if sigma else ct.hu
        image = replace(ct, hu=np.asfortranarray(smooth))
        try:
            seeds = [seed_lps] if seed_lps is not None else _trachea_seeds(image, outside)
        except AnatomyError as error:
            first = first or error
            continue
        for seed in seeds:
            try:
                airway = _long_enough(image, grow_from(image, _with_throat(image, outside, seed), seed))
            except AnatomyError as error:
                first = first or error
                continue
            found = True
            yield airway
    if not found and first is not None:
        raise first


def _with_throat(ct: CoarseCt, outside: Mask, seed_lps: Float) -> Mask:
    """Return `outside` with all that lies above the glottis."""
    air = np.asfortranarray((ct.hu < COLUMN_HU) & ~outside)
    barred, seed = outside.copy(order="F"), _given_seed(ct, seed_lps)
    barred[:, :, max(throat_level(air, seed, ct.spacing_mm[2]), int(seed[2]) + 1) :] = True
    return barred


def _long_enough(ct: CoarseCt, found: CentralAirway) -> CentralAirway:
    low, high = bounds(found.grown)
    length_mm = float((high - low)[2] * ct.spacing_mm[2])
    if not length_mm >= SHORTEST_COLUMN_MM:
        raise AnatomyError(
            f"Only {length_mm:.0f} mm of the trachea could be followed",
            expected=f"at least {SHORTEST_COLUMN_MM:g} mm",
            remedy="Give the masks with --lungs and --airway; the image may be too noisy",
        )
    return found


def grow_from(ct: CoarseCt, outside: Mask, seed_lps: Float) -> CentralAirway:
    """Follow the large airways from a point in them, staying out of `outside`.

    Raises AnatomyError if the point does not lie in air, or that air is not enclosed by a wall.
    """
    seed = _given_seed(ct, seed_lps)
    grown = grow(ct, seed, outside)
    main, warnings = _main_part(ct, grown)
    if not main[tuple(seed)]:  # the column was a lobar bronchus
        # The voxel in the upper half of the main airways that is farthest from their wall.
        low, high = bounds(main)
        depth = distance_mm(main, ct.spacing_mm)
        depth[:, :, : (low[2] + high[2]) // 2] = 0.0
        seed = np.array(np.unravel_index(int(np.argmax(depth)), depth.shape), dtype=np.int64)
    return CentralAirway(grown=grown, main=main, seed=seed, warnings=warnings)


def _given_seed(ct: CoarseCt, seed_lps: Float) -> Int:
    block = ct.block(seed_lps)
    if block is None or ct.hu[block] > GROWTH_HU[-1]:
        found = "outside the image" if block is None else f"at {ct.hu[block]:.0f} HU"
        raise AnatomyError(
            f"The seed {np.round(seed_lps, 1).tolist()} (LPS mm) lies {found}",
            expected=f"a point in the air of the trachea, below {GROWTH_HU[-1]:.0f} HU",
            remedy="Name a point in the middle of the trachea with --seed lps:x,y,z",
        )
    return np.array(block, dtype=np.int64)


def _trachea_seeds(ct: CoarseCt, outside: Mask) -> list[Float]:
    """Return the middles `(3,)` LPS mm of columns of air that may be a trachea, the largest first."""
    from scipy import ndimage

    pieces, counts = pieces_of(_column_cross_sections(ct, outside))
    boxes, sizes = ndimage.find_objects(pieces), counts[1:]
    tall = np.array([(box[2].stop - box[2].start) * ct.spacing_mm[2] for box in boxes]) >= SHORTEST_COLUMN_MM
    if not tall.any():
        raise AnatomyError(
            "No trachea was found: no column of air near the middle is "
            f"{SHORTEST_COLUMN_MM:g} mm long and as wide as a trachea",
            expected="a CT of the chest that shows the trachea down to the carina",
            remedy="Give a point in the trachea with --seed, if the image shows it",
        )
    seeds = []
    # Trachea, throat, stomach and bowel: so many columns are tried until one leads into lungs.
    for piece in np.argsort(-(sizes * tall), kind="stable")[: min(4, int(tall.sum()))]:
        levels, column = boxes[piece][2], pieces == piece + 1
        # The column may go on through the glottis: its lower part tells where it narrows.
        low = _middle(ct, column, levels.start + (levels.stop - levels.start) // 3)
        top = min(levels.stop, throat_level(column, low, ct.spacing_mm[2]))
        # How far down the column the seed lies.
        level = top - 1 - int(0.3 * (top - 1 - levels.start))
        seeds.append(ct.grid.lps(_middle(ct, column, level)))
    return seeds


def _middle(ct: CoarseCt, column: Mask, level: int) -> Int:
    """Return the voxel of a column that lies deepest in its axial section."""
    from scipy import ndimage

    inside = ndimage.distance_transform_edt(column[:, :, level], sampling=ct.spacing_mm[:2])
    i, j = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return np.array((i, j, level), dtype=np.int64)


def _column_cross_sections(ct: CoarseCt, outside: Mask) -> Mask:
    """Mark, in every axial slice, pieces of air as large, round and central as a trachea."""
    from scipy import ndimage

    dx, dy, _ = ct.spacing_mm
    # Cross-sections of a trachea, up to where it widens to the carina.
    least, most = (area / (dx * dy) for area in (40.0, 800.0))
    chosen = np.zeros(ct.hu.shape, dtype=np.bool_)
    # The middle of the body along the axis from right to left, as an index.
    body = np.count_nonzero(~outside, axis=(1, 2)).astype(np.float64)
    middle = float((body * np.arange(len(body))).sum() / body.sum())
    for k in range(ct.hu.shape[2]):
        plane = ct.hu[:, :, k]
        pieces, sizes = pieces_of((plane < COLUMN_HU) & ~outside[:, :, k])
        for piece, box in enumerate(ndimage.find_objects(pieces), start=1):
            width, depth = (s.stop - s.start for s in box)
            centre = 0.5 * (box[0].start + box[0].stop - 1)
            # A trachea that is pushed aside stays within this distance of the middle of the image.
            fits = least <= sizes[piece] <= most and abs(centre - middle) * dx <= 50.0
            # A trachea that is flattened by breathing out is still rounder than this.
            if not fits or max(width * dx, depth * dy) > 2.5 * min(width * dx, depth * dy):
                continue
            inside = pieces[box] == piece
            # The middle of a trachea is nearly pure air; lung is above this.
            if np.median(plane[box][inside]) <= -920.0:
                chosen[(*box, k)] |= inside
    return chosen


def grow(ct: CoarseCt, seed: Int, outside: Mask) -> Mask:
    """Return the air connected to `seed`, at the highest threshold before it leaks into the lung.

    The thresholds rise; a leak is a growth by more than a share and a volume at once, or to a volume that
    no airway has.
    """
    from scipy import ndimage

    low, high = bounds(~outside)
    box = window(low, high)
    air = np.asfortranarray(np.where(outside[box], np.float32(0.0), ct.hu[box]))
    at = tuple(int(n) for n in seed - low)
    grown = np.zeros(air.shape, dtype=np.bool_, order="F")
    volume_ml = 0.0
    for threshold in GROWTH_HU:
        if air[at] >= threshold:
            continue
        pieces = ndimage.label((air < threshold).T)[0].T
        candidate = pieces == pieces[at]
        candidate_ml = np.count_nonzero(candidate) * ct.voxel_ml
        step_ml = candidate_ml - volume_ml
        leaks = volume_ml > 0 and step_ml > max(GREATEST_STEP_SHARE * volume_ml, GREATEST_STEP_ML)
        # Lumen of a large trachea and the bronchi that coarse voxels show.
        if leaks or candidate_ml > 180.0:
            break
        grown, volume_ml = candidate, candidate_ml
    if not volume_ml:
        raise AnatomyError(
            f"The air around the trachea (coarse voxel {at}) is connected to the lung or the outside",
            expected="a trachea with a wall around it",
            remedy="Give a point in the trachea with --seed, or the masks with --lungs and --airway",
        )
    whole = np.zeros(ct.hu.shape, dtype=np.bool_, order="F")
    whole[box] = grown
    return whole


def _main_part(ct: CoarseCt, grown: Mask) -> tuple[Mask, tuple[str, ...]]:
    """Return trachea and main bronchi: the parts nearest to the two first generations of the tree."""
    from anatomy.tree import tree_from_mask

    low, high = bounds(grown, 1)
    box = window(low, high)
    part = np.asfortranarray(grown[box])
    depth = distance_mm(part, ct.spacing_mm, bordered=True)
    # Airways narrower than this share of the trachea's radius are left to the segmentation of the airways.
    wide_mm = 0.35 * float(np.percentile(depth[depth > 0], 99))
    core = depth >= wide_mm
    wide = part & (distance_mm(~core, ct.spacing_mm) <= wide_mm)
    grid = ct.grid.crop(low, high)
    main = np.zeros(grown.shape, dtype=np.bool_, order="F")
    try:
        tree = tree_from_mask(Volume(grid=grid, array=wide))
    except AnatomyError as error:
        main[box] = wide
        return main, (
            f"The main bronchi could not be told from the lobar ones: {error.found}. The image may be "
            "blurred by breathing or noise: airways are missing, and reach is understated.",
        )
    voxels = np.argwhere(wide)
    _, nearest = tree.nearest_point_index.query(grid.lps(voxels))
    first = tree.generation[tree.branch_of_point[nearest]] <= 1
    chosen = voxels[first] + low
    main[tuple(chosen.T)] = True
    return main, ()


def without_throat(lumen: Mask, seed_ijk: Int, grid: Grid) -> tuple[Mask, float]:
    """Cut the airway off at the throat, which `throat_level` finds; also return the length that was cut, mm.

    Vocal cords that are closed while the breath is held taper the airway to a point, which would be too
    narrow for any scope, although a scope passes them in fact.  `lumen` `(ni, nj, nk)` is in the order of
    voxels of `canonical`, and returned as it is if there is no throat; `seed_ijk` `(3,)` is a voxel in the
    trachea.
    """
    slice_mm = float(grid.spacing_mm[2])
    return _below(lumen, throat_level(lumen, seed_ijk, slice_mm), slice_mm)


def without_top(
    lumen: Mask, seed_ijk: Int, grid: Grid, tree_of: Callable[[Mask], object]
) -> tuple[Mask, float]:
    """Cut the airway off at the throat; where no tree can be made of what is left, at its narrowest place.

    A glottis may be as wide as the trachea: only the tree, or the AnatomyError, that `tree_of` returns then
    tells that pharynx and mouth are there.  Where no cut gives it a tree the lumen stays as it was; the rest
    as in `without_throat`.
    """
    lumen, cut_mm = without_throat(lumen, seed_ijk, grid)
    if isinstance(tree_of(lumen), AnatomyError):
        lower, more_mm = _below(lumen, narrowest_level(lumen, seed_ijk), float(grid.spacing_mm[2]))
        if not isinstance(tree_of(lower), AnatomyError):
            return lower, cut_mm + more_mm
    return lumen, cut_mm


def _below(lumen: Mask, level: int, slice_mm: float) -> tuple[Mask, float]:
    """Return an airway without what lies at an axial level and above, and how long that was, mm."""
    top = int(np.flatnonzero(lumen.any(axis=(0, 1)))[-1]) + 1 if lumen.any() else 0
    if level >= top:
        return lumen, 0.0
    cut = np.array(lumen, order="F")
    cut[:, :, level:] = False
    return cut, (top - level) * slice_mm


def throat_level(air: Mask, seed_ijk: Int, slice_mm: float) -> int:
    """Return the first axial level of the throat above a seed in the trachea; the image's end if none.

    The trachea narrows at the glottis, and above it the airway ends or becomes wider than the trachea.  Where
    it does neither, it is only narrow, as at mucus or a stenosis, and goes on.
    """
    # The cross-section of a trachea is the median over this length above and below a place in it.
    reach = max(1, round(20.0 / slice_mm))
    first, count = int(seed_ijk[2]), int(air.shape[2])
    lower = _areas(air, seed_ijk, range(first, max(first - reach, -1), -1))
    upper = _areas(air, seed_ijk, range(first, count))
    usual = float(np.median([*lower, *upper[1:reach]])) if lower else 0.0
    for above, area in enumerate(upper):
        most = max(upper[above:])
        if area < NARROW * usual and (most < CLOSED * usual or most > WIDER * usual):
            return first + above
    return count


def narrowest_level(lumen: Mask, seed_ijk: Int) -> int:
    """Return the axial level above a seed where the airway is narrowest, but for its first two."""
    upper = _areas(lumen, seed_ijk, range(int(seed_ijk[2]), lumen.shape[2]))[2:]
    return int(seed_ijk[2]) + 2 + int(np.argmin(upper)) if upper else int(lumen.shape[2])


def _areas(air: Mask, seed_ijk: Int, levels: Iterable[int]) -> list[int]:
    """Return the voxels of the piece of air that a seed lies in, level by level, as far as it goes on."""
    from scipy import ndimage

    found: list[int] = []
    piece = np.zeros(air.shape[:2], dtype=np.bool_)
    piece[int(seed_ijk[0]), int(seed_ijk[1])] = True
    for level in levels:
        pieces, count = ndimage.label(air[:, :, level])
        shared = np.bincount(pieces[piece], minlength=count + 1)
        shared[0] = 0
        if not shared.any():
            break
        piece = pieces == int(np.argmax(shared))
        found.append(int(np.count_nonzero(piece)))
    return found
