"""How errors spread along deployed devices, to first order: a fast estimate of the chance of success.

It ranks candidates before any of them is simulated, and deployments from a scope's tip as measured.  Errors
are taken as small and normal.  Then each point of a device has a normal error whose covariance is the sum
over the kinds of error of `v v^T`, where `v` is what one standard deviation moves the point by.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Float
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from lungaccess.procedure.settings import Procedure
from lungaccess.risk.breathing import share_of_motion
from lungaccess.risk.errors import BREATHING, CURVATURE, ErrorModel
from stages.tube import Deployments

TUBE_STATIONS, NEEDLE_STATIONS = 6, 24
"""Points at which clearance is compared with the errors: some mm apart, as vessels are wide."""
CAP = 6.0
"""A clearance of so many standard deviations is as good as any more."""


@frozen_record
class Residuals:
    """Standard deviations of what is left of the errors after what a procedure measures, mm and rad.

    Parameters
    ----------
    scope_mm, scope_rad : float
        Of the scope's tip when the tubes are planned: those of the measurement where it is measured.
    rotation_rad, insertion_mm : float
        Of the tubes.
    tip_mm, tip_rad : float or None
        Of the tip of the tubes when the needle is planned; None where it follows from scope and tubes.
    curvature, roll_rad, stop_mm : float
        Of the needle: the logarithm of its curvature's factor, roll and insertion.
    target_mm : float
    breathing_mm : float
        Of the target beside the scope's tip, towards the feet.
    """

    scope_mm: float
    scope_rad: float
    rotation_rad: float
    insertion_mm: float
    tip_mm: float | None
    tip_rad: float
    curvature: float
    roll_rad: float
    stop_mm: float
    target_mm: float
    breathing_mm: float

    @staticmethod
    def of(errors: ErrorModel, procedure: Procedure, stretch: float) -> Residuals:
        """Return what a procedure leaves of errors; `stretch` is that of `lungaccess.risk.Draws`."""
        size = {kind: errors.term(kind).size for kind in ("scope_position", "target_position")}
        angle = {
            kind: math.radians(errors.term(kind).size)
            for kind in ("scope_direction", "tube_rotation", "needle_roll")
        }
        scope, tubes, image, needle = (
            procedure.scope, procedure.tubes, procedure.imaging, procedure.needle,
        )  # fmt: skip
        steered = needle.closed_loop
        return Residuals(
            scope_mm=scope.position_mm if scope.measured else size["scope_position"],
            scope_rad=math.radians(scope.direction_deg) if scope.measured else angle["scope_direction"],
            rotation_rad=angle["tube_rotation"],
            insertion_mm=errors.tube_insertion.size,
            tip_mm=tubes.position_mm if tubes.measured else needle.position_mm if steered else None,
            tip_rad=math.radians(tubes.direction_deg if tubes.measured else needle.direction_deg),
            curvature=0.0 if steered else errors.term(CURVATURE).size,
            roll_rad=0.0 if steered else angle["needle_roll"],
            stop_mm=errors.needle_insertion.size,
            target_mm=image.position_mm if image.measured else size["target_position"],
            breathing_mm=0.0 if image.measured else abs(stretch) * errors.term(BREATHING).size,
        )


class Spread:
    """Direct arcs of the needle from deployments to one target, with what the errors do to each.

    Parameters
    ----------
    tips : (N, 9) float64
        Point, direction and +x of the scope tip of each deployment, LPS mm.
    deployments : Deployments
        N of them.
    radius_mm : float
        Radius of the goal.
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
        self._lung, self._system, self._tips = lung, system, tips
        self._at, self._ahead = deployments.positions, deployments.tangents
        self._length, self._exit = deployments.inner_mm, deployments.exit_mm
        self._with_fissures = fissures_are_obstacles(lung, system)
        self._radius_mm, self._target = radius_mm, target_lps
        height = share_of_motion(lung.height_share(target_lps))
        scope = share_of_motion(lung.height_share(tips[0, :3])) if len(tips) else height
        self._left = Residuals.of(errors, procedure, height - scope)

    @cached_property
    def chances(self) -> Float:
        """The estimated chance of success of each, `(N,)`: to end in the goal, and to stay clear.

        What deviated tubes meet of the airway that they leave is not in it.
        """
        return np.asarray(self.goal_chances * self.clear_chances)

    @cached_property
    def goal_chances(self) -> Float:
        """The chance of each to end within the goal's radius, `(N,)`."""
        return self._hits([each[:, -1] for each in self._moved_needle])

    @cached_property
    def clear_chances(self) -> Float:
        """The chance of each to stay clear where it is nearest to an obstacle, `(N,)`."""
        tubes, inner = self._tube_points(), self._system.tubes.inner
        of_tubes = self._margin(tubes, self._before(tubes, of_needle=False), inner.radius_mm, airway=False)
        of_needle = self._margin(self._needle[0], self._moved_needle, self._needle_radius_mm, airway=True)
        return _below(np.minimum(of_tubes, of_needle))

    @cached_property
    def _needle(self) -> tuple[Float, Float, Float, Float]:
        return self._needle_points()

    @cached_property
    def _moved_needle(self) -> list[Float]:
        """What one standard deviation of each error moves points of the needle by."""
        points = self._needle[0]
        return [*self._before(points, of_needle=True), *self._of_needle(*self._needle)]

    @property
    def _needle_radius_mm(self) -> float:
        return self._system.require_needle("A chance of success").radius_mm

    def _needle_points(self) -> tuple[Float, Float, Float, Float]:
        """Return points `(N, S, 3)` of the arcs to the target, their normals, curvatures and lengths."""
        offset = self._target - self._at
        along = (offset * self._ahead).sum(axis=1, keepdims=True)
        aside = offset - along * self._ahead
        off = np.linalg.norm(aside, axis=1, keepdims=True)
        normal = aside / np.maximum(off, 1e-9)
        kappa = 2.0 * off / np.maximum(off**2 + along**2, 1e-12)
        turn = 2.0 * np.arctan2(off, along)
        lengths = np.where(turn > 1e-9, turn / np.maximum(kappa, 1e-12), along)
        angle = turn * np.linspace(1.0 / NEEDLE_STATIONS, 1.0, NEEDLE_STATIONS)
        share = np.linspace(1.0 / NEEDLE_STATIONS, 1.0, NEEDLE_STATIONS) * lengths
        forward = np.where(turn > 1e-9, np.sin(angle) / np.maximum(kappa, 1e-12), share)
        bent = np.where(turn > 1e-9, (1.0 - np.cos(angle)) / np.maximum(kappa, 1e-12), 0.0)
        points = (
            self._at[:, None] + forward[..., None] * self._ahead[:, None] + bent[..., None] * normal[:, None]
        )
        return points, normal, kappa, lengths

    def _tube_points(self) -> Float:
        """Return points `(N, S, 3)` of the tubes from the exit on: cubics through both ends."""
        begin, forward = self._tips[:, :3], self._tips[:, 3:6]
        exit_at = np.clip(self._exit / np.maximum(self._length, 1e-9), 0.0, 1.0)[:, None]
        u = exit_at + (1.0 - exit_at) * np.linspace(1.0 / TUBE_STATIONS, 1.0, TUBE_STATIONS)
        u = u[..., None]
        length = self._length[:, None, None]
        return np.asarray(
            (2 * u**3 - 3 * u**2 + 1) * begin[:, None]
            + (u**3 - 2 * u**2 + u) * length * forward[:, None]
            + (3 * u**2 - 2 * u**3) * self._at[:, None]
            + (u**3 - u**2) * length * self._ahead[:, None]
        )

    def _before(self, points: Float, *, of_needle: bool) -> list[Float]:
        """Return what the errors before the needle move points `(N, S, 3)` by."""
        left = self._left
        if of_needle and left.tip_mm is not None:
            return [*_shifted(points, left.tip_mm), *_tilted(points, self._at, self._ahead, left.tip_rad)]
        forward = self._tips[:, 3:6]
        arms = points - self._tips[:, None, :3]
        moved = [
            *_shifted(points, left.scope_mm),
            *_tilted(points, self._tips[:, :3], forward, left.scope_rad),
        ]
        moved.append(left.rotation_rad * np.cross(forward[:, None], arms))
        if of_needle:
            moved.append(
                np.broadcast_to(left.insertion_mm * self._ahead[:, None], points.shape) + self._bent(points)
            )
        return moved

    def _bent(self, points: Float) -> Float:
        """Return what an inner tube too far out moves points by as it bends on."""
        tubes = self._system.tubes
        curvature = tubes.inner.precurvature_per_mm if tubes.planar else 0.0
        about = np.cross(self._tips[:, 3:6], self._ahead)
        about /= np.maximum(np.linalg.norm(about, axis=1, keepdims=True), 1e-9)
        arms = points - self._at[:, None]
        return np.asarray(self._left.insertion_mm * curvature * np.cross(about[:, None], arms))

    def _of_needle(self, points: Float, normal: Float, kappa: Float, lengths: Float) -> list[Float]:
        """Return what the errors of the needle and of the target move points of the needle by."""
        left, share = self._left, np.linspace(1.0 / NEEDLE_STATIONS, 1.0, NEEDLE_STATIONS)
        bow = (0.5 * kappa * (share * lengths) ** 2)[..., None]
        binormal = np.cross(self._ahead, normal)
        moved = [left.curvature * bow * normal[:, None], left.roll_rad * bow * binormal[:, None]]
        return [each for each in moved if np.any(each)]

    def _margin(self, points: Float, moved: list[Float], radius_mm: float, *, airway: bool) -> Float:
        """Return the least clearance `(N,)` of points, in standard deviations across the device."""
        names = ["vessel", "pleura", *(["fissure"] if self._with_fissures else [])]
        flat, shape = points.reshape(-1, 3), points.shape[:2]
        clear = np.min([self._lung.fields[name].lower_bound_mm(flat) for name in names], axis=0).reshape(
            shape
        )
        if airway:
            near = self._lung.fields["airway"].lower_bound_mm(flat).reshape(shape)
            exempt = self._system.require_needle("A chance").exit_exemption_mm
            away = np.linalg.norm(points - self._at[:, None], axis=2) > exempt
            clear = np.where(away, np.minimum(clear, near), clear)
        # Two of three directions lie across a device.
        variance = np.sum([(each**2).sum(axis=2) for each in moved], axis=0) / 1.5
        margin = (clear - radius_mm) / np.sqrt(np.maximum(variance, 1e-12))
        return np.asarray(np.clip(margin, -CAP, CAP).min(axis=1))

    def _hits(self, moved: list[Float]) -> Float:
        """Return the chance that the end `(N, 3)` of a needle stays within the goal's radius.

        The squared miss is a sum of weighted chi-squares, taken as one of the same mean and variance
        [Satterthwaite1946].
        """
        from scipy.special import gammainc

        left = self._left
        end = np.tile((left.target_mm**2) * np.eye(3), (len(self._at), 1, 1))
        for each in moved:
            end += np.einsum("ni,nj->nij", each, each)
        end[:, 2, 2] += left.breathing_mm**2
        end = end + left.stop_mm**2 * np.einsum("ni,nj->nij", self._ahead, self._ahead)
        mean = np.trace(end, axis1=1, axis2=2)
        variance = 2.0 * np.einsum("nij,nji->n", end, end)
        scale = variance / (2.0 * np.maximum(mean, 1e-12))
        freedom = mean / np.maximum(scale, 1e-12)
        return np.asarray(gammainc(0.5 * freedom, 0.5 * self._radius_mm**2 / np.maximum(scale, 1e-12)))


def _shifted(points: Float, size_mm: float) -> list[Float]:
    return [np.broadcast_to(size_mm * axis, points.shape) for axis in np.eye(3)] if size_mm else []


def _tilted(points: Float, about: Float, forward: Float, size_rad: float) -> list[Float]:
    """Return what tilts about two axes across `forward` `(N, 3)` move points by."""
    if not size_rad:
        return []
    helper = np.eye(3)[np.argmin(np.abs(forward), axis=1)]
    first = np.cross(forward, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    arms = points - about[:, None]
    return [size_rad * np.cross(axis[:, None], arms) for axis in (first, np.cross(forward, first))]


def _below(standard: Float) -> Float:
    """Return the chance that a standard normal number stays below."""
    from scipy.special import ndtr

    return np.asarray(ndtr(standard))
