"""All tips that a bronchoscope is brought to by proved motions: one tree of states for the whole airway."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.airway_tree import AirwayTree
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float, Int
from stages.scope.device import Bronchoscope
from stages.scope.growth import Growth, StateTree, rings
from stages.scope.kernels import growth as kernel
from stages.scope.kernels import turning
from stages.scope.lumen_walls import kernel_device, walls_of
from stages.scope.motion import ScopeMotion
from stages.scope.motion_steps import State, slide, turn
from stages.scope.passages import Passages, find_passages
from stages.scope.tip_region import in_tip_region

TURNED_SPACING_MM = 2.0
"""Spacing of turned tips: each place has many directions, and nearer ones give about the same poses."""
TURN_RINGS_PER_MM = (0.004, 0.008, 0.014, 0.022, 0.032, 0.045, 0.06)
"""Curvatures beside that of a state: they turn the tip of a section of 15 mm by 3 to 50 degrees."""
TURN_SPOKES = 12
POLAR_RAD = math.radians(15.0)
"""Turned tips are told apart by rings of so many degrees about the direction of the airway."""
AZIMUTHS = 8
SIDES = 3
"""And by whether they lie on the axis, or beside it before or behind the direction they are turned to."""
BESIDE_AXIS_MM = 0.5
"""The lumen may be wider by so much, half a voxel or more, beside the axis than on it."""
TRIES = 12
"""So many of a kind are tried before a kind is given up: most are refused for the same wall."""
OFF_AXIS_MM = 1.0
"""Nearer to the axis tips count as on it: about a voxel and a half."""


@frozen_record
class ScopeTip:
    """A pose of the scope's tip, and the motion that brings the device there.

    Parameters
    ----------
    lps_from_scope_tip : (4, 4) float64
        Frame of the working channel: +z is forward, rotations of the tubes count from +x.
    tree_point : int
        Nearest point of the airway tree.
    """

    motion: ScopeMotion
    lps_from_scope_tip: Float
    tree_point: int


@frozen_record
class ScopeMotions:
    """Tips of a scope in one airway, each with a proved motion to it; S tips, N states.

    Parameters
    ----------
    tips : (S, 9) float64
        Point, direction, and +x of the working channel's frame, LPS mm.
    tree_point : (S,) int64
        Nearest point of the airway tree.
    turned : (S,) bool
        Whether the tip is one of many directions at its place, or the one nearest to the axis and its
        direction.
    room_mm : (S,) float64
        A room between the scope with its gap and the wall that the proof of the motion found everywhere.
    max_curvature_per_mm : (S,) float64
        Largest curvature of the body.
    state : (S,) int64
        State of the tree before the last change in place.
    settings : (S, 3) float64
        Twist and bend in rad after it, and 1 if it goes by the straight section, else 0.
    lps_from_entry : (4, 4) float64
    states : StateTree
    bending_length_mm : float
    passages : Passages
        Where the scope passes along the axis, and why it does not get farther.
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

        Raises
        ------
        AnatomyError
            If there is no tip.
        """
        if not self.count:
            raise _no_tip()
        away = np.linalg.norm(self.tips[:, :3] - np.asarray(point_lps, dtype=np.float64), axis=1)
        direction = np.asarray(forward, dtype=np.float64)
        cosine = self.tips[:, 3:6] @ (direction / np.linalg.norm(direction))
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        return int(np.argmin(np.hypot(away, angle / MM_AS_ANGLE_RAD)))


MM_AS_ANGLE_RAD = math.radians(10.0)


def _no_tip() -> Exception:
    from anatomy.errors import AnatomyError

    return AnatomyError(
        "No motion brings this bronchoscope to a place from which tubes leave the airway",
        expected="at least one scope tip",
        remedy="Use a thinner bronchoscope, or one whose bending section bends more tightly",
    )


def find_motions(
    lung: Lung,
    scope: Bronchoscope,
    *,
    reach_mm: float,
    max_curvature_per_mm: float = math.inf,
    tip_bends_rad: tuple[float, float] | None = None,
    spacing_mm: float = 1.0,
) -> ScopeMotions:
    """Find scope tips from which tubes can leave the airway, each with a proved motion of the scope.

    Parameters
    ----------
    reach_mm : float
        How far ahead of the scope tip the airway may be left.
    max_curvature_per_mm : float
        Largest curvature of the body that the tubes in its channel can stand.
    tip_bends_rad : (float, float), optional
        Bends farthest down and up of the section at the tip, where tubes in it take some; those of the scope
        by default.
    spacing_mm : float
        Distance between tips along a branch.
    """
    passages = find_passages(lung, scope, reach_mm=reach_mm)
    walls, device = walls_of(lung), kernel_device(scope, max_curvature_per_mm)
    states = Growth(walls, lung.tree, _worth_a_try(lung.tree, device.radius), device).grow()
    found = _Tips(lung, passages, states, device, spacing_mm)
    least, most = tip_bends_rad or scope.bends_rad
    found.turn(device._replace(least_bend=least, most_bend=most), max_curvature_per_mm)
    kept, rooms = found.prove(walls)
    return found.motions(kept, rooms)


def _worth_a_try(tree: AirwayTree, radius_mm: float) -> Bool:
    """Tell which tree points are not too narrow on the way to them, nor would be a little beside the axis."""
    wide = tree.radius_mm >= radius_mm - BESIDE_AXIS_MM
    for point in range(1, tree.n_points):
        wide[point] &= wide[tree.parent_point[point]]
    return wide


class _Tips:
    """Candidates for tips, sorted by kind: the first free one of each kind is taken."""

    def __init__(
        self, lung: Lung, passages: Passages, states: StateTree, device: kernel.Device, spacing_mm: float
    ) -> None:
        self._tree, self._passages, self._states, self._device = lung.tree, passages, states, device
        self._spacing_mm = spacing_mm

    def turn(self, device: kernel.Device, max_curvature_per_mm: float) -> None:
        """Make the candidates."""
        tree, rows = self._tree, self._states.states[self._states.turned_from]
        offsets = rings(TURN_RINGS_PER_MM, TURN_SPOKES)[1:]
        out = np.zeros((len(rows), len(offsets), 11))
        turning.tips_beside(device, max_curvature_per_mm, rows, offsets, out)
        candidates = out.reshape(-1, 11)
        source = np.repeat(self._states.turned_from, len(offsets))
        possible = np.flatnonzero(np.isfinite(candidates[:, 9]))
        nearest, inside = in_tip_region(tree, candidates[possible])
        inside &= self._passages.exits_ahead[nearest]
        self._source, self._tips, self._near = (
            source[possible[inside]], candidates[possible[inside]], nearest[inside],
        )  # fmt: skip

    def _kinds(self) -> tuple[Int, Float]:
        """Return the kind of each candidate and what it costs within its kind."""
        tree, near, tips = self._tree, self._near, self._tips
        axis = tree.tangents[near]
        cosine = np.clip(np.einsum("sk,sk->s", tips[:, 3:6], axis), -1.0, 1.0)
        polar = np.arccos(cosine)
        helper = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
        first = np.cross(axis, helper)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(axis, first)
        turned_to = tips[:, 3:6] - cosine[:, None] * axis
        azimuth = np.arctan2(
            np.einsum("sk,sk->s", turned_to, second), np.einsum("sk,sk->s", turned_to, first)
        )
        away = tips[:, :3] - tree.points_lps[near]
        across = away - np.einsum("sk,sk->s", away, axis)[:, None] * axis
        off = np.linalg.norm(across, axis=1)
        ring = np.floor(polar / POLAR_RAD + 0.5).astype(np.int64)
        spoke = np.floor((azimuth / (2.0 * math.pi) + 0.5) * AZIMUTHS).astype(np.int64) % AZIMUTHS
        towards = np.einsum("sk,sk->s", across, turned_to)
        side = np.where(off <= OFF_AXIS_MM, 0, np.where(towards >= 0.0, 1, 2))
        kind = (np.where(ring == 0, 0, ring * AZIMUTHS + spoke)) * SIDES + side
        return kind, off**2 + (0.3 * np.abs(polar - ring * POLAR_RAD) / POLAR_RAD) ** 2

    def prove(self, walls: object) -> tuple[Int, Float]:
        """Return the candidates taken and their rooms."""
        tree, near = self._tree, self._near
        kind, cost = self._kinds()
        from_root = tree.distance_from_root_mm[near]
        branch = tree.branch_of_point[near]
        chosen, rooms = [], []
        for spacing, straight in (
            (self._spacing_mm, True),
            (max(self._spacing_mm, TURNED_SPACING_MM), False),
        ):
            slot = np.floor(from_root / spacing).astype(np.int64)
            rows = np.flatnonzero((kind == 0) == straight)
            order = rows[np.lexsort((rows, cost[rows], kind[rows], slot[rows], branch[rows]))]
            keys = np.stack([branch[order], slot[order], kind[order]], axis=1)
            new = np.ones(len(order), dtype=np.bool_)
            new[1:] = (keys[1:] != keys[:-1]).any(axis=1)
            groups = np.cumsum(new)
            kept, room = np.zeros(len(order), dtype=np.bool_), np.zeros(len(order))
            turning.first_free(
                walls, self._device, self._states.states[self._source[order]], self._tips[order], groups,
                TRIES, kept, room,
            )  # fmt: skip
            chosen.append(order[kept])
            rooms.append(room[kept])
        self._straight = len(chosen[0])
        return np.concatenate(chosen), np.concatenate(rooms)

    def motions(self, kept: Int, rooms: Float) -> ScopeMotions:
        """Return the record."""
        tips, source = self._tips[kept], self._source[kept]
        states, number = self._states.only(source)
        frames = turning.tip_frames(self._device.length, self._states.states[source], tips)
        entry = np.eye(4)
        if len(self._states.states):
            row = self._states.states[0]
            entry[:3] = row[: kernel.U].reshape(4, 3).T
        curvature = np.maximum(
            self._states.states[source, kernel.CURVATURE], np.hypot(tips[:, 6], tips[:, 7])
        )
        return ScopeMotions(
            tips=frames,
            tree_point=self._near[kept],
            turned=np.arange(len(kept)) >= self._straight,
            room_mm=rooms,
            max_curvature_per_mm=curvature,
            state=number,
            settings=tips[:, 8:11],
            lps_from_entry=entry,
            states=states,
            bending_length_mm=self._device.length,
            passages=self._passages,
        )
