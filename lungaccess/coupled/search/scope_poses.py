"""Scope poses in a row along the airway, as the kernels of the coupled search take them."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from anatomy import poses
from anatomy.records import frozen_record
from anatomy.typed import Bool, Float, Int
from stages.scope import ScopeMotions, ScopeTip

REACH_MM = 4.0
"""How far from a tip its neighbours lie: several times as far as the next tip of the atlas."""
MOST = 64
"""So many neighbours at most, the nearest: about eight times the spread of a change of the local search."""
MM_OF_TURN = 5.0
"""A turn by one radian counts as so many mm: it moves the tip of the tubes by some times as much."""


@frozen_record
class PoseRow:
    """Tips of an atlas near one of them, from behind it to ahead of it; K poses.

    Parameters
    ----------
    numbers : (K,) int64
        The tips by their numbers in the atlas.
    home : int
        Which of them is the one in whose neighbourhood they lie.
    rows : (K, 9) float64
        Point, direction, and the vector from which rotations count: the +x of the tip at home, carried over
        to each tip, so that the tubes keep their direction from one tip to the next.
    allowed : (K,) bool
        Which of these poses the scope can take: all, as each has a proved motion.
    """

    numbers: Int
    home: int
    rows: Float
    allowed: Bool


class ScopePoses:
    """The tips of an atlas by neighbourhood."""

    def __init__(self, motions: ScopeMotions) -> None:
        self.motions = motions

    @cached_property
    def _places(self) -> Float:
        """Points and scaled directions `(S, 6)`: near in them are tips that can replace each other."""
        tips = self.motions.tips
        return np.hstack([tips[:, :3], MM_OF_TURN * tips[:, 3:6]])

    def around(self, tip: ScopeTip) -> PoseRow | None:
        """Return the tips near one of the atlas, None for a tip of another origin."""
        frame = tip.lps_from_scope_tip
        here = np.concatenate([frame[:3, 3], MM_OF_TURN * frame[:3, 2]])
        away = np.linalg.norm(self._places - here, axis=1)
        home = int(np.argmin(away))
        if away[home] > SAME_MM:
            return None
        near = np.flatnonzero(away <= REACH_MM)
        near = near[np.argsort(away[near], kind="stable")][:MOST]
        ahead = (self.motions.tips[near, :3] - frame[:3, 3]) @ frame[:3, 2]
        near = near[np.argsort(ahead, kind="stable")]
        rows = self.motions.tips[near].copy()
        sideways = frame[:3, 0]
        across = sideways - (rows[:, 3:6] @ sideways)[:, None] * rows[:, 3:6]
        rows[:, 6:] = across / np.linalg.norm(across, axis=1, keepdims=True)
        return PoseRow(
            numbers=near,
            home=int(np.flatnonzero(near == home)[0]),
            rows=rows,
            allowed=np.ones(len(near), dtype=np.bool_),
        )

    def tip(self, row: PoseRow, index: int) -> ScopeTip:
        """Return a tip of a row."""
        return self.motions.tip(int(row.numbers[index]))

    @staticmethod
    def rotation_rad(row: PoseRow, index: int, tip: ScopeTip, rotation_rad: float) -> float:
        """Return the rotation counted from the tip's own +x, from one counted from the row's vector."""
        point, forward, sideways = np.split(row.rows[index], 3)
        bend = poses.bending_directions(poses.pose(point, forward, sideways), rotation_rad)[0]
        return poses.roll_towards(tip.lps_from_scope_tip, bend)


SAME_MM = 1e-6
"""Tips that differ by less are one tip, read from a plan."""
