"""Lobes of a CT: bronchi say where each one is, fissures and the lack of vessels where it ends.

As in [Lassen2013] and [Ukil2009] seeds come from the bronchi and borders from fissures and from where there
are no vessels.  Lobes are shared out by diffusion, which passes a gap in a fissure by no more than its width.
"""

from collections.abc import Mapping

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float32, Int, Int32, Mask, UInt8
from anatomy.base.words import percent
from anatomy.grid import Volume
from anatomy.lobes import (
    BORDER,
    LEAST_CHANCE,
    LEFT_LOWER,
    LEFT_UPPER,
    RIGHT_LOWER,
    RIGHT_MIDDLE,
    RIGHT_UPPER,
    SEEN,
    UNKNOWN,
    fissures_between,
)
from anatomy.morphology import at_label_borders, bounds, closed, largest_piece, window
from anatomy.segmentation.airway import Airways
from anatomy.segmentation.fissures import BLOCK, EDGE_MM, Cubic, Fissureness, blocks_of, fissureness
from anatomy.segmentation.lobar_bronchi import LEAST_SHARE, TRUNK_SHARE, Regions, lobes_of_branches
from anatomy.segmentation.lungs import Lungs

OF_LUNG = {"right": (RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER), "left": (LEFT_UPPER, LEFT_LOWER)}
FISSURES = {
    "right horizontal fissure": ((RIGHT_UPPER,), (RIGHT_MIDDLE,)),
    "right oblique fissure": ((RIGHT_UPPER, RIGHT_MIDDLE), (RIGHT_LOWER,)),
    "left oblique fissure": ((LEFT_UPPER,), (LEFT_LOWER,)),
}
"""The lobes on both sides of each fissure."""
SEEN_WITHIN_VOXELS = 3
"""A sheet so near to a border is the border's fissure: about twice the error of either."""
FISSURE_COST = 100.0
"""Crossing a fissure costs as much as going round it through 100 mm of lung."""
HOLE_MM, HOLE_LIKELIHOOD = 6.0, np.float32(0.5)
"""Vessels, their blur and the pleura hide so much of a fissure to each side, which is likely there."""
ROUNDS, RELAXATION = 120, np.float32(1.8)
"""Diffusion starts near to its end, and then changes less than one voxel in a thousand."""
LEAST_SEEN = 0.5
"""Below this share a fissure's course is mostly inferred, which a warning says."""
LEAST_ENDS, LEAST_CONFIDENCE = 10, 0.94
"""Where no oblique fissure is seen, lobes are inferred from at least so many ends of the airway in a lung,
whose names have this mean probability: with less, as at 5 mm slices, names of phantoms are often wrong."""
BAND_MM, BAND_GROWTH, BAND_UNSEEN_MM, WIDEST_SHARE = 3.0, 2.5, 6.0, 0.22
"""In 95 of 100 places of phantoms the true fissure lies within the first of a border that is seen.  To that
come the second times the root of the way to there, both in mm, as a path strays by chance, and the third
times the share of the fissure that is unseen.  At most it is the last of the edge of a cube as large as the
lung."""
OUTER_VOXELS = 2
"""Lobes are made so far beyond the lung, so that none of its voxels is left without one."""


@frozen_record
class Lobes:
    """Lobes of both lungs on the grid of the CT.

    Args:
        lobes ((ni, nj, nk) uint8): Numbers of `anatomy.lobes.LOBES`, 0 outside the lungs; 0 everywhere if
            lobes could not be told apart.
        fissures ((ni, nj, nk) uint8): Both sides of the borders between lobes, `SEEN` where a fissure is
            seen, else `BORDER`; around them the band in which the fissure lies in 95 of 100 places, as
            `anatomy.lobes` says; `UNKNOWN` in a lung whose lobes are not known.
        seen: Share of each border at which a fissure is seen.
    """

    lobes: UInt8
    fissures: UInt8
    seen: Mapping[str, float]
    warnings: tuple[str, ...]


def segment_lobes(
    ct: Volume, lungs: Lungs, airways: Airways, vessels: Mask, tree: AirwayTree | AnatomyError
) -> Lobes:
    """Return the lobes and fissures of a CT.

    Args:
        ct: Hounsfield units.
        lungs, airways: On the grid of the CT.
        vessels ((ni, nj, nk) bool): All vessels.
        tree: Of the lumen of the airways, or why there is none.

    References:
        [Lassen2013], [Ukil2009], [Wiemker2005]
    """
    if isinstance(tree, AnatomyError):
        nothing = np.zeros(ct.grid.shape, dtype=np.uint8, order="F")
        said = f"Lobes and fissures are not known, because the airway gives no tree: {tree.found}"
        return Lobes(lobes=nothing, fissures=nothing, seen={}, warnings=(said,))
    cubic, sheets = _sheets(ct, lungs, airways, vessels)
    masks = {"right": cubic.sampled(lungs.right), "left": cubic.sampled(lungs.left)}
    found, vessel, warnings = np.zeros(cubic.shape, dtype=np.uint8), cubic.sampled(vessels), []
    for side, mask in masks.items():
        if not mask.any():
            continue
        low, high = bounds(mask, OUTER_VOXELS)
        box = window(low, high)
        parts = _LungParts(mask[box], vessel[box], sheets.likelihood[box], cubic, low, tree)
        made = parts.lobes(side)
        if not made.any():
            warnings.append(f"The lobes of the {side} lung are not known: too few of its bronchi are found.")
        found[box][made > 0] = made[made > 0]
        share = _seen_shares(found, sheets).get(f"{side} oblique fissure", 1.0)
        if share < LEAST_SEEN and not parts.has_sure_names:
            found[np.isin(found, OF_LUNG[side])] = 0
            warnings.append(
                f"The lobes of the {side} lung are not known: its oblique fissure is seen on "
                f"{percent(share)} of what would be its course, and too few of its bronchi are found to tell."
            )
    lobes = cubic.back(found)
    lobes *= np.where(lobes >= LEFT_UPPER, lungs.left, lungs.right)
    return _with_fissures(lobes, found, lungs, sheets, cubic, warnings)


def _with_fissures(
    lobes: UInt8, found: UInt8, lungs: Lungs, sheets: Fissureness, cubic: Cubic, warnings: list[str]
) -> Lobes:
    """Return lobes with the fissures between them and their bands; `found` are the lobes on cubic voxels."""
    seen = _seen_shares(found, sheets)
    for name, share in seen.items():
        if share < LEAST_SEEN:
            warnings.append(
                f"The {name} is seen on {percent(share)} of the border between its lobes; the rest is "
                "inferred, and lies in a wide band around that border in 95 of 100 places."
            )
    near = _grown(sheets.seen, SEEN_WITHIN_VOXELS)
    fissures = cubic.back(_bands(found, near, seen)) * lungs.mask
    between = fissures_between(lobes)
    fissures[between] = np.where(cubic.back(near), np.uint8(SEEN), np.uint8(BORDER))[between]
    fissures = _without_lobes_unknown(fissures, lobes, lungs)
    return Lobes(lobes=lobes, fissures=fissures, seen=seen, warnings=tuple(warnings))


def _without_lobes_unknown(fissures: UInt8, lobes: UInt8, lungs: Lungs) -> UInt8:
    """Return fissures that are `UNKNOWN` in a lung of which less than half has a lobe, and nothing else."""
    for side in (lungs.left, lungs.right):
        if np.count_nonzero(lobes[side]) <= 0.5 * np.count_nonzero(side):
            fissures = np.where(side, np.uint8(UNKNOWN), fissures)
    return fissures


def _bands(lobes: UInt8, near: Mask, seen: Mapping[str, float]) -> UInt8:
    """Return around each border of lobes the chance in percent that a place lies beyond the true fissure.

    How far the fissure may lie from the border grows with the way along the border to where it is seen.  The
    error of its place is taken for normal, and as one for all places that are as near to each other.  Lobes
    and `near`, where a sheet is near, are on cubic voxels (nk, nj, ni).
    """
    from scipy import ndimage, special

    bands = np.zeros_like(lobes)
    for name, share in seen.items():
        one, other = (np.isin(lobes, side) for side in FISSURES[name])
        widest_mm = WIDEST_SHARE * EDGE_MM * np.isin(lobes, OF_LUNG[name.split()[0]]).sum() ** (1.0 / 3.0)
        border = _grown(one, 1) & other | _grown(other, 1) & one
        box = window(*bounds(border, int(widest_mm / EDGE_MM)))
        border, inside = border[box], (one | other)[box]
        width_mm, found = np.full(border.shape, widest_mm, dtype=np.float32), border & near[box]
        if found.any():
            unseen_mm = ndimage.distance_transform_edt(~found, sampling=EDGE_MM).astype(np.float32)
            width_mm = BAND_MM + BAND_GROWTH * np.sqrt(unseen_mm) + np.float32(BAND_UNSEEN_MM * (1.0 - share))
            width_mm = np.minimum(width_mm, np.float32(widest_mm))
        away, nearest = ndimage.distance_transform_edt(~border, sampling=EDGE_MM, return_indices=True)
        # The border runs between two voxels, half a voxel from the middle of either.
        part = (away + 0.5 * EDGE_MM) / width_mm[tuple(nearest)]
        chance = np.clip(np.rint(50.0 * special.erfc(1.96 / np.sqrt(2.0) * part)), LEAST_CHANCE, 49.0)
        bands[box] = np.maximum(bands[box], np.where(inside & (part <= 1.0), chance, 0.0).astype(np.uint8))
    return bands


def confirmed_lobes(ct: Volume, lungs: Lungs, airways: Airways, vessels: Mask, lobes: UInt8) -> Lobes:
    """Return given lobes `(ni, nj, nk)` with fissures, and how much the CT shows, as `segment_lobes`."""
    cubic, sheets = _sheets(ct, lungs, airways, vessels)
    return _with_fissures(lobes, cubic.sampled(lobes), lungs, sheets, cubic, [])


def _sheets(ct: Volume, lungs: Lungs, airways: Airways, vessels: Mask) -> tuple[Cubic, Fissureness]:
    cubic = Cubic.over(ct.grid)
    barred = cubic.sampled(vessels | airways.lumen | airways.wall)
    return cubic, fissureness(cubic.mean(ct.array), cubic.sampled(lungs.mask), barred)


def lobes_given(lobes: UInt8, fissures: UInt8 | None, lungs: Lungs) -> dict[str, UInt8]:
    """Return lobes that a person corrected, and the fissures between them if there are no others."""
    if fissures is None:
        fissures = _without_lobes_unknown((SEEN * fissures_between(lobes)).astype(np.uint8), lobes, lungs)
    return {"lobes": lobes, "fissures": fissures}


class _LungParts:
    """One lung in blocks of 2 mm, and what its bronchi and fissures part it into."""

    def __init__(
        self, mask: Mask, vessels: Mask, likelihood: Float32, cubic: Cubic, low: Int, tree: AirwayTree
    ) -> None:
        self._fine, self._likelihood, self._cubic, self._tree = mask, likelihood, cubic, tree
        self._low = low
        self._mask = blocks_of(mask).mean(axis=(1, 3, 5), dtype=np.float32) >= np.float32(0.5)
        self._coarse = blocks_of(likelihood).max(axis=(1, 3, 5))
        self._vessels = blocks_of(vessels).any(axis=(1, 3, 5))
        place = (cubic.index(tree.points_lps) - low) // BLOCK
        self._inside = ((place >= 0) & (place < self._mask.shape)).all(axis=1)
        self._place = tuple(np.clip(place, 0, np.array(self._mask.shape) - 1).T)
        self._inside &= self._mask[self._place]

    def lobes(self, side: str) -> UInt8:
        """Return the lobes on the cubic voxels; all 0 if there are too few bronchi."""
        lobe_of_branch = lobes_of_branches(self._regions(), OF_LUNG[side])
        nothing = np.zeros(self._fine.shape, dtype=np.uint8)
        if set(OF_LUNG[side]) - set(lobe_of_branch.tolist()):
            return nothing
        made = self._refined(self._shared_out(lobe_of_branch, OF_LUNG[side]))
        sizes = np.bincount(made[self._fine], minlength=LEFT_LOWER + 1)[list(OF_LUNG[side])]
        # A bronchus of which too little is found leaves its lobe to the others.
        return made if sizes.min() >= LEAST_SHARE * sizes.sum() else nothing

    @property
    def has_sure_names(self) -> bool:
        """Whether the ends of the tree in this lung are as many as it has segments, with sure names."""
        tree, here = self._tree, np.zeros(self._tree.n_branches, dtype=np.bool_)
        here[tree.branch_of_point[self._inside]] = True
        here[tree.branch_parent[1:]] = False
        return here.sum() >= LEAST_ENDS and float(tree.bronchi.confidence[here].mean()) >= LEAST_CONFIDENCE

    def _seeded(self, number_of_branch: Int) -> Int32:
        """Return the blocks on the centreline of each branch, with its number; -1 outside the lung."""
        seeds = np.where(self._mask, 0, -1).astype(np.int32)
        numbers = number_of_branch[self._tree.branch_of_point]
        there = (numbers > 0) & self._inside
        seeds[tuple(axis[there] for axis in self._place)] = numbers[there]
        return seeds

    def _flooded(self, seeds: Int32, likelihood: Float32) -> Int32:
        """Return the number of the seeds from which the way to each block costs least."""
        from anatomy.segmentation.kernels.flooding import flood

        labels = seeds.copy()
        flood(labels, 1.0 + np.float32(FISSURE_COST / BLOCK) * likelihood)
        return np.maximum(labels, 0)

    def _regions(self) -> Regions:
        """Return what lies nearest to each branch of this lung that is no main bronchus."""
        tree, count = self._tree, self._tree.n_branches
        below = np.eye(count, dtype=np.bool_)
        for branch in range(count - 1, 0, -1):
            below[tree.branch_parent[branch]] |= below[branch]
        here = np.bincount(tree.branch_of_point, weights=self._inside, minlength=count)
        behind = below @ here
        used = (here > 0) & (behind < TRUNK_SHARE * here.sum())
        labels = self._flooded(self._seeded(np.where(used, np.arange(1, count + 1), 0)), self._coarse)
        used &= np.bincount(labels.ravel(), minlength=count + 1)[1:] > 0
        return _regions_of(labels, self._coarse, below, used, tree.bronchi.lobes, self._cubic, self._low)

    def _shared_out(self, lobe_of_branch: Int, lobes: tuple[int, ...]) -> Int32:
        """Return the lobe of every block of the lung by diffusion from the bronchi."""
        from scipy import ndimage

        from anatomy.segmentation.kernels.flooding import diffuse

        seeds = self._seeded(lobe_of_branch)
        # Likelihoods with the holes of sheets closed, and the gaps between sheets and the pleura.
        solid = np.asfortranarray((self._coarse > 0) | ~self._mask)
        hidden = closed(solid, HOLE_MM, (BLOCK * EDGE_MM,) * 3) & self._mask
        likelihood = np.where(hidden, np.maximum(self._coarse, HOLE_LIKELIHOOD), self._coarse)
        start = np.pad(self._flooded(seeds, likelihood), 1)
        # Vessels are so far apart within a lobe; farther from them, where fissures run, lung resists more.
        far = ndimage.distance_transform_edt(~self._vessels, sampling=BLOCK * EDGE_MM) / 6.0
        # Times that of lung: a fissure then outweighs the whole way from a bronchus to it.
        resistance = (1.0 + far**2) * (1.0 + 200.0 * likelihood)
        resistance = np.pad(resistance.astype(np.float32), 1, constant_values=1.0)
        along = _conductance(resistance, np.pad(self._mask, 1))
        free = np.flatnonzero(np.pad(seeds == 0, 1))
        shares = []
        for lobe in lobes[:-1]:
            share = (start == lobe).astype(np.float32)
            diffuse(share, free, *along, ROUNDS, RELAXATION)
            shares.append(share[1:-1, 1:-1, 1:-1])
        shares.append(1.0 - np.sum(shares, axis=0, dtype=np.float32))
        return np.where(self._mask, np.array(lobes)[np.argmax(shares, axis=0)], 0).astype(np.int32)

    def _refined(self, coarse: Int32) -> UInt8:
        """Return lobes on the cubic voxels: near the borders of the coarse ones they meet on the fissure."""
        from scipy import ndimage

        from anatomy.segmentation.kernels.flooding import flood

        nearest = ndimage.distance_transform_edt(coarse == 0, return_distances=False, return_indices=True)
        whole = coarse[tuple(nearest)]
        # In blocks, 10 mm: so far from the border of the diffusion the fissure itself is looked for.
        labels = self._on_cubic(np.where(_grown(at_label_borders(whole), 5), 0, whole))
        labels[~_grown(self._fine, OUTER_VOXELS)] = -1
        cost = 1.0 + np.float32(FISSURE_COST) * self._likelihood
        flood(labels, cost)
        for lobe in np.unique(coarse[coarse > 0]):
            labels[(labels == lobe) & ~largest_piece(labels == lobe)] = 0
        flood(labels, cost)
        return np.maximum(labels, 0).astype(np.uint8)

    def _on_cubic(self, blocks: Int32) -> Int32:
        sizes = zip(self._fine.shape, blocks.shape, strict=True)
        places = [np.minimum(np.arange(n) // BLOCK, m - 1) for n, m in sizes]
        return np.ascontiguousarray(blocks[np.ix_(*places)])


def _regions_of(
    labels: Int32, likelihood: Float32, below: Bool, used: Bool, named: Int, cubic: Cubic, low: Int
) -> Regions:
    count = len(used)
    sums, faces = (np.zeros((count + 1) ** 2) for _ in range(2))
    for axis in range(3):
        one, other = np.moveaxis(labels, axis, 0)[:-1], np.moveaxis(labels, axis, 0)[1:]
        value = np.moveaxis(likelihood, axis, 0)
        meet = (one != other) & (one > 0) & (other > 0)
        pair = one[meet].astype(np.int64) * (count + 1) + other[meet]
        sums += np.bincount(pair, np.maximum(value[:-1], value[1:])[meet], minlength=sums.size)
        faces += np.bincount(pair, minlength=sums.size)
    square = [each.reshape(count + 1, count + 1)[1:, 1:] for each in (sums, faces)]
    at = np.argwhere(labels > 0)
    owner = labels[tuple(at.T)]
    places = cubic.grid.lps(((at + 0.5) * BLOCK + low)[:, ::-1] * EDGE_MM / cubic.grid.spacing_mm - 0.5)
    return Regions(
        volume=np.bincount(owner, minlength=count + 1)[1:].astype(np.float64),
        moment=np.stack([np.bincount(owner, p, minlength=count + 1)[1:] for p in places.T], axis=1),
        likelihood=square[0] + square[0].T,
        faces=square[1] + square[1].T,
        below=below,
        used=used,
        named=named,
    )


def _conductance(resistance: Float32, mask: Mask) -> list[Float32]:
    """Return the conductance from each voxel to the next along i, j, k; 0 unless both lie in the lung."""
    found = []
    for axis in (2, 1, 0):
        made = np.zeros(mask.shape, dtype=np.float32)
        first, inside, of = (np.moveaxis(each, axis, 0) for each in (made, mask, resistance))
        first[:-1] = np.where(inside[:-1], inside[1:], False) / (of[:-1] + of[1:])
        found.append(made)
    return found


def _grown(mask: Mask, voxels: int) -> Mask:
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(mask, iterations=voxels))


def _seen_shares(lobes: UInt8, sheets: Fissureness) -> dict[str, float]:
    """Return at which share of each border a fissure is seen, of where one could be."""
    near, shares = _grown(sheets.seen, SEEN_WITHIN_VOXELS), {}
    for name, sides in FISSURES.items():
        one, other = (np.isin(lobes, side) for side in sides)
        border = _grown(one, 1) & other | _grown(other, 1) & one
        if border.any():
            looked = border & sheets.looked
            shares[name] = float(near[looked].mean()) if looked.any() else 0.0
    return shares
