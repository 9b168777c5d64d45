"""The airway tree: named bronchi down to the segments from a template, grown from there on.

Lengths, directions and the names B1 to B10 follow anatomy; diameters follow from the lung volume that
a bronchus supplies.

References:
    [Horsfield1971], [Weibel1963]
"""

from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.phantom.branching import Sprouts, bent_line
from anatomy.phantom.chest import LOBES
from anatomy.phantom.growth import STEP_MM, GrowthRule, grow, limit_turn
from anatomy.phantom.territory import Territory
from anatomy.phantom.traits import PLAIN, Traits
from anatomy.poses import unit

TRACHEA_LENGTH_MM = 110.0
"""This is the part that lies in the chest of an adult [Weibel1963]."""
MIDDLE_WEIGHT = 0.4
"""Segmental bronchi turn partly towards what they supply: wholly would lose the template."""
STUMP_SHARE, STUMP_DIAMETER_MM = 0.45, 7.0
"""An operation leaves this share and diameter of a lobar bronchus."""


@frozen_value
class Bronchus:
    """One named bronchus of an adult; `direction` is LPS of any length, `segment` marks segmental ones."""

    name: str
    parent: str
    direction: tuple[float, float, float]
    length_mm: float
    lobe: int = 0
    segment: bool = False


_Direction = tuple[float, float, float]


def _stem(name: str, parent: str, direction: _Direction, length_mm: float, lobe: int = 0) -> Bronchus:
    return Bronchus(name=name, parent=parent, direction=direction, length_mm=length_mm, lobe=lobe)


def _segment(name: str, parent: str, direction: _Direction, length_mm: float, lobe: int) -> Bronchus:
    return replace(_stem(name, parent, direction, length_mm, lobe), segment=True)


TEMPLATE = (
    _stem("right main bronchus", "trachea", (-0.60, 0.15, -0.79), 24),
    _stem("left main bronchus", "trachea", (0.76, 0.25, -0.60), 46),
    _stem("right upper lobe bronchus", "right main bronchus", (-0.93, -0.05, 0.10), 15, RIGHT_UPPER),
    _stem("bronchus intermedius", "right main bronchus", (-0.35, 0.25, -0.90), 24),
    _segment("RB1", "right upper lobe bronchus", (-0.45, 0.05, 0.90), 13, RIGHT_UPPER),
    _stem("RB2+3", "right upper lobe bronchus", (-0.95, 0.00, 0.00), 6, RIGHT_UPPER),
    _segment("RB2", "RB2+3", (-0.65, 0.65, 0.30), 12, RIGHT_UPPER),
    _segment("RB3", "RB2+3", (-0.60, -0.78, 0.00), 13, RIGHT_UPPER),
    _stem("right middle lobe bronchus", "bronchus intermedius", (-0.50, -0.68, -0.50), 18, RIGHT_MIDDLE),
    _stem("right lower lobe bronchus", "bronchus intermedius", (-0.25, 0.30, -0.90), 9, RIGHT_LOWER),
    _segment("RB4", "right middle lobe bronchus", (-0.85, -0.25, -0.40), 13, RIGHT_MIDDLE),
    _segment("RB5", "right middle lobe bronchus", (-0.25, -0.80, -0.50), 13, RIGHT_MIDDLE),
    _segment("RB6", "right lower lobe bronchus", (-0.40, 0.92, 0.05), 11, RIGHT_LOWER),
    _stem("right basal trunk", "right lower lobe bronchus", (-0.40, 0.15, -0.90), 13, RIGHT_LOWER),
    _segment("RB7", "right basal trunk", (0.05, -0.25, -0.97), 12, RIGHT_LOWER),
    _stem("RB8+9+10", "right basal trunk", (-0.55, 0.20, -0.80), 8, RIGHT_LOWER),
    _segment("RB8", "RB8+9+10", (-0.65, -0.40, -0.65), 13, RIGHT_LOWER),
    _stem("RB9+10", "RB8+9+10", (-0.35, 0.50, -0.80), 9, RIGHT_LOWER),
    _segment("RB9", "RB9+10", (-0.75, 0.25, -0.65), 13, RIGHT_LOWER),
    _segment("RB10", "RB9+10", (-0.10, 0.65, -0.78), 14, RIGHT_LOWER),
    _stem("left upper lobe bronchus", "left main bronchus", (0.85, -0.45, 0.10), 13, LEFT_UPPER),
    _stem("left lower lobe bronchus", "left main bronchus", (0.40, 0.40, -0.83), 11, LEFT_LOWER),
    _stem("left upper division", "left upper lobe bronchus", (0.50, -0.20, 0.85), 10, LEFT_UPPER),
    _stem("lingular bronchus", "left upper lobe bronchus", (0.60, -0.60, -0.55), 15, LEFT_UPPER),
    _segment("LB1+2", "left upper division", (0.30, 0.40, 0.88), 14, LEFT_UPPER),
    _segment("LB3", "left upper division", (0.45, -0.85, 0.30), 13, LEFT_UPPER),
    _segment("LB4", "lingular bronchus", (0.85, -0.40, -0.25), 12, LEFT_UPPER),
    _segment("LB5", "lingular bronchus", (0.25, -0.72, -0.65), 13, LEFT_UPPER),
    _segment("LB6", "left lower lobe bronchus", (0.40, 0.92, 0.05), 11, LEFT_LOWER),
    _stem("left basal trunk", "left lower lobe bronchus", (0.45, 0.10, -0.88), 14, LEFT_LOWER),
    _segment("LB8", "left basal trunk", (0.45, -0.55, -0.72), 13, LEFT_LOWER),
    _stem("LB9+10", "left basal trunk", (0.40, 0.45, -0.80), 9, LEFT_LOWER),
    _segment("LB9", "LB9+10", (0.82, 0.15, -0.58), 13, LEFT_LOWER),
    _segment("LB10", "LB9+10", (0.10, 0.65, -0.78), 14, LEFT_LOWER),
)
CENTRAL = (
    "right main bronchus",
    "left main bronchus",
    "right upper lobe bronchus",
    "left upper lobe bronchus",
    "left lower lobe bronchus",
)
"""Main bronchi and the lobar ones that leave them."""


def _skeleton(
    scale: float, rng: np.random.Generator, central_length: float
) -> dict[str, tuple[Float, Float]]:
    """Return start and end `(3,)` LPS mm of every bronchus of the template, slightly varied.

    `central_length` is a factor of the lengths of main and lobar bronchi.
    """
    top = scale * TRACHEA_LENGTH_MM * np.array([rng.uniform(-0.02, 0.02), -0.12, 1.0])
    ends = {"trachea": (top, np.zeros(3))}
    for bronchus in TEMPLATE:
        # Four degrees or so: patients differ, and segments keep their place.
        jitter = rng.normal(0, 0.07, 3).clip(-0.15, 0.15)
        direction = unit(unit(np.array(bronchus.direction)) + jitter)
        start = ends[bronchus.parent][1]
        # Lengths of bronchi differ about this much between patients [Horsfield1971].
        length = scale * bronchus.length_mm * (1 + 0.08 * rng.uniform(-1, 1))
        length *= central_length if bronchus.name in CENTRAL else 1.0
        ends[bronchus.name] = (start, start + length * direction)
    return ends


def _share_out(cloud: Float, starts: Float, directions: Float) -> Int:
    """Assign points `(N, 3)` to segments by angle, weighted for about equal shares; return `(N,)` indices."""
    rays = unit(cloud[:, None, :] - starts[None])
    cosine = np.einsum("nsa,sa->ns", rays, directions)
    weights = np.zeros(len(starts))
    owner = cosine.argmax(axis=1)
    # Shares need only be about equal: each round moves the weights half-way.
    for _ in range(25):
        share = np.bincount(owner, minlength=len(starts)) / len(cloud)
        weights -= 0.5 * (share - 1 / len(starts))
        owner = (cosine + weights).argmax(axis=1)
    return np.asarray(owner)


def _segment_clouds(
    ends: dict[str, tuple[Float, Float]], territory: Territory, resected: int
) -> dict[str, Float]:
    """Return the points that every segment supplies."""
    clouds: dict[str, Float] = {}
    for lobe in sorted(set(LOBES.values()) - {resected}):
        segments = [b for b in TEMPLATE if b.segment and b.lobe == lobe]
        cloud = territory.points_lps[territory.lobe_of_point == lobe]
        starts = np.array([ends[b.name][0] for b in segments])
        directions = unit(np.array([ends[b.name][1] for b in segments]) - starts)
        owner = _share_out(cloud, starts, directions)
        clouds.update({b.name: cloud[owner == i] for i, b in enumerate(segments)})
    return clouds


def _supplied(clouds: dict[str, Float]) -> dict[str, int]:
    """Return how many points each bronchus of the template supplies."""
    counts = {name: len(cloud) for name, cloud in clouds.items()}
    for bronchus in reversed(TEMPLATE):
        counts[bronchus.parent] = counts.get(bronchus.parent, 0) + counts.get(bronchus.name, 0)
    return counts


def grow_airways(
    territory: Territory, scale: float, rng: np.random.Generator, traits: Traits = PLAIN
) -> tuple[Sprouts, GrowthRule]:
    """Grow the airway tree that supplies the points of a territory.

    Returns the tree, whose `diameter_mm` is the lumen's, and the rule it follows.  Branch 0 is the
    trachea, 1 and 2 are the right and the left main bronchus.
    """
    ends = _skeleton(scale, rng, traits.bronchus_length)
    resected = traits.resected_lobe
    clouds = _segment_clouds(ends, territory, resected)
    counts = _supplied(clouds)
    rule = GrowthRule(
        # This is the diameter in an adult [Weibel1963].
        root_diameter_mm=scale * 18.0 * (1 + 0.05 * rng.uniform(-1, 1)),
        total_points=len(territory.points_lps),
        # Below what any CT shows, so that the drawing decides where airways end.
        smallest_diameter_mm=scale * 1.25 / traits.vessel_calibre,
        flow_exponent=traits.flow_exponent,
        length_per_diameter=traits.slenderness,
        # Branches are at most so many times as long as is aimed at.
        greatest_length_per_diameter=traits.slenderness * (4.2 / 3.0),
    )
    sprouts, index = Sprouts(), {"trachea": 0}
    trachea = np.linspace(*ends["trachea"], int(scale * TRACHEA_LENGTH_MM / STEP_MM))
    sprouts.add(-1, trachea, rule.root_diameter_mm, 0, "trachea")
    for bronchus in TEMPLATE:
        stump = resected and bronchus.lobe == resected
        if stump and _lobe_of(bronchus.parent) == resected:
            continue
        parent = index[bronchus.parent]
        start, end = sprouts.points[parent][-1], ends[bronchus.name][1]
        if stump:
            end = start + STUMP_SHARE * (end - start)
        elif bronchus.segment:
            # Turn a segmental bronchus towards the middle of the points it supplies.
            chord = end - start
            middle = unit(clouds[bronchus.name].mean(axis=0) - start)
            heading = unit((1 - MIDDLE_WEIGHT) * unit(chord) + MIDDLE_WEIGHT * middle)
            end = np.asarray(start + np.linalg.norm(chord) * limit_turn(heading, unit(chord), 0.0, np.pi / 6))
        line = bent_line(start, sprouts.direction(parent), end, STEP_MM, bend=0.25)
        diameter = scale * STUMP_DIAMETER_MM if stump else rule.diameter_mm(counts[bronchus.name])
        index[bronchus.name] = sprouts.add(parent, line, diameter, bronchus.lobe, bronchus.name)
    for name, cloud in clouds.items():
        grow(sprouts, index[name], cloud, rule, territory, rng)
    return sprouts, rule


def _lobe_of(name: str) -> int:
    return next((bronchus.lobe for bronchus in TEMPLATE if bronchus.name == name), 0)
