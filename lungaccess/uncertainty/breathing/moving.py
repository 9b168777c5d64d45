"""Where the tissue of a lung and the devices of a plan are in a phase, for whoever shows them."""

from dataclasses import replace
from typing import Self

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.breathing.kernels.rigid import Rigid, turned
from lungaccess.uncertainty.breathing.window import carrier, require_motion


@frozen_record
class Moving:
    """Tissue and devices of one plan in any phase.

    The lung of the target moves as the plan's window has it.  The other lung has its own displacement, which
    takes over smoothly beyond the middle, so that a picture of both has no tear.

    Args:
        tissue: With that one displacement for both lungs.
        rigid: What carries the tubes and the needle.
    """

    tissue: Motion
    rigid: Rigid

    @classmethod
    def of(cls, plan: Plan, lung: Lung) -> Self:
        """Return what moves with the breathing of the patient of a plan.

        Raises:
            AnatomyError: If the patient has no motion.
        """
        motion = require_motion(lung)
        side = motion.side_of(plan.target_lps)
        rigid = carrier(motion, plan.scope.lps_from_scope_tip[:3, 3], side)
        return cls(tissue=replace(motion, nodes=_one_field(motion, side)), rigid=rigid)

    def moved(self, points_lps: Float, phase: float) -> Float:
        """Return where places of the masks `(N, 3)` LPS mm are in a phase."""
        return self.tissue.moved(points_lps, phase, 0)

    def pulled_back(self, points_lps: Float, phase: float) -> Float:
        """Return the places of the masks that are at points `(N, 3)` LPS mm in a phase."""
        return self.tissue.pulled_back(points_lps, phase, 0)

    def pose(self, phase: float) -> Float:
        """Return the rigid motion `(4, 4)`, LPS mm, of tubes and needle from the masks' phase."""
        rotation, rate, pose = np.zeros((3, 3)), np.zeros((3, 3)), np.eye(4)
        share = self.tissue.share(phase)
        turned(self.rigid.gradient, share, rotation, rate)
        pose[:3, :3] = rotation
        pose[:3, 3] = self.rigid.centre + share * self.rigid.displacement - rotation @ self.rigid.centre
        return pose

    def carried(self, points_lps: Float, phase: float) -> Float:
        """Return where points of tubes and needle `(N, 3)` LPS mm are in a phase."""
        pose = self.pose(phase)
        return np.asarray(points_lps @ pose[:3, :3].T + pose[:3, 3])

    @property
    def field(self) -> Float:
        """The displacement `(ni, nj, nk, 3)` from end-exhale to end-inhale at the nodes, mm."""
        return np.asarray(self.tissue.nodes[0])


def _one_field(motion: Motion, side: int) -> Float:
    x = motion.grid.lps_from_ijk[0, 3] + motion.grid.spacing_mm[0] * np.arange(motion.grid.shape[0])
    beyond = (x - motion.middle_x_mm) * (1.0 if side == 0 else -1.0)
    # So far beyond the carina's plane the other lung's displacement takes over: about half a mediastinum.
    share = np.clip(beyond / 30.0, 0.0, 1.0)
    share = (share**2 * (3.0 - 2.0 * share))[:, None, None, None]
    one = (1.0 - share) * motion.nodes[side] + share * motion.nodes[1 - side]
    return np.stack([one, one])
