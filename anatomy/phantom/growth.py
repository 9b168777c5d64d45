"""Volume-filling growth: a branch end and the points it must supply split, again and again.

References:
    [Kitaoka1999] flow-splitting diameters and lengths; [Tawhai2000] splitting of a cloud of points.
"""

from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.phantom.branching import Sprouts, bent_line
from anatomy.phantom.territory import Territory
from anatomy.poses import unit

Clearance = Callable[[Float], Float]

FEWEST_POINTS = 4
"""A part with fewer points has no middle worth growing to."""
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
        if len(points) < 2 * FEWEST_POINTS:
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
