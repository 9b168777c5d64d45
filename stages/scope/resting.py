"""The shaft of a bronchoscope at rest in the lumen: its shape, how it presses the wall, where its tip lies.

A motion lays the shaft where the section led it, free of the wall.  A real shaft is elastic: it leans on the
wall, and its tip lies and looks elsewhere.  Here the shaft takes the shape of least energy in the lumen, with
the section bent as commanded, and the hand advances until the tip has the planned depth.
"""

import math
from typing import Annotated
from weakref import WeakKeyDictionary

import numpy as np

from anatomy import poses as frames
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import quantity, settings, text
from anatomy.base.typed import Float, Mask
from anatomy.fields import corner_geometry, distance_corners
from anatomy.grid import Grid, read_only
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.morphology import bounds, window
from anatomy.structures import LUMEN
from stages.scope.device import Bronchoscope, laid_pieces
from stages.scope.kernels import resting as kernel
from stages.scope.kernels.resting import Lumen
from stages.scope.motion import BEND, TWIST, ScopeMotion, frame_columns

SECTION_STEP_MM = 1.0
"""Length of the arcs of the bending section, at most, which is bent more tightly."""
ENOUGH_N_MM = 1e-7
"""A step worth less energy is not taken: it would move a tip that hangs over by 50 mm by some micrometres."""
MOST_STEPS = 1000
"""Ten to sixty steps bring a shaft to rest, some hundreds one that begins deep in the wall."""
ROUNDS = 12
"""The tip comes to its depth, and friction to what the wall presses, in so many rounds at most."""
FARTHER_MM = 3.0
"""The hand advances by no more in a round."""
PRESSED_MM = 10.0
"""The force on the wall is stated as the largest on a stretch of this length, about that of one contact."""


@frozen_value
class Circumstances:
    """One choice of what is not known of a shaft at rest; the defaults are the nominal one.

    Args:
        stiffer, wall_stiffer: Factors of the bending stiffness of the scope and of the stiffness of the wall.
        friction: Coefficient of friction between shaft and wall.
        slid_rad: The way in which the shaft slid last, which friction resists: 0 is ahead, pi back, and pi /
            2 and -pi / 2 are about its axis, to either side.
    """

    stiffer: float = 1.0
    wall_stiffer: float = 1.0
    friction: float = 0.0
    slid_rad: float = 0.0


NOMINAL = Circumstances()
"""Scope and wall are as stiff as stated, and there is no friction."""


@frozen_record
class RestingShape:
    """A shaft at rest; N arcs.

    Args:
        lps_from_scope_tip ((4, 4) float64): Frame of the working channel, as in `ScopeMotion.lps_from_tip`.
        frames ((N + 1, 12) float64): Frames of the entry and of the ends of all arcs, as in
            `stages.scope.kernels.body`.
        lengths_mm: (N,) float64.
        curvature ((N, 2) float64): Of each arc in its Bishop frame, 1/mm.
        force_n, give_mm ((N,) float64): How the wall presses at the end of each arc, and how far it yields.
        farther_mm: How much farther than planned the shaft is advanced at the entry.
        settled: Whether it is at rest: no step lowers the energy any more, and the tip has its depth.
    """

    lps_from_scope_tip: Float
    frames: Float
    lengths_mm: Float
    curvature: Float
    force_n: Float
    give_mm: Float
    farther_mm: float
    energy_n_mm: float
    settled: bool

    @property
    def wall_force_n(self) -> float:
        """Largest force on `PRESSED_MM` of wall."""
        end = np.cumsum(self.lengths_mm)
        total = np.append(0.0, np.cumsum(self.force_n))
        # A piece that ends where the window begins does not count, whatever the rounding of its sum is.
        first = np.searchsorted(end, end - PRESSED_MM + 1e-6)
        return float((total[1:] - total[first]).max(initial=0.0))

    @property
    def most_give_mm(self) -> float:
        """How far the wall yields at most."""
        return float(self.give_mm.max(initial=0.0))

    @property
    def max_curvature_per_mm(self) -> float:
        """Largest curvature of the body, which tubes in the channel pass."""
        return float(np.linalg.norm(self.curvature, axis=1).max())


class RestingShaft:
    """Brings the shaft of a bronchoscope to rest in a lumen, see `lumen_of`."""

    def __init__(self, lumen: Lumen, scope: Bronchoscope, contact: "WallContact") -> None:
        self._lumen, self._scope, self._contact = lumen, scope, contact

    def rest(
        self,
        motion: ScopeMotion,
        chosen: Circumstances = NOMINAL,
        *,
        start: RestingShape | None = None,
        as_advanced: bool = False,
    ) -> RestingShape:
        """Return the shape of the shaft at rest in the last state of a motion.

        It begins from `start`, a shape of a motion of the same length, or as it was laid.  Unless it stays
        `as_advanced`, the hand advances more or less until the tip has the planned depth, which cameras and
        trackers show.
        """
        planned, entry = motion.lps_from_tip, frame_columns(motion.lps_from_entry)
        shaft, curvature = self._shaft(motion, chosen)
        farther = 0.0
        if start is not None:
            curvature, farther = start.curvature.copy(), start.farther_mm
        count = len(curvature)
        pull, laid = np.zeros((count, 3)), np.zeros((count + 1, 12))
        give, force = np.zeros(count), np.zeros((count, 3))
        before: tuple[float, float] | None = None
        tip, settled = planned[:3, 3], False
        if start is None and not as_advanced:
            farther = self._followed(motion, shaft, entry, curvature, pull, laid)
        for _ in range(ROUNDS):
            entry[9:] = motion.lps_from_entry[:3, 3] + farther * entry[6:9]
            drawn = _drawn_back(shaft, farther)
            energy, expected, _steps = kernel.bring_to_rest(
                self._lumen, drawn, entry, curvature, pull, laid, ENOUGH_N_MM, MOST_STEPS
            )
            kernel.press(self._lumen, drawn, laid, give, force)
            moved, tip = float(np.linalg.norm(laid[-1, 9:] - tip)), laid[-1, 9:].copy()
            beyond = 0.0 if as_advanced else float((tip - planned[:3, 3]) @ planned[:3, 2])
            # Friction has settled where a round moves the tip by less than this.
            still = not chosen.friction or moved < 0.05
            settled = expected <= ENOUGH_N_MM
            # The tip has its depth up to this, far less than anybody measures.
            if abs(beyond) < 0.02 and still:
                break
            if chosen.friction:
                # Against the way in which the shaft slid, in N.
                ahead, pressed = laid[1:, 6:9], np.linalg.norm(force, axis=1, keepdims=True)
                way = np.cos(chosen.slid_rad) * pressed * ahead
                pull = -chosen.friction * (way + np.sin(chosen.slid_rad) * np.cross(force, ahead))
            if not as_advanced:
                slope = 1.0
                if before is not None and abs(farther - before[0]) > 1e-6:
                    slope = min(max((beyond - before[1]) / (farther - before[0]), 0.3), 3.0)
                before = farther, beyond
                farther -= min(max(beyond / slope, -FARTHER_MM), FARTHER_MM)
        else:
            settled = False
        twist = float(motion.states[-1, TWIST])
        sideways = np.cos(twist) * laid[-1, :3] + np.sin(twist) * laid[-1, 3:6]
        return RestingShape(
            # The frame of the channel is the Bishop frame rolled by the twist.
            lps_from_scope_tip=frames.pose(laid[-1, 9:], laid[-1, 6:9], sideways),
            frames=read_only(laid),
            lengths_mm=read_only(shaft.length),
            curvature=read_only(curvature),
            force_n=read_only(np.linalg.norm(force, axis=1)),
            give_mm=read_only(give),
            farther_mm=float((laid[0, 9:] - motion.lps_from_entry[:3, 3]) @ laid[0, 6:9]),
            energy_n_mm=float(energy),
            settled=bool(settled),
        )

    def _followed(
        self,
        motion: ScopeMotion,
        shaft: kernel.Shaft,
        entry: Float,
        curvature: Float,
        pull: Float,
        laid: Float,
    ) -> float:
        """Return how far the hand follows until nothing holds the tip of a shaft that is too long as laid."""
        # The tip is held so stiffly at its depth while the shaft settles at first, lest it leaves its branch.
        held = shaft._replace(hold=1.0)
        farther, before, slope = 0.0, (0.0, 0.0), 0.0
        for count in range(ROUNDS):
            entry[9:] = motion.lps_from_entry[:3, 3] + farther * entry[6:9]
            drawn = _drawn_back(held, farther)
            # While the tip is held, a step is worth at least this.
            kernel.bring_to_rest(self._lumen, drawn, entry, curvature, pull, laid, 1e-4, MOST_STEPS)
            beyond = float((laid[-1, 9:] - held.tip) @ held.ahead)
            # The hand has followed where the tip moves the spring by less than this: a force of 0.01 N.
            if abs(beyond) < 0.01:
                break
            if count and abs(farther - before[0]) > 1e-6:
                slope = (beyond - before[1]) / (farther - before[0])
            before = farther, beyond
            step = beyond / slope if slope > 0.0 else math.copysign(1.0, beyond)
            farther -= min(max(step, -FARTHER_MM), FARTHER_MM)
        return farther

    def _shaft(self, motion: ScopeMotion, chosen: Circumstances) -> tuple[kernel.Shaft, Float]:
        """Return the shaft in the last state of a motion, and the curvature `(N, 2)` as it was laid."""
        section, head = motion.bending_length_mm, self._scope.rigid_head_mm
        behind = motion.length_mm - section
        # Length of the arcs of the shaft, at most: the wall is looked at where they end.
        parts = [(behind, 2.0), (section - head, SECTION_STEP_MM), (head, SECTION_STEP_MM)]
        counts = [int(np.ceil(length / step - 1e-9)) for length, step in parts]
        arcs = [np.full(n, size / max(n, 1)) for n, (size, _step) in zip(counts, parts, strict=True)]
        length = np.concatenate(arcs)
        laid = _laid(motion, length)
        stiffness = np.full(len(length), chosen.stiffer * self._scope.bending_stiffness_n_mm2)
        rest = np.zeros((len(length), 2))
        begin, end = len(arcs[0]), len(arcs[0]) + len(arcs[1])
        twist, bend = motion.states[-1, TWIST], motion.states[-1, BEND]
        rest[begin:end] = bend / (section - head) * np.array([np.cos(twist), np.sin(twist)])
        # The camera head is so many times as stiff as the section: it does not bend.
        stiffness[end:] *= 1e3
        laid[begin:] = rest[begin:]
        stiff = chosen.wall_stiffer * self._contact.wall_stiffness_n_per_mm2
        wall = stiff * 0.5 * (length + np.append(length[1:], 0.0))
        yields, radius = self._contact.max_wall_give_mm, self._scope.radius_mm
        ahead, tip = motion.lps_from_tip[:3, 2:].T.copy()
        return kernel.Shaft(length, stiffness, rest, wall, yields, radius, tip, ahead, 0.0), laid


def _drawn_back(shaft: kernel.Shaft, farther_mm: float) -> kernel.Shaft:
    """Return a shaft that touches no wall behind the planned entry, where the image may end."""
    return shaft._replace(wall=np.where(np.cumsum(shaft.length) + farther_mm < 0.0, 0.0, shaft.wall))


def _laid(motion: ScopeMotion, length: Float) -> Float:
    """Return the mean curvature `(N, 2)` of the laid body along arcs of some lengths."""
    pieces = laid_pieces(motion.states, motion.bending_length_mm)
    ends = np.append(0.0, np.cumsum(pieces[:, 0]))
    twist = np.cumsum(pieces[:, 1])
    turned = pieces[:, :1] * pieces[:, 2:] * np.column_stack([np.cos(twist), np.sin(twist)])
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
    at = np.append(0.0, np.cumsum(length))
    along = np.column_stack([np.interp(at, ends, total[:, axis]) for axis in range(2)])
    return np.asarray(np.diff(along, axis=0) / length[:, None])


_LUMENS: WeakKeyDictionary[Lung, Lumen] = WeakKeyDictionary()
"""The lumen of each lung: to measure it takes seconds, to bring a shaft to rest milliseconds."""


def lumen_of(lung: Lung) -> Lumen:
    """Return the signed depth of the lumen of a lung, made once."""
    if lung not in _LUMENS:
        _LUMENS[lung] = signed_depth((lung.labels & LUMEN) != 0, lung.grid)
    return _LUMENS[lung]


def signed_depth(inside: Mask, grid: Grid) -> Lumen:
    """Return the signed depth in a lumen `(ni, nj, nk)` bool: voxels are boxes, and the border is at 0."""
    # The wall is known so far outside the lumen: farther than any shaft reaches into it.
    wide = np.ceil(6.0 / grid.spacing_mm).astype(np.int64)
    low, high = bounds(inside)
    low, high = low - wide, high + wide
    first, last = np.maximum(low, 0), np.minimum(high, grid.shape)
    part = inside[window(first, last)]
    # An airway at the border of the image goes on beyond it, as the shaft does.
    part = np.pad(part, np.column_stack([first - low, high - last]), mode="edge")
    depth = distance_corners(~part, grid.spacing_mm).astype(np.float32)
    depth -= distance_corners(part, grid.spacing_mm)
    depth /= np.float32(UNITS_PER_MM)
    return Lumen(read_only(np.asfortranarray(depth)), corner_geometry(grid.crop(low, high)))


@settings
class WallContact:
    """How the wall yields, how the shaft slides on it, and what it may bear.

    `docs/explanation/resting_scope.md` says where the defaults come from.

    Args:
        wall_stiffness_n_per_mm2: Force on a mm of the shaft's length that presses the wall in by a mm.
            Mucosa of 0.02 to 0.28 MPa [Wang2011] yields by about as much as a bed of that modulus.
        wall_stiffness_range, scope_stiffness_range: Factors by which the stiffness of wall and scope may be
            less or more.
        max_friction: Largest coefficient of friction; the least is 0.
        max_wall_force_n: Largest force on 10 mm of wall.
        max_wall_give_mm: How far the wall may be pressed in; it is then twice as hard as at first, as soft
            tissue stiffens.
        source: Where the numbers come from; what nobody has published begins with "assumption".
    """

    wall_stiffness_n_per_mm2: Annotated[
        float, quantity("force on a mm of length that presses the wall in by a mm", above=0.0, at_most=100.0)
    ] = 0.1
    wall_stiffness_range: Annotated[
        float, quantity("factor by which the wall may be softer or stiffer", at_least=1.0, at_most=100.0)
    ] = 3.0
    scope_stiffness_range: Annotated[
        float, quantity("factor by which the scope may be softer or stiffer", at_least=1.0, at_most=100.0)
    ] = 2.0
    max_friction: Annotated[
        float, quantity("largest coefficient of friction on the wall", at_least=0.0, at_most=2.0)
    ] = 0.2
    max_wall_force_n: Annotated[
        float, quantity("largest force on 10 mm of wall", above=0.0, at_most=100.0)
    ] = 1.0
    max_wall_give_mm: Annotated[
        float, quantity("how far the wall may be pressed in", above=0.0, at_most=10.0)
    ] = 1.0
    source: Annotated[str, text("where the numbers come from, or a text that begins with 'assumption'")] = (
        "assumption"
    )
