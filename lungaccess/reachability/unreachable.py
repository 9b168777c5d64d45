"""Proof that no deployment of a system has a target in its needle's workspace; see docs/unreachable.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.errors import TargetError
from anatomy.fields import distance_corners
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.structures import BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from anatomy.typed import Float, Int32, Mask
from lungaccess.problem.system import System
from lungaccess.reachability.kernels.deployment_boxes import BOX_COLUMNS, FIRST_KNOT, LAST_KNOT
from lungaccess.reachability.kernels.unreachable import (
    INSERTION_STEP_MM,
    ROOM,
    RULED_OUT,
    greatest_insertions,
    rule_out,
)
from stages.needle import needle_environment
from stages.scope import LEAVING_MM, MAX_TURN_AT_TIP_RAD, find_sites
from stages.tube import tube_constants
from stages.tube.kernels import MAX_EXTENSION

KNOT_MM = 0.5
"""Greatest distance of knots on the medial axis."""
KNOTS_A_PIECE = 16
INSERTION_SPACING_MM = 0.02
MOST_BOXES = 3_000_000
"""To look at for one piece of the airway."""
SPARE_RAD = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachVerdict:
    """Whether a target is proved unreachable.

    Parameters
    ----------
    proved : bool
        If not, nothing is known.
    boxes : int
        Boxes of deployments that were looked at.
    open_lps : (3,) float64 or None
        A place of the scope tip, LPS mm, from which the first deployments start that could not be ruled out.
    """

    proved: bool
    boxes: int
    open_lps: Float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Piece:
    """A piece of the medial axis where the scope tip may be; see the kernel `unreachable`."""

    knots: Float
    cones: Float
    frame: Float
    wide: float


class UnreachableProof:
    """Tries to prove targets of one patient unreachable for one system.

    Parameters
    ----------
    lung : Lung
    system : System
    with_fissures : bool
        Whether fissures are obstacles.

    Notes
    -----
    What is ruled out is every place of the scope tip on the medial axis to which the scope fits, every
    direction that a tip can have there, and every rotation and insertion of the tubes, such that the tubes
    leave an airway outside the mediastinum, keep clear of vessels and pleura from there on, and sweep little,
    and a needle from their tip reaches the target.  That needle heeds no obstacle, but its tip and the
    target must lie in the same free region.
    """

    def __init__(self, lung: Lung, system: System, *, with_fissures: bool) -> None:
        self._lung = lung
        self._tubes = tube_constants(system.tubes, system.margins)
        self._limits = needle_environment(
            lung, system.needle, system.margins, with_fissures=with_fissures
        ).limits
        longest = float(self._tubes[MAX_EXTENSION])
        self._insertions = np.zeros(int(longest / INSERTION_STEP_MM) + 1)
        greatest_insertions(self._tubes, longest, INSERTION_SPACING_MM, self._insertions)
        spacing_mm = lung.grid.spacing_mm
        hazards = VESSEL | OUTSIDE | (FISSURE if with_fissures else 0)
        self._hazard_bits = hazards
        leaving = _may_be_left(lung)
        self._masks = tuple(
            distance_corners(mask, spacing_mm)
            for mask in ((lung.labels & LUMEN) != 0, leaving, (lung.labels & hazards) != 0)
        )
        # Corners are rounded down, and between them a bound lacks at most half a diagonal of a voxel.
        self._loss_mm = 0.5 * float(np.linalg.norm(spacing_mm)) + 1.0 / UNITS_PER_MM
        self._free = _free_regions(lung, self._limits.required_mm, self._loss_mm, with_fissures)
        reach_mm = float(self._insertions.max())
        self._pieces = list(_pieces(lung, system, leaving, reach_mm))

    def prove(
        self,
        target_lps: Float,
        *,
        most_boxes: int = MOST_BOXES,
        progress: Callable[[float], None] | None = None,
    ) -> ReachVerdict:
        """Try to prove that no deployment has the target in its workspace.

        Parameters
        ----------
        target_lps : (3,) float64
            LPS mm.
        most_boxes : int
            To look at for one piece of the airway before it is given up.
        progress : callable, optional
            Told the share of the pieces that is done.

        Returns
        -------
        ReachVerdict
            It ends with the first piece that cannot be ruled out.

        Raises
        ------
        TargetError
            If the target is not a finite point of the image.
        """
        target = np.asarray(target_lps, dtype=np.float64)
        scene = self._scene(target)
        boxes = np.zeros((ROOM, BOX_COLUMNS))
        looked_at = 0
        order = np.argsort([np.linalg.norm(piece.knots[0] - target) for piece in self._pieces], kind="stable")
        for done, n in enumerate(order):
            piece = self._pieces[n]
            outcome, looked = rule_out(
                scene, self._tubes, self._insertions, self._limits, target,
                piece.frame, piece.knots, piece.cones, piece.wide, most_boxes, boxes,
            )  # fmt: skip
            looked_at += looked
            if outcome != RULED_OUT:
                middle = int(0.5 * (boxes[0, FIRST_KNOT] + boxes[0, LAST_KNOT]))
                return ReachVerdict(proved=False, boxes=looked_at, open_lps=piece.knots[middle])
            if progress is not None:
                progress((done + 1) / len(order))
        return ReachVerdict(proved=True, boxes=looked_at)

    def _scene(self, target: Float) -> tuple[object, ...]:
        lung = self._lung
        if not np.isfinite(target).all() or not lung.grid.contains(target):
            raise TargetError(
                f"The target {np.round(target, 1).tolist()} (LPS mm) is not in the image",
                expected="a point of the image",
                remedy="Check the frame of the point",
            )
        lumen, leaving, hazards = self._masks
        depth = lung.lumen_depth
        near = _near(lung, target, self._limits.goal_tolerance_mm + self._loss_mm)
        regions = np.unique(self._free[near])
        passable = np.isin(self._free, regions[regions > 0])
        return (
            lumen,
            leaving,
            hazards,
            depth.corners,
            distance_corners(passable, lung.grid.spacing_mm),
            lung.labels,
            lung.geometry,
            depth.geometry,
            self._hazard_bits,
            self._loss_mm,
        )


def _may_be_left(lung: Lung) -> Mask:
    """Return the lumen of the airways that tubes may leave."""
    branch = (lung.labels >> BRANCH_SHIFT).astype(np.int64) - 1
    inside = ((lung.labels & LUMEN) != 0) & (branch >= 0)
    return np.asarray(inside & ~lung.tree.mediastinal[np.maximum(branch, 0)])


def _free_regions(lung: Lung, required_mm: float, loss_mm: float, with_fissures: bool) -> Int32:
    """Return the number of the region, joined by faces, edges and corners, where a needle may be; 0 for none.

    A voxel is left out only if the clearance is less than required everywhere in it.
    """
    from scipy import ndimage

    corners = lung.obstacle_field(with_fissures=with_fissures).corners
    greatest = ndimage.maximum_filter(corners, size=2, origin=-1)[:-1, :-1, :-1]
    bits = obstacle_bits(with_fissures)
    free = (greatest / UNITS_PER_MM + loss_mm >= required_mm) & ((lung.labels & bits) == 0)
    labels, _ = ndimage.label(free, structure=np.ones((3, 3, 3)))
    return np.asarray(labels, dtype=np.int32)


def _near(lung: Lung, target: Float, distance_mm: float) -> tuple[slice, ...]:
    """Return the window of voxels that may hold a point so near to the target."""
    at = lung.grid.ijk(target)
    reach = distance_mm / lung.grid.spacing_mm + 1.0
    low = np.maximum(np.floor(at - reach).astype(int), 0)
    high = np.ceil(at + reach).astype(int) + 1
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))


def _pieces(lung: Lung, system: System, leaving: Mask, reach_mm: float) -> Iterator[_Piece]:
    """Yield the pieces of the medial axis to which the scope fits and from which an exit is within reach."""
    from scipy.spatial import cKDTree

    tree = lung.tree
    exits = np.argwhere(leaving)
    if not len(exits):
        return
    nearest = cKDTree(lung.grid.lps(exits))
    reach_mm += float(np.linalg.norm(lung.grid.spacing_mm))
    passable = find_sites(lung, system.scope, reach_mm=reach_mm).passable
    knots: list[Float] = []
    cones: list[Float] = []
    last = -1
    for point in np.flatnonzero(passable & (tree.parent_point >= 0)):
        parent = int(tree.parent_point[point])
        if last != parent:
            yield from _finished(knots, cones, nearest, reach_mm)
            knots, cones = [tree.points_lps[parent]], []
        begin, end = tree.points_lps[parent], tree.points_lps[point]
        count = max(1, math.ceil(float(np.linalg.norm(end - begin)) / KNOT_MM))
        for m in range(count):
            if len(cones) == KNOTS_A_PIECE:
                yield from _finished(knots, cones, nearest, reach_mm)
                knots, cones = [knots[-1]], []
            shares = np.array([m / count, (m + 1) / count])
            cones.append(_cone(tree, int(point), shares))
            knots.append(begin + shares[1] * (end - begin))
        last = int(point)
    yield from _finished(knots, cones, nearest, reach_mm)


def _finished(knots: list[Float], cones: list[Float], nearest: object, reach_mm: float) -> Iterator[_Piece]:
    if not cones or nearest.query(np.array(knots))[0].min() > reach_mm:  # type: ignore[attr-defined]
        return
    table = np.array(cones)
    axis = table[:, :3].sum(axis=0)
    axis /= np.linalg.norm(axis)
    frame = frames.pose(knots[0], axis)[:3, :3].T
    from_axis = np.arccos(np.clip(table[:, :3] @ axis, -1.0, 1.0))
    wide = float((from_axis + table[:, 3]).max()) + SPARE_RAD
    yield _Piece(knots=np.array(knots), cones=table, frame=np.ascontiguousarray(frame), wide=wide)


def _cone(tree: AirwayTree, point: int, shares: Float) -> Float:
    """Return the mean direction of tips on a part of the edge to a tree point, and the angle around it.

    A tip looks along the medial axis, or is turned from the chord between where the scope leaves the axis
    and its place; see `stages.scope.tips`.
    """
    parent = int(tree.parent_point[point])
    begin, end = tree.points_lps[parent], tree.points_lps[point]
    inserted_mm = tree.distance_from_root_mm
    tips_mm = inserted_mm[parent] + shares * (inserted_mm[point] - inserted_mm[parent])
    places = [begin + share * (end - begin) for share in shares]
    tangents = [(1.0 - share) * tree.tangents[parent] + share * tree.tangents[point] for share in shares]
    chords: list[Float] = []
    left = point
    while inserted_mm[left] > tips_mm[1] - LEAVING_MM and tree.parent_point[left] >= 0:
        left = int(tree.parent_point[left])
    while True:
        chords += [place - tree.points_lps[left] for place in places]
        if inserted_mm[left] <= tips_mm[0] - LEAVING_MM or tree.parent_point[left] < 0:
            break
        left = int(tree.parent_point[left])
    seen = np.array([_unit(chord if np.any(chord) else tree.tangents[point]) for chord in chords])
    middle = _unit(seen.sum(axis=0))
    turned = MAX_TURN_AT_TIP_RAD + float(np.arccos(np.clip(seen @ middle, -1.0, 1.0)).max())
    straight = max(math.acos(min(max(float(_unit(t) @ middle), -1.0), 1.0)) for t in tangents)
    return np.append(middle, max(turned, straight) + SPARE_RAD)


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))
