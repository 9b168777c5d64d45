"""Scope tips beside a tip along its own motion, each proved: what local search and refinement may choose."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.lung import Lung
from stages.scope import Bronchoscope, ScopeTip, TipRow, in_tip_region, prover_of


class TipRows:
    """Moves tips of a scope along the motions to them."""

    def __init__(self, lung: Lung, scope: Bronchoscope) -> None:
        self._tree = lung.tree
        self._prover = prover_of(lung, scope)

    def along(self, tip: ScopeTip, shifts_mm: ArrayLike) -> TipRow:
        """Return the tips whose base stops so much farther, and which of them the scope may take."""
        return self._prover.row(tip.motion, shifts_mm)

    def tip(self, row: TipRow, index: int) -> ScopeTip:
        """Return a tip of a row with its motion."""
        point, forward, sideways = np.split(row.tips[index], 3)
        nearest, _inside = in_tip_region(self._tree, row.tips[index : index + 1])
        return ScopeTip(
            motion=row.motion_to(index),
            lps_from_scope_tip=poses.pose(point, forward, sideways),
            tree_point=int(nearest[0]),
        )

    def moved(self, tip: ScopeTip, shift_mm: float) -> ScopeTip | None:
        """Return a tip moved along its motion, None if the scope may not take it."""
        if shift_mm == 0.0:
            return tip
        row = self.along(tip, [shift_mm])
        return self.tip(row, 0) if row.proved[0] else None
