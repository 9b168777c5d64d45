"""Own kinematics of the bronchoscope: products of exponentials of screws, one for every state of a motion.

The bending section is a screw: forward at unit speed, turning towards where twist and bend point.  The base
follows the section when the scope advances, and stays where it is when it twists or bends.
"""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int

TINY_MM = 1e-9
TINY_RAD = 1e-9
"""A smaller change between two states is rounding."""


@frozen_record
class Motion:
    """The bases of a bending section in all states of a motion, re-derived; M states.

    Args:
        states ((M, 3) float64): Advance in mm, twist in rad, bend in rad.
        bends ((M, 2) float64): Curvature of the section in the x and y directions of its base, 1/mm.
        bases ((M, 4, 4) float64): `lps_from_base`; none is rolled by the twist.
    """

    states: Float
    bends: Float
    bases: Float
    section_mm: float

    @property
    def advances(self) -> Float:
        """Advance from each state to the next, `(M - 1,)` mm."""
        return np.asarray(np.diff(self.states[:, 0]))

    @property
    def turns(self) -> Bool:
        """Tell between which states twist or bend change, `(M - 1,)`."""
        return np.asarray((np.abs(np.diff(self.states[:, 1:], axis=0)) > TINY_RAD).any(axis=1))

    @property
    def moves(self) -> Bool:
        """Tell between which states the scope advances, `(M - 1,)`."""
        return np.asarray(np.abs(self.advances) > TINY_MM)

    @property
    def tip(self) -> Float:
        """Frame of the tip in the last state, rolled by the twist, `(4, 4)`."""
        end = self.bases[-1] @ screws(self.bends[-1:], np.array([self.section_mm]))[0]
        twist = self.states[-1, 1]
        roll = np.eye(4)
        roll[:2, :2] = [[np.cos(twist), -np.sin(twist)], [np.sin(twist), np.cos(twist)]]
        return np.asarray(end @ roll)

    def points(self, states: Int, along_mm: Float, bends: Float | None = None) -> Float:
        """Return points `(N, 3)`, LPS mm, on the arcs that begin at the bases of some states.

        Args:
            states: (N,) int64.
            along_mm ((N,) float64): Lengths from the bases.
            bends ((N, 2) float64): Curvatures, if not those of the states.
        """
        local = screws(self.bends[states] if bends is None else bends, along_mm)[:, :3, 3]
        return np.asarray(
            (self.bases[states, :3, :3] @ local[:, :, None])[:, :, 0] + self.bases[states, :3, 3]
        )

    def body_pieces(self) -> tuple[Int, Float]:
        """Return the arcs of the body in the last state: their states `(P,)` and lengths `(P,)` in mm.

        What draws back, which a motion must not, lays none.
        """
        moved = np.flatnonzero(self.advances > TINY_MM)
        last = len(self.states) - 1
        return np.append(moved, last), np.append(self.advances[moved], self.section_mm)

    def body(self, step_mm: float) -> tuple[Float, Float]:
        """Return points `(N, 3)` of the body in the last state and their distances `(N,)` from the entry."""
        states, lengths = self.body_pieces()
        counts = np.maximum(np.ceil(lengths / step_mm).astype(np.int64), 1)
        which = np.repeat(states, counts)
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        along = np.repeat(lengths / counts, counts) * (number + 1)
        begin = np.repeat(np.cumsum(lengths) - lengths, counts)
        points = np.concatenate([self.bases[:1, :3, 3], self.points(which, along)])
        return points, np.append(0.0, begin + along)


def motion_of(lps_from_entry: Float, states: Float, section_mm: float) -> Motion:
    """Follow the states of a motion from its entry."""
    bends = states[:, 2:] / section_mm * np.stack([np.cos(states[:, 1]), np.sin(states[:, 1])], axis=1)
    bases = [np.asarray(lps_from_entry, dtype=np.float64)]
    for step in screws(bends[:-1], np.diff(states[:, 0])):
        bases.append(bases[-1] @ step)
    return Motion(states=states, bends=bends, bases=np.array(bases), section_mm=section_mm)


def screws(bends: Float, lengths_mm: Float) -> Float:
    """Return the exponentials `(N, 4, 4)` of screws that go forward along +z and turn towards a direction.

    They follow Rodrigues' formula for rigid motions [Rucker2010, twist exponentials].

    Args:
        bends ((N, 2) float64): Curvature in the x and y directions, 1/mm.
        lengths_mm: (N,) float64.
    """
    s = np.asarray(lengths_mm, dtype=np.float64)
    spin = np.zeros((len(s), 3, 3))
    # The axis of rotation is z x bend; its cross matrix takes z to the bend.
    spin[:, 0, 2], spin[:, 1, 2] = bends[:, 0], bends[:, 1]
    spin[:, 2, 0], spin[:, 2, 1] = -bends[:, 0], -bends[:, 1]
    angle = np.hypot(bends[:, 0], bends[:, 1]) * s
    # Below this angle the coefficients of a screw come from their series, whose next term is below 1e-12.
    small = np.abs(angle) < 1e-2
    safe = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 1.0 - square / 6.0 + square**2 / 120.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24.0 + square**2 / 720.0, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(small, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0, (safe - np.sin(safe)) / safe**3)
    twice = spin @ spin
    out = np.zeros((len(s), 4, 4))
    out[:, :3, :3] = np.eye(3) + (first * s)[:, None, None] * spin + (second * s**2)[:, None, None] * twice
    along = s[:, None, None] * np.eye(3)
    along = along + (second * s**2)[:, None, None] * spin + (third * s**3)[:, None, None] * twice
    out[:, :3, 3] = along[:, :, 2]
    out[:, 3, 3] = 1.0
    return out
