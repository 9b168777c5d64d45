"""Figures of the masks of a patient, each by itself and beside the others."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from anatomy import morphology
from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Array, Float, Int, Mask
from anatomy.base.words import percent
from anatomy.display import point
from anatomy.grid import Grid
from anatomy.landmarks import SAMPLE_MM, directions
from anatomy.lobes import LOBES, RIGHT_LOWER
from anatomy.patient import PatientImages
from anatomy.plausibility import DOUBTFUL, REFUSED, Finding, findings_of

Kept = Callable[[str, tuple[Array | None, ...], Callable[[], Any]], Any]
AROUND = np.vstack([np.eye(3), -np.eye(3)])
"""Directions in which what lies around a point is looked for."""
LEAST_CUT, GREATEST_CUT = 0.01, 0.1
"""A piece of the airway with this share of the lumen is named, and one with the other share is refused: in
phantoms a segment and all behind it has 2 to 5 %, what hangs on a main bronchus 20 % and more."""


def mask_findings(
    images: PatientImages,
    tree: AirwayTree,
    lungs_lps: tuple[Float, Float],
    kept: Kept = lambda _name, _sources, make: make(),
) -> tuple[Finding, ...]:
    """Check the masks of a patient by all figures of `anatomy.plausibility.LIMITS`, and by their directions.

    `lungs_lps` are points `(N, 3)` spread evenly over the left and the right lung, LPS mm, empty if they
    cannot be told apart.  Every check is returned, what is usual included; those that `images.accepted` names
    are accepted.  `kept` is `anatomy.build.Reused.get`.
    """
    found = findings_of(dict(_figures(images, tree, kept)))
    found += _cut_off(images, tree)
    lowest_mm = float(images.grid.corners_lps[:, 2].min())
    sources = images.lumen.array, *lungs_lps
    found += kept("directions", sources, lambda: directions(tree, *lungs_lps, lowest_mm=lowest_mm))
    found += [Finding(name="airway", found=said, verdict=DOUBTFUL) for said in tree.report.warnings]
    return tuple(found)


def _figures(images: PatientImages, tree: AirwayTree, kept: Kept) -> Iterator[tuple[str, float]]:
    """Yield the figures that can be told, by the names of `anatomy.plausibility.LIMITS`."""
    ml = images.grid.voxel_volume_mm3 / 1000.0
    lung, lumen, vessels = images.lung.array, images.lumen.array, images.vessels.array
    fissures = None if images.fissures is None else images.fissures.array
    # A band says itself where fissures are not known; an inferred oblique fissure may begin below the apex.
    everywhere = fissures if images.fissure_band is None else None
    points = kept("points of the lungs", (lung,), lambda: morphology.sampled(lung, images.grid, SAMPLE_MM))
    yield from _of_lungs(lung, points, {"vessels": vessels, "fissures": everywhere}, images.grid, tree)
    yield "lungs_l", _count(lung) * ml / 1000.0
    yield "lumen_ml", _count(lumen) * ml
    yield "lumen_end_mm2", kept("end of the lumen", (lumen,), lambda: _lowest_mm2(lumen, images.grid))
    yield "lumen_holes", tree.report.cavity_voxels / _count(lumen)
    yield from _of_airway(lung, images.grid, tree)
    inside = vessels & lung
    yield "vessels_of_lungs", _count(inside) / _count(lung)
    yield "vessels_in_lungs", _count(inside) / _count(vessels)
    yield "vessels_in_lumen", _shared(vessels, lumen)
    if images.wall is not None:
        wall = images.wall.array
        yield "wall_in_lumen", _shared(wall, lumen)
        yield "wall_in_vessels", _shared(wall, vessels)
        near = kept("wall at the lumen", (wall, lumen), lambda: share_at_lumen(wall, lumen, images.grid))
        yield "wall_at_lumen", near
        # How much of the airway has a wall, in the part that has the least.
        around = (
            _around(wall, images.grid, tree.points_lps, tree.radius_mm + by).any(1) for by in (0, 0.5, 1, 2)
        )
        yield "least_wall", min(_shares_of_parts(np.any(list(around), 0), tree.points_lps, tree))
    if fissures is not None:
        within = _count(fissures & lung)
        yield "fissures_of_lungs", within / _count(lung)
        yield "fissures_in_lungs", within / _count(fissures)
        sheet = morphology.sampled(fissures & lung, images.grid, SAMPLE_MM / 2)
        if len(sheet):
            # Fissures that end as near to the surface of the lungs reach it.
            yield "fissures_at_rim", float((~_around(lung, images.grid, sheet, 3.0)).any(1).mean())
            # A sheet, which is drawn two voxels thick, ends within this distance in some direction.
            beside_mm = max(2.5, 1.5 * float(images.grid.spacing_mm.max()))
            thick = _around(fissures, images.grid, sheet, beside_mm).all(1)
            yield "fissures_thick", float(thick.mean())
        yield "fissures_in_others", _count(fissures & (vessels | lumen)) / _count(fissures)
    if images.nodules is not None:
        nodules = images.nodules.array
        yield "nodules_ml", _count(nodules) * ml
        yield "nodules_in_others", _count(nodules & (vessels | lumen)) / _count(nodules)
        if images.targets_lps:
            there = images.grid.values_at(nodules, np.array(images.targets_lps), False)
            yield "targets_in_nodules", float(there.mean())
        # Nodules of more voxels are not taken apart: they are refused for their volume.
        if _count(nodules) <= 5_000_000:
            yield from _of_nodules(nodules, lung, images.grid)
            if images.nodule_labels is not None:
                # How many nodules that do not touch have the same label, where most have.
                voxels, part = morphology.components(nodules)
                named = np.stack([images.nodule_labels.array[tuple(voxels.T)], part], axis=1)
                yield "nodule_pieces", float(np.bincount(np.unique(named, axis=0)[:, 0]).max())
    if images.lobes is not None:
        lobes = images.lobes.array
        sources = lobes, lung, images.lumen.array
        yield from kept("lobes", sources, lambda: tuple(_of_lobes(lobes, lung, images.grid, tree)))


def _count(mask: Mask) -> float:
    """Return how many voxels a mask has, at least one."""
    return float(max(int(np.count_nonzero(mask)), 1))


def _lowest_mm2(mask: Mask, grid: Grid) -> float:
    """Return the area of the slice of a mask that lies farthest down."""
    axis = int(np.abs(grid.lps_from_ijk[2, :3]).argmax())
    low, high = morphology.bounds(mask)
    last = low[axis] if grid.lps_from_ijk[2, axis] > 0.0 else high[axis] - 1
    return np.count_nonzero(mask.take(last, axis)) * grid.voxel_volume_mm3 / float(grid.spacing_mm[axis])


def _shared(one: Mask, other: Mask) -> float:
    return float(np.count_nonzero(one & other)) / min(_count(one), _count(other))


def _around(mask: Mask, grid: Grid, points: Float, far_mm: Float | float) -> Mask:
    """Tell for points `(N, 3)` LPS mm whether a mask holds what lies so far off in each of `AROUND`."""
    steps = np.reshape(far_mm, (-1, 1, 1)) * AROUND
    return np.asarray(grid.values_at(mask, points[:, None] + steps, False))


def _shares_of_parts(marks: Mask, points: Float, tree: AirwayTree) -> list[float]:
    """Return the share of points that are marked in every part of either lung, from apex to base."""
    left = points[:, 0] > tree.carina_lps[0]
    ordered = [np.flatnonzero(side)[np.argsort(points[side, 2], kind="stable")] for side in (left, ~left)]
    # Each lung is looked at in so many parts from apex to base, of the same volume.
    parts = [part for order in ordered for part in np.array_split(order, 3)]
    return [float(marks[part].mean()) for part in parts if len(part)]


def _of_lungs(
    lung: Mask, points: Float, others: Mapping[str, Mask | None], grid: Grid, tree: AirwayTree
) -> Iterator[tuple[str, float]]:
    """Yield what about one voxel in every cube of `SAMPLE_MM` tells of the lungs."""
    from scipy import ndimage

    lattice = morphology.lattice_of(grid, SAMPLE_MM)
    coarse = np.pad(lung[lattice], 1)
    sizes = morphology.pieces_of(coarse, corners=True)[1][1:]
    total = float(max(sizes.sum(), 1))
    # A piece with less than this share of the lungs is no lung.
    yield "lung_pieces", float(sizes[sizes < 0.05 * total].sum()) / total
    outside, _ = ndimage.label(~coarse)
    yield "lung_holes", float(np.count_nonzero((outside != outside[0, 0, 0]) & ~coarse)) / total
    if len(points):
        wide, _, tall = np.ptp(points, axis=0) + SAMPLE_MM
        yield "tall_lungs", float(tall / wide)
    left = points[:, 0] > tree.carina_lps[0]
    yield "smaller_lung", float(min(left.mean(), 1.0 - left.mean())) if len(points) else 0.0
    for name, other in others.items():
        if other is not None:
            marks = other[lattice][lung[lattice]]
            mean = float(marks.mean()) if marks.any() else 1.0
            yield f"least_{name}", min(_shares_of_parts(marks, points, tree), default=0.0) / mean


def _of_airway(lung: Mask, grid: Grid, tree: AirwayTree) -> Iterator[tuple[str, float]]:
    ends = np.setdiff1d(np.arange(tree.n_branches), tree.branch_parent)
    last = tree.branch_start[ends + 1] - 1
    tips = tree.points_lps[last]
    yield "trachea_mm", float(np.median(tree.radius_mm[tree.branch_points(0)]))
    yield "thinnest_mm", float(np.median(tree.radius_mm[last]))
    yield "ends_in_lungs", float(np.mean(grid.values_at(lung, tips, False)))
    widest, usual = (
        np.array([how(tree.radius_mm[tree.branch_points(n)]) for n in range(tree.n_branches)])
        for how in (np.max, np.median)
    )
    yield "widening", float(np.max(widest[1:] / usual[tree.branch_parent[1:]], initial=0.0))
    left = int(np.count_nonzero(tips[:, 0] > tree.carina_lps[0]))
    yield "least_ends", float(min(left, len(tips) - left))


def share_at_lumen(wall: Mask, lumen: Mask, grid: Grid) -> float:
    """Return the share of a wall near the lumen."""
    box = morphology.window(*morphology.bounds(wall | lumen))
    # Walls are up to 3 mm thick, and their inner voxels share a face with the lumen.
    near = morphology.distance_mm(~lumen[box], grid.spacing_mm) <= 4.0
    return float(np.count_nonzero(near & wall[box])) / _count(wall)


def _of_nodules(nodules: Mask, lung: Mask, grid: Grid) -> Iterator[tuple[str, float]]:
    """Yield how much of the nodules lies in, at and beyond the lungs, and how compact the largest one is."""
    voxels, part = morphology.components(nodules)
    box = morphology.window(*morphology.bounds(nodules, 1))
    near = morphology.grown_by_one(np.asfortranarray(lung[box]))
    touches = np.bincount(part, weights=near[tuple((voxels - [axis.start for axis in box]).T)]) > 0
    yield "nodules_at_lungs", float(touches[part].mean())
    beyond_mm = morphology.distance_mm(~lung[box], grid.spacing_mm)[nodules[box]]
    yield "nodules_beyond_lungs_mm", float(beyond_mm.max(initial=0.0))
    largest = voxels[part == np.argmax(np.bincount(part))]
    yield "nodule_filled", len(largest) / float(np.prod(np.ptp(largest, axis=0) + 1))
    yield "nodule_end", max(_flattest(voxels[:, axis], part) for axis in range(3))


def _flattest(places: Int, part: Int) -> float:
    """Return how large the first or last slice along an axis is beside the largest one, in any nodule."""
    length = int(places.max()) + 1
    keys, counts = np.unique(part * length + places, return_counts=True)
    first = np.flatnonzero(np.diff(keys // length, prepend=-1))
    last = np.append(first[1:], len(keys)) - 1
    ends = np.maximum(counts[first], counts[last]) / np.maximum.reduceat(counts, first)
    # A nodule of fewer voxels may well have a flat face.
    return float(ends[np.bincount(part) >= 50].max(initial=0.0))


def _of_lobes(lobes: Array, lung: Mask, grid: Grid, tree: AirwayTree) -> Iterator[tuple[str, float]]:
    lattice = morphology.lattice_of(grid, SAMPLE_MM)
    numbers, inside = lobes[lattice], lung[lattice]
    yield "lobes_of_lungs", _count((numbers > 0) & inside) / _count(inside)
    points, number = morphology.sampled(lobes > 0, grid, SAMPLE_MM), numbers[numbers > 0]
    on_left = points[:, 0] > tree.carina_lps[0]
    yield "lobes_on_side", float(np.mean(on_left == (number > RIGHT_LOWER))) if len(number) else 1.0


def _cut_off(images: PatientImages, tree: AirwayTree) -> Iterator[Finding]:
    """Yield the pieces of the airway that hang on nothing, with the gap and what lies behind it."""
    whole = _count(images.lumen.array)
    for piece in tree.report.pieces_left_out:
        share = piece.voxels / whole
        if share < LEAST_CUT:
            continue
        # The lobe, or else the lung, in which the middle of the piece lies.
        behind = "left lung" if piece.middle_lps[0] > tree.carina_lps[0] else "right lung"
        if images.lobes is not None:
            lobe = int(images.grid.values_at(images.lobes.array, piece.middle_lps, 0))
            behind = LOBES[lobe] if lobe else behind
        yield Finding(
            name="gap",
            found=f"A gap of {piece.length_mm:.1f} mm at LPS ({point(piece.position_lps)}) mm cuts off "
            f"{percent(share)} of the airway, which leads into the {behind}: none of it is used, and no "
            "path that leads through it is known",
            remedy="Close the gap in the mask of the airway, if it is one",
            verdict=REFUSED if share >= GREATEST_CUT else DOUBTFUL,
        )
