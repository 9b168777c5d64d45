"""The motion of a bronchoscope: advance, twist and bend of its bending section, and the body that it leaves.

The bending section is an arc of one curvature, tangent to the shaft behind it; the shaft lies where the
section led it [Rosell2012, sec. IV-C, in the limit of many short links].  A motion is a row of states.  From
one state to the next the scope either advances with its twist and bend held, so that the section slides along
its own arc, or twists and bends in place, both at a steady rate.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import freeze_arrays, read_only
from anatomy.poses import poses_on_arc, poses_on_pieces
from stages.scope.device import laid_pieces

ADVANCE, TWIST, BEND = range(3)
"""Columns of a motion's states: advance in mm, twist and bend in rad."""


@frozen_record
class ScopeMotion:
    """How a bronchoscope gets from the trachea to where it stops; M states.

    Args:
        lps_from_entry ((4, 4) float64): Base of the bending section when the motion begins: +z forward, +x
            the way a positive bend turns the tip at twist 0.
        states ((M, 3) float64): Advance of that base in mm, which never falls, twist in rad about the scope's
            axis, and bend in rad, the angle of the whole section.  A twist turns the scope as a whole; its
            frame does not roll otherwise (it is a Bishop frame).
        bending_length_mm: Length of the bending section.
    """

    lps_from_entry: Float
    states: Float
    bending_length_mm: float

    def __post_init__(self) -> None:
        freeze_arrays(self, "lps_from_entry", "states", dtype=np.float64)

    @property
    def pieces(self) -> Float:
        """The last state's arcs, entry to tip, `(P, 3)`, as `anatomy.poses.poses_on_arc` takes them."""
        return laid_pieces(self.states, self.bending_length_mm)

    @property
    def length_mm(self) -> float:
        """Length of the body in the last state, from the entry to the tip."""
        return float(self.states[-1, ADVANCE] - self.states[0, ADVANCE]) + self.bending_length_mm

    def body(self, step_mm: float) -> Float:
        """Return frames `(N, 4, 4)` along the last state's body, `step_mm` apart; the channel's is last."""
        return poses_on_pieces(self.lps_from_entry, self.pieces, step_mm)[0]

    @property
    def lps_from_tip(self) -> Float:
        """Frame of the working channel at the tip `(4, 4)`, +z forward, +x as in `body`."""
        return np.asarray(self.body(np.inf)[-1])

    @property
    def max_curvature_per_mm(self) -> float:
        """Largest curvature of the body in the last state, which tubes in the channel pass."""
        return float(np.abs(self.pieces[:, 2]).max())

    @cached_property
    def tips(self) -> Float:
        """Frames of the tip in every state, `(M, 4, 4)`, +x as in `body`."""
        curvature = self.states[:, BEND] / self.bending_length_mm
        advanced = np.diff(self.states[:, ADVANCE], append=self.states[-1, ADVANCE])
        turned = np.diff(self.states[:, TWIST], prepend=0.0)
        base, tips = self.lps_from_entry, []
        for roll, bent, step in zip(turned, curvature, advanced, strict=True):
            base, tip = poses_on_arc(base, roll, bent, [step, self.bending_length_mm])
            tips.append(tip)
        return read_only(np.array(tips))

    def between(self, advance_mm: float, turn_rad: float) -> "ScopeMotion":
        """Return the same motion with states put between, at most so much advance and turn apart."""
        shares = np.abs(np.diff(self.states, axis=0)) / [advance_mm, turn_rad, turn_rad]
        states = [self.states[:1]]
        for before, after, most in zip(self.states[:-1], self.states[1:], shares.max(axis=1), strict=True):
            states.append(np.linspace(before, after, max(1, int(np.ceil(most - 1e-9))) + 1)[1:])
        return replace(self, states=np.concatenate(states))

    def written(self, decimals: int) -> "ScopeMotion":
        """Return the motion as read in mm and degrees of so many decimals; bends are cut off, not rounded."""
        scale = 10.0**decimals
        advance, (twist, bend) = self.states[:, ADVANCE], np.degrees(self.states[:, 1:]).T
        # A number that misses a whole one by less is whole: it went through radians.
        cut = np.sign(bend) * np.floor(np.abs(bend) * scale + 1e-6) / scale
        angles = np.radians(np.stack([np.round(twist, decimals), cut], axis=1))
        return replace(self, states=np.column_stack([np.round(advance, decimals), angles]))


def frame_columns(frame: Float) -> Float:
    """Return a frame as kernels take it, `(12,)`: the columns +x, +y, +z, and the point."""
    return np.concatenate([frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3]])
