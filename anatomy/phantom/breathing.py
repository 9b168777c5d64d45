"""The breathing of a phantom: a motion whose inverse is known in closed form.

A place at depth t below the apex of the lungs, as a share of their height at end-exhale, moves by A t^2 to
the feet and by A t^2 / 4 to the front until end-inhale.  The left lung moves a little less than the right
one.
"""

from typing import Self

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.motion.source import MotionSource
from anatomy.phantom.patient import SCALES, Phantom

LEFT_SHARE = 0.85
"""The heart hinders the left lung."""
FIELD_MM = 4.0
"""Voxels of the field that is written."""
BORDER_MM = 12.0
"""The field goes on so far beyond the lungs."""


@frozen_value
class PhantomBreathing:
    """The true motion of a phantom, whose masks show end-inhale.

    Parameters
    ----------
    apex_z_mm, height_mm : float
        The apex at end-exhale, where nothing moves, and the height of the lungs then.
    right_mm, left_mm : float
        A of each lung; the carina is at x = 0.
    """

    apex_z_mm: float
    height_mm: float
    right_mm: float
    left_mm: float

    @classmethod
    def of(cls, phantom: Phantom) -> Self:
        """Return the breathing of a phantom."""
        z = phantom.grid.lps(np.argwhere(phantom.images.lung.array))[:, 2]
        # Motion of the base of an adult's right lung, about the median of the population's.
        motion = 16.0 * SCALES[phantom.size] * phantom.traits.stature
        apex, base = float(z.max()), float(z.min())
        # At end-inhale, which the masks show, the height is longer by A.
        return cls(
            apex_z_mm=apex, height_mm=apex - base - motion, right_mm=motion, left_mm=LEFT_SHARE * motion
        )

    def _motion_mm(self, points: Float) -> Float:
        return np.where(points[:, 0] > 0.0, self.left_mm, self.right_mm)

    def _vectors(self, motion_mm: Float, depth: Float) -> Float:
        down = motion_mm * np.maximum(depth, 0.0) ** 2
        # The front of the chest rises by some millimetres.
        return np.stack([np.zeros_like(down), -0.25 * down, -down], axis=1)

    def from_exhale(self, points_lps: Float) -> Float:
        """Return the displacements `(N, 3)` to end-inhale of places `(N, 3)` at end-exhale."""
        depth = (self.apex_z_mm - points_lps[:, 2]) / self.height_mm
        return self._vectors(self._motion_mm(points_lps), depth)

    def at_masks(self, points_lps: Float) -> Float:
        """Return the displacements from end-exhale to end-inhale of places `(N, 3)` at end-inhale."""
        motion = self._motion_mm(points_lps)
        below = np.maximum(self.apex_z_mm - points_lps[:, 2], 0.0)
        root = np.sqrt(self.height_mm**2 + 4.0 * motion * below)
        return self._vectors(motion, (root - self.height_mm) / (2.0 * motion))

    def field(self, phantom: Phantom) -> tuple[Grid, Float]:
        """Return grid and vectors `(ni, nj, nk, 3)` of the displacement field from end-exhale."""
        lungs = phantom.grid.lps(np.argwhere(phantom.images.lung.array))
        low, high = lungs.min(axis=0) - BORDER_MM, lungs.max(axis=0) + BORDER_MM
        shape = np.ceil((high - low) / FIELD_MM).astype(int) + 1
        grid = Grid.from_spacing(shape, (FIELD_MM,) * 3, low)
        places = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
        return grid, self.from_exhale(places).reshape(*grid.shape, 3)

    def source(self, phantom: Phantom) -> MotionSource:
        """Return the motion as it would be read from the field."""
        grid, vectors = self.field(phantom)
        return MotionSource(
            description="the phantom's own breathing", masks_phase=1.0, grid=grid, vectors=vectors
        )
