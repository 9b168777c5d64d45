"""Whether masks from elsewhere lie on what they show in the CT: moved by a little, they must fit worse."""

from collections.abc import Mapping

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Volume
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import distance_mm
from anatomy.segmentation.gate import Implausible

STEP_MM = 3.0
"""The step is wider than an airway's wall, and less than the distance of vessels."""
SAMPLES = 200_000
"""The mean of so many voxels of a mask is known to 1 HU."""
CLIPPED_HU = (-1100.0, 200.0)
"""Bone, metal and contrast medium count as tissue."""
LEAST_COVERED = 0.8
"""Share of the lungs that lobes cover: with less, one of them is missing."""
WALL_MM, LEAST_AT_LUMEN = 4.0, 0.5
"""Walls are up to 3 mm thick."""


@frozen_value
class Fit:
    """What moving a mask by `STEP_MM` costs at least, HU.

    Parameters
    ----------
    brighter : bool
        Whether what is shown is brighter than what is around it.
    least_hu, mean_hu : float
        By how much it must be brighter, or darker, in place than moved: in the worst of six directions, and
        on average.
    doubt_hu : float
        What the worst direction has in phantoms, halved.
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
) -> tuple[list[Implausible], list[str]]:
    """Check masks from elsewhere by the CT.

    Parameters
    ----------
    ct : Volume
        Hounsfield units.
    images : mapping of str to (ni, nj, nk) array
        Masks and label maps from elsewhere, by the name of the image, on the voxels of the CT.
    lungs, lumen : (ni, nj, nk) bool
        Of the CT, wherever they come from.

    Returns
    -------
    list of Implausible
        The check `masks`, for each image that fails it.
    list of str
        Warnings.
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
                failed.append(_failure(name, f"only {share:.0%} of it lie in the lungs"))
        if name == "lobes":
            share = _share(mask & lungs, lungs)
            if share < LEAST_COVERED:
                failed.append(_failure(name, f"it covers only {share:.0%} of the lungs"))
        if name == "airway_wall" and (share := _at_lumen(mask, lumen, ct)) < LEAST_AT_LUMEN:
            failed.append(_failure(name, f"only {share:.0%} of it lie at the lumen"))
    return failed, warnings


def moved_by(ct: Volume, mask: Mask) -> Float:
    """Return by how much the mean of the CT in a mask rises, HU, when the mask is moved: `(6,)`.

    The directions are down and up each axis.
    """
    at = np.flatnonzero(mask.ravel(order="F"))
    voxels = np.stack(np.unravel_index(at[:: max(1, len(at) // SAMPLES)], mask.shape, order="F"), axis=1)
    steps = np.maximum(1, np.rint(STEP_MM / ct.grid.spacing_mm)).astype(np.int64)
    means = []
    for shift in (np.zeros(3, dtype=np.int64), *(s * np.diag(steps)[a] for a in range(3) for s in (-1, 1))):
        place = np.clip(voxels + shift, 0, np.array(mask.shape) - 1)
        means.append(float(np.clip(ct.array[tuple(place.T)], *CLIPPED_HU).mean(dtype=np.float64)))
    return np.asarray(means[1:], dtype=np.float64) - float(means[0])


def _share(part: Mask, whole: Mask) -> float:
    return float(np.count_nonzero(part)) / max(float(np.count_nonzero(whole)), 1.0)


def _at_lumen(wall: Mask, lumen: Mask, ct: Volume) -> float:
    box = window(*bounds(wall | lumen))
    near = distance_mm(np.asfortranarray(~lumen[box]), ct.grid.spacing_mm) <= WALL_MM
    return float(near[wall[box]].mean()) if wall.any() else 1.0


def _failure(name: str, why: str) -> Implausible:
    return Implausible(
        name="masks",
        found=f"The mask of the {name.replace('_', ' ')} is not of this CT: {why}",
        remedy="Check that mask and CT show the same patient, scan and side, and that the mask holds nothing "
        "else",
    )
