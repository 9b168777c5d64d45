"""Sites: candidate scope poses on the medial axis, with the proved lumen radius of the route to each."""

from __future__ import annotations

import math

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float, Int
from stages.scope.device import Bronchoscope
from stages.scope.passages import find_passages
from stages.scope.tips import ScopeTip, approach, looks_ahead, tip_at, turned_aside


@frozen_record
class Sites:
    """Candidate poses of the scope tip: S tree points, about evenly spaced, and why others are no sites.

    Parameters
    ----------
    tree_point : (S,) int64
        Index into the airway tree.
    poses : (S, 6) float64
        Point and direction of the scope tip, LPS mm.
    turned : (S,) bool
        Whether the tip is turned aside, or looks along the medial axis.
    narrowest_radius_mm : (S,) float64
        Proved radius of the narrowest place of the lumen on the route to the site, also beside the axis.
    lumen_radius_mm : (N,) float64
        For each tree point, the smallest radius of the lumen on the route to it from the root, proved for
        every point of the route and not only for the tree points.
    passable : (N,) bool
        Whether the scope fits at each tree point and on the whole route to it.
    exits_ahead : (N,) bool
        Whether an airway lying in lung tissue, not in the mediastinum, is within reach ahead.
    narrowest : tuple of (int, float)
        Generation at which the most branches become too narrow, and by how much the scope's radius
        exceeds that of the lumen there, in mm (median); (-1, 0) if every branch is passable.
    widest_scope_mm : float
        Outer diameter of the thickest scope that would have a site; 0 if none has.
    """

    tree_point: Int
    poses: Float
    turned: Bool
    narrowest_radius_mm: Float
    lumen_radius_mm: Float
    passable: Bool
    exits_ahead: Bool
    narrowest: tuple[int, float]
    widest_scope_mm: float

    @property
    def count(self) -> int:
        """Number of sites, S."""
        return len(self.tree_point)

    def tip(self, tree: AirwayTree, site: int) -> ScopeTip:
        """Return the scope tip at a site."""
        point, pose = int(self.tree_point[site]), self.poses[site]
        if not self.turned[site]:
            return tip_at(tree, point)
        frame = frames.pose(pose[:3], pose[3:])
        return ScopeTip(tree_point=point, back_mm=0.0, lps_from_scope_tip=frame, turned=True)


TURNED_SPACING_MM = 2.0
"""Spacing of turned tips: each has 25 directions, and nearer ones give about the same poses."""


def find_sites(
    lung: Lung, scope: Bronchoscope, *, reach_mm: float, spacing_mm: float = 1.0, turning: bool = True
) -> Sites:
    """Find the sites: scope poses from which tubes can leave the airway.

    A site is a point of the medial axis that the scope reaches through a lumen wider than itself on the
    whole route, where its tip looks on along the route, with an airway inside the lung within `reach_mm`
    ahead.  Airways in the mediastinum do not count: leaving them pierces the pleura [Kuntz2015, fig. 5].

    Parameters
    ----------
    reach_mm : float
        How far ahead of the scope tip the airway may be left.
    spacing_mm : float
        Distance between sites along a branch.
    turning : bool
        Whether tips are also turned aside, every 2 mm, by up to 45 degrees from where the scope comes from,
        as far as its body fits into the lumen.
    """
    tree = lung.tree
    places = find_passages(lung, scope, reach_mm=reach_mm)
    narrowest_so_far, passable, ahead = places.lumen_radius_mm, places.passable, places.exits_ahead
    spaced = np.flatnonzero(ahead & _every(tree, spacing_mm))
    looking = _looking_ahead(tree, spaced)
    straight = looking[passable[looking]]
    sparse = np.flatnonzero(ahead & passable & _every(tree, max(spacing_mm, TURNED_SPACING_MM)))
    turned, depths = _turned_tips(lung, scope, sparse) if turning else ([], np.zeros(0))
    chosen = np.concatenate([straight, np.array([tip.tree_point for tip in turned], dtype=np.int64)])
    aside = [np.concatenate([tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]]) for tip in turned]
    along = np.hstack([tree.points_lps[straight], tree.tangents[straight]])
    widest = float(narrowest_so_far[looking].max(initial=0.0))
    return Sites(
        tree_point=chosen,
        poses=np.concatenate([along, np.array(aside).reshape(-1, 6)]),
        turned=np.arange(len(chosen)) >= len(straight),
        narrowest_radius_mm=np.minimum(
            narrowest_so_far[chosen], np.concatenate([np.full(len(straight), np.inf), depths])
        ),
        lumen_radius_mm=narrowest_so_far,
        passable=passable,
        exits_ahead=ahead,
        narrowest=places.narrowest,
        widest_scope_mm=max(2.0 * (widest - scope.lumen_margin_mm), 0.0),
    )


def approach_depth_mm(lung: Lung, tip: ScopeTip) -> float:
    """Return a radius that the lumen has all along where a scope with a turned tip leaves the axis.

    0 if it cannot bend there.  The depth in the lumen is 1-Lipschitz: between two samples it is at most half
    their distance less.
    """
    return float(_approach_depths(lung, [tip])[0])


def tip_is_feasible(lung: Lung, scope: Bronchoscope, sites: Sites, tip: ScopeTip) -> bool:
    """Tell whether a scope can reach a tip pose: it fits on the whole route, and bends no more than it can.

    Parameters
    ----------
    sites : Sites
        Those of this scope; they tell where it fits.
    """
    if not sites.passable[tip.tree_point]:
        return False
    if not tip.turned:
        return looks_ahead(lung.tree, tip)
    return approach_depth_mm(lung, tip) >= scope.radius_mm + scope.lumen_margin_mm


APPROACH_STEP_MM = 0.25
"""Spacing of the samples where a turned scope leaves the axis: coarser, for there are many more of them."""
ARC_SAGITTA_MM = 0.01
"""Distance between the arc of a bent scope and its polyline, at most; see `tips.approach`."""


def _approach_depths(lung: Lung, tips: list[ScopeTip]) -> Float:
    samples, owner = [], []
    depths = np.zeros(len(tips))
    for number, tip in enumerate(tips):
        line = approach(lung.tree, tip)
        if line is None:
            continue
        depths[number] = math.inf
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        share = np.concatenate([[0.0], np.cumsum(steps)])
        at = np.linspace(0.0, share[-1], math.ceil(share[-1] / APPROACH_STEP_MM) + 1)
        samples.append(np.stack([np.interp(at, share, line[:, axis]) for axis in range(3)], axis=1))
        owner.append(np.full(len(at), number))
    if samples:
        found = lung.lumen_depth.lower_bound_mm(np.concatenate(samples))
        np.minimum.at(depths, np.concatenate(owner), found - 0.5 * APPROACH_STEP_MM - ARC_SAGITTA_MM)
    return np.maximum(depths, 0.0)


TURNS_RAD = tuple(math.radians(angle) for angle in (0.0, 15.0, 30.0, 45.0))
"""Angles of turned tips from the chord behind them, up to `tips.MAX_TURN_AT_TIP_RAD`."""
TURN_DIRECTIONS = 8
"""Directions of a turn about the chord, 45 degrees apart: at most 30 degrees apart at the largest angle."""


def _turned_tips(lung: Lung, scope: Bronchoscope, points: Int) -> tuple[list[ScopeTip], Float]:
    """Return the turned tips at tree points that the scope's body fits behind, and the lumen radii there."""
    tips = []
    for point in points:
        along = tip_at(lung.tree, int(point))
        for polar in TURNS_RAD:
            for azimuth in np.arange(TURN_DIRECTIONS if polar else 1) * (2.0 * math.pi / TURN_DIRECTIONS):
                tips.append(turned_aside(lung.tree, along, polar, float(azimuth)))
    depths = _approach_depths(lung, tips)
    fits = depths >= scope.radius_mm + scope.lumen_margin_mm
    return [tip for tip, does in zip(tips, fits, strict=True) if does], depths[fits]


def _looking_ahead(tree: AirwayTree, points: Int) -> Int:
    return np.array([p for p in points if looks_ahead(tree, tip_at(tree, int(p)))], dtype=np.int64)


def _every(tree: AirwayTree, spacing_mm: float) -> Bool:
    """Choose points about `spacing_mm` apart along the tree."""
    slot = np.floor(tree.distance_from_root_mm / spacing_mm)
    chosen = np.ones(tree.n_points, dtype=bool)
    chosen[1:] = slot[1:] != slot[tree.parent_point[1:]]
    return chosen
