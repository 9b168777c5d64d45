"""Which lobe each bronchus supplies: the parting of the tree that fits fissures and names of bronchi."""

import itertools
from collections.abc import Mapping

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER

USUAL_SHARES: Mapping[int, tuple[float, float]] = {
    RIGHT_UPPER: (0.37, 0.15), RIGHT_MIDDLE: (0.17, 0.08), RIGHT_LOWER: (0.46, 0.15),
    LEFT_UPPER: (0.52, 0.15), LEFT_LOWER: (0.48, 0.15),
}  # fmt: skip
"""Mean share of each lobe in its lung, and twice the spread of the healthy, as lobes shrink and swell."""
LEAST_SHARE = 0.03
"""No lobe is smaller, unless it has collapsed."""
TRUNK_SHARE = 0.9
"""A branch that leads to so much of a lung is a main bronchus."""
STARTS = 10
"""This many of the best cuts are improved: where the tree is wrong, no cut parts the lobes."""
ROUNDS = 5
"""Moving twigs between lobes settles after one or two."""


@frozen_record
class Regions:
    """What lies nearest to each of the B branches of a tree in one lung.

    Args:
        volume ((B,) float64): In voxels.
        moment ((B, 3) float64): Sum of the places of the voxels, LPS mm.
        likelihood, faces ((B, B) float64): Sum of the likelihood of a fissure over the faces between two
            regions, and their number.
        below ((B, B) bool): Whether the second branch descends from the first, or is it.
        used ((B,) bool): Branches that have a region.
        named ((B,) int64): The lobe of each branch by the name of its bronchus, 0 where that is not sure.
    """

    volume: Float
    moment: Float
    likelihood: Float
    faces: Float
    below: Bool
    used: Bool
    named: Int

    @property
    def support(self) -> Float:
        """How much a border between two regions speaks for a fissure, `(B, B)`."""
        # A border counts against a parting if less of it than this is like a fissure: segments have no sheet.
        return self.likelihood - 0.15 * self.faces

    def means(self, parts: list[Bool]) -> Float:
        """Return the middles of some parts, LPS mm, `(P, 3)`."""
        return np.array([self.moment[part].sum(axis=0) / self.volume[part].sum() for part in parts])


def lobes_of_branches(regions: Regions, lobes: tuple[int, ...]) -> Int:
    """Return the lobe of every branch `(B,)`, 0 for those that lead to several or to none.

    Every way to cut the tree into as many parts as there are lobes is tried; then twigs move to another part
    where that is better, because a lobe can have several bronchi.  Good is a parting whose parts meet where
    fissures are seen, have about usual shares of the lung, and hold the bronchi that are named after them.
    """
    whole = regions.volume[regions.used].sum()
    large = [
        int(branch)
        for branch in np.flatnonzero(regions.used)
        if regions.volume[regions.below[branch] & regions.used].sum() >= LEAST_SHARE * whole
    ]
    ways = itertools.combinations(large, len(lobes) - 1)
    partings = [_named(regions, _parted(regions, cuts), lobes) for cuts in ways]
    partings.append(np.where(regions.used & np.isin(regions.named, lobes), regions.named, 0))
    partings.sort(key=lambda lobe: -_value(regions, lobe, lobes))
    settled = [_settled(regions, lobe, lobes) for lobe in partings[:STARTS]]
    return max(settled, key=lambda lobe: _value(regions, lobe, lobes))


def _settled(regions: Regions, lobe: Int, lobes: tuple[int, ...]) -> Int:
    """Return the lobes of branches after twigs have moved to where they fit better."""
    best = _value(regions, lobe, lobes)
    for _ in range(ROUNDS):
        before = best
        for branch in np.flatnonzero(regions.used & (lobe > 0)):
            for other in lobes:
                moved = np.where(regions.below[branch] & regions.used, other, lobe)
                value = _value(regions, moved, lobes)
                if value > best:
                    best, lobe = value, moved
        lobe = _named(regions, np.select([lobe == each for each in lobes], range(1, len(lobes) + 1)), lobes)
        best = _value(regions, lobe, lobes)
        if best <= before:
            break
    return lobe


def _parted(regions: Regions, cuts: tuple[int, ...]) -> Int:
    """Return the part of each branch: 1, 2, ... behind the cuts, the last for the rest, 0 before a cut."""
    part = np.where(regions.used, len(cuts) + 1, 0)
    for number, cut in enumerate(cuts, start=1):  # parents come before children
        part[regions.below[:, cut]] = 0
        part[regions.below[cut] & regions.used] = number
    return part


def _named(regions: Regions, part: Int, lobes: tuple[int, ...]) -> Int:
    """Return each branch's lobe by its part: the upper is highest, the middle in front; 0 for none."""
    numbers = np.zeros(len(lobes) + 1, dtype=np.int64)
    parts = [part == number for number in range(1, len(lobes) + 1)]
    if all(regions.volume[each].sum() > 0 for each in parts):
        means = regions.means(parts)
        upper = int(means[:, 2].argmax())
        others = sorted(set(range(len(lobes))) - {upper}, key=lambda each: means[each, 1])
        for lobe, place in zip(lobes, [upper, *others], strict=True):
            numbers[place + 1] = lobe
    return numbers[part]


def _value(regions: Regions, lobe: Int, lobes: tuple[int, ...]) -> float:
    parts = [lobe == each for each in lobes]
    if not all(part.any() for part in parts):
        return -np.inf
    whole = float(regions.volume[lobe > 0].sum())
    value = 0.0
    for one, other in itertools.combinations(parts, 2):
        value += float(regions.support[np.ix_(one, other)].sum()) / whole ** (2.0 / 3.0)
    for part, number in zip(parts, lobes, strict=True):
        usual, spread = USUAL_SHARES[number]
        # A spread off the usual share weighs as much as a fissure over 1/20 of the cross-section.
        value -= 0.05 * ((regions.volume[part].sum() / whole - usual) / spread) ** 2
    agrees = np.where(regions.named == lobe, 1.0, -1.0) * ((lobe > 0) & (regions.named > 0))
    # A parting that puts all of a lung into the lobes that its bronchi are named after is worth as much as a
    # fissure over half of the cross-section: names decide where no fissure is seen.
    value += 0.5 * float(agrees @ regions.volume) / whole
    # Most lobes have one bronchus: each further one must be worth as much as a fissure over a fiftieth.
    return value - 0.02 * (_bronchi(regions, lobe) - len(lobes))


def _bronchi(regions: Regions, lobe: Int) -> int:
    """Return how many bronchi lead to one lobe alone and do not hang on another that does."""
    numbers = lobe * regions.used
    most = np.where(regions.below, numbers, 0).max(axis=1)
    least = np.where(regions.below & (numbers > 0), numbers, np.iinfo(np.int64).max).min(axis=1)
    alone = (most == least) & (most > 0)
    above = (regions.below & alone[:, None]).sum(axis=0)  # of each branch, itself included
    return int(np.count_nonzero(alone & (above == 1)))
