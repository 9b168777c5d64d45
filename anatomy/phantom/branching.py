"""Trees of tubes: the list of branches, their growth into points to supply, and the true centrelines.

References:
    [Kitaoka1999] flow-splitting diameters and lengths; [Tawhai2000] splitting of a cloud of points.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float, Int
from anatomy.grid import freeze_arrays
from anatomy.phantom.territory import Territory
from anatomy.poses import unit


def bent_line(start: Float, leaving: Float, end: Float, step_mm: float, bend: float = 0.35) -> Float:
    """Return points `(K, 3)` of a curve that leaves `start` partly along `leaving` and reaches `end`."""
    chord = end - start
    length = float(np.linalg.norm(chord))
    control = start + 0.5 * length * ((1 - bend) * chord / max(length, 1e-9) + bend * leaving)
    t = np.linspace(0, 1, max(3, int(np.ceil(length / step_mm)) + 1))[:, None]
    return np.asarray((1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * end)


def smooth_line(knots: Float, step_mm: float) -> Float:
    """Return points of a Catmull-Rom spline through `knots` `(K, 3)`, about `step_mm` apart."""
    padded = np.vstack([2 * knots[0] - knots[1], knots, 2 * knots[-1] - knots[-2]])
    pieces = [knots[:1]]
    for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False):
        t = np.linspace(0, 1, max(2, int(np.ceil(np.linalg.norm(c - b) / step_mm)) + 1))[1:, None]
        cubic = 3 * b - a - 3 * c + d
        square = 2 * a - 5 * b + 4 * c - d
        pieces.append(b + 0.5 * t * (c - a + t * (square + t * cubic)))
    return np.vstack(pieces)


@dataclass
class Sprouts:
    """A tree while it grows; one entry a branch, parents first, each from the last point of its parent."""

    parent: list[int] = field(default_factory=list)
    points: list[Float] = field(default_factory=list)
    diameter_mm: list[float] = field(default_factory=list)
    lobe: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)

    def add(self, parent: int, points: Float, diameter_mm: float, lobe: int, name: str = "") -> int:
        """Append a branch and return its index."""
        if parent >= 0:
            diameter_mm = min(diameter_mm, 0.98 * self.diameter_mm[parent])
        self.parent.append(parent)
        self.points.append(points)
        self.diameter_mm.append(diameter_mm)
        self.lobe.append(lobe)
        self.name.append(name)
        return len(self.parent) - 1

    @property
    def counts(self) -> Int:
        """Number of points of each branch, `(B,)`."""
        return np.array([len(line) for line in self.points], dtype=np.int64)

    def pruned(self, keep: Bool) -> Sprouts:
        """Return the tree of the branches `keep` `(B,)` whose ancestors are all kept."""
        tree, index = Sprouts(), {-1: -1}
        for branch, parent in enumerate(self.parent):
            if keep[branch] and parent in index:
                what = self.diameter_mm[branch], self.lobe[branch], self.name[branch]
                index[branch] = tree.add(index[parent], self.points[branch], *what)
        return tree

    def direction(self, branch: int) -> Float:
        """Return the unit chord of a branch."""
        return unit(self.points[branch][-1] - self.points[branch][0])


@frozen_record
class Centerlines:
    """Ground-truth centrelines of one tree (N points, B branches).

    Args:
        points_lps ((N, 3) float64): Points of a branch are consecutive; its first point repeats the last
            point of its parent.
        radius_mm, outer_radius_mm ((N,) float64): Radius of the lumen and of the outside of the wall (equal
            for vessels).
        branch_start ((B + 1,) int64): Points of branch b are `branch_start[b]:branch_start[b + 1]`.
        branch_parent ((B,) int64): -1 at the root; parents come before children.  Blood of a vein flows from
            child to parent.
        lobe ((B,) int64): The lobe (1 to 5) a branch supplies, 0 where it supplies more than one.
        names: Name of the anatomical branch, empty for the nameless ones.
    """

    points_lps: Float
    radius_mm: Float
    outer_radius_mm: Float
    branch_start: Int
    branch_parent: Int
    lobe: Int
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze_arrays(
            self, "points_lps", "radius_mm", "outer_radius_mm", "branch_start", "branch_parent", "lobe"
        )

    @property
    def n_branches(self) -> int:
        """Number of branches."""
        return len(self.branch_parent)

    @property
    def generation(self) -> Int:
        """Number of branchings from the root, `(B,)`; the root has 0."""
        generation = np.zeros(self.n_branches, dtype=np.int64)
        for branch in range(1, self.n_branches):
            generation[branch] = generation[self.branch_parent[branch]] + 1
        return generation

    @property
    def horsfield_order(self) -> Int:
        """Horsfield order `(B,)`: 1 at the tips, else one more than the largest of the children."""
        order = np.ones(self.n_branches, dtype=np.int64)
        for branch in range(self.n_branches - 1, 0, -1):
            parent = self.branch_parent[branch]
            order[parent] = max(order[parent], order[branch] + 1)
        return order

    @property
    def strahler_order(self) -> Int:
        """Strahler order `(B,)`: 1 at the tips, one more only where two of the highest order meet."""
        order, highest, ties = (np.full(self.n_branches, n, dtype=np.int64) for n in (1, 0, 0))
        for branch in range(self.n_branches - 1, -1, -1):
            if highest[branch]:
                order[branch] = highest[branch] + (ties[branch] > 1)
            parent = self.branch_parent[branch]
            if parent < 0:
                continue
            if order[branch] > highest[parent]:
                highest[parent], ties[parent] = order[branch], 1
            elif order[branch] == highest[parent]:
                ties[parent] += 1
        return order


def centerlines(sprouts: Sprouts, radius_mm: Float, outer_radius_mm: Float, keep: Bool) -> Centerlines:
    """Freeze the branches of `keep` `(B,)`, whose radii `(N,)` by point are given, into centrelines.

    Where a branch keeps a single child, the two become one branch: without a branching no generation begins.
    """
    kept = [int(b) for b in np.flatnonzero(keep)]
    siblings = np.bincount([sprouts.parent[b] + 1 for b in kept], minlength=len(keep) + 1)
    head: dict[int, int] = {}
    members: dict[int, list[int]] = {}
    for branch in kept:
        parent = sprouts.parent[branch]
        continues = parent >= 0 and siblings[parent + 1] == 1
        head[branch] = head[parent] if continues else branch
        members.setdefault(head[branch], []).append(branch)
    index = {branch: i for i, branch in enumerate(members)}
    lines = [np.vstack([sprouts.points[b][b != h :] for b in group]) for h, group in members.items()]
    start = np.concatenate([[0], np.cumsum(sprouts.counts)])
    spans = [np.arange(start[b] + (b != h), start[b + 1]) for h, group in members.items() for b in group]
    order = np.concatenate(spans)
    parents = [sprouts.parent[h] for h in members]
    return Centerlines(
        points_lps=np.vstack(lines),
        radius_mm=radius_mm[order],
        outer_radius_mm=outer_radius_mm[order],
        branch_start=np.concatenate([[0], np.cumsum([len(line) for line in lines])]),
        branch_parent=np.array([index[head[p]] if p >= 0 else -1 for p in parents], dtype=np.int64),
        lobe=np.array([sprouts.lobe[h] for h in members], dtype=np.int64),
        names=tuple(sprouts.name[h] for h in members),
    )


Clearance = Callable[[Float], Float]

SMALLEST_SHARE = 0.2
"""No branch supplies less of its parent's points: real forks are this uneven at most."""
STEP_MM = 1.5
"""Distance of the points of a line: below the radius of all but the thinnest tubes, so that none has gaps."""
DIAMETER_WEIGHT, DISTANCE_WEIGHT = 0.42, 0.22
"""A branch's length is a mean of what its diameter and the distance ask for, set so that lengths are about
three diameters."""


@frozen_value
class GrowthRule:
    """How branches divide, from the tube of `root_diameter_mm` that supplies all points of both lungs on.

    Growth stops below the smallest diameter.  Flow (number of points) goes with the power `flow_exponent`
    of the diameter [Kitaoka1999].  The angle between a branch and its parent lies between the two turns.
    """

    root_diameter_mm: float
    total_points: int
    smallest_diameter_mm: float
    flow_exponent: float = 2.8
    length_per_diameter: float = 3.0
    greatest_length_per_diameter: float = 4.2
    least_turn_rad: float = float(np.deg2rad(18))
    greatest_turn_rad: float = float(np.deg2rad(52))

    def diameter_mm(self, n_points: int) -> float:
        """Return the diameter of a tube that supplies `n_points`."""
        return float(self.root_diameter_mm * (n_points / self.total_points) ** (1 / self.flow_exponent))


def limit_turn(wanted: Float, heading: Float, least_rad: float, greatest_rad: float) -> Float:
    """Turn the unit vector `wanted` so that its angle to `heading` lies in the given range."""
    cosine = float(np.clip(wanted @ heading, -1, 1))
    angle = np.arccos(cosine)
    sideways = wanted - cosine * heading
    length = np.linalg.norm(sideways)
    if length < 1e-9:
        return wanted
    angle = min(max(angle, least_rad), greatest_rad)
    return np.asarray(np.cos(angle) * heading + np.sin(angle) * sideways / length)


def split_cloud(cloud: Float, heading: Float, rng: np.random.Generator) -> tuple[Float, Float] | None:
    """Cut a cloud `(N, 3)` across its widest direction perpendicular to `heading` into two parts."""
    centred = cloud - cloud.mean(axis=0)
    flat = centred - np.outer(centred @ heading, heading)
    widest = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    along = flat @ (widest * np.sign(widest[np.argmax(np.abs(widest))]))
    smallest = max(1, int(SMALLEST_SHARE * len(cloud)))
    share = float(np.clip(rng.normal(0.5, 0.11), SMALLEST_SHARE, 1 - SMALLEST_SHARE))
    count = min(max(round(share * len(cloud)), smallest), len(cloud) - smallest)
    order = np.argsort(along, kind="stable")
    if count == 0 or count == len(cloud):
        return None
    return cloud[order[:count]], cloud[order[count:]]


def grow(
    sprouts: Sprouts,
    branch: int,
    cloud: Float,
    rule: GrowthRule,
    territory: Territory,
    rng: np.random.Generator,
    clearance: Clearance | None = None,
) -> None:
    """Let `branch` divide until its descendants supply the points `cloud` `(N, 3)` of its lobe.

    With `clearance`, the free distance in mm at points `(N, 3)`, branches turn aside from obstacles.
    """
    queue = deque([(branch, cloud)])
    while queue:
        parent, points = queue.popleft()
        # A part with fewer points has no middle worth growing to.
        if len(points) < 2 * 4:
            continue
        parts = split_cloud(points, sprouts.direction(parent), rng)
        if parts is None:
            continue
        for part in parts:
            diameter = rule.diameter_mm(len(part))
            if diameter < rule.smallest_diameter_mm:
                continue
            chord = _chord(sprouts, parent, part, diameter, rule, rng)
            line = _free_line(sprouts, parent, chord, diameter, territory, clearance)
            if line is not None:
                queue.append((sprouts.add(parent, line, diameter, sprouts.lobe[parent]), part))


def _chord(
    sprouts: Sprouts, parent: int, part: Float, diameter_mm: float, rule: GrowthRule, rng: np.random.Generator
) -> Float:
    """Return the vector `(3,)` mm from the end of `parent` towards the middle of `part`."""
    to_middle = part.mean(axis=0) - sprouts.points[parent][-1]
    distance = float(np.linalg.norm(to_middle))
    heading = sprouts.direction(parent)
    direction = limit_turn(unit(to_middle), heading, rule.least_turn_rad, rule.greatest_turn_rad)
    by_diameter = rule.length_per_diameter * diameter_mm * rng.uniform(0.8, 1.2)
    length = DIAMETER_WEIGHT * by_diameter + DISTANCE_WEIGHT * distance
    return np.asarray(
        direction * np.clip(length, 1.6 * diameter_mm, rule.greatest_length_per_diameter * diameter_mm)
    )


def _free_line(
    sprouts: Sprouts,
    parent: int,
    chord: Float,
    diameter_mm: float,
    territory: Territory,
    clearance: Clearance | None,
) -> Float | None:
    """Return the curve of a new branch along about `chord` `(3,)`, or None if it leaves the lobe."""
    start, heading = sprouts.points[parent][-1], sprouts.direction(parent)
    # Tubes keep this far from the border of their lobe: a voxel of the usual CT.
    margin = 0.5 * diameter_mm + 1.0
    best, least = None, np.inf
    for turned, penalty in _variants(chord) if clearance is not None else [(chord, 0.0)]:
        for shrink in (1.0, 0.75, 0.5):
            end = start + shrink * turned
            if territory.holds(end, sprouts.lobe[parent], margin):
                break
        else:
            continue
        line = bent_line(start, heading, end, STEP_MM)
        cost = penalty + (0.0 if clearance is None else overlap_mm(line[1:], 0.5 * diameter_mm, clearance))
        if cost < least:
            best, least = line, cost
        if cost <= penalty:
            break
    return best


def _variants(chord: Float) -> Iterator[tuple[Float, float]]:
    """Yield `chord` and copies turned aside by more and more, each with a penalty in mm for the turn."""
    yield chord, 0.0
    first = unit(np.cross(chord, np.eye(3)[np.argmin(np.abs(chord))]))
    second = unit(np.cross(chord, first))
    length = float(np.linalg.norm(chord))
    # Turns that are tried in order around an obstacle, up to 43 degrees.
    for angle in (0.25, 0.5, 0.75):
        for azimuth in np.arange(6) * (np.pi / 3):
            side = np.cos(azimuth) * first + np.sin(azimuth) * second
            yield np.cos(angle) * chord + np.sin(angle) * length * side, 0.3 * angle


def overlap_mm(line: Float, radius_mm: float, clearance: Clearance) -> float:
    """Return the most, in mm, by which a tube around `line` `(K, 3)` lacks clearance."""
    return float(np.maximum(radius_mm - clearance(line), 0).max())
