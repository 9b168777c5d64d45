"""Plan the trees and nodules of a phantom: what runs where and how thick, before anything is drawn."""

from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float, UInt8
from anatomy.phantom.branching import Sprouts
from anatomy.phantom.bronchi import grow_airways
from anatomy.phantom.nodules import Bulla, Nodule, place_bullae, place_nodules
from anatomy.phantom.territory import Territory
from anatomy.phantom.traits import PLAIN, Traits
from anatomy.phantom.vessels import Obstacles, copy_arteries, grow_veins, make_way

# A tube is drawn without gaps if its radius is at least half the diagonal of a voxel.
GAPLESS_RADIUS = 0.87
EMPHYSEMA_VESSEL_SHARE = 0.5
"""Severe emphysema destroys vessels up to half as thick again."""
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


@frozen_value
class VesselRule:
    """How vessels follow from a tree: diameters of `calibre` times the tree's, down to `limit_mm`.

    They are drawn in voxels of `spacing_mm`.
    """

    calibre: float
    limit_mm: float
    spacing_mm: float


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

    Raises:
        AnatomyError: If three nodules do not fit.
    """
    bullae = place_bullae(territory, traits.emphysema, scale, rng)
    # The diameter at which vessels end: in small patients later, in coarse voxels earlier.
    limit_mm = traits.vessel_limit_mm * (1.0 + EMPHYSEMA_VESSEL_SHARE * traits.emphysema)
    vessels = VesselRule(
        calibre=traits.vessel_calibre, limit_mm=limit_mm * max(scale, spacing_mm), spacing_mm=spacing_mm
    )
    sprouts, rule = grow_airways(territory, scale, rng, traits)
    airways = _plan_airways(sprouts, spacing_mm)
    rim_mm = scale * traits.vessel_rim_mm
    arteries = _below_rim(_plan_arteries(sprouts, scale, vessels), territory, rim_mm)
    tubes = _obstacles(airways, arteries)
    # Only tubes of a larger radius keep nodules away: thin ones run into them in patients, too.
    large = tubes.radii > 1.4 * scale
    nodules = place_nodules(territory, tubes.centres[large], tubes.radii[large], scale, rng, bullae)
    obstacles = Obstacles(
        centres=np.vstack([tubes.centres, *(n.centre_lps for n in nodules)]),
        radii=np.concatenate([tubes.radii, [n.radius_mm for n in nodules]]),
    )
    root_mm, calibre = rule.root_diameter_mm, vessels.calibre
    rule = replace(rule, smallest_diameter_mm=vessels.limit_mm, root_diameter_mm=calibre * root_mm)
    grown = grow_veins(territory, obstacles, rule, scale, rng)
    veins = _plan_veins(grown, obstacles, scale, replace(vessels, calibre=1.0))
    veins = _below_rim(veins, territory, rim_mm)
    return PatientPlan(airways=airways, arteries=arteries, veins=veins, nodules=nodules, bullae=bullae)


def wall_thickness_mm(diameter_mm: Float) -> Float:
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
    outer = 0.5 * diameter + wall_thickness_mm(diameter)
    return PlannedTree(sprouts=drawn, inner_mm=0.5 * diameter, outer_mm=outer, freedom=_freedom(drawn))


def _vessel_part(sprouts: Sprouts, rule: VesselRule) -> tuple[Sprouts, Float]:
    """Return the branches that carry a drawn vessel, and the vessel's radius `(B,)`."""
    part = sprouts.pruned(rule.calibre * np.array(sprouts.diameter_mm) >= rule.limit_mm)
    radius_mm = 0.5 * rule.calibre * np.array(part.diameter_mm)
    return part, np.maximum(radius_mm, GAPLESS_RADIUS * rule.spacing_mm)


def _vessels(
    sprouts: Sprouts, radius_mm: Float, obstacles: Obstacles, spacing_mm: float, fixed: int, freedom: UInt8
) -> PlannedTree:
    """Lead vessels around obstacles; they become thinner in narrow places, but never too thin to draw."""
    # Tissue between a vessel and what it passes: thinner than a voxel, so that some touch, as in a CT.
    radius = make_way(sprouts, radius_mm, obstacles, 0.3, fixed)
    radius = np.maximum(radius, GAPLESS_RADIUS * spacing_mm)
    return PlannedTree(sprouts=sprouts, inner_mm=radius, outer_mm=radius, freedom=freedom)


def _plan_arteries(sprouts: Sprouts, scale: float, rule: VesselRule) -> PlannedTree:
    airways, radius = _vessel_part(sprouts, rule)
    # Pulmonary trunk, right and left pulmonary artery of an adult.
    radius[:CENTRAL_BRANCHES] = scale * np.array((12.5, 9.5, 9.5))
    diameter = np.array(airways.diameter_mm)
    outer = 0.5 * diameter + wall_thickness_mm(diameter)
    arteries = copy_arteries(airways, outer, radius, scale)
    obstacles = Obstacles(centres=np.vstack(airways.points), radii=np.repeat(outer, airways.counts))
    fixed = int(arteries.counts[:CENTRAL_BRANCHES].sum())
    return _vessels(arteries, radius, obstacles, rule.spacing_mm, fixed, _freedom(arteries))


def _plan_veins(grown: Sprouts, obstacles: Obstacles, scale: float, rule: VesselRule) -> PlannedTree:
    veins, radius = _vessel_part(grown, rule)
    # Veins from this diameter on lie outside the lung and may be drawn there.
    freedom = (np.array(veins.diameter_mm) > 6.0 * scale).astype(np.uint8)
    freedom[0] = 2
    return _vessels(veins, radius, obstacles, rule.spacing_mm, len(veins.points[0]), freedom)


def _below_rim(tree: PlannedTree, territory: Territory, rim_mm: float) -> PlannedTree:
    """Let vessels end below the rim; without a rim the tree is as it was."""
    if rim_mm == 0.0:
        return tree
    sprouts, radius, kept = ends_below_pleura(tree.sprouts, tree.outer_mm, tree.freedom, territory, rim_mm)
    return PlannedTree(sprouts=sprouts, inner_mm=radius, outer_mm=radius, freedom=tree.freedom[kept])


def _obstacles(*trees: PlannedTree) -> Obstacles:
    return Obstacles(
        centres=np.vstack([tree.points_lps for tree in trees]),
        radii=np.concatenate([tree.outer_mm for tree in trees]),
    )


def ends_below_pleura(
    sprouts: Sprouts, radius_mm: Float, freedom: UInt8, territory: Territory, rim_mm: float
) -> tuple[Sprouts, Float, Bool]:
    """End the nameless branches of a tree where they run from deeper tissue into the rim.

    A vessel that has not yet left the rim, on its way from the mediastinum, goes on.

    Args:
        sprouts: B branches, N points.
        radius_mm: (N,) float64.
        freedom ((B,) uint8): Nameless branches have 0, see `paint_tree`.
        rim_mm: Depth of the rim.

    Returns:
        Sprouts, (M,) float64, (B,) bool: The tree that is left, its radii, and which branches those are.
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
    cut = Sprouts(
        parent=sprouts.parent,
        points=points,
        diameter_mm=sprouts.diameter_mm,
        lobe=sprouts.lobe,
        name=sprouts.name,
    )
    return cut.pruned(kept), np.concatenate(radii), kept
