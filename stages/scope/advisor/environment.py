"""The environment of the scope: the true radius in the depth field, or eq. 1 of [Rosell2012] as printed.

Eq. 1 compares an L1 distance, which is up to sqrt(3) times the Euclidean one, in units of the largest voxel
side, and looks at the joints alone: it lets a scope touch the wall.  It is there for reproduction only.
"""

import math
from functools import cached_property

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from stages.scope.advisor.kernels import collision as kernel
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import NavigationField


@frozen_record
class ScopeEnvironment:
    """A scope in a lumen with a goal: what the scope collides with, and where it is to go.

    In reproduction eq. 1 decides about collisions and eq. 3 about twists as printed: i times a tenth of the
    range, held within the range.  Otherwise the scope's radius is kept along its whole body, and the twists
    cover their whole range.  What eq. 1 allows must not feed a plan.
    """

    model: ScopeModel
    field: NavigationField
    reproduction: bool = False

    @property
    def lumen(self) -> Lumen:
        """The lumen of the field."""
        return self.field.lumen

    @cached_property
    def arrays(self) -> kernel.LumenArrays:
        """The arrays of the lumen and the field."""
        lumen = self.lumen
        return kernel.LumenArrays(
            numbers=lumen.index,
            geometry=lumen.geometry,
            lps_from_ijk=np.ascontiguousarray(lumen.grid.lps_from_ijk[:3]),
            voxels=lumen.voxels,
            depth=lumen.depth.corners,
            depth_geometry=lumen.depth.geometry,
            solid=lumen.solid,
            clearance=self.field.clearance,
            potential=self.field.potential,
            steps_to_wall=lumen.steps_to_wall,
            centre_depth=lumen.depth_mm,
        )

    @cached_property
    def scope(self) -> kernel.Scope:
        """The scope's numbers."""
        model = self.model
        low, high = math.radians(model.twist_low_deg), math.radians(model.twist_high_deg)
        return kernel.Scope(
            links=model.links,
            link=model.link_mm,
            twist_low=low,
            twist_high=high,
            bend_low=math.radians(model.bend_low_deg),
            bend_high=math.radians(model.bend_high_deg),
            bend_step=math.radians(model.bend_step_deg),
            radius=0.0 if self.reproduction else model.radius_mm,
            printed_limit=model.link_mm / float(self.lumen.grid.spacing_mm.max()),
            sweep_middle=0.0 if self.reproduction else 0.5 * (low + high),
        )

    def fits(self, states: Float) -> Bool:
        """Tell for states (M, 14) whether the bending tip is free of collision, `(M,)`."""
        return self._measure(states)[0]

    def distances(self, states: Float) -> Float:
        """Return sums of L1 clearances (voxels) of states (M, 14) at links and tip [Rosell2012, IV-D]."""
        return self._measure(states)[1]

    def _measure(self, states: Float) -> tuple[Bool, Float]:
        rows = np.ascontiguousarray(np.atleast_2d(states))
        fits, distances = np.zeros(len(rows), dtype=bool), np.zeros(len(rows))
        kernel.measure(self.arrays, self.scope, rows, fits, distances)
        return fits, distances
