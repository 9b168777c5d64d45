"""The five lobes: their numbers and names, and the fissures that lie between them."""

import re
from collections.abc import Mapping

import numpy as np

from anatomy.base.typed import Mask, UInt8
from anatomy.morphology import at_label_borders, bounds, pieces_of, window

RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER, LEFT_UPPER, LEFT_LOWER = 1, 2, 3, 4, 5
LOBES: Mapping[int, str] = {
    RIGHT_UPPER: "right upper lobe", RIGHT_MIDDLE: "right middle lobe", RIGHT_LOWER: "right lower lobe",
    LEFT_UPPER: "left upper lobe", LEFT_LOWER: "left lower lobe",
}  # fmt: skip
"""Number of a lobe in a volume of lobes, and its name; 0 is no lobe."""

FISSURES_UNKNOWN = "no fissure mask, so that nobody knows whether a fissure is crossed"
"""Check, plan and report say this where a patient has no mask of the fissures."""
FISSURES_UNKNOWN_HERE = "lung of which nobody knows where its fissures are is passed"
"""Check, plan and report say this of a plan in a lung whose lobes are not known."""
BORDER, SEEN, LEAST_CHANCE, UNKNOWN = 1, 2, 3, 99
"""Values of an image of fissures: a border between lobes where no fissure is seen, and one where it is; from
`LEAST_CHANCE` to 49, around a border, the chance in percent that a place lies beyond the fissure, in another
lobe; and `UNKNOWN`, where nobody knows of fissures."""
GAP_VOXELS = 2
"""Masks of two lobes may leave so many voxels between them to neither: a fissure as drawn by hand."""

_SHORT = {"rul": RIGHT_UPPER, "rml": RIGHT_MIDDLE, "rll": RIGHT_LOWER, "lul": LEFT_UPPER, "lll": LEFT_LOWER}
_LEVELS = {"upper": "upper", "superior": "upper", "middle": "middle", "lower": "lower", "inferior": "lower"}
_WORDS = re.compile(r"left|right|upper|superior|middle|lower|inferior|lobe|lung")


def lobe_named(name: str) -> int:
    """Return the number of the lobe that a file or label is named after; 0 if it is none.

    Examples:
        >>> [lobe_named(name) for name in ("RUL", "lung_upper_lobe_left", "RightLowerLobe", "lung")]
        [1, 4, 3, 0]
    """
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    if plain in _SHORT:
        return _SHORT[plain]
    words = _WORDS.findall(plain)
    sides = [word for word in words if word in ("left", "right")]
    levels = [_LEVELS[word] for word in words if word in _LEVELS]
    if "".join(words) != plain or len(sides) != 1 or len(levels) != 1:
        return 0
    meant = f"{sides[0]} {levels[0]} lobe"
    return next((number for number, lobe in LOBES.items() if lobe == meant), 0)


def main_pieces(mask: Mask) -> Mask:
    """Return a lobe without the small pieces that lie apart from it."""
    box = window(*bounds(mask))
    pieces, sizes = pieces_of(mask[box], corners=True)
    kept = np.zeros(mask.shape, dtype=np.bool_, order="F")
    if len(sizes) > 1:
        # A piece of a lobe's mask with less than this share of it is a slip of the pen, not a part of the
        # lobe.
        kept[box] = (sizes >= 0.1 * sizes.sum())[pieces]
    return kept


def grown_into(lobes: UInt8, lung: Mask) -> UInt8:
    """Give voxels of the lung that are in no lobe, but within `GAP_VOXELS` of one, to it."""
    from scipy import ndimage

    low, high = bounds(lobes, GAP_VOXELS)
    box = window(low, high)
    grown = np.array(lobes, order="F")
    inner, tissue = grown[box], lung[box]
    for _ in range(GAP_VOXELS):
        free = tissue & (inner == 0)
        inner[free] = ndimage.maximum_filter(inner, 3)[free]
    return grown


def fissures_between(lobes: UInt8) -> Mask:
    """Mark the voxels on both sides of every border between two lobes of the same lung.

    No chain of face neighbours passes from lobe to lobe without entering the fissure.

    `lobes` `(ni, nj, nk)` are numbers of `LOBES`, 0 elsewhere.
    """
    fissures = np.zeros(lobes.shape, dtype=np.bool_, order="F")
    for lung in (lobes <= RIGHT_LOWER, lobes > RIGHT_LOWER):
        box = window(*bounds(lung & (lobes > 0)))
        fissures[box] |= at_label_borders(lobes[box] * lung[box])
    return fissures
