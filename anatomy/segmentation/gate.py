"""Whether what was segmented can be the lungs and airways of a patient, and where lung is missing."""

from collections.abc import Iterator

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Mask
from anatomy.base.words import percent
from anatomy.grid import Grid, Volume
from anatomy.landmarks import SAMPLE_MM, directions
from anatomy.morphology import bounds, distance_mm, pieces_of, sampled, window
from anatomy.plausibility import DOUBTFUL, REFUSED, Finding, findings_of
from anatomy.segmentation.input import FINE_SLICE_MM
from anatomy.segmentation.lungs import Lungs

CUBE_MM = 4.0
"""The shape of the chest is looked at on voxels of this size."""
TOP_SHARE, BASE_SHARE = 0.1, 0.3
"""At these shares of the height the shoulders narrow the chest, and the diaphragm rises."""
LEAST_BACK, LEAST_BASE = 0.24, 0.48
"""Each lung reaches at least so far behind and below the carina, as shares of the width of both: in healthy
phantoms it is 0.33 and 0.58 at least; with fluid at the back 0.13, and with the lower third gone 0.39."""
FITS = 20
"""The midline settles after so many weighted fits, in which levels that lack a lobe count less and less."""
SOLID_HU, SOLID_RADIUS_MM, LEAST_SOLID_ML = -200.0, 6.0, 10.0
"""A mass of 27 mm has 10 ml; vessels and nodules into which no ball of 12 mm fits are not counted."""


def missing_lung(left: Mask, right: Mask, grid: Grid, carina_lps: Float) -> tuple[str, ...]:
    """Warn of zones of the chest that hold hardly any lung.

    In every section across the chest this is the convex hull of both lungs and their mirror images about the
    `midline`.  What is missing on both sides alike is told by how far the lungs reach back and down.  The
    lungs are `(ni, nj, nk)` in the order of voxels of `canonical`, and the carina `(3,)` LPS mm.
    """
    points = sampled(left | right, grid, CUBE_MM)
    points[:, 0] -= midline(points, carina_lps)
    chest, first = _on_cubes(points)
    zones = tuple(
        f"About {lost_ml / 1000.0:.2f} l of lung are missing in the {name}: only {percent(share)} of "
        "what lies there in a healthy chest is lung. It may be solid, full of fluid or collapsed. Its "
        f"airways and vessels are not seen, it counts as outside the lung, and reach in the {name} is "
        "understated."
        for name, share, lost_ml in _zones(chest, first, carina_lps)
        # Half-way between the zones of healthy phantoms, 0.92 up, and those with a solid lobe, up to 0.2.
        if share < 0.6
    )
    return zones or tuple(_short(left, right, grid, carina_lps))


def _short(left: Mask, right: Mask, grid: Grid, carina_lps: Float) -> Iterator[str]:
    """Yield warnings of lungs that end too early at the back or at the base."""
    sides = {"right": sampled(right, grid, CUBE_MM), "left": sampled(left, grid, CUBE_MM)}
    width = float(np.subtract(*np.percentile(np.concatenate([*sides.values()])[:, 0], [98.0, 2.0])))
    low, high = np.percentile(np.concatenate([*sides.values()])[:, 2], [0.5, 99.5])
    deep = {
        name: int(np.count_nonzero((p[:, 2] < low + BASE_SHARE * (high - low)) & (p[:, 1] > carina_lps[1])))
        for name, p in sides.items()
    }
    # Share of the lung behind the carina, in the lowest third of the chest, that one side has of the other:
    # 0.95 in healthy phantoms, and at most 0.3 if 330 ml of one base are solid.
    if not (left | right)[:, :, 0].any() and min(deep.values()) < 0.5 * max(deep.values()):
        name = min(deep, key=lambda side: deep[side])
        yield (
            f"Lung seems to be missing at the base of the {name} lung: behind, it holds "
            f"{percent(deep[name] / max(deep.values()))} of the lung of the other side. It may be solid, "
            "under fluid or collapsed, or not breathed in; reach there is understated."
        )
    for name, points in sides.items():
        lower = points[points[:, 2] < carina_lps[2]]
        if not len(lower):
            continue
        whole = not (left if name == "left" else right)[:, :, 0].any()
        back = (float(np.percentile(lower[:, 1], 97.0)) - carina_lps[1]) / width
        base = (carina_lps[2] - float(np.percentile(lower[:, 2], 1.0))) / width
        ends = (("back", back, LEAST_BACK, True), ("base", base, LEAST_BASE, whole))
        for place, share, least, counts in ends:
            if counts and share < least:
                yield (
                    f"Lung seems to be missing at the {place} of the {name} lung, which ends "
                    f"{share * width:.0f} mm from the carina: {least * width:.0f} mm and more are usual in a "
                    "chest of this width. It may be solid, under fluid or collapsed, or not breathed in; "
                    "reach there is understated."
                )


def _zones(chest: Mask, first: Float, carina_lps: Float) -> Iterator[tuple[str, float, float]]:
    """Yield the name of each zone, the share of it that is lung, and the volume that is not, ml."""
    from skimage.morphology import convex_hull_image

    n = chest.shape
    across = CUBE_MM * (np.arange(n[0]) - 0.5 * (n[0] - 1))
    # Within this share of the half width lie heart, spine and large vessels.
    beside = np.abs(across) > 0.4 * np.abs(across).max()
    behind = first[1] + CUBE_MM * np.arange(n[1]) > carina_lps[1]
    heights = first[2] + CUBE_MM * np.arange(n[2])
    levels = np.flatnonzero(chest.any(axis=(0, 1)))
    counts = np.zeros((2, 2, 2))
    base = levels[0] + BASE_SHARE * (levels[-1] - levels[0])
    top = levels[-1] - TOP_SHARE * (levels[-1] - levels[0])
    for k in levels:
        # Below this, the heart takes part of the front.
        upper = heights[k] > carina_lps[2] - 10.0
        if k > top or (k < base and not upper):
            continue
        plane = chest[:, :, k]
        zone = convex_hull_image(plane | plane[::-1]) & beside[:, None]
        zone &= True if upper else behind[None, :]
        for side, half in enumerate((across < 0, across > 0)):
            part = zone & half[:, None]
            counts[side, int(upper)] += np.count_nonzero(part & plane), np.count_nonzero(part)
    for side, name in enumerate(("right", "left")):
        for upper, part in enumerate(("lower part at the back", "upper part")):
            lung, whole = counts[side, upper]
            if whole:
                lost_ml = (whole - lung) * CUBE_MM**3 / 1000.0
                yield f"{part} of the {name} lung", float(lung / whole), float(lost_ml)


def midline(points: Float, carina_lps: Float) -> Float:
    """Return x of the middle of the chest at the height of each point of both lungs, `(N,)` LPS mm.

    It is a parabola along the height, between straight and what a spine curved to a side makes of it; the
    patient may lean to a side, too.  Levels with lung on one side of the carina alone tell nothing.
    """
    numbers = np.rint(points[:, 2] / CUBE_MM).astype(np.int64)
    levels, middles = [], []
    for number in np.unique(numbers):
        x = points[numbers == number, 0]
        left, right = x[x > carina_lps[0]], x[x < carina_lps[0]]
        if min(len(left), len(right)) > 0.2 * len(x):
            levels.append(CUBE_MM * number)
            middles.append(0.5 * (np.percentile(left, 98.0) + np.percentile(right, 2.0)))
    if len(levels) < 3:
        return np.full(len(points), float(carina_lps[0]))
    z, x, weights = np.array(levels), np.array(middles), np.ones(len(levels))
    for _ in range(FITS):
        fitted = np.polynomial.Polynomial.fit(z, x, 2, w=np.sqrt(weights))
        weights = 1.0 / np.maximum(np.abs(x - fitted(z)), 1.0)
    return np.asarray(fitted(np.clip(points[:, 2], z[0], z[-1])))


def _on_cubes(points: Float) -> tuple[Mask, Float]:
    """Return points on cubes along LPS whose middle is at x = 0, and the first cube's LPS mm."""
    from scipy.ndimage import binary_closing

    low, high = points.min(axis=0) - 2.0 * CUBE_MM, points.max(axis=0) + 2.0 * CUBE_MM
    high[0] = max(high[0], -low[0])
    low[0] = -high[0]
    chest = np.zeros(np.ceil((high - low) / CUBE_MM).astype(np.int64) + 1, dtype=np.bool_)
    chest[tuple(np.rint((points - low) / CUBE_MM).astype(np.int64).T)] = True
    return np.asarray(binary_closing(chest, np.ones((3, 3, 3)))), low


def solid_tissue(ct: Volume, lung: Mask) -> tuple[str, ...]:
    """Warn of solid tissue in the lungs that is thicker than vessels: masses and consolidations."""
    step = np.maximum(1, np.floor(2.0 / ct.grid.spacing_mm)).astype(np.int64)
    sparse = tuple(slice(None, None, int(s)) for s in step)
    inside = lung[sparse]
    box = window(*bounds(inside, 1))
    solid = np.asfortranarray((ct.array[sparse][box] > SOLID_HU) & inside[box])
    spacing = ct.grid.spacing_mm * step
    core = distance_mm(solid, spacing) >= SOLID_RADIUS_MM
    if not core.any():
        return ()
    pieces, counts = pieces_of(solid & (distance_mm(np.asfortranarray(~core), spacing) <= SOLID_RADIUS_MM))
    sizes = counts[1:] * float(np.prod(spacing)) / 1000.0
    found = []
    for piece in np.flatnonzero(sizes >= LEAST_SOLID_ML):
        middle = np.argwhere(pieces == piece + 1).mean(axis=0) + [s.start for s in box]
        place = ", ".join(f"{x:.0f}" for x in ct.grid.lps(middle * step))
        found.append(
            f"{sizes[piece]:.0f} ml of solid tissue lie in the lung about LPS ({place}) mm: a mass or a "
            "consolidation. Airways and vessels in it are not seen: a path that looks free there may not be."
        )
    return tuple(found)


DENSITY_HU = (-975.0, -300.0)
"""The median of inflated lung lies between that of gas and that of a lung that is half filled."""
THIN_HU, DENSE_HU = -925.0, -650.0
"""Emphysema is thinner than the one; lungs after breathing out, or with oedema, are denser than the other."""


def plausibility(
    ct: Volume, lungs: Lungs, tree: AirwayTree | AnatomyError, slices_mm: float = 0.0
) -> tuple[tuple[Finding, ...], tuple[str, ...]]:
    """Check lungs and airway by anatomy, with the limits and signs that masks of any source have to meet.

    The CT has Hounsfield units, in the order of voxels of `canonical`; the tree is that of the lumen, or says
    why there is none; `slices_mm` is the distance of the slices of the scan.  Returned are the checks that
    failed, and warnings.
    """
    median_hu = float(np.median(ct.array[lungs.mask]))
    found = [*_sizes(ct, lungs, median_hu)]
    warnings = [*_density_warnings(median_hu), *solid_tissue(ct, lungs.mask)]
    correct = "correct the mask of the airway"
    if slices_mm > FINE_SLICE_MM:
        correct = f"take slices of 1 mm, since {slices_mm:.1f} mm hide thin bronchi, or {correct}"
    if isinstance(tree, AnatomyError):
        name = "axes" if "upside down" in tree.found else "airway"
        remedy = "Check the header of the image" if name == "axes" else correct.capitalize()
        found.append(Finding(name=name, found=tree.found, remedy=remedy))
    else:
        for name, lung in (("left", lungs.left), ("right", lungs.right)):
            if lung.any() and not ct.grid.values_at(lung, tree.points_lps, False).any():
                gap_mm = tree.nearest_point_index.query(sampled(lung, ct.grid, SAMPLE_MM))[0].min()
                found.append(
                    Finding(
                        name="bronchi",
                        found=f"The airway ends {gap_mm:.0f} mm before the {name} lung, so "
                        "that no bronchus leads into it",
                        remedy=f"Look whether it is lung, and where the airway ends: {correct}",
                    )
                )
        left, right = (sampled(mask, ct.grid, SAMPLE_MM) for mask in (lungs.left, lungs.right))
        found += directions(tree, left, right, float(ct.grid.lps(np.zeros(3))[2]))
        if lungs.left.any() and lungs.right.any():
            warnings += missing_lung(lungs.left, lungs.right, ct.grid, tree.carina_lps)
    failed = tuple(each for each in found if each.verdict == REFUSED)
    return failed, (*warnings, *(each.found for each in found if each.verdict == DOUBTFUL))


def _sizes(ct: Volume, lungs: Lungs, median: float) -> Iterator[Finding]:
    litre = ct.grid.voxel_volume_mm3 * 1e-6
    sides = {"left": lungs.left, "right": lungs.right}
    missing = [name for name, mask in sides.items() if not mask.any()]
    if missing:
        yield Finding(
            name="one-lung",
            found=f"Only one lung was found; there is no {missing[0]} lung",
            remedy="Look whether the other one is solid, taken out, or not in the image",
        )
    volume = litre * sum(int(np.count_nonzero(mask)) for mask in sides.values())
    # Whether a volume that is possible is usual is told with the figures of the segmentation.
    yield from (each for each in findings_of({"lungs_l": volume}) if each.verdict == REFUSED)
    if not DENSITY_HU[0] <= median <= DENSITY_HU[1]:
        yield Finding(
            name="density",
            found=f"The median of the lungs is {median:.0f} HU",
            remedy="Look whether the masks show lung; a mask from elsewhere may be of another image",
        )


def _density_warnings(median: float) -> list[str]:
    if DENSITY_HU[0] <= median < THIN_HU:
        return [
            f"The lungs are thin: their median is {median:.0f} HU. In emphysema the walls of small airways "
            "have little contrast, and pockets of air look like airways: look at the thin ones on the way "
            "to the target."
        ]
    if DENSE_HU < median <= DENSITY_HU[1]:
        return [
            f"The lungs are dense: their median is {median:.0f} HU, as after breathing out or with oedema. "
            "They are smaller than when inflated, and vessels have less contrast: plan on the state of "
            "breathing of the procedure."
        ]
    return []
