"""Own view of breathing: where tissue and devices are in a phase, by interpolation and singular values."""

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Float

if TYPE_CHECKING:
    from anatomy.motion.motion import Motion

TIP_BALL_MM = 10.0
"""Tissue so near to the tip of the scope turns it."""
TIP_STEP_MM = 2.5
"""Distance of the places that are looked at in it."""
CONVERGED_MM = 1e-8
"""A step below this ends the search for a place."""
STEPS = 50
"""Of the fixed point that pulls a point back; each takes a third of the error or less in a lung."""


class Breath:
    """The breathing of the lung that holds a target, and the devices that the airway around a tip carries."""

    def __init__(self, motion: "Motion", target_lps: Float, tip_lps: Float) -> None:
        side = 1 if target_lps[0] > motion.middle_x_mm else 0
        self._motion, self._nodes = motion, np.moveaxis(np.asarray(motion.nodes[side]), -1, 0)
        self._tip = np.asarray(tip_lps, dtype=np.float64)
        steps = np.arange(-TIP_BALL_MM, TIP_BALL_MM + 1e-9, TIP_STEP_MM)
        ball = np.array([(x, y, z) for x in steps for y in steps for z in steps])
        ball = ball[(ball**2).sum(axis=1) <= TIP_BALL_MM**2]
        with_constant = np.column_stack([ball, np.ones(len(ball))])
        fitted = np.linalg.lstsq(with_constant, self.displacement(self._tip + ball), rcond=None)[0]
        self._gradient = fitted[:3].T

    def share(self, phase: float) -> float:
        """Return by which share of its displacement a place of the masks is moved in a phase."""
        return float(self._motion.amplitude * (phase - self._motion.masks_phase))

    def displacement(self, places: Float) -> Float:
        """Return displacements `(N, 3)` from end-exhale to end-inhale of places of the masks `(N, 3)`."""
        grid = self._motion.grid
        index = (places - grid.lps_from_ijk[:3, 3]) / np.diag(grid.lps_from_ijk)[:3]
        parts = [ndimage.map_coordinates(part, index.T, order=1, mode="nearest") for part in self._nodes]
        return np.stack(parts, axis=1)

    def moved(self, places: Float, phase: float) -> Float:
        """Return where places of the masks are."""
        return np.asarray(places + self.share(phase) * self.displacement(places))

    def pulled_back(self, points: Float, phase: float) -> Float:
        """Return which places of the masks are at points."""
        share, found = self.share(phase), np.asarray(points)
        for _ in range(STEPS):
            before, found = found, points - share * self.displacement(found)
            if float(np.abs(found - before).max(initial=0.0)) < CONVERGED_MM:
                break
        return found

    def carried(self, points: Float, phase: float) -> Float:
        """Return where points of the devices are: the tip as its tissue, turned as the tissue around it."""
        left, _sizes, right = np.linalg.svd(np.eye(3) + self.share(phase) * self._gradient)
        return np.asarray((points - self._tip) @ (left @ right).T + self.moved(self._tip[None], phase))
