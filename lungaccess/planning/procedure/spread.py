"""How errors spread along deployed devices, to first order: a fast estimate of the chance of success.

It ranks candidates before any of them is simulated, and deployments from a scope's tip as measured.  Errors
are taken as small and normal.  Then each point of a device has a normal error whose covariance is the sum
over the kinds of error of `v v^T`, where `v` is what one standard deviation moves the point by.
"""

from functools import cached_property

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.motion.source import share_of_motion
from lungaccess.planning.procedure.kernels import spread as kernel
from lungaccess.planning.procedure.residuals import Residuals
from lungaccess.problem.errors import CURVATURE, ErrorModel
from lungaccess.problem.procedures import Procedure
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.tube import Deployments

ASIDE = 0.6
"""Points beside the target are aimed at so far out, as a share of the goal's radius: what is left of it is
there for the errors that come after."""


class Spread:
    """Direct arcs of the needle from deployments to one target, with what the errors do to each.

    Without a needle the tubes end at the target, where a needle of no length shows what the errors do.

    Args:
        tips ((N, 9) float64): Point, direction and +x of the scope tip of each deployment, LPS mm.
        deployments: N of them.
        radius_mm: Radius of the goal.
    """

    def __init__(
        self,
        lung: Lung,
        system: System,
        tips: Float,
        deployments: Deployments,
        target_lps: Float,
        errors: ErrorModel,
        procedure: Procedure,
        radius_mm: float,
    ) -> None:
        height = share_of_motion(lung.height_share(target_lps))
        scope = share_of_motion(lung.height_share(tips[0, :3])) if len(tips) else height
        left = Residuals.of(errors, procedure, height - scope)
        aside = ASIDE * radius_mm if procedure.tubes.measured else 0.0
        self._radius_mm = radius_mm
        self._replanned = system.needle is not None and (
            procedure.tubes.measured or procedure.needle.closed_loop
        )
        x, y, z = target_lps.tolist()
        self._found = np.zeros((deployments.count, kernel.N_FOUND))
        ends = deployments.positions
        if system.needle is None:
            ends = np.ascontiguousarray(np.broadcast_to(target_lps, ends.shape))
        kernel.find_spread(
            around(lung, with_fissures=fissures_are_obstacles(lung, system)),
            sizes(system, left, errors, aside), np.ascontiguousarray(tips), ends,
            deployments.tangents, deployments.exit_mm, deployments.inner_mm,
            (x, y, z), self._found,
        )  # fmt: skip

    @cached_property
    def chances(self) -> Float:
        """The estimated chance of success of each, `(N,)`: to end in the goal, and to stay clear.

        What deviated tubes meet of the airway that they leave is not in it.
        """
        margin = self._found[:, [kernel.OF_TUBE, kernel.OF_NEEDLE]].min(axis=1)
        return np.asarray(self.goal_chances * self.reach_chances * _below(margin))

    @cached_property
    def reach_chances(self) -> Float:
        """The chance of each that the target lies within the needle's bending from the true tip of the tubes.

        It is 1 where the needle is not planned again from there.
        """
        reach = self._found[:, kernel.REACH]
        return _below(reach) if self._replanned else np.ones(len(reach))

    @cached_property
    def goal_chances(self) -> Float:
        """The chance of each to end within the goal's radius, `(N,)`.

        The squared miss is a sum of weighted chi-squares, taken as one of the same mean and variance
        [Satterthwaite1946].
        """
        from scipy.special import gammainc

        mean, variance = self._found[:, kernel.MEAN], self._found[:, kernel.VARIANCE]
        scale = variance / (2.0 * np.maximum(mean, kernel.SMALL))
        freedom = mean / np.maximum(scale, kernel.SMALL)
        squared = 0.5 * self._radius_mm**2 / np.maximum(scale, kernel.SMALL)
        return np.asarray(gammainc(0.5 * freedom, squared))


def around(lung: Lung, *, with_fissures: bool) -> kernel.Around:
    """Return what the devices may meet, for the kernels."""
    vessel = lung.fields["vessel"]
    fissure = lung.fields["fissure"] if with_fissures else vessel
    return kernel.Around(
        vessel.corners, lung.fields["pleura"].corners, fissure.corners, lung.fields["airway"].corners,
        vessel.geometry,
    )  # fmt: skip


def sizes(system: System, left: Residuals, errors: ErrorModel, aside_mm: float) -> kernel.Sizes:
    """Return the errors and devices for the kernels; without a needle no length of the tubes is exempt."""
    needle, tubes = system.needle, system.tubes
    tip_mm = None if needle is None else left.tip_mm
    return kernel.Sizes(
        scope=left.scope_mm, scope_turn=left.scope_rad, rotation=left.rotation_rad,
        insertion=left.insertion_mm, tip_known=tip_mm is not None, tip=tip_mm or 0.0,
        tip_turn=left.tip_rad, curvature=left.curvature, roll=left.roll_rad,
        stop=0.0 if needle is None else left.stop_mm,
        target=left.target_mm, breathing=left.foot_mm, bend=bend_per_mm(system),
        steepest=1.0 if needle is None else needle.max_curvature_per_mm * errors.needle_curvature.median,
        slack=errors.term(CURVATURE).size, aside=aside_mm, tube_radius=tubes.inner.radius_mm,
        needle_radius=0.0 if needle is None else needle.radius_mm,
        exempt=-1.0 if needle is None else needle.exit_exemption_mm,
    )  # fmt: skip


def bend_per_mm(system: System) -> float:
    """Return the curvature with which the inner tube bends on as it goes farther; 0 where it is not one."""
    return system.tubes.free_curvature_per_mm if system.tubes.planar else 0.0


def _below(standard: Float) -> Float:
    """Return the chance that a standard normal number stays below."""
    from scipy.special import ndtr

    return np.asarray(ndtr(standard))
