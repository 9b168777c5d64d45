"""Names of bronchi: which lobar or segmental bronchus a branch of the airway tree is, and how sure that is.

A bronchus is named after the segments that it supplies.  The tree is read as a derivation: a branch that
supplies several segments divides them among its children, and one that supplies a single segment is that
segment's bronchus, with all that lies beyond.  Every derivation has a probability: how often the variant is
seen, and how well the directions of the branches fit those of the atlas.  The sum over all derivations gives
the probability of every name, exactly and without drawing anything at random.

References:
    [Boyden1955], [Javed2024], [Javed2024a], [Huang2019], [Tschirren2005]
"""

import itertools
from collections.abc import Mapping
from functools import cache, cached_property
from typing import Protocol

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.poses import unit

_Segments = tuple[int, ...]

RIGHT, LEFT = "R", "L"
DIRECTIONS: Mapping[str, Mapping[int, tuple[float, float, float]]] = {
    RIGHT: {
        1: (0.5, 0.0, 1.0), 2: (0.5, 1.0, 0.5), 3: (0.5, -1.0, 0.0), 4: (1.0, -0.5, -0.5),
        5: (0.0, -1.0, -0.5), 6: (0.5, 1.0, 0.0), 7: (0.0, -0.5, -1.0), 8: (0.5, -0.5, -1.0),
        9: (1.0, 0.0, -1.0), 10: (0.0, 0.5, -1.0),
    },
    LEFT: {
        1: (0.5, 0.5, 1.0), 3: (0.5, -1.0, 0.5), 4: (1.0, -1.0, 0.0), 5: (0.5, -1.0, -1.0),
        6: (0.5, 1.0, 0.0), 8: (0.5, -0.5, -1.0), 9: (1.0, 0.0, -1.0), 10: (0.0, 0.5, -1.0),
    },
}  # fmt: skip
"""Where each segment lies from its bronchus: outwards, backwards and upwards, as anatomy puts it in words.

A word counts 1, "slightly" counts a half [Boyden1955].  Left 1 stands for 1+2, and left 8 for 7+8, because B7
leaves B8 in most left lungs.
"""
STEMS: Mapping[str, Mapping[_Segments, float]] = {
    RIGHT: {
        (1, 2, 3, 4, 5, 6, 7, 8, 9, 10): 1.0, (2, 3, 4, 5, 6, 7, 8, 9, 10): 0.009,
        (4, 5, 6, 7, 8, 9, 10): 1.0, (1, 2, 3): 1.0, (1, 2): 0.39, (2, 3): 0.27, (1, 3): 0.28,
        (4, 5): 1.0, (6, 7, 8, 9, 10): 1.0, (4, 5, 7, 8, 9, 10): 0.05, (4, 5, 6): 0.01,
        (7, 8, 9, 10): 1.0, (8, 9, 10): 0.6, (9, 10): 0.5, (8, 9): 0.25, (7, 8): 0.1, (7, 9, 10): 0.05,
        (7, 10): 0.05, (7, 8, 9): 0.05, (8, 10): 0.02,
    },
    LEFT: {
        (1, 3, 4, 5, 6, 8, 9, 10): 1.0, (1, 3, 4, 5): 1.0, (1, 3): 0.9, (4, 5): 1.0, (3, 4, 5): 0.1,
        (6, 8, 9, 10): 1.0, (8, 9, 10): 1.0, (9, 10): 0.8, (8, 9): 0.2, (8, 10): 0.02,
    },
}  # fmt: skip
"""How many patients have each stem, by the segments it supplies; no other set of segments has one.

The upper lobes are those of 10,000 patients [Javed2024] [Javed2024a], with a third of the trifurcations
added, because a tree of forks shows two of three as a short stem; the lower lobes follow [Huang2019].
"""
STEM_NAMES: Mapping[str, Mapping[_Segments, str]] = {
    RIGHT: {
        (1, 2, 3, 4, 5, 6, 7, 8, 9, 10): "right main bronchus",
        (2, 3, 4, 5, 6, 7, 8, 9, 10): "right main bronchus",
        (4, 5, 6, 7, 8, 9, 10): "bronchus intermedius", (1, 2, 3): "right upper lobe bronchus",
        (4, 5): "right middle lobe bronchus", (6, 7, 8, 9, 10): "right lower lobe bronchus",
        (7, 8, 9, 10): "right basal trunk",
    },
    LEFT: {
        (1, 3, 4, 5, 6, 8, 9, 10): "left main bronchus", (1, 3, 4, 5): "left upper lobe bronchus",
        (1, 3): "left upper division", (4, 5): "lingular bronchus",
        (6, 8, 9, 10): "left lower lobe bronchus", (8, 9, 10): "left basal trunk",
    },
}  # fmt: skip
"""Stems with a name of their own; any other one is called after its segments, such as RB9+10."""
SEGMENT_LOBES: Mapping[str, Mapping[int, int]] = {
    RIGHT: {n: RIGHT_UPPER if n < 4 else RIGHT_MIDDLE if n < 6 else RIGHT_LOWER for n in range(1, 11)},
    LEFT: {n: LEFT_UPPER if n < 6 else LEFT_LOWER for n in DIRECTIONS[LEFT]},
}
"""The lobe of each segment, a number of `anatomy.lobes.LOBES`."""
CONCENTRATION, STEM_CONCENTRATION, PAIR_CONCENTRATION = 6.0, 3.0, 4.0
"""How closely directions of segments, of stems and between siblings keep to the atlas (von Mises-Fisher).

6 is a spread of 24 degrees about each axis: directions in words are no better, and patients differ by 10.
"""
LOST = 0.05
"""A segmental bronchus is absent, or missing in the mask, in about one patient of twenty."""
ODD, ODD_SHARE = 0.1, 0.04
"""A branch that is none of the atlas is a twig: likely once in ten forks, less so with its share of the lung.

The probability falls to 1/e for every such share of all airways of the lung that lies on the branch.
"""
TRACHEA_SHARE, LUNG_SHARE = 0.7, 0.15
"""The trachea goes on in a branch that leads to most airways, and to two lungs of at least this share."""
LEAST_CONFIDENCE = 0.7
"""A name is given if it is at least this probable; it must exceed one half, or names could contradict."""


class BranchedTree(Protocol):
    """What is read of an `anatomy.airway_tree.AirwayTree`, which knows this module and is not known to it."""

    @property
    def points_lps(self) -> Float: ...
    @property
    def parent_point(self) -> Int: ...
    @property
    def branch_start(self) -> Int: ...
    @property
    def branch_parent(self) -> Int: ...
    @property
    def distance_from_root_mm(self) -> Float: ...
    @property
    def n_branches(self) -> int: ...
    def children(self, branch: int) -> Int: ...


@frozen_record
class BronchialNames:
    """The names of the B branches of an airway tree.

    Args:
        names: Of the bronchus that each branch is, such as "right upper lobe bronchus" or "RB6", or beyond a
            segmental bronchus is a branch of; "" where none is sure enough.
        starts ((B,) bool): Whether the named bronchus begins with this branch.
        confidence ((B,) float64): Probability of the name under the atlas; of the likeliest name where a
            branch is unnamed.
        lobes ((B,) int64): The lobe that the branch supplies alone, a number of `anatomy.lobes.LOBES`; 0 if
            none or not sure.
    """

    names: tuple[str, ...]
    starts: Bool
    confidence: Float
    lobes: Int

    def words(self, branch: int) -> str:
        """Return the name of a branch, or of the bronchus that it is a branch of; "" if it is unnamed."""
        name = self.names[branch]
        return name if self.starts[branch] or not name else f"a branch of {name}"

    @cached_property
    def segments(self) -> tuple[str, ...]:
        """The segment that each branch lies in, such as "RS6"; "" where it is not known or several."""
        single = [name[1:2] == "B" and ("+" not in name or name == "LB1+2") for name in self.names]
        return tuple(n.replace("B", "S", 1) if one else "" for n, one in zip(self.names, single, strict=True))


class _Atlas:
    """The grammar of one lung: S sets of segments, and R rules by which a set divides into two.

    `sets` are the empty one, the single ones and the stems, the whole lung first of these; `mean` (S, 3) is
    the direction of each in LPS, `rules` (R, 3) a set and the two that it divides into, `lost` (R,) how many
    segments are in neither, and `apart` (R, 3) the direction from the second of the two to the first.
    """

    def __init__(self, side: str) -> None:
        mirrored = np.array([-1.0 if side == RIGHT else 1.0, 1.0, 1.0])
        single = {(n,): mirrored * unit(np.array(words)) for n, words in DIRECTIONS[side].items()}
        self.sets: tuple[_Segments, ...] = ((), *single, *STEMS[side])
        self.sizes = np.array([len(each) for each in self.sets])
        self.whole = len(single) + 1
        centre = np.array([sum((single[n,] for n in each), np.zeros(3)) for each in self.sets])
        centre /= np.maximum(self.sizes, 1)[:, None]
        self.mean = unit(centre)
        self.prior = np.log([STEMS[side].get(each, 1.0) for each in self.sets])
        rules = [
            (whole, one, other)
            for whole, one, other in itertools.product(range(len(self.sets)), repeat=3)
            if set(self.sets[one]).isdisjoint(self.sets[other])
            and set(self.sets[one] + self.sets[other]) <= set(self.sets[whole])
            and (one or other or not whole)
        ]
        self.rules = np.array(rules)
        self.lost = self.sizes[self.rules[:, 0]] - self.sizes[self.rules[:, 1:]].sum(axis=1)
        self.apart = unit(centre[self.rules[:, 1]] - centre[self.rules[:, 2]])
        self.siblings = (self.rules[:, 1:] > 0).all(axis=1)


_atlas = cache(_Atlas)


class _Lung:
    """The branches of one lung as a binary tree of nodes, parents first, and the sum over its derivations.

    A node holds one branch, or several that part together.  All probabilities are logarithms.
    """

    def __init__(self, side: str, tree: BranchedTree, shape: "_Shape", roots: list[int]) -> None:
        self.atlas, self._tree, self._shape = _atlas(side), tree, shape
        whole_mm = float(shape.beyond_mm[roots].sum())
        self.groups, self._children = [roots], []
        for group in self.groups:  # which grows while it is read
            parted = group
            if len(group) == 1:
                # A branch with a smaller share of a lung's airways does not lead to several segments.
                divides = shape.beyond_mm[group[0]] >= 0.01 * whole_mm
                parted = tree.children(group[0]).tolist() if divides else []
            parts = shape.two_parts(parted)
            self._children.append(len(self.groups) if parts else 0)
            self.groups += parts
        self._own = np.array([self._likelihood(group, whole_mm) for group in self.groups])
        self._inside = np.zeros_like(self._own)
        for node in range(len(self.groups) - 1, -1, -1):
            self._inside[node] = self._from_below(node)

    def _likelihood(self, group: list[int], whole_mm: float) -> Float:
        """Return how well a node fits each set `(S,)`, without what lies beyond it."""
        atlas = self.atlas
        if len(group) > 1:
            return np.zeros(len(atlas.sets))
        share = float(self._shape.beyond_mm[group[0]]) / whole_mm
        concentration = np.where(atlas.sizes == 1, CONCENTRATION, STEM_CONCENTRATION)
        fit = atlas.prior + _log_density(atlas.mean @ self._shape.direction[group[0]], concentration)
        excess = np.log(share * atlas.sizes[atlas.whole] / np.maximum(atlas.sizes, 1))
        if not self._tree.children(group[0]).size:  # The mask ends here, and does not tell what lies beyond.
            excess = np.maximum(excess, 0.0)
        # Segments have equal shares of a lung's airways within a factor of e, as masks end early or late.
        fit -= 0.5 * excess**2
        fit[0] = np.log(ODD) - share / ODD_SHARE
        return np.asarray(fit)

    def _rules(self, node: int) -> Float:
        """Return the probability of each rule `(R,)` at a node, without what its two children are."""
        atlas, first = self.atlas, self._children[node]
        middles = [self._shape.middle_of(self.groups[each]) for each in (first, first + 1)]
        fit = _log_density(atlas.apart @ unit(middles[0] - middles[1]), np.array(PAIR_CONCENTRATION))
        weight = self._own[node][atlas.rules[:, 0]] + np.where(atlas.siblings, fit, 0.0)
        weight += atlas.lost * np.log(LOST)
        if len(self.groups[node]) > 1:  # what is lost, is lost where a branch divides
            return np.where(atlas.lost == 0, weight, -np.inf) if node else weight
        return np.where(atlas.sizes[atlas.rules[:, 0]] > 1, weight, -np.inf)

    def _from_below(self, node: int) -> Float:
        """Return the probability of all that is at and beyond a node, for each set `(S,)`."""
        atlas, first = self.atlas, self._children[node]
        ends = self._own[node] + np.where(atlas.sizes > 1, atlas.sizes * np.log(LOST), 0.0)
        if not first:
            return np.asarray(ends)
        one, other = self._inside[first], self._inside[first + 1]
        value = np.where(atlas.sizes > 1, -np.inf, ends if len(self.groups[node]) == 1 else -np.inf)
        rules = atlas.rules
        np.logaddexp.at(value, rules[:, 0], self._rules(node) + one[rules[:, 1]] + other[rules[:, 2]])
        return np.asarray(value)

    def probabilities(self) -> dict[int, Float]:
        """Return the probability `(S,)` that each branch is the bronchus of each set."""
        rules = self.atlas.rules
        outside = np.full_like(self._inside, -np.inf)
        outside[0, self.atlas.whole] = 0.0
        for node, first in enumerate(self._children):
            if first:
                weight = outside[node][rules[:, 0]] + self._rules(node)
                for child, its, sibling, others in ((first, 1, first + 1, 2), (first + 1, 2, first, 1)):
                    along = weight + self._inside[sibling][rules[:, others]]
                    np.logaddexp.at(outside[child], rules[:, its], along)
        joint = np.exp(outside + self._inside - self._inside[0, self.atlas.whole])
        return {group[0]: each for group, each in zip(self.groups, joint, strict=True) if len(group) == 1}


@frozen_record
class _Shape:
    """Where the branches of a tree lead: the mean place `middle` (B, 3) LPS mm of the airways at and beyond
    each, their length `beyond_mm` (B,), and the unit vector `direction` (B, 3) from its beginning to there.
    """

    middle: Float
    beyond_mm: Float
    direction: Float

    @classmethod
    def of(cls, tree: BranchedTree) -> "_Shape":
        above = np.maximum(tree.parent_point, 0)
        length = np.maximum(tree.distance_from_root_mm - tree.distance_from_root_mm[above], 1e-6)
        moment = np.column_stack([length, length[:, None] * tree.points_lps])
        sums = np.add.reduceat(moment, tree.branch_start[:-1])
        for branch in range(tree.n_branches - 1, 0, -1):
            sums[tree.branch_parent[branch]] += sums[branch]
        middle = sums[:, 1:] / sums[:, :1]
        begin = tree.points_lps[above[tree.branch_start[:-1]]]
        return cls(middle=middle, beyond_mm=sums[:, 0], direction=unit(middle - begin))

    def two_parts(self, group: list[int]) -> list[list[int]]:
        """Return the branch that leads farthest from the others, and the others; nothing if it is alone."""
        if len(group) < 2:
            return []
        away = np.linalg.norm(self.middle[group] - self.middle_of(group), axis=1)
        alone = group[int(np.argmax(away))]
        return [[alone], [each for each in group if each != alone]]

    def middle_of(self, group: list[int]) -> Float:
        """Return the mean place `(3,)` LPS mm of the airways at and beyond some branches."""
        return np.asarray(np.average(self.middle[group], axis=0, weights=self.beyond_mm[group]))


def _log_density(cosine: Float, concentration: Float) -> Float:
    """Return the logarithm of a von Mises-Fisher density by the uniform one."""
    return np.asarray(concentration * cosine + np.log(concentration / np.sinh(concentration)))


def name_bronchi(tree: BranchedTree) -> BronchialNames:
    """Return the names of the branches of an airway tree; left and right are those of the carina."""
    shape = _Shape.of(tree)
    names = [""] * tree.n_branches
    confidence, lobes = np.zeros(tree.n_branches), np.zeros(tree.n_branches, dtype=np.int64)
    trachea = _trachea(tree, shape)
    on_left = shape.middle[:, 0] > tree.points_lps[tree.branch_start[trachea[-1] + 1] - 1, 0]
    for branch in trachea:
        names[branch], confidence[branch] = "trachea", 1.0
    leaving = np.setdiff1d(np.flatnonzero(np.isin(tree.branch_parent, trachea)), trachea)
    for side in (RIGHT, LEFT):
        roots = [int(each) for each in leaving if on_left[each] == (side == LEFT)]
        if roots:
            _name_lung(side, tree, _Lung(side, tree, shape, roots), names, confidence, lobes)
    above = [names[max(int(parent), 0)] for parent in tree.branch_parent]
    pairs = enumerate(zip(names, above, strict=True))
    starts = np.array([name != "" and (name != its or not b) for b, (name, its) in pairs])
    return BronchialNames(names=tuple(names), starts=starts, confidence=confidence, lobes=lobes)


def _trachea(tree: BranchedTree, shape: _Shape) -> list[int]:
    """Return the branches of the trachea: more than one where a bronchus leaves it above the carina."""
    branches, whole_mm = [0], float(shape.beyond_mm[0])
    for branch in range(1, tree.n_branches):
        if int(tree.branch_parent[branch]) == branches[-1]:
            below = tree.children(branch)
            on_left = shape.middle[below, 0] > tree.points_lps[tree.branch_start[branch + 1] - 1, 0]
            sides_mm = [shape.beyond_mm[below[on_left]].sum(), shape.beyond_mm[below[~on_left]].sum()]
            if shape.beyond_mm[branch] >= TRACHEA_SHARE * whole_mm and min(sides_mm) >= LUNG_SHARE * whole_mm:
                branches.append(branch)
    return branches


def _name_lung(
    side: str, tree: BranchedTree, lung: _Lung, names: list[str], confidence: Float, lobes: Int
) -> None:
    """Write the names of one lung's branches, their confidence and lobes."""
    atlas, lobe_of = lung.atlas, SEGMENT_LOBES[side]
    lobe = np.array([lobe_of[each[0]] if len({lobe_of[n] for n in each}) == 1 else 0 for each in atlas.sets])
    texts = ["", *(_text(side, each) for each in atlas.sets[1:])]
    found = lung.probabilities()
    within: dict[int, Float] = {}
    for branch in range(1, tree.n_branches):
        parent = int(tree.branch_parent[branch])
        if parent not in within and branch not in found:
            continue
        here = found.get(branch, np.zeros(len(atlas.sets))).copy()
        here[0] = 0.0
        if parent in within:
            here += np.where(atlas.sizes == 1, within[parent], 0.0)
        within[branch] = here
        best = int(np.argmax(here))
        confidence[branch] = min(float(here[best]), 1.0)
        names[branch] = texts[best] if here[best] >= LEAST_CONFIDENCE else ""
        shares = np.bincount(lobe, weights=here)
        shares[0] = 0.0
        lobes[branch] = int(np.argmax(shares)) if shares.max() >= LEAST_CONFIDENCE else 0


def _text(side: str, segments: _Segments) -> str:
    numbers = ["1+2" if side == LEFT and n == 1 else f"{n}" for n in segments]
    return STEM_NAMES[side].get(segments, f"{side}B{'+'.join(numbers)}")
