"""Plan the trees and nodules of a phantom: what runs where and how thick, before anything is drawn.

Bronchi down to the segments come from a template, and are grown from there on.  Lengths, directions and the
names B1 to B10 follow anatomy; diameters follow from the lung volume that a bronchus supplies.

References:
    [Horsfield1971], [Weibel1963]
"""

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int, UInt8
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.phantom.branching import STEP_MM, GrowthRule, Sprouts, bent_line, grow, limit_turn
from anatomy.phantom.chest import LOBES
from anatomy.phantom.territory import Bulla, Nodule, Territory, place_bullae, place_nodules
from anatomy.phantom.traits import PLAIN, Traits
from anatomy.phantom.vessels import Obstacles, copy_arteries, grow_veins, make_way
from anatomy.poses import unit

TRACHEA_LENGTH_MM = 110.0
"""This is the part that lies in the chest of an adult [Weibel1963]."""
MIDDLE_WEIGHT = 0.4
"""Segmental bronchi turn partly towards what they supply: wholly would lose the template."""
STUMP_SHARE, STUMP_DIAMETER_MM = 0.45, 7.0
"""An operation leaves this share and diameter of a lobar bronchus."""


class Bronchus(NamedTuple):
    """One named bronchus of an adult; `direction` is LPS of any length."""

    name: str
    parent: str
    direction: tuple[float, float, float]
    length_mm: float
    lobe: int = 0

    @property
    def segment(self) -> bool:
        """Whether it leads to one segment, by its name; the left segments 1 and 2 are one."""
        return re.fullmatch(r"RB\d+|LB\d+|LB1\+2", self.name) is not None


TEMPLATE = (
    Bronchus("right main bronchus", "trachea", (-0.60, 0.15, -0.79), 24),
    Bronchus("left main bronchus", "trachea", (0.76, 0.25, -0.60), 46),
    Bronchus("right upper lobe bronchus", "right main bronchus", (-0.93, -0.05, 0.10), 15, RIGHT_UPPER),
    Bronchus("bronchus intermedius", "right main bronchus", (-0.35, 0.25, -0.90), 24),
    Bronchus("RB1", "right upper lobe bronchus", (-0.45, 0.05, 0.90), 13, RIGHT_UPPER),
    Bronchus("RB2+3", "right upper lobe bronchus", (-0.95, 0.00, 0.00), 6, RIGHT_UPPER),
    Bronchus("RB2", "RB2+3", (-0.65, 0.65, 0.30), 12, RIGHT_UPPER),
    Bronchus("RB3", "RB2+3", (-0.60, -0.78, 0.00), 13, RIGHT_UPPER),
    Bronchus("right middle lobe bronchus", "bronchus intermedius", (-0.50, -0.68, -0.50), 18, RIGHT_MIDDLE),
    Bronchus("right lower lobe bronchus", "bronchus intermedius", (-0.25, 0.30, -0.90), 9, RIGHT_LOWER),
    Bronchus("RB4", "right middle lobe bronchus", (-0.85, -0.25, -0.40), 13, RIGHT_MIDDLE),
    Bronchus("RB5", "right middle lobe bronchus", (-0.25, -0.80, -0.50), 13, RIGHT_MIDDLE),
    Bronchus("RB6", "right lower lobe bronchus", (-0.40, 0.92, 0.05), 11, RIGHT_LOWER),
    Bronchus("right basal trunk", "right lower lobe bronchus", (-0.40, 0.15, -0.90), 13, RIGHT_LOWER),
    Bronchus("RB7", "right basal trunk", (0.05, -0.25, -0.97), 12, RIGHT_LOWER),
    Bronchus("RB8+9+10", "right basal trunk", (-0.55, 0.20, -0.80), 8, RIGHT_LOWER),
    Bronchus("RB8", "RB8+9+10", (-0.65, -0.40, -0.65), 13, RIGHT_LOWER),
    Bronchus("RB9+10", "RB8+9+10", (-0.35, 0.50, -0.80), 9, RIGHT_LOWER),
    Bronchus("RB9", "RB9+10", (-0.75, 0.25, -0.65), 13, RIGHT_LOWER),
    Bronchus("RB10", "RB9+10", (-0.10, 0.65, -0.78), 14, RIGHT_LOWER),
    Bronchus("left upper lobe bronchus", "left main bronchus", (0.85, -0.45, 0.10), 13, LEFT_UPPER),
    Bronchus("left lower lobe bronchus", "left main bronchus", (0.40, 0.40, -0.83), 11, LEFT_LOWER),
    Bronchus("left upper division", "left upper lobe bronchus", (0.50, -0.20, 0.85), 10, LEFT_UPPER),
    Bronchus("lingular bronchus", "left upper lobe bronchus", (0.60, -0.60, -0.55), 15, LEFT_UPPER),
    Bronchus("LB1+2", "left upper division", (0.30, 0.40, 0.88), 14, LEFT_UPPER),
    Bronchus("LB3", "left upper division", (0.45, -0.85, 0.30), 13, LEFT_UPPER),
    Bronchus("LB4", "lingular bronchus", (0.85, -0.40, -0.25), 12, LEFT_UPPER),
    Bronchus("LB5", "lingular bronchus", (0.25, -0.72, -0.65), 13, LEFT_UPPER),
    Bronchus("LB6", "left lower lobe bronchus", (0.40, 0.92, 0.05), 11, LEFT_LOWER),
    Bronchus("left basal trunk", "left lower lobe bronchus", (0.45, 0.10, -0.88), 14, LEFT_LOWER),
    Bronchus("LB8", "left basal trunk", (0.45, -0.55, -0.72), 13, LEFT_LOWER),
    Bronchus("LB9+10", "left basal trunk", (0.40, 0.45, -0.80), 9, LEFT_LOWER),
    Bronchus("LB9", "LB9+10", (0.82, 0.15, -0.58), 13, LEFT_LOWER),
    Bronchus("LB10", "LB9+10", (0.10, 0.65, -0.78), 14, LEFT_LOWER),
)
CENTRAL = (
    "right main bronchus", "left main bronchus", "right upper lobe bronchus", "left upper lobe bronchus",
    "left lower lobe bronchus",
)  # fmt: skip
"""Main bronchi and the lobar ones that leave them."""


def _skeleton(
    scale: float, rng: np.random.Generator, central_length: float
) -> dict[str, tuple[Float, Float]]:
    """Return start and end `(3,)` LPS mm of the template's bronchi, varied; main and lobar ones scaled in
    length."""
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
    cosine = np.einsum("nsa,sa->ns", unit(cloud[:, None, :] - starts[None]), directions)
    weights = np.zeros(len(starts))
    owner = cosine.argmax(axis=1)
    # Shares need only be about equal: each round moves the weights half-way.
    for _ in range(25):
        share = np.bincount(owner, minlength=len(starts)) / len(cloud)
        weights -= 0.5 * (share - 1 / len(starts))
        owner = (cosine + weights).argmax(axis=1)
    return np.asarray(owner)


def grow_airways(
    territory: Territory, scale: float, rng: np.random.Generator, traits: Traits = PLAIN
) -> tuple[Sprouts, GrowthRule]:
    """Grow the airway tree that supplies the points of a territory.

    Returns the tree, whose `diameter_mm` is the lumen's, and the rule it follows.  Branch 0 is the
    trachea, 1 and 2 are the right and the left main bronchus.
    """
    ends = _skeleton(scale, rng, traits.bronchus_length)
    resected = traits.resected_lobe
    clouds: dict[str, Float] = {}
    for lobe in sorted(set(LOBES.values()) - {resected}):
        segments = [b for b in TEMPLATE if b.segment and b.lobe == lobe]
        cloud = territory.points_lps[territory.lobe_of_point == lobe]
        starts = np.array([ends[b.name][0] for b in segments])
        owner = _share_out(cloud, starts, unit(np.array([ends[b.name][1] for b in segments]) - starts))
        clouds |= {b.name: cloud[owner == i] for i, b in enumerate(segments)}
    counts = {name: len(cloud) for name, cloud in clouds.items()}  # The points that each bronchus supplies.
    for bronchus in reversed(TEMPLATE):
        counts[bronchus.parent] = counts.get(bronchus.parent, 0) + counts.get(bronchus.name, 0)
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
        if stump and any(each.name == bronchus.parent and each.lobe == resected for each in TEMPLATE):
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


# A tube is drawn without gaps if its radius is at least half the diagonal of a voxel.
GAPLESS_RADIUS = 0.87
CENTRAL_BRANCHES = 3
"""The trunk and the two main branches come first in the list."""


@frozen_record
class PlannedTree:
    """A tree of B branches and N points, ready to be drawn.

    `inner_mm` and `outer_mm`, `(N,)`, are the radii of lumen and outside, the same for a vessel;
    `freedom`, `(B,)`, tells where a branch may be drawn, see `paint_tree`.
    """

    sprouts: Sprouts
    inner_mm: Float
    outer_mm: Float
    freedom: UInt8

    @property
    def points_lps(self) -> Float:
        """All points `(N, 3)`, LPS mm."""
        return np.vstack(self.sprouts.points)


@frozen_record
class PatientPlan:
    """What a phantom holds besides the chest."""

    airways: PlannedTree
    arteries: PlannedTree
    veins: PlannedTree
    nodules: tuple[Nodule, ...]
    bullae: tuple[Bulla, ...] = ()


def plan_patient(
    territory: Territory, scale: float, spacing_mm: float, rng: np.random.Generator, traits: Traits = PLAIN
) -> PatientPlan:
    """Plan trees and nodules for a territory of `scale` times adult size and voxels of `spacing_mm`.

    Raises AnatomyError if three nodules do not fit.
    """
    bullae = place_bullae(territory, traits.emphysema, scale, rng)
    # The diameter at which vessels end: in small patients later, in coarse voxels earlier.
    # Severe emphysema destroys vessels up to half as thick again.
    limit_mm = traits.vessel_limit_mm * (1.0 + 0.5 * traits.emphysema) * max(scale, spacing_mm)
    calibre = traits.vessel_calibre
    sprouts, rule = grow_airways(territory, scale, rng, traits)
    airways = _plan_airways(sprouts, spacing_mm)
    rim_mm = scale * traits.vessel_rim_mm
    arteries = _below_rim(_plan_arteries(sprouts, scale, calibre, limit_mm, spacing_mm), territory, rim_mm)
    tubes = Obstacles(
        centres=np.vstack([airways.points_lps, arteries.points_lps]),
        radii=np.concatenate([airways.outer_mm, arteries.outer_mm]),
    )
    # Only tubes of a larger radius keep nodules away: thin ones run into them in patients, too.
    large = tubes.radii > 1.4 * scale
    nodules = place_nodules(territory, tubes.centres[large], tubes.radii[large], scale, rng, bullae)
    obstacles = Obstacles(
        centres=np.vstack([tubes.centres, *(n.centre_lps for n in nodules)]),
        radii=np.concatenate([tubes.radii, [n.radius_mm for n in nodules]]),
    )
    rule = replace(rule, smallest_diameter_mm=limit_mm, root_diameter_mm=calibre * rule.root_diameter_mm)
    grown = grow_veins(territory, obstacles, rule, scale, rng)
    sprouts, radius = _vessel_part(grown, 1.0, limit_mm, spacing_mm)
    # Veins from this diameter on lie outside the lung and may be drawn there.
    freedom = (np.array(sprouts.diameter_mm) > 6.0 * scale).astype(np.uint8)
    freedom[0] = 2
    veins = _vessels(sprouts, radius, obstacles, spacing_mm, len(sprouts.points[0]), freedom)
    veins = _below_rim(veins, territory, rim_mm)
    return PatientPlan(airways=airways, arteries=arteries, veins=veins, nodules=nodules, bullae=bullae)


def _wall_thickness_mm(diameter_mm: Float) -> Float:
    """Return the wall thickness for lumen diameters: about 20 % of thin airways, 10 % of wide ones."""
    # About the wall of a bronchus of 2 mm.
    return np.asarray(np.maximum(0.5, diameter_mm * (0.1 + 0.1 * np.exp(-diameter_mm / 6.0))))


def _freedom(sprouts: Sprouts) -> UInt8:
    """Let central branches be drawn in any case and named ones outside the lung."""
    named = np.array([bool(name) for name in sprouts.name])
    central = np.arange(len(named)) < CENTRAL_BRANCHES
    return np.where(central, 2, np.where(named, 1, 0)).astype(np.uint8)


def _plan_airways(sprouts: Sprouts, spacing_mm: float) -> PlannedTree:
    # Thinner lumens are not to be seen in a usual CT.
    limit = max(1.8, 2 * GAPLESS_RADIUS * spacing_mm)
    drawn = sprouts.pruned(np.array(sprouts.diameter_mm) >= limit)
    diameter = np.repeat(drawn.diameter_mm, drawn.counts)
    outer = 0.5 * diameter + _wall_thickness_mm(diameter)
    return PlannedTree(sprouts=drawn, inner_mm=0.5 * diameter, outer_mm=outer, freedom=_freedom(drawn))


def _vessel_part(
    sprouts: Sprouts, calibre: float, limit_mm: float, spacing_mm: float
) -> tuple[Sprouts, Float]:
    """Return the branches that carry a vessel of `calibre` times their diameter, and its radius `(B,)`."""
    part = sprouts.pruned(calibre * np.array(sprouts.diameter_mm) >= limit_mm)
    return part, np.maximum(0.5 * calibre * np.array(part.diameter_mm), GAPLESS_RADIUS * spacing_mm)


def _vessels(
    sprouts: Sprouts, radius_mm: Float, obstacles: Obstacles, spacing_mm: float, fixed: int, freedom: UInt8
) -> PlannedTree:
    """Lead vessels around obstacles; they become thinner in narrow places, but never too thin to draw."""
    # Tissue between a vessel and what it passes: thinner than a voxel, so that some touch, as in a CT.
    radius = make_way(sprouts, radius_mm, obstacles, 0.3, fixed)
    radius = np.maximum(radius, GAPLESS_RADIUS * spacing_mm)
    return PlannedTree(sprouts=sprouts, inner_mm=radius, outer_mm=radius, freedom=freedom)


def _plan_arteries(
    sprouts: Sprouts, scale: float, calibre: float, limit_mm: float, spacing_mm: float
) -> PlannedTree:
    airways, radius = _vessel_part(sprouts, calibre, limit_mm, spacing_mm)
    # Pulmonary trunk, right and left pulmonary artery of an adult.
    radius[:CENTRAL_BRANCHES] = scale * np.array((12.5, 9.5, 9.5))
    diameter = np.array(airways.diameter_mm)
    outer = 0.5 * diameter + _wall_thickness_mm(diameter)
    arteries = copy_arteries(airways, outer, radius, scale)
    obstacles = Obstacles(centres=np.vstack(airways.points), radii=np.repeat(outer, airways.counts))
    fixed = int(arteries.counts[:CENTRAL_BRANCHES].sum())
    return _vessels(arteries, radius, obstacles, spacing_mm, fixed, _freedom(arteries))


def _below_rim(tree: PlannedTree, territory: Territory, rim_mm: float) -> PlannedTree:
    """Let vessels end below the rim; without a rim the tree is as it was."""
    if rim_mm == 0.0:
        return tree
    sprouts, radius, kept = ends_below_pleura(tree.sprouts, tree.outer_mm, tree.freedom, territory, rim_mm)
    return PlannedTree(sprouts=sprouts, inner_mm=radius, outer_mm=radius, freedom=tree.freedom[kept])


def ends_below_pleura(
    sprouts: Sprouts, radius_mm: Float, freedom: UInt8, territory: Territory, rim_mm: float
) -> tuple[Sprouts, Float, Bool]:
    """End the nameless branches of a tree where they run from deeper tissue into the rim, `rim_mm` deep.

    A vessel that has not yet left the rim, on its way from the mediastinum, goes on.  The radii are those of
    the points `(N,)`; nameless branches have the freedom 0, see `paint_tree`.  Returned are the tree that is
    left, its radii, and which branches `(B,)` those are.
    """
    start = np.concatenate([[0], np.cumsum(sprouts.counts)])
    outside_rim = territory.depth_mm(np.vstack(sprouts.points)) >= rim_mm
    deep = np.zeros(len(sprouts.parent), dtype=np.bool_)
    whole, kept = deep.copy(), deep.copy()
    points = list(sprouts.points)
    radii = []
    for branch, parent in enumerate(sprouts.parent):
        if parent >= 0 and not whole[parent]:
            continue
        along = outside_rim[start[branch] : start[branch + 1]]
        was_deep = np.logical_or.accumulate(along) | (parent >= 0 and deep[parent])
        bound = np.flatnonzero(was_deep & ~along) if freedom[branch] == 0 else np.zeros(0, dtype=np.int64)
        count = int(bound[0]) if len(bound) else len(along)
        if count < 2:
            continue
        kept[branch], whole[branch], deep[branch] = True, count == len(along), was_deep[-1]
        points[branch] = points[branch][:count]
        radii.append(radius_mm[start[branch] : start[branch] + count])
    return replace(sprouts, points=points).pruned(kept), np.concatenate(radii), kept
