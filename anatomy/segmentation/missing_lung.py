"""Where lung is missing that a chest of this shape would have: consolidation, fluid, collapse, large
masses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from anatomy.grid import Grid, Volume
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import distance_mm
from anatomy.typed import Float, Mask

SAMPLE_MM = 4.0
"""The shape of the chest is looked at on voxels of this size."""
LEAST_FILLED = 0.6
"""Of a zone: half-way between healthy phantoms, 0.92 and more, and those with a solid lobe, 0.2 and less."""
FROM_MIDDLE_SHARE = 0.4
"""Of the half width: nearer to the middle lie heart, spine and large vessels."""
TOP_SHARE, BASE_SHARE = 0.1, 0.3
"""Of the height: the shoulders narrow the chest above, and the diaphragm rises below."""
ABOVE_CARINA_MM = -10.0
"""Below this, the heart takes part of the front."""
SOLID_HU, SOLID_RADIUS_MM, LEAST_SOLID_ML = -200.0, 6.0, 10.0
"""A mass of 27 mm has 10 ml; vessels and nodules into which no ball of 12 mm fits are not counted."""


def missing_lung(left: Mask, right: Mask, grid: Grid, carina_lps: Float) -> tuple[str, ...]:
    """Warn of zones of the chest that hold hardly any lung.

    In every axial section the chest is the convex hull of both lungs and their mirror images.

    Parameters
    ----------
    left, right : (ni, nj, nk) bool
    grid : Grid
        In the order of voxels of `canonical`.
    carina_lps : (3,) float64
    """
    return tuple(
        f"About {lost_ml / 1000.0:.2f} l of lung are missing in the {name}: only {100 * share:.0f} % of "
        "what lies there in a healthy chest is lung. It may be solid, full of fluid or collapsed. Its "
        f"airways and vessels are not seen, it counts as outside the lung, and reach in the {name} is "
        "understated."
        for name, share, lost_ml in _zones(left, right, grid, carina_lps)
        if share < LEAST_FILLED
    )


def _zones(left: Mask, right: Mask, grid: Grid, carina_lps: Float) -> Iterator[tuple[str, float, float]]:
    """Yield the name of each zone, the share of it that is lung, and the volume that is not, ml."""
    from skimage.morphology import convex_hull_image

    chest, first = _sampled(left, right, grid)
    n = chest.shape
    across = SAMPLE_MM * (np.arange(n[0]) - 0.5 * (n[0] - 1))
    beside = np.abs(across) > FROM_MIDDLE_SHARE * np.abs(across).max()
    behind = first[1] + SAMPLE_MM * np.arange(n[1]) > carina_lps[1]
    heights = first[2] + SAMPLE_MM * np.arange(n[2])
    levels = np.flatnonzero(chest.any(axis=(0, 1)))
    counts = np.zeros((2, 2, 2))
    base = levels[0] + BASE_SHARE * (levels[-1] - levels[0])
    top = levels[-1] - TOP_SHARE * (levels[-1] - levels[0])
    for k in levels:
        upper = heights[k] > carina_lps[2] + ABOVE_CARINA_MM
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
                lost_ml = (whole - lung) * SAMPLE_MM**3 / 1000.0
                yield f"{part} of the {name} lung", float(lung / whole), float(lost_ml)


def _sampled(left: Mask, right: Mask, grid: Grid) -> tuple[Mask, Float]:
    """Return both lungs on cubes along LPS whose middle is that of the chest, and the first cube's LPS mm."""
    from scipy.ndimage import binary_closing

    step = np.maximum(1, np.rint(SAMPLE_MM / grid.spacing_mm)).astype(np.int64)
    sampled = (left | right)[tuple(slice(None, None, int(s)) for s in step)]
    points = grid.lps(np.argwhere(sampled) * step)
    low, high = points.min(axis=0) - 2.0 * SAMPLE_MM, points.max(axis=0) + 2.0 * SAMPLE_MM
    shape = np.ceil((high - low) / SAMPLE_MM).astype(np.int64) + 1
    chest = np.zeros(shape, dtype=np.bool_)
    chest[tuple(np.rint((points - low) / SAMPLE_MM).astype(np.int64).T)] = True
    return np.asarray(binary_closing(chest, np.ones((3, 3, 3)))), low


def solid_tissue(ct: Volume, lung: Mask) -> tuple[str, ...]:
    """Warn of solid tissue in the lungs that is thicker than vessels: masses and consolidations."""
    from scipy import ndimage

    step = np.maximum(1, np.floor(2.0 / ct.grid.spacing_mm)).astype(np.int64)
    sparse = tuple(slice(None, None, int(s)) for s in step)
    inside = lung[sparse]
    box = window(*bounds(inside, 1))
    solid = np.asfortranarray((ct.array[sparse][box] > SOLID_HU) & inside[box])
    spacing = ct.grid.spacing_mm * step
    core = distance_mm(solid, spacing) >= SOLID_RADIUS_MM
    if not core.any():
        return ()
    mass = solid & (distance_mm(np.asfortranarray(~core), spacing) <= SOLID_RADIUS_MM)
    pieces, count = ndimage.label(mass)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[1:] * float(np.prod(spacing)) / 1000.0
    found = []
    for piece in np.flatnonzero(sizes >= LEAST_SOLID_ML):
        middle = np.argwhere(pieces == piece + 1).mean(axis=0) + [s.start for s in box]
        place = ", ".join(f"{x:.0f}" for x in ct.grid.lps(middle * step))
        found.append(
            f"{sizes[piece]:.0f} ml of solid tissue lie in the lung about LPS ({place}) mm: a mass or a "
            "consolidation. Airways and vessels in it are not seen: a path that looks free there may not be."
        )
    return tuple(found)
