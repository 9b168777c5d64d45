"""Whether what was segmented can be the lungs and airways of a patient: refused if not."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Mask
from anatomy.grid import Grid, Volume
from anatomy.segmentation.lungs import Lungs
from anatomy.segmentation.missing_lung import missing_lung, sampled, solid_tissue

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
"""The checks, by the name that `--accept` takes."""
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
    for name, lung in (("left", lungs.left), ("right", lungs.right)):
        if lung.any() and not ct.grid.values_at(lung, tree.points_lps, False).any():
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


SAMPLE_MM = 3.0
"""Lungs are looked at in steps of this: their shape is known to a step."""
LEAST_TRACHEA_MM = 15.0
"""From a shorter trachea no direction can be told."""
HEART_MM = (70.0, 120.0)
"""The heart is looked for so far in front of the carina, and so far below it."""


@frozen_value
class Landmarks:
    """Signs of each direction: 1 as in a patient whose header is right, -1 against it, 0 undecided."""

    up: tuple[int, ...]
    front: tuple[int, ...]
    left: tuple[int, ...]


def landmarks(tree: AirwayTree, left: Mask, right: Mask, grid: Grid) -> Landmarks:
    """Return what airway and lungs, bool `(ni, nj, nk)` on `grid`, say about the directions.

    Each direction is told by signs that do not depend on each other.  Only a header that is wrong, or organs
    that are mirrored, turn all signs of a direction around.
    """
    lungs = [sampled(mask, grid, SAMPLE_MM) for mask in (left, right)]
    top, carina = tree.points_lps[0], tree.carina_lps
    along = top - carina
    length = float(np.linalg.norm(along))
    up, front = [], []
    if length >= LEAST_TRACHEA_MM:
        # The trachea runs upwards within 60 degrees even in a bent patient.
        up.append(1 if along[2] >= 0.5 * length else -1)
        # The trachea runs backwards on its way down, by 8 to 40 degrees; less than 3 degrees say nothing.
        front.append(_sign(-along[1] / length, 0.05))
    bases = [_base(points) for points, mask in zip(lungs, (left, right), strict=True) if _whole(mask)]
    if bases:
        # The base lies 9 to 30 mm behind the rest; less says nothing.
        front.append(_sign(float(np.mean(bases)), 3.0))
    return Landmarks(up=tuple(up), front=tuple(front), left=_left(tree, lungs, carina))


def _left(tree: AirwayTree, lungs: list[Float], carina: Float) -> tuple[int, ...]:
    if not all(len(points) for points in lungs):
        return ()
    signs = []
    lengths = _main_bronchi(tree, lungs)
    if lengths is not None:
        # The left main bronchus is about twice as long as the right one, 5 against 2.5 cm.
        signs.append(_sign(float(np.log(lengths[0] / lengths[1])), float(np.log(1.2))))
    heart = _heart_mm(lungs, carina)
    if heart is not None:
        # Two thirds of the heart lie on the left: 10 to 30 mm on the average; less says nothing.
        signs.append(_sign(heart, 4.0))
    return tuple(signs)


def _sign(value: float, least: float) -> int:
    return 0 if abs(value) < least else int(np.sign(value))


def _whole(mask: Mask) -> bool:
    """Tell whether the lower end of a lung is in the image, the third axis running upwards."""
    return bool(mask.any()) and not bool(mask[:, :, 0].any())


def _base(points: Float) -> float:
    """Return how far the base of a lung lies behind the rest, mm."""
    # This share of each lung is its base, which lies behind, where the diaphragm slopes down.
    low = points[:, 2] <= np.quantile(points[:, 2], 0.15)
    return float(points[low, 1].mean() - points[~low, 1].mean())


def _main_bronchi(tree: AirwayTree, lungs: list[Float]) -> tuple[float, float] | None:
    """Return the lengths of the left and right main bronchus, mm; None unless the trachea leads to both."""
    middle = 0.5 * (lungs[0][:, 0].mean() + lungs[1][:, 0].mean())
    left_at_plus_x = lungs[0][:, 0].mean() > lungs[1][:, 0].mean()
    top = np.arange(tree.n_branches)
    for branch in range(1, tree.n_branches):  # the child of the trachea that each branch hangs on
        parent = int(tree.branch_parent[branch])
        top[branch] = branch if parent == 0 else top[parent]
    ends = tree.points_lps[tree.branch_start[1:] - 1]
    is_left = (ends[:, 0] > middle) == left_at_plus_x
    found = []
    for side in (is_left, ~is_left):
        counts = np.bincount(top[1:][side[1:]], minlength=tree.n_branches)
        if not counts.any():
            return None
        found.append(int(np.argmax(counts)))
    if found[0] == found[1]:
        return None
    left, right = (float(tree.branch_length_mm[b]) for b in found)
    return (left, right) if min(left, right) > 0.0 else None


def _heart_mm(lungs: list[Float], carina: Float) -> float | None:
    """Return how far left of the carina the middle between the lungs lies in front of it and below, mm."""
    low = max(float(carina[2]) - HEART_MM[1], *(float(np.quantile(p[:, 2], 0.03)) for p in lungs))
    bins = []
    for points in lungs:
        at = points[
            (points[:, 1] <= carina[1])
            & (points[:, 1] >= carina[1] - HEART_MM[0])
            # Above this lie vessels that are as wide on both sides.
            & (points[:, 2] <= carina[2] - 30.0)
            & (points[:, 2] >= low)
        ]
        lines = np.floor((at[:, 1:] - carina[1:]) / (2.0 * SAMPLE_MM)).astype(np.int64)
        bins.append((at[:, 0], lines))
    left_is_right = lungs[0][:, 0].mean() < lungs[1][:, 0].mean()
    inner = []
    for n, (x, lines) in enumerate(bins):
        towards_plus = (n == 0) == left_is_right
        nearest: dict[tuple[int, int], float] = {}
        for value, line in zip(x.tolist(), map(tuple, lines.tolist()), strict=True):
            known = nearest.get(line, value)
            nearest[line] = max(known, value) if towards_plus else min(known, value)
        inner.append(nearest)
    shared = inner[0].keys() & inner[1].keys()
    # From fewer lines across the chest no place of the heart is told.
    if len(shared) < 20:
        return None
    middle = np.mean([0.5 * (inner[0][line] + inner[1][line]) for line in sorted(shared)])
    return float(middle - carina[0])
