"""Whether what was segmented can be the lungs and airways of a patient, by the CT and by anatomy."""

from collections.abc import Iterator

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Mask
from anatomy.grid import Volume
from anatomy.landmarks import SAMPLE_MM, directions
from anatomy.morphology import sampled
from anatomy.plausibility import DOUBTFUL, REFUSED, Finding, findings_of
from anatomy.segmentation.input import FINE_SLICE_MM
from anatomy.segmentation.lungs import Lungs
from anatomy.segmentation.missing_lung import missing_lung, solid_tissue

DENSITY_HU = (-975.0, -300.0)
"""The median of inflated lung lies between that of gas and that of a lung that is half filled."""
THIN_HU, DENSE_HU = -925.0, -650.0
"""Emphysema is thinner than the one; lungs after breathing out, or with oedema, are denser than the other."""


def plausibility(
    ct: Volume, lungs: Lungs, tree: AirwayTree | AnatomyError, slices_mm: float = 0.0
) -> tuple[tuple[Finding, ...], tuple[str, ...]]:
    """Check lungs and airway by anatomy, with the limits and signs that masks of any source have to meet.

    Args:
        ct: Hounsfield units, in the order of voxels of `canonical`.
        tree: Of the lumen of the airway, or why there is none.
        slices_mm: How far the slices of the scan lie apart.

    Returns:
        - tuple of Finding - The checks that failed.
        - tuple of str - Warnings.
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
                found.append(
                    Finding(
                        name="bronchi",
                        found=f"The airway ends {_gap_mm(ct, lung, tree):.0f} mm before the {name} lung, so "
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


def _gap_mm(ct: Volume, lung: Mask, tree: AirwayTree) -> float:
    from scipy.spatial import cKDTree

    return float(cKDTree(sampled(lung, ct.grid, SAMPLE_MM)).query(tree.points_lps)[0].min())


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
