"""Whether what was segmented can be the lungs and airways of a patient: refused if not."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_value
from anatomy.grid import Volume
from anatomy.segmentation.landmarks import Landmarks, landmarks
from anatomy.segmentation.lungs import Lungs
from anatomy.segmentation.missing_lung import missing_lung, solid_tissue

CHECKS: Mapping[str, str] = MappingProxyType(
    {
        "axes": "the trachea runs upwards, and the spine is behind: the header is right",
        "sides": "left and right are not exchanged",
        "airway": "trachea and bronchi form a tree",
        "bronchi": "a bronchus leads into each lung",
        "one-lung": "there are two lungs",
        "volume": "the lungs are as large as lungs can be",
        "density": "the lungs are as dense as lungs can be",
        "masks": "masks from elsewhere lie on what they show in the CT",
    }
)
"""What is checked, by the name that `--accept` takes."""
LUNGS_L = (0.3, 11.0)
"""From a child of one year after breathing out to the total capacity of a very tall man, with a margin."""
DENSITY_HU = (-975.0, -300.0)
"""The median of inflated lung lies between that of gas and that of a lung that is half filled."""
THIN_HU, DENSE_HU = -925.0, -650.0
"""Emphysema is thinner than the one; lungs after breathing out, or with oedema, are denser than the other."""


@frozen_value
class Implausible:
    """A check that failed: its name in `CHECKS`, what was found, and what to do about it."""

    name: str
    found: str
    remedy: str


def plausibility(
    ct: Volume, lungs: Lungs, tree: AirwayTree | AnatomyError
) -> tuple[tuple[Implausible, ...], tuple[str, ...]]:
    """Check lungs and airway by anatomy.

    Parameters
    ----------
    ct : Volume
        Hounsfield units, in the order of voxels of `canonical`.
    lungs : Lungs
    tree : AirwayTree or AnatomyError
        Of the lumen of the airway, or why there is none.

    Returns
    -------
    tuple of Implausible
        The checks that failed.
    tuple of str
        Warnings.
    """
    median_hu = float(np.median(ct.array[lungs.mask]))
    failed = [*_sizes(ct, lungs, median_hu)]
    warnings = [*_density_warnings(median_hu), *solid_tissue(ct, lungs.mask)]
    if isinstance(tree, AnatomyError):
        name = "axes" if "upside down" in tree.found else "airway"
        remedy = "Check the header of the image" if name == "axes" else "Correct the mask of the airway"
        return (*failed, Implausible(name=name, found=tree.found, remedy=remedy)), tuple(warnings)
    at = np.clip(np.rint(ct.grid.ijk(tree.points_lps)).astype(np.int64), 0, np.array(ct.grid.shape) - 1)
    for name, lung in (("left", lungs.left), ("right", lungs.right)):
        if lung.any() and not lung[tuple(at.T)].any():
            failed.append(
                Implausible(
                    name="bronchi",
                    found=f"No bronchus leads into the {name} lung",
                    remedy="Look whether it is lung, and correct the masks of lungs or airway",
                )
            )
    failures, doubts = _directions(landmarks(tree, lungs.left, lungs.right, ct.grid))
    if not any(check.name == "one-lung" for check in failed):
        warnings += missing_lung(lungs.left, lungs.right, ct.grid, tree.carina_lps)
    return (*failed, *failures), (*warnings, *doubts)


def require_plausible(failed: Collection[Implausible], accepted: Collection[str]) -> tuple[str, ...]:
    """Return the names of the checks that failed and are accepted.

    Raises
    ------
    AnatomyError
        If a check failed that is not.
    """
    refused = [check for check in failed if check.name not in accepted]
    if refused:
        names = " ".join(f"--accept {name}" for name in dict.fromkeys(check.name for check in refused))
        raise AnatomyError(
            "; ".join(check.found for check in refused),
            expected="; ".join(dict.fromkeys(CHECKS[check.name] for check in refused)),
            remedy="; ".join(dict.fromkeys(check.remedy for check in refused))
            + f"; if the masks are right all the same, add {names}",
        )
    return tuple(dict.fromkeys(check.name for check in failed))


def require_known_checks(names: Collection[str]) -> None:
    """Refuse names that are not in `CHECKS`."""
    unknown = [name for name in names if name not in CHECKS]
    if unknown:
        raise SettingsError(
            f"--accept names {', '.join(unknown)}, which is no check",
            expected=f"one of {', '.join(CHECKS)}",
            remedy="Take the name from the message that refuses the CT",
        )


def _sizes(ct: Volume, lungs: Lungs, median: float) -> list[Implausible]:
    found = []
    litre = ct.grid.voxel_volume_mm3 * 1e-6
    sides = {"left": lungs.left, "right": lungs.right}
    missing = [name for name, mask in sides.items() if not mask.any()]
    if missing:
        found.append(
            Implausible(
                name="one-lung",
                found=f"Only one lung was found; there is no {missing[0]} lung",
                remedy="Look whether the other one is solid, taken out, or not in the image",
            )
        )
    volume = litre * sum(int(np.count_nonzero(mask)) for mask in sides.values())
    if not LUNGS_L[0] <= volume <= LUNGS_L[1]:
        found.append(
            Implausible(
                name="volume",
                found=f"The lungs have {volume:.2f} l; {LUNGS_L[0]:g} to {LUNGS_L[1]:g} l are possible",
                remedy="Check the voxel size in the header, and look at the masks",
            )
        )
    if not DENSITY_HU[0] <= median <= DENSITY_HU[1]:
        found.append(
            Implausible(
                name="density",
                found=f"The median of the lungs is {median:.0f} HU",
                remedy="Look whether the masks show lung; a mask from elsewhere may be of another image",
            )
        )
    return found


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


def _directions(signs: Landmarks) -> tuple[list[Implausible], list[str]]:
    """Return what fails: all signs of a direction are against it; and what is in doubt: one is."""
    failed, doubts = [], []
    for name, what, votes in (
        ("axes", "upside down or lying across: the trachea does not run upwards", signs.up),
        (
            "axes",
            "front to back: trachea and bases of the lungs lie as if front and back were exchanged",
            signs.front,
        ),
        ("sides", "mirrored: main bronchi and heart lie as if left and right were exchanged", signs.left),
    ):
        decided = [vote for vote in votes if vote]
        if not decided or max(decided) > 0 > min(decided):
            if name == "sides" or decided:
                doubts.append(_doubt(name))
        elif max(decided) < 0 and (name == "sides" or len(decided) > 1 or what.startswith("upside")):
            remedy = "Check the header of the image: its directions may be wrong"
            if name == "sides":
                remedy += "; or the organs of this patient are mirrored"
            failed.append(Implausible(name=name, found=f"The image is {what}", remedy=remedy))
        elif max(decided) < 0:
            doubts.append(_doubt(name))
    return failed, doubts


def _doubt(name: str) -> str:
    what = "left and right" if name == "sides" else "front and back"
    return (
        f"The anatomy does not tell {what} for sure: look at segmentation.png whether they are where they "
        "belong. If the header is wrong, every plan is for the wrong place."
    )
