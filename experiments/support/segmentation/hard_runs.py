"""A case of the suite of wrong and hard inputs: segmented, and judged by the truth."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from scipy import ndimage

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, LungaccessError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Mask
from anatomy.grid import Volume
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.plausibility import require_plausible
from anatomy.segmentation.airway import segment_airway
from anatomy.segmentation.box import Box
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.central_airway import without_top
from anatomy.segmentation.gate import plausibility
from anatomy.segmentation.input import require_chest_ct
from anatomy.segmentation.lungs import Lungs, segment_lungs
from anatomy.segmentation.scan_warnings import airway_warnings, cut_off, scan_warnings, tree_or_error
from experiments.support.segmentation.hard_images import HardImage, upright
from experiments.support.segmentation.scores import dice

VOXEL_MM = 1.25
"""Those of the phantom: cases of thicker slices are interpolated to them, which keeps the suite fast."""
LEAST_DICE = 0.95
"""Of each lung: a lobe or a pleural pocket that is lost or gained lies below."""
LEAST_TREE = 0.9
"""Of the tree that is found in the image without what makes it hard."""
RIGHT_LUNG, LEFT_LUNG = (RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER), (LEFT_UPPER, LEFT_LOWER)


@frozen_value
class HardCase:
    """One input: how it is made, and the words, a pattern, of the warning or refusal that would be pertinent.

    Without words only the right result counts. `refuse` says that only a refusal counts, `warn` that nothing
    counts without a warning. `never` is a pattern of words that would be wrong.
    """

    name: str
    group: str
    make: Callable[[HardImage], HardImage]
    words: str = ""
    never: str = ""
    refuse: bool = False
    warn: bool = False
    thick: bool = False
    accepted: tuple[str, ...] = ()


@frozen_record
class Outcome:
    """What came of a case: Dice of the right and left lung, share of the tree, and what was said."""

    verdict: str
    right: float = 0.0
    left: float = 0.0
    tree: float = 0.0
    said: str = ""


def plain_tree(image: HardImage) -> float:
    """Return the share of the tree that is found in an image that nothing makes hard."""
    return tree_share(upright(image), segmented(image.ct)[1])


def run(case: HardCase, image: HardImage, plain: float) -> Outcome:
    """Segment the image of a case up to the airways and judge the result by the truth.

    `plain` is the share of the tree that is found without what makes the case hard.
    """
    made = case.make(image)
    try:
        lungs, lumen, warnings = segmented(made.ct, thick=case.thick, accepted=case.accepted)
    except LungaccessError as error:
        said = str(error)
        return Outcome(
            verdict="refused" if case.words and re.search(case.words, said) else "refused wrongly", said=said
        )
    said = " ".join(warnings)
    made = upright(made)
    right, left = (
        dice(found, of_lobes(made, lobes)) if of_lobes(made, lobes).any() else float(not found.any())
        for found, lobes in ((lungs.right, RIGHT_LUNG), (lungs.left, LEFT_LUNG))
    )
    tree = tree_share(made, lumen) / plain
    good = min(right, left) >= LEAST_DICE and tree >= LEAST_TREE and not (case.refuse or case.warn)
    warned = bool(case.words) and re.search(case.words, said) is not None and not case.refuse
    verdict = "right" if good else "warned" if warned else "SILENTLY WRONG"
    if case.never and re.search(case.never, said):
        verdict = "warned wrongly"
    return Outcome(verdict=verdict, right=right, left=left, tree=tree, said=said)


def segmented(
    ct: Volume, *, thick: bool = False, accepted: tuple[str, ...] = ()
) -> tuple[Lungs, Mask, tuple[str, ...]]:
    """Return the lungs, the lumen of the airways, and all warnings; the voxels are those of `canonical`."""
    warnings = require_chest_ct(ct, thick_slices=thick)
    ct = canonical(ct)
    found = segment_lungs(ct)
    box = Box.whole(ct.grid, VOXEL_MM).around(found)
    finer, lungs = box.image(found.scale.image(ct)), box.lungs(found)

    def tree_of(mask: Mask) -> AirwayTree | AnatomyError:
        return tree_or_error(Volume(grid=finer.grid, array=mask))

    lumen = segment_airway(finer, lungs).lumen
    lumen, _cut_mm = without_top(lumen, lungs.trachea_seed_ijk, finer.grid, tree_of)
    tree = tree_of(lumen)
    failed, further = plausibility(finer, lungs, tree)
    said = (
        *warnings,
        *lungs.warnings,
        *airway_warnings(tree, lungs.left, lungs.right, finer.grid),
        *cut_off(lungs.central_airway, lumen, finer.grid),
        *further,
        *scan_warnings(ct, found.mask),
        *require_plausible(failed, accepted),
    )
    return found, box.on_ct(lumen), said


def tree_share(image: HardImage, lumen: Mask) -> float:
    """Return the share of the points of the true tree in the image that are found within a voxel."""
    ijk = np.rint(image.grid.ijk(image.tree_lps)).astype(np.int64)
    ijk = ijk[((ijk >= 0) & (ijk < lumen.shape)).all(axis=1)]
    ijk = ijk[image.lung[tuple(ijk.T)] | image.lumen[tuple(ijk.T)]]
    near = ndimage.binary_dilation(lumen, np.ones((3, 3, 3)))
    return float(near[tuple(ijk.T)].mean()) if len(ijk) else 1.0


def of_lobes(image: HardImage, lobes: tuple[int, ...]) -> Mask:
    return np.isin(image.lobes, lobes)
