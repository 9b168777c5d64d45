"""All tips that a bronchoscope is brought to by proved motions: one tree of states for the whole airway."""

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int, Labels
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, OUTSIDE
from stages.scope.device import Bronchoscope
from stages.scope.growth import Growth, StateTree, rings
from stages.scope.kernels import growth as kernel
from stages.scope.kernels import turning
from stages.scope.kernels.body import Walls
from stages.scope.kernels.growth import Device
from stages.scope.kernels.turning import Places
from stages.scope.motion import ScopeMotion
from stages.scope.motion_proof import (
    MAX_OFF_AXIS_MM,
    MAX_TURN_AT_TIP_RAD,
    State,
    kernel_device,
    slide,
    turn,
    walls_of,
)


@frozen_record
class Passages:
    """How far a ball as thick as the scope gets along the medial axis; N tree points.

    Args:
        lumen_radius_mm ((N,) float64): For each tree point, the smallest radius of the lumen on the route to
            it from the root, proved for every point of the route and not only for the tree points.
        passable ((N,) bool): Whether the scope fits at each tree point and on the whole route to it.
        exits_ahead ((N,) bool): Whether an airway lying in lung tissue, not in the mediastinum, is within
            reach ahead.
        narrowest (tuple of (int, float)): Generation at which the most branches become too narrow, and by how
            much the scope's radius exceeds that of the lumen there, in mm (median); (-1, 0) if every branch
            is passable.
        widest_scope_mm: Outer diameter of the thickest scope that would pass a place with an exit ahead; 0 if
            none does.
    """

    lumen_radius_mm: Float
    passable: Bool
    exits_ahead: Bool
    narrowest: tuple[int, float]
    widest_scope_mm: float


def find_passages(lung: Lung, scope: Bronchoscope, *, reach_mm: float) -> Passages:
    """Find where a scope passes, and where an airway in lung tissue is within `reach_mm` ahead of its tip.

    Airways in the mediastinum do not count: leaving them pierces the pleura [Kuntz2015, fig. 5].
    """
    tree = lung.tree
    needed = scope.radius_mm + scope.lumen_margin_mm
    narrowest = _narrowest_on_the_route(lung)
    passable = narrowest >= needed
    ahead = _distance_to_exit(tree, _in_lung_tissue(lung)) <= reach_mm
    return Passages(
        lumen_radius_mm=narrowest,
        passable=passable,
        exits_ahead=ahead,
        narrowest=_where_too_narrow(tree, passable, needed - narrowest),
        widest_scope_mm=max(2.0 * (float(narrowest[ahead].max(initial=0.0)) - scope.lumen_margin_mm), 0.0),
    )


def _narrowest_on_the_route(lung: Lung) -> Float:
    """Return the proved lumen radius of the narrowest place up to each point; the depth is 1-Lipschitz."""
    tree = lung.tree
    parent = np.maximum(tree.parent_point, 0)
    step = tree.points_lps - tree.points_lps[parent]
    # Spacing of the samples of a proof along the medial axis; half of it is lost, far less than a voxel.
    count = max(1, math.ceil(float(np.linalg.norm(step, axis=1).max()) / 0.05))
    share = np.linspace(0.0, 1.0, count + 1)
    samples = tree.points_lps[parent][:, None] + share[:, None] * step[:, None]
    depth = lung.lumen_depth.lower_bound_mm(samples.reshape(-1, 3)).reshape(len(step), -1)
    narrowest = np.maximum(depth.min(axis=1) - np.linalg.norm(step, axis=1) / (2 * count), 0.0)
    for point in range(1, tree.n_points):
        narrowest[point] = min(narrowest[point], narrowest[tree.parent_point[point]])
    return np.asarray(narrowest, dtype=np.float64)


PROBE_DIRECTIONS = 8
"""Directions across the airway in which tissue is looked for; at 2 to 6 mm they are a few voxels apart."""


def _in_lung_tissue(lung: Lung) -> Bool:
    """Tell at which tree points free lung tissue lies beside the airway, in some direction."""
    tree = lung.tree
    first = np.cross(tree.tangents, np.eye(3)[np.argmin(np.abs(tree.tangents), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tree.tangents, first)
    nowhere = np.ones(tree.n_points, dtype=bool)
    for phi in np.arange(PROBE_DIRECTIONS) * (2 * math.pi / PROBE_DIRECTIONS):
        direction = math.cos(phi) * first + math.sin(phi) * second
        # Tissue is looked for so far beyond the lumen: beyond the walls of the airways that tubes leave.
        probe = tree.points_lps + (tree.radius_mm + 2.5)[:, None] * direction
        nowhere &= (_labels_at(lung, probe) & (OUTSIDE | AIRWAY)) != 0
    return ~nowhere


def _labels_at(lung: Lung, points: Float) -> Labels:
    ijk = np.floor(lung.grid.ijk(points) + 0.5).astype(np.int64)
    inside = ((ijk >= 0) & (ijk < lung.grid.shape)).all(axis=1)
    labels = np.full(len(points), OUTSIDE, dtype=np.uint16)
    labels[inside] = lung.labels[tuple(ijk[inside].T)]
    return labels


def _distance_to_exit(tree: AirwayTree, in_tissue: Bool) -> Float:
    """Return the distance from each point down the tree to the next point in lung tissue."""
    distance_mm = np.where(in_tissue, 0.0, np.inf)
    for point in range(tree.n_points - 1, 0, -1):
        parent = tree.parent_point[point]
        step = tree.distance_from_root_mm[point] - tree.distance_from_root_mm[parent]
        distance_mm[parent] = min(distance_mm[parent], distance_mm[point] + step)
    return distance_mm


def _where_too_narrow(tree: AirwayTree, passable: Bool, shortfall_mm: Float) -> tuple[int, float]:
    """Say at which generation most routes end, and by how much (median)."""
    ends = np.flatnonzero(~passable[1:] & passable[tree.parent_point[1:]]) + 1
    if not len(ends):
        return (-1, 0.0) if passable[0] else (0, float(shortfall_mm[0]))
    generation = tree.generation[tree.branch_of_point[ends]]
    worst = int(np.argmax(np.bincount(generation)))
    return worst, float(np.median(shortfall_mm[ends[generation == worst]]))


@frozen_record
class ScopeTip:
    """A pose of the scope's tip, the tree point nearest to it, and the motion that brings the device there.

    The pose is the frame of the working channel: +z is forward, rotations of the tubes count from +x.
    """

    motion: ScopeMotion
    lps_from_scope_tip: Float
    tree_point: int


@frozen_record
class ScopeMotions:
    """Tips of a scope in one airway, each with a proved motion to it; S tips, N states.

    Args:
        tips ((S, 9) float64): Point, direction, and +x of the working channel's frame, LPS mm.
        tree_point ((S,) int64): Nearest point of the airway tree.
        turned ((S,) bool): Whether the tip is one of many directions at its place, or the one nearest to the
            axis and its direction.
        room_mm ((S,) float64): A room between the scope with its gap and the wall that the proof of the
            motion found everywhere.
        max_curvature_per_mm ((S,) float64): Largest curvature of the body.
        state ((S,) int64): State of the tree before the last change in place.
        settings ((S, 3) float64): Twist and bend in rad after it, and 1 if it goes by the straight section,
            else 0.
        lps_from_entry: (4, 4) float64.
        passages: Where the scope passes along the axis, and why it does not get farther.
    """

    tips: Float
    tree_point: Int
    turned: Bool
    room_mm: Float
    max_curvature_per_mm: Float
    state: Int
    settings: Float
    lps_from_entry: Float
    states: StateTree
    bending_length_mm: float
    passages: Passages

    @property
    def count(self) -> int:
        """Number of tips, S."""
        return len(self.tips)

    def motion(self, tip: int) -> ScopeMotion:
        """Return the motion to a tip."""
        tree = self.states
        chain = [int(self.state[tip])]
        while tree.parent[chain[-1]] >= 0:
            chain.append(int(tree.parent[chain[-1]]))
        rows: list[State] = [(0.0, 0.0, 0.0)]
        for node in chain[-2::-1]:
            twist, bend = tree.states[node, kernel.TWIST], tree.states[node, kernel.BEND]
            turn(rows, float(twist), float(bend), bool(tree.by_straight[node]))
            slide(rows, float(tree.advance_mm[node]))
        twist, bend, straight = self.settings[tip].tolist()
        turn(rows, twist, bend, straight > 0.0)
        return ScopeMotion(
            lps_from_entry=self.lps_from_entry,
            states=np.array(rows),
            bending_length_mm=self.bending_length_mm,
        )

    def tip(self, tip: int) -> ScopeTip:
        """Return a tip with its motion."""
        point, forward, sideways = np.split(self.tips[tip], 3)
        return ScopeTip(
            motion=self.motion(tip),
            lps_from_scope_tip=frames.pose(point, forward, sideways),
            tree_point=int(self.tree_point[tip]),
        )

    def nearest(self, point_lps: ArrayLike, forward: ArrayLike) -> int:
        """Return the tip nearest to a pose; 10 degrees count as much as 1 mm.

        Raises AnatomyError if there is no tip.
        """
        if not self.count:
            raise AnatomyError(
                "No motion brings this bronchoscope to a place from which tubes leave the airway",
                expected="at least one scope tip",
                remedy="Use a thinner bronchoscope, or one whose bending section bends more tightly",
            )
        away = np.linalg.norm(self.tips[:, :3] - np.asarray(point_lps, dtype=np.float64), axis=1)
        direction = np.asarray(forward, dtype=np.float64)
        angle = np.arccos(np.clip(self.tips[:, 3:6] @ (direction / np.linalg.norm(direction)), -1.0, 1.0))
        return int(np.argmin(np.hypot(away, angle / math.radians(10.0))))


def find_motions(
    lung: Lung,
    scope: Bronchoscope,
    *,
    reach_mm: float,
    max_curvature_per_mm: float = math.inf,
    tip_bends_rad: tuple[float, float] | None = None,
    spacing_mm: float = 1.0,
) -> ScopeMotions:
    """Find scope tips from which tubes can leave the airway at most `reach_mm` ahead, with proved motions.

    The tubes in the channel stand `max_curvature_per_mm` of the body; `tip_bends_rad` are the bends farthest
    down and up of the section at the tip, by default those of the scope, where tubes take some of them.  Tips
    along a branch are `spacing_mm` apart; those turned aside are twice as far apart.
    """
    passages = find_passages(lung, scope, reach_mm=reach_mm)
    tree, walls, device = lung.tree, walls_of(lung), kernel_device(scope, max_curvature_per_mm)
    # Points are tried that are wide enough on the way to them; beside the axis the lumen may be wider by so
    # much than on it, half a voxel or more.
    tried = tree.radius_mm >= device.radius - 0.5
    for point in range(1, tree.n_points):
        tried[point] &= tried[tree.parent_point[point]]
    states = Growth(walls, tree, tried, passages.passable, device).grow()
    least, most = tip_bends_rad or scope.bends_rad
    device = device._replace(least_bend=least, most_bend=most)
    tips, tree_point, ahead = _find_tips(
        walls, tree, passages.exits_ahead, states, device, max_curvature_per_mm, spacing_mm
    )
    kept, number = states.only(tips[:, turning.SOURCE].astype(np.int64))
    entry = np.eye(4)
    if len(states.states):
        entry[:3] = states.states[0, : kernel.U].reshape(4, 3).T
    return ScopeMotions(
        tips=tips[:, :9],
        tree_point=tree_point,
        turned=np.arange(len(tips)) >= ahead,
        room_mm=tips[:, turning.TIP_ROOM],
        max_curvature_per_mm=tips[:, turning.TIP_CURVATURE],
        state=number,
        settings=tips[:, turning.TWIST_TO : turning.BY_STRAIGHT + 1],
        lps_from_entry=entry,
        states=kept,
        bending_length_mm=device.length,
        passages=passages,
    )


TURN_SPOKES = 12
KINDS = (math.floor(MAX_TURN_AT_TIP_RAD / turning.POLAR_RAD + 0.5) + 1) * turning.AZIMUTHS * turning.SIDES
"""Kinds of tips at a place, by angle from the axis, direction and side."""
ROUNDING = 1e-9
"""Tips keep the limits of their region by this much, so that who computes them otherwise agrees."""


def _find_tips(
    walls: Walls,
    tree: AirwayTree,
    wanted: Bool,
    states: StateTree,
    device: Device,
    max_curvature_per_mm: float,
    spacing_mm: float,
) -> tuple[Float, Int, int]:
    """Return tips that are proved reachable in place from states, their tree points, and how many look ahead.

    The tips `(S, 15)`, see `stages.scope.kernels.turning`, are at the tree points `(N,)` where they are
    wanted; those that look ahead on the axis come first.
    """
    places, ahead, count = _places(tree, wanted, spacing_mm)
    from_states = states.states[states.turned_from]
    # Curvatures beside that of a state: they turn the tip of a section of 15 mm by 3 to 50 degrees.
    offsets = rings((0.004, 0.008, 0.014, 0.022, 0.032, 0.045, 0.06), TURN_SPOKES)[1:]
    best = np.full((count, turning.TRIES), -1, dtype=np.int64)
    costs = np.full((count, turning.TRIES), np.inf)
    turning.sort_tips(device, max_curvature_per_mm, from_states, offsets, places, best, costs)
    some = np.flatnonzero(best[:, 0] >= 0)
    tips, near = np.zeros((len(some), turning.TIP_COLUMNS)), np.zeros(len(some), dtype=np.int64)
    turning.first_free(
        walls, device, max_curvature_per_mm, from_states, offsets, best[some], tips, near, places
    )
    kept = near >= 0
    tips[:, turning.SOURCE] = states.turned_from[tips[:, turning.SOURCE].astype(np.int64)]
    return tips[kept], near[kept], int((some[kept] < ahead).sum())


def _places(tree: AirwayTree, wanted: Bool, spacing_mm: float) -> tuple[Places, int, int]:
    """Return where tips may be, how many groups there are of tips that look ahead, and how many in all."""
    ahead = _slots(tree, spacing_mm)
    # Turned tips are so much farther apart: a place has many directions, nearer ones give about the same.
    aside = _slots(tree, 2.0 * spacing_mm)
    groups = int(ahead.max()) + 1
    first = np.cross(tree.tangents, np.eye(3)[np.argmin(np.abs(tree.tangents), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    low, size = tree.points_lps.min(axis=0), MAX_OFF_AXIS_MM * (1.0 - ROUNDING)
    begins, order = _cells(np.floor((tree.points_lps - low) / size).astype(np.int64))
    places = Places(
        points=tree.points_lps,
        tangents=tree.tangents,
        first=first,
        second=np.cross(tree.tangents, first),
        wanted=wanted,
        slots=np.stack([ahead, groups + KINDS * aside]),
        low=low,
        begins=begins,
        order=order,
        off_axis_mm=size,
        least_cosine=math.cos(MAX_TURN_AT_TIP_RAD) + ROUNDING,
    )
    return places, groups, groups + KINDS * (int(aside.max()) + 1)


def _cells(cell: Int) -> tuple[Int, Int]:
    """Return where the points of a cell begin, for one cell more a row, and the points sorted by cells."""
    shape = cell.max(axis=0) + 1
    number = np.ravel_multi_index((cell[:, 0], cell[:, 1], cell[:, 2]), shape)
    order = np.argsort(number, kind="stable")
    bounds = np.searchsorted(number[order], np.arange(shape.prod() + 1))
    begins, ends = bounds[:-1].reshape(shape), bounds[1:].reshape(shape)
    return np.ascontiguousarray(np.concatenate([begins, ends[:, :, -1:]], axis=2)), order


def _slots(tree: AirwayTree, spacing_mm: float) -> Int:
    """Return for each tree point the number of its stretch `spacing_mm` long, counted along the branches."""
    along = np.floor(tree.distance_from_root_mm / spacing_mm).astype(np.int64)
    pairs = np.stack([tree.branch_of_point, along], axis=1)
    return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)
