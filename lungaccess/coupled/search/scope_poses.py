"""Scope poses in a row along the airway, as the kernels of the coupled search take them."""

from __future__ import annotations

import numpy as np

from anatomy import poses
from anatomy.lung import Lung
from anatomy.typed import Bool, Float
from stages.scope import Bronchoscope, ScopeTip, Sites, tip_is_feasible, walk

STEP_MM = 0.25
"""Spacing of the poses: a fraction of the 1 mm between the sites of an atlas."""
REACH_MM = 4.0
"""Length of the row each way: several times as far as the next site of the atlas."""
TURNED_STEP_MM = 0.5
"""Spacing of turned poses, which take longer to validate."""


class ScopePoses:
    """The scope tips up to REACH_MM behind and ahead of one; at each fork a random branch is taken.

    Parameters
    ----------
    places : Sites
        Where the scope passes.

    Attributes
    ----------
    tips : list of ScopeTip
    home : int
        The index of the tip given.
    rows : (K, 9) float64
        Point, tangent, and the vector from which rotations count: the +x of the tip given, carried over to
        each tip.
    allowed : (K,) bool
        Which of these poses the scope can take.
    """

    def __init__(
        self, lung: Lung, scope: Bronchoscope, places: Sites, tip: ScopeTip, rng: np.random.Generator
    ) -> None:
        step = TURNED_STEP_MM if tip.turned else STEP_MM
        self.home = round(REACH_MM / step)
        behind = [walk(lung.tree, tip, -step * n, rng) for n in range(self.home, 0, -1)]
        ahead = [tip]
        for _ in range(self.home):
            ahead.append(walk(lung.tree, ahead[-1], step, rng))
        self.tips = [*behind, *ahead]
        sideways = tip.lps_from_scope_tip[:3, 0]
        self.rows: Float = np.zeros((len(self.tips), 9))
        self.allowed: Bool = np.zeros(len(self.tips), dtype=np.bool_)
        for n, each in enumerate(self.tips):
            frame = each.lps_from_scope_tip
            self.rows[n, :3], self.rows[n, 3:6] = frame[:3, 3], frame[:3, 2]
            across = sideways - (sideways @ frame[:3, 2]) * frame[:3, 2]
            size = float(np.linalg.norm(across))
            self.rows[n, 6:] = across / size if size > 0.1 else frame[:3, 0]
            self.allowed[n] = tip_is_feasible(lung, scope, places, each)

    def rotation_rad(self, index: int, rotation_rad: float) -> float:
        """Return the rotation counted from the tip's own +x, from one counted from the row's vector."""
        point, forward, sideways = np.split(self.rows[index], 3)
        bend = poses.bending_directions(poses.pose(point, forward, sideways), rotation_rad)[0]
        return poses.roll_towards(self.tips[index].lps_from_scope_tip, bend)
