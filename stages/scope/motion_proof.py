"""The proof of one motion of a bronchoscope: limits, room in and between states; and proved tips along it."""

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.fields import corner_geometry
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.morphology import bounds, window
from anatomy.structures import LUMEN, OUTSIDE
from stages.scope.device import SHORTEST_MM, Bronchoscope
from stages.scope.kernels.body import MOST_TWIST_RAD, Walls, motion_room
from stages.scope.kernels.growth import Device
from stages.scope.kernels.turning import shifted_tips, step_tolerances
from stages.scope.motion import ADVANCE, BEND, TWIST, ScopeMotion, frame_columns
from stages.scope.simplifying import Simplifier

PROOF_STEP_MM = 0.1
"""Longest step of the proof along the body; at most half of it is lost, far less than a voxel."""
PROOF_TURN_MM = 0.2
"""A change in place is cut until the tip moves by less than this from piece to piece; a quarter is lost."""
SIMPLER_ROOM_MM, KEPT_ROOM = 0.1, 0.5
"""A simpler motion keeps at least so much room, or this share of that of the given one if that is less."""
ROUNDING = 1e-9
"""Limits are kept up to this share of them: states were computed with rounding."""


_PROVERS: "WeakKeyDictionary[Lung, dict[Bronchoscope, MotionProver]]" = WeakKeyDictionary()
"""The provers of each lung: to make one takes a fraction of a second, to prove a motion milliseconds."""


def prover_of(lung: Lung, scope: Bronchoscope) -> "MotionProver":
    """Return the prover of a scope's motions in a lung, made once."""
    provers = _PROVERS.setdefault(lung, {})
    if scope not in provers:
        provers[scope] = MotionProver(lung, scope)
    return provers[scope]


def prove_motion(lung: Lung, scope: Bronchoscope, motion: ScopeMotion) -> float | str:
    """Prove one motion; see `MotionProver.prove`."""
    return prover_of(lung, scope).prove(motion)


class MotionProver:
    """Proves motions of a scope in a lung."""

    def __init__(self, lung: Lung, scope: Bronchoscope) -> None:
        self._scope, self._walls = scope, walls_of(lung)
        self._device, self._tree = kernel_device(scope, math.inf), lung.tree

    def prove(
        self, motion: ScopeMotion, *, turn_mm: float = PROOF_TURN_MM, step_mm: float = PROOF_STEP_MM
    ) -> float | str:
        """Prove a motion: return its margin in mm, or say in words why there is no proof.

        The margin is a lower bound on the distance between the scope's surface and the wall of the lumen,
        beyond the gap that the scope keeps, over all places of the body during the whole motion.  Near the
        wall the bound is about 0.1 mm too low at most.  Longer parts of changes in place, `turn_mm`, and
        longer steps along the body, `step_mm`, prove less.
        """
        wrong = _broken_limit(self._scope, motion)
        if wrong:
            return wrong
        device, entry = self._device, frame_columns(motion.lps_from_entry)
        where = np.zeros(1, dtype=np.int64)
        room = motion_room(
            self._walls, device.radius, device.length, entry, motion.states, turn_mm, step_mm, where
        )
        if room < 0.0:
            return f"the scope is not proved to be free of the wall from state {int(where[0])} on"
        return float(room)

    def tolerances(self, motion: ScopeMotion) -> Float:
        """Return by how much advance in mm, twist and bend in rad may err in each step, `(M - 1, 3)`.

        If one of the three errs by no more than this anywhere in a step of a proved motion, and all else is
        as stated, the scope with its gap stays in the lumen during it.  Larger values may be possible,
        smaller ones are.
        """
        out = np.zeros((len(motion.states) - 1, 3))
        device, entry = self._device, frame_columns(motion.lps_from_entry)
        step_tolerances(self._walls, device.radius, device.length, entry, motion.states, PROOF_TURN_MM, out)
        return out

    def simplest(
        self, motion: ScopeMotion, *, max_curvature_per_mm: float, end_bends_rad: tuple[float, float]
    ) -> ScopeMotion:
        """Return a proved motion of fewer changes and twists to the same tip, the given one if none is found.

        The tubes in the channel stand `max_curvature_per_mm` of the body; `end_bends_rad` are the bends
        farthest down and up of the section at the tip, where tubes in it take some.
        """
        room = self.prove(motion)
        if isinstance(room, str):
            return motion
        device = kernel_device(self._scope, max_curvature_per_mm)
        tightest = max_curvature_per_mm * device.length
        ends = max(end_bends_rad[0], -tightest), min(end_bends_rad[1], tightest)
        least = min(KEPT_ROOM * room, SIMPLER_ROOM_MM)
        found = Simplifier(self._walls, device, motion, ends, least).best()
        return motion if isinstance(self.prove(found), str) else found

    def row(self, motion: ScopeMotion, shifts_mm: ArrayLike) -> "TipRow":
        """Return tips along a proved motion to one of them, and which of them may be tips of a plan.

        Those have a proved motion and lie in the region of scope tips, as all tips of `find_motions` do.  The
        base stops farther by shifts `(K,)` mm, see `shifted`.
        """
        shifts = np.ascontiguousarray(np.atleast_1d(np.asarray(shifts_mm, dtype=np.float64)))
        tips, rooms = np.zeros((len(shifts), 9)), np.zeros(len(shifts))
        entry = frame_columns(motion.lps_from_entry)
        shifted_tips(self._walls, self._device, entry, motion.states, shifts, tips, rooms)
        proved = (rooms >= 0.0) & in_tip_region(self._tree, tips)[1]
        return TipRow(motion=motion, shifts_mm=shifts, tips=tips, proved=proved | (shifts == 0.0))


def _broken_limit(scope: Bronchoscope, motion: ScopeMotion) -> str:
    """Say which limit of the device a motion breaks, "" if none."""
    states = motion.states
    if not np.isfinite(states).all() or not np.isfinite(motion.lps_from_entry).all():
        return "a state is not finite"
    if abs(motion.bending_length_mm - scope.bending_length_mm) > ROUNDING:
        return f"the bending section is {motion.bending_length_mm:g} mm long, not {scope.bending_length_mm:g}"
    advance = np.diff(states[:, ADVANCE])
    turned = (np.diff(states[:, 1:], axis=0) != 0.0).any(axis=1)
    if (advance < 0.0).any():
        return "the scope is pulled back"
    if ((advance > SHORTEST_MM) & turned).any():
        return "the scope advances and turns at once"
    twist = float(np.abs(states[:, TWIST]).max())
    if twist > MOST_TWIST_RAD * (1.0 + ROUNDING):
        return f"the scope is twisted by {math.degrees(twist):.1f} degrees, more than half a turn"
    least, most = scope.bends_rad
    bends, slack = states[:, BEND], 1.0 + ROUNDING
    if bends.min() < least * slack or bends.max() > most * slack:
        worst = bends[np.argmax(np.maximum(least - bends, bends - most))]
        return (
            f"the section bends by {math.degrees(worst):.1f} degrees, not between "
            f"{math.degrees(least):.1f} and {math.degrees(most):.1f}"
        )
    laid = np.abs(bends[:-1][advance > SHORTEST_MM]) / scope.bending_length_mm
    if laid.max(initial=0.0) > scope.laying_curvature_per_mm * slack:
        return f"the shaft lies in an arc of {1.0 / laid.max():.1f} mm radius, too tight for it"
    return ""


MAX_OFF_AXIS_MM = 3.0
"""A tip lies at most so far from the nearest point of the tree.

That holds the whole cross-section which thin scopes leave free in bronchi of 10 mm, beyond which tubes leave.
"""
MAX_TURN_AT_TIP_RAD = math.radians(45.0)
"""A tip looks along the airway, within this angle of its direction: more means sideways."""


def in_tip_region(tree: AirwayTree, tips: Float) -> tuple[Int, Bool]:
    """Return the nearest tree point of tips `(S, >= 6)`, and whether each lies in the region of tips, `(S,)`.

    A tip is a point and a unit direction, LPS mm.  Proofs that a target is unreachable rule out all of this
    region, so every tip of a motion lies in it.
    """
    distance_mm, nearest = tree.nearest_point_index.query(tips[:, :3])
    cosine = np.einsum("sk,sk->s", tips[:, 3:6], tree.tangents[nearest])
    inside = (distance_mm <= MAX_OFF_AXIS_MM) & (cosine >= math.cos(MAX_TURN_AT_TIP_RAD))
    return np.asarray(nearest, dtype=np.int64), np.asarray(inside)


_WALLS: WeakKeyDictionary[Lung, Walls] = WeakKeyDictionary()
"""The walls of each lung: to make them takes as long as to prove a hundred motions."""


def walls_of(lung: Lung) -> Walls:
    """Return the walls around the lumen of a lung, made once."""
    if lung not in _WALLS:
        inside = (lung.labels & LUMEN) != 0
        low, high = bounds(inside, 1)
        solid = np.where(inside[window(low, high)], np.uint16(0), np.uint16(OUTSIDE))
        _WALLS[lung] = Walls(
            solid=read_only(np.asfortranarray(solid)),
            geometry=corner_geometry(lung.grid.crop(low, high)),
            depth=lung.lumen_depth.corners,
            depth_geometry=lung.lumen_depth.geometry,
        )
    return _WALLS[lung]


def kernel_device(scope: Bronchoscope, max_curvature_per_mm: float) -> Device:
    """Return a scope whose body may have a largest curvature that the tubes in its channel can stand."""
    least, most = scope.bends_rad
    return Device(
        radius=scope.radius_mm + scope.lumen_margin_mm,
        length=scope.bending_length_mm,
        laying=min(scope.laying_curvature_per_mm, max_curvature_per_mm),
        least_bend=least,
        most_bend=most,
    )


@frozen_record
class TipRow:
    """Tips in a row along the motion to one of them; K tips.

    Args:
        motion: That of the tip at shift 0.
        shifts_mm ((K,) float64): How much farther the bending section's base stops, negative for less far.
        tips ((K, 9) float64): Point, direction, and +x of the working channel's frame, LPS mm.
        proved ((K,) bool): Whether the motion to the tip is proved, and the tip where tips of plans may be.
    """

    motion: ScopeMotion
    shifts_mm: Float
    tips: Float
    proved: Bool

    def motion_to(self, index: int) -> ScopeMotion:
        """Return the motion to a tip."""
        return shifted(self.motion, float(self.shifts_mm[index]))


def shifted(motion: ScopeMotion, shift_mm: float) -> ScopeMotion:
    """Return a motion whose base stops `shift_mm` farther, its section turned alike; nothing is proved."""
    states = motion.states
    stop = float(states[-1, ADVANCE]) + shift_mm
    slides = np.flatnonzero(np.diff(states[:, ADVANCE]) > SHORTEST_MM)
    held = slides[states[slides, ADVANCE] <= stop]
    if shift_mm == 0.0 or not len(held):
        return motion
    rows = [tuple(row) for row in states[: held[-1] + 1].tolist()]
    slide(rows, stop)
    _, twist, bend = rows[-1]
    to_twist, to_bend = states[-1, 1:].tolist()
    direct = math.hypot(to_bend - bend, max(abs(bend), abs(to_bend)) * (to_twist - twist))
    turn(rows, to_twist, to_bend, direct > abs(bend) + abs(to_bend))
    return replace(motion, states=np.array(rows))


def evenly(step_mm: float, reach_mm: float) -> Float:
    """Return shifts `(K,)` a step apart as far as `reach_mm` each way, 0 in the middle."""
    count = round(reach_mm / step_mm)
    return step_mm * np.arange(-count, count + 1, dtype=np.float64)


State = tuple[float, ...]
"""Advance in mm, twist and bend in rad."""


def turn(rows: list[State], twist: float, bend: float, by_straight: bool) -> None:
    """Add a change in place, which may go by the straight section: twisting that moves nothing."""
    advance, twist_before, bend_before = rows[-1]
    if (twist, bend) == (twist_before, bend_before):
        return
    if by_straight and bend_before != 0.0:
        rows.append((advance, twist_before, 0.0))
    if by_straight and twist != twist_before and bend != 0.0:
        rows.append((advance, twist, 0.0))
    rows.append((advance, twist, bend))


def slide(rows: list[State], advance_mm: float) -> None:
    """Add an advance with twist and bend held; one that goes on with the advance before replaces its end."""
    if advance_mm <= rows[-1][0]:
        return
    _, twist, bend = rows[-1]
    if len(rows) > 1 and rows[-2][1:] == (twist, bend):
        rows.pop()
    rows.append((advance_mm, twist, bend))
