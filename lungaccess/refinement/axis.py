"""The scope's tip as a smooth function of arc length along the airway, and back to the tree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.typed import Float
from lungaccess.refinement.layout import AXIS_DEGREE, AXIS_SCALE_MM
from stages.scope import ScopeTip, Sites, looks_ahead, tip_at

SAMPLE_MM = 0.125
"""Step in which poses of the tip are tested and fitted; a voxel is several times as large."""
ROUNDING_MM = 1e-9
"""Keeps the end of a range in it whatever is rounded."""


class LocalAxis:
    """The airway's medial axis near a tip, AXIS_SCALE_MM each way, as far as the scope fits.

    Parameters
    ----------
    sites : Sites
        Says where the scope passes.
    branch : int
        The branch that the tubes pierce: where the airway forks, the axis goes on towards it.

    Attributes
    ----------
    low_mm, high_mm : float
        How far the tip can be moved, back (negative) and ahead.
    points, tangents : (3, AXIS_DEGREE + 1) float64
        Coefficients of the tip's point and direction, LPS mm, in powers of the shift by AXIS_SCALE_MM.
    """

    def __init__(self, tree: AirwayTree, sites: Sites, tip: ScopeTip, branch: int) -> None:
        self._tree = tree
        from_root = tree.distance_from_root_mm
        self._tip_mm = float(from_root[tip.tree_point]) - tip.back_mm
        self._points = _route_through(tree, tip, branch, self._tip_mm)
        self._arc_lengths_mm = from_root[self._points]
        behind = np.arange(
            0.0, min(self._tip_mm - self._arc_lengths_mm[0], AXIS_SCALE_MM) + ROUNDING_MM, SAMPLE_MM
        )
        ahead = np.arange(
            0.0, min(self._arc_lengths_mm[-1] - self._tip_mm, AXIS_SCALE_MM) + ROUNDING_MM, SAMPLE_MM
        )
        self.low_mm, self.high_mm = -self._farthest(sites, -behind), self._farthest(sites, ahead)
        self.points, self.tangents = self._fit()

    def tip(self, shift_mm: float) -> ScopeTip:
        """Return the tip moved by `shift_mm` along the airway, as far as the scope fits."""
        return self._moved(min(max(shift_mm, self.low_mm), self.high_mm))

    def _moved(self, shift_mm: float) -> ScopeTip:
        at = self._tip_mm + shift_mm
        index = min(int(np.searchsorted(self._arc_lengths_mm, at)), len(self._points) - 1)
        return tip_at(self._tree, int(self._points[index]), float(self._arc_lengths_mm[index] - at))

    def _farthest(self, sites: Sites, shifts: Float) -> float:
        """Return how far one may go along `shifts`, away from 0, while the scope fits everywhere."""
        reached = 0.0
        for shift in shifts.tolist():
            tip = self._moved(shift)
            if not (sites.passable[tip.tree_point] and looks_ahead(self._tree, tip)):
                break
            reached = abs(shift)
        return reached

    def _fit(self) -> tuple[Float, Float]:
        """Return the coefficients `(3, AXIS_DEGREE + 1)` of point and tangent; exact at no shift."""
        shifts = np.arange(self.low_mm, self.high_mm + ROUNDING_MM, SAMPLE_MM)
        frames = np.stack([self._moved(shift).lps_from_scope_tip for shift in [0.0, *shifts.tolist()]])
        powers = (shifts[:, None] / AXIS_SCALE_MM) ** np.arange(1, AXIS_DEGREE + 1)
        fitted = []
        for column in (3, 2):
            values = frames[:, :3, column]
            rest = np.linalg.lstsq(powers, values[1:] - values[0], rcond=1e-9)[0]
            fitted.append(np.vstack([values[:1], rest]).T)
        return fitted[0], fitted[1]


class FixedTip:
    """A tip that is turned aside and stays where it is: it has no smooth axis along the airway.

    Its attributes are those of `LocalAxis`.
    """

    def __init__(self, tip: ScopeTip) -> None:
        self._tip = tip
        self.low_mm = self.high_mm = 0.0
        self.points, self.tangents = one_tip(tip)

    def tip(self, _shift_mm: float) -> ScopeTip:
        """Return the tip."""
        return self._tip


def axis_of(tree: AirwayTree, sites: Sites, tip: ScopeTip, branch: int) -> LocalAxis | FixedTip:
    """Return where a tip can be moved; see `LocalAxis`."""
    return FixedTip(tip) if tip.turned else LocalAxis(tree, sites, tip, branch)


def one_tip(tip: ScopeTip) -> tuple[Float, Float]:
    """Return the coefficients of an axis that is one tip."""
    points, tangents = np.zeros((3, AXIS_DEGREE + 1)), np.zeros((3, AXIS_DEGREE + 1))
    points[:, 0], tangents[:, 0] = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]
    return points, tangents


def _route_through(tree: AirwayTree, tip: ScopeTip, branch: int, tip_mm: float) -> np.ndarray:
    """Return tree points from behind the tip to ahead of it, each the parent of the next."""
    from_root = tree.distance_from_root_mm
    points = [tip.tree_point]
    while from_root[points[0]] > tip_mm - AXIS_SCALE_MM and tree.parent_point[points[0]] >= 0:
        points.insert(0, int(tree.parent_point[points[0]]))
    wanted = set(tree.route(int(tree.branch_start[branch + 1]) - 1).tolist()) if branch >= 0 else set()
    while from_root[points[-1]] < tip_mm + AXIS_SCALE_MM:
        children = np.flatnonzero(tree.parent_point == points[-1]).tolist()
        if not children:
            break
        points.append(_best_child(tree, tip, children, wanted))
    return np.array(points)


def _best_child(tree: AirwayTree, tip: ScopeTip, children: Sequence[int], wanted: set[int]) -> int:
    """Return the child on the wanted route, else the one that lies straightest ahead of the tip."""
    forward = tip.lps_from_scope_tip[:3, 2]
    return max(children, key=lambda c: (c in wanted, float(tree.tangents[c] @ forward)))
