"""What to look at before trusting a segmentation: noise, slices, the airway, figures, masks from elsewhere.

Whether such masks lie on what they show in the CT is told by moving them a little: they must fit worse.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Array, Float, Mask
from anatomy.base.words import percent
from anatomy.grid import Grid, Volume
from anatomy.lobes import UNKNOWN
from anatomy.mask_findings import share_at_lumen
from anatomy.morphology import bounds, components, distance_mm, window
from anatomy.nodule_size import NoduleSize, nodule_size
from anatomy.plausibility import LIMITS, Finding
from anatomy.segmentation.input import FINE_SLICE_MM, slice_mm
from anatomy.segmentation.parts import Parts

STEP_MM = 3.0
"""The step is wider than an airway's wall, and less than the distance of vessels."""
SAMPLES = 200_000
"""The mean of so many voxels of a mask is known to 1 HU."""


TISSUE_HU = (-50.0, 150.0)
"""Muscle and blood, whose own texture is weak."""
QUIET_SHARE = 0.2
"""This share of the cubes is taken as quiet: the others hold the edge of something."""
METAL_HU, LEAST_METAL_ML = 2500.0, 0.1
"""Compact bone ends at 2000 HU; a screw has more than the volume, as has a vein while contrast medium
enters."""


def scan_warnings(ct: Volume, near: Mask) -> tuple[str, ...]:
    """Warn of noise and metal in the box of the lungs `near`, `(ni, nj, nk)` bool, and of thick slices."""
    warnings = []
    metal = np.count_nonzero(ct.array[window(*bounds(near))] > METAL_HU) * ct.grid.voxel_volume_mm3 / 1000.0
    if metal >= LEAST_METAL_ML:
        warnings.append(
            f"{metal:.1f} ml of metal or undiluted contrast medium lie between or beside the lungs: streaks "
            "hide airways and vessels in the slices around, so a path that looks free there may not be."
        )
    noise = noise_hu(ct, near)
    # Diagnostic CT of the chest has 10 to 30 HU.
    if noise > 30.0:
        # In phantoms each HU above 20 costs this share of the tree: 8 % at 40 HU, 20 % at 70 HU.
        loss = 100.0 * 0.004 * (noise - 20.0)
        warnings.append(
            f"The noise is {noise:.0f} HU: {loss:.0f} % of the airways or more, the thin ones, are not "
            "found, and reach is understated by what they lead to. A reconstruction with a smoother "
            "kernel or thicker slices (up to 1.5 mm) shows more."
        )
    if slice_mm(ct) > FINE_SLICE_MM:
        warnings.append(
            f"The slices are {slice_mm(ct):.1f} mm apart: bronchi look narrower than they are, and thin "
            "ones are missing, so that reach is understated, most in the upper and lower lobes. Slices of "
            "1 mm show more."
        )
    return tuple(warnings)


def noise_hu(ct: Volume, near: Mask) -> float:
    """Return the noise in soft tissue of the box around the lungs, HU; 0 if unknown.

    It is the standard deviation of noise without correlation that leaves as much in the mean of a pixel and
    its four neighbours, which airways are searched in.  Correlated noise leaves more there than its own
    deviation tells.
    """
    box = window(*bounds(near))
    # Noise is measured in cubes of this side.
    side = np.maximum(2, np.rint(6.0 / ct.grid.spacing_mm)).astype(np.int64)
    values = ct.array[box]
    counts = np.array(values.shape) // side
    # The cubes are spread evenly.  A tenth of them lie in soft tissue: the spread of the quietest is then
    # known to a few per cent.
    chosen = np.unique(np.linspace(0, counts.prod() - 1, min(int(counts.prod()), 20_000)).astype(np.int64))
    low = np.stack(np.unravel_index(chosen, tuple(counts)), axis=1) * side
    inside = np.stack(np.meshgrid(*(np.arange(n) for n in side), indexing="ij"), axis=-1).reshape(-1, 3)
    at = low[:, None, :] + inside[None]
    patches = values[at[..., 0], at[..., 1], at[..., 2]].reshape(-1, *side).astype(np.float32)
    middles = patches.mean(axis=(1, 2, 3))
    patches = patches[(middles > TISSUE_HU[0]) & (middles < TISSUE_HU[1])]
    # From fewer no noise is told.
    if len(patches) < 20 or side[:2].min() < 3:
        return 0.0
    deviation = float(np.quantile(patches.std(axis=(1, 2, 3)), QUIET_SHARE))
    inner = patches[:, 1:-1, 1:-1]
    beside = patches[:, 2:, 1:-1] + patches[:, :-2, 1:-1] + patches[:, 1:-1, 2:] + patches[:, 1:-1, :-2]
    mean_of_five = (inner + beside) / np.float32(5.0)
    left = float(np.quantile(mean_of_five.std(axis=(1, 2, 3)), QUIET_SHARE))
    return max(deviation, float(np.sqrt(5.0)) * left)


LEAST_TRACHEA_MM = 25.0
"""A chest CT shows at least a quarter of the trachea, which is about 100 mm long."""
LEAST_SHARE = 0.2
"""A lung with fewer ends than this share of the other's has lost most of its airways."""


def tree_or_error(lumen: Volume) -> AirwayTree | AnatomyError:
    """Return the tree of a lumen, or why there is none: it is made once, and many judge by it."""
    from anatomy.tree import tree_from_mask

    try:
        return tree_from_mask(lumen)
    except AnatomyError as error:
        return error


def airway_warnings(tree: AirwayTree | AnatomyError, left: Mask, right: Mask, grid: Grid) -> tuple[str, ...]:
    """Judge a lumen by its tree: trachea cut, early stop, leak; lungs are bool `(ni, nj, nk)` on the grid."""
    if isinstance(tree, AnatomyError):
        return (f"No tree can be made from the airway: {tree.found}.",)
    warnings = []
    trachea = tree.distance_from_root_mm[tree.branch_start[1] - 1]
    if trachea < LEAST_TRACHEA_MM:
        warnings.append(
            f"The trachea is cut: only {trachea:.0f} mm of it are in the airway. How "
            "a scope lies above it is not known."
        )
    ends = np.setdiff1d(np.arange(len(tree.branch_parent)), tree.branch_parent)
    tips = tree.points_lps[tree.branch_start[ends + 1] - 1]
    lungs = {"left": left, "right": right}
    counts = {side: int(grid.values_at(lung, tips, False).sum()) for side, lung in lungs.items()}
    for side, count in counts.items():
        # A lung has three lobes or two, and some segments of each are always seen.
        if count < max(4, LEAST_SHARE * max(counts.values())):
            warnings.append(
                f"The airway stops early in the {side} lung: it has {count} ends there. Reach in that lung "
                "is understated."
            )
    loops = len(tree.report.loops_opened)
    # An airway with so many rings per end has grown into lung.
    if loops > max(0.25 * len(ends), 2):
        warnings.append(
            f"Leak suspected: the airway has {loops} rings. A branch may be lung that no scope can "
            "enter: look at the branches of a plan."
        )
    return tuple(warnings)


CUT_OFF_MM, LEAST_CUT_OFF_ML = 3.0, 0.3
"""Air of a main bronchus so far from the lumen is no edge of it; a piece of that volume is 5 mm long."""


def cut_off(central_airway: Mask, lumen: Mask, grid: Grid) -> tuple[str, ...]:
    """Warn of air of trachea and main bronchi that the lumen does not hold; bool `(ni, nj, nk)`."""
    box = window(*bounds(central_airway | lumen, 1))
    lost = np.asfortranarray(central_airway[box])
    lost &= distance_mm(np.asfortranarray(~lumen[box]), grid.spacing_mm) > CUT_OFF_MM
    volume_ml = float(np.count_nonzero(lost)) * grid.voxel_volume_mm3 / 1000.0
    if volume_ml < LEAST_CUT_OFF_ML:
        return ()
    middle = np.argwhere(lost).mean(axis=0) + [side.start for side in box]
    place = ", ".join(f"{x:.0f}" for x in grid.lps(middle))
    return (
        f"{volume_ml:.1f} ml of air in a main bronchus or the trachea, about LPS ({place}) mm, are not in "
        "the airway: it may end before its lung. What lies behind is not reached.",
    )


@frozen_record
class Quality:
    """Figures and warnings about a segmentation; no tree: none could be made; nodules by first voxels."""

    volumes_l: dict[str, float]
    tree: AirwayTree | None
    ends: int
    nodules: tuple[NoduleSize, ...]
    warnings: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for a record."""
        tree = self.tree
        return {
            "volumes_l": {name: round(volume, 5) for name, volume in self.volumes_l.items()},
            "airway": {
                "ends": self.ends,
                "branches": 0 if tree is None else int(tree.n_branches),
                "deepest_generation": 0 if tree is None else int(tree.generation.max()),
                "length_mm": 0.0 if tree is None else round(float(tree.branch_length_mm.sum()), 1),
                "gaps_bridged": 0 if tree is None else len(tree.report.gaps_bridged),
                "loops_opened": 0 if tree is None else len(tree.report.loops_opened),
            },
            "nodules": [asdict(each) for each in self.nodules],
            "warnings": list(self.warnings),
        }


def quality_of(parts: Parts) -> Quality:
    """Measure a segmentation."""
    litre = parts.ct.grid.voxel_volume_mm3 * 1e-6
    counted = {
        "right lung": parts.right, "left lung": parts.left, "airway lumen": parts.lumen,
        "airway wall": parts.wall, "large vessels": parts.large_vessels, "all vessels": parts.all_vessels,
        "nodule": parts.nodule, "band of the fissures": (parts.fissures > 0) & (parts.fissures < UNKNOWN),
        "lung without known fissures": parts.fissures == UNKNOWN,
    }  # fmt: skip
    volumes = {name: float(np.count_nonzero(mask)) * litre for name, mask in counted.items()}
    both, (least, most) = volumes["right lung"] + volumes["left lung"], LIMITS["lungs_l"].usual
    warnings = []
    if not least <= both <= most:
        warnings = [f"The lungs have {both:.2f} l in all; {least:g} to {most:g} l are usual in adults."]
    voxels, part = components(parts.nodule)
    nodules = tuple(nodule_size(voxels[part == n], parts.ct.grid) for n in range(part.max(initial=-1) + 1))
    tree = parts.tree
    if isinstance(tree, AnatomyError):
        failed = f"No airway tree could be made: {tree}"
        return Quality(volumes_l=volumes, tree=None, ends=0, nodules=nodules, warnings=(*warnings, failed))
    ends = sum(len(tree.children(branch)) == 0 for branch in range(tree.n_branches))
    warnings += [*tree.report.warnings, *_leaks(tree)]
    return Quality(volumes_l=volumes, tree=tree, ends=ends, nodules=nodules, warnings=tuple(warnings))


def _leaks(tree: AirwayTree) -> list[str]:
    radius, parent = np.asarray(tree.branch_mean_radius_mm), np.asarray(tree.branch_parent)
    # A bronchus is never so much wider than its parent, and so wide; a leak into the lung is.
    wide = (parent >= 0) & (radius >= 2.5) & (radius > 1.6 * radius[np.maximum(parent, 0)])
    found = []
    for branch in np.flatnonzero(wide):
        place = ", ".join(f"{x:.0f}" for x in tree.points_lps[tree.branch_start[branch + 1] - 1])
        found.append(
            f"Leak suspected at LPS ({place}) mm: an airway of {radius[branch]:.1f} mm radius grows "
            f"from one of {radius[parent[branch]]:.1f} mm."
        )
    return found


@frozen_value
class Fit:
    """By how much a mask must fit the CT better in place than moved: worst of six directions, and mean.

    What is shown is brighter or darker than what is around it.  `doubt_hu` is what the worst direction has in
    phantoms, halved.
    """

    brighter: bool
    least_hu: float
    mean_hu: float
    doubt_hu: float


FITS: Mapping[str, Fit] = {
    "lungs": Fit(brighter=False, least_hu=-10.0, mean_hu=8.0, doubt_hu=4.0),
    "airway": Fit(brighter=False, least_hu=0.0, mean_hu=20.0, doubt_hu=30.0),
    "vessels": Fit(brighter=True, least_hu=0.0, mean_hu=20.0, doubt_hu=60.0),
    "fissures": Fit(brighter=True, least_hu=-np.inf, mean_hu=15.0, doubt_hu=-np.inf),
}
"""In phantoms masks of lungs have 16 and 25 HU, of airways 60 and 110, of vessels 150 and 170, of fissures
-18 and 90.  Off by 3 mm along an axis, lungs have -16 and less, airways and vessels -60 and less, as those
of another patient or of a mirrored one have less than 0.  Lungs may hold fluid, which is not dark; fissures
can be moved in their plane."""


def misplaced(
    ct: Volume, images: Mapping[str, Array], lungs: Mask, lumen: Mask
) -> tuple[list[Finding], list[str]]:
    """Check masks and label maps from elsewhere, by the name of their image, by the CT.

    All are `(ni, nj, nk)` on the voxels of the CT in Hounsfield units; `lungs` and `lumen` are its own,
    wherever they come from.  Returned are the check `masks` for each image that fails it, and warnings.
    """
    failed, warnings = [], []
    for name, image in images.items():
        mask = image != 0
        fit = FITS.get("lungs" if name == "lobes" else name)
        if fit is not None:
            change = moved_by(ct, mask) * (-1.0 if fit.brighter else 1.0)
            worst, mean = float(change.min()), float(change.mean())
            if worst < fit.least_hu or mean < fit.mean_hu:
                failed.append(_failure(name, f"moved by {STEP_MM:g} mm it fits the CT better or as well"))
            elif worst < fit.doubt_hu:
                warnings.append(
                    f"The mask of the {name.replace('_', ' ')} fits the CT hardly better than when moved by "
                    f"{STEP_MM:g} mm: look at its edges in segmentation.png."
                )
        if name in ("lobes", "fissures"):
            share = _share(mask & lungs, mask)
            # Share of lobes and fissures that lies in the lungs: half the lungs lie in the mirrored ones.
            if share < 0.7:
                failed.append(_failure(name, f"only {percent(share)} of it lie in the lungs"))
        if name == "lobes":
            share = _share(mask & lungs, lungs)
            # Share of the lungs that lobes cover: with less, one of them is missing.
            if share < 0.8:
                failed.append(_failure(name, f"it covers only {percent(share)} of the lungs"))
        share = share_at_lumen(mask, lumen, ct.grid) if name == "airway_wall" and mask.any() else 1.0
        # Walls are up to 3 mm thick.
        if share < 0.5:
            failed.append(_failure(name, f"only {percent(share)} of it lie at the lumen"))
    return failed, warnings


def moved_by(ct: Volume, mask: Mask) -> Float:
    """Return by how much the CT's mean in a mask rises, HU, moved down and up each axis: `(6,)`."""
    at = np.flatnonzero(mask.ravel(order="F"))
    voxels = np.stack(np.unravel_index(at[:: max(1, len(at) // SAMPLES)], mask.shape, order="F"), axis=1)
    steps = np.maximum(1, np.rint(STEP_MM / ct.grid.spacing_mm)).astype(np.int64)
    means = []
    for shift in (np.zeros(3, dtype=np.int64), *(s * np.diag(steps)[a] for a in range(3) for s in (-1, 1))):
        place = np.clip(voxels + shift, 0, np.array(mask.shape) - 1)
        # Bone, metal and contrast medium count as tissue.
        means.append(float(np.clip(ct.array[tuple(place.T)], -1100.0, 200.0).mean(dtype=np.float64)))
    return np.asarray(means[1:], dtype=np.float64) - float(means[0])


def _share(part: Mask, whole: Mask) -> float:
    return float(np.count_nonzero(part)) / max(float(np.count_nonzero(whole)), 1.0)


def _failure(name: str, why: str) -> Finding:
    return Finding(
        name="masks",
        found=f"The mask of the {name.replace('_', ' ')} is not of this CT: {why}",
        remedy="Check that mask and CT show the same patient, scan and side, and that the mask holds nothing "
        "else",
    )
