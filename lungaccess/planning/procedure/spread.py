"""How errors spread along deployed devices, to first order: a fast estimate of the chance of success.

It ranks candidates before any of them is simulated, and deployments from a scope's tip as measured.  Errors
are taken as small and normal.  Then each point of a device has a normal error whose covariance is the sum
over the kinds of error of `v v^T`, where `v` is what one standard deviation moves the point by.
"""

import math
from functools import cached_property

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.motion.source import share_of_motion
from lungaccess.planning.procedure.kernels import spread as kernel
from lungaccess.problem.errors import BREATHING, CURVATURE, ErrorModel
from lungaccess.problem.procedures import Procedure
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.tube import Deployments


def sizes_of(
    system: System, errors: ErrorModel, procedure: Procedure, stretch: float, aside_mm: float = 0.0
) -> kernel.Sizes:
    """Return what a procedure leaves of the errors by measuring, with the devices; a bias counts as spread.

    Without a needle no length of the tubes is exempt.

    Args:
        stretch: That of `Draws`.
        aside_mm: How far beside the target the needle may aim.
    """
    placed, aimed = errors.term("scope_position").rms, errors.term("target_position").rms
    angles = ("scope_direction", "tube_rotation", "needle_roll")
    turned, rotated, rolled = (math.radians(errors.term(kind).rms) for kind in angles)
    scope, image, steering = procedure.scope, procedure.imaging, procedure.needle
    steered, breath = steering.closed_loop, abs(stretch) * errors.term(BREATHING).size
    foot = math.hypot(aimed, breath)
    if scope.measured:
        placed = fused_size(placed, scope.position_mm)
        turned = fused_size(turned, math.radians(scope.direction_deg))
    if image.measured:
        aimed, foot = fused_size(aimed, image.position_mm), fused_size(foot, image.position_mm)
    tubes, needle = system.tubes, system.needle
    # The tip of the tubes follows from scope and tubes where nothing measures it.
    tip = procedure.tubes if procedure.tubes.measured else steering
    tip_known = needle is not None and (procedure.tubes.measured or steered)
    return kernel.Sizes(
        scope=placed, scope_turn=turned, rotation=rotated, insertion=errors.tube_insertion.rms,
        tip_known=tip_known, tip=tip.position_mm if tip_known else 0.0,
        tip_turn=math.radians(tip.direction_deg),
        curvature=0.0 if steered else errors.term(CURVATURE).size, roll=0.0 if steered else rolled,
        stop=0.0 if needle is None else errors.needle_insertion.rms,
        target=aimed, breathing=math.sqrt(max(foot**2 - aimed**2, 0.0)),
        bend=tubes.free_curvature_per_mm if tubes.planar else 0.0,
        steepest=1.0 if needle is None else needle.max_curvature_per_mm * errors.needle_curvature.median,
        slack=errors.term(CURVATURE).size, aside=aside_mm, tube_radius=tubes.inner.radius_mm,
        needle_radius=0.0 if needle is None else needle.radius_mm,
        exempt=-1.0 if needle is None else needle.exit_exemption_mm,
    )  # fmt: skip


def fused_size(expected: float, measured: float) -> float:
    """Return the standard deviation of what two independent errors leave together."""
    if expected == 0.0 or measured == 0.0:
        return 0.0
    return expected * measured / math.hypot(expected, measured)


ASIDE = 0.6
"""Points beside the target are aimed at so far out, as a share of the goal's radius: what is left of it is
there for the errors that come after."""


class Spread:
    """Direct arcs of the needle from N deployments to one target, with what the errors do to each.

    Without a needle the tubes end at the target, where a needle of no length shows what the errors do.  The
    tips `(N, 9)` are point, direction and +x of the scope tip of each, LPS mm; `radius_mm` is that of the
    goal.
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
            sizes_of(system, errors, procedure, height - scope, aside), np.ascontiguousarray(tips), ends,
            deployments.tangents, deployments.exit_mm, deployments.inner_mm,
            (x, y, z), self._found,
        )  # fmt: skip

    @cached_property
    def chances(self) -> Float:
        """The estimated chance of success of each, `(N,)`: to end in the goal, and to stay clear.

        What deviated tubes meet of the airway that they leave is not in it.
        """
        margin = self._found[:, [kernel.OF_TUBE, kernel.OF_NEEDLE]].min(axis=1)
        # The chance that the target lies within the needle's bending from where the tubes truly end.
        reached = _below(self._found[:, kernel.REACH]) if self._replanned else 1.0
        return np.asarray(self.goal_chances * reached * _below(margin))

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


def _below(standard: Float) -> Float:
    """Return the chance that a standard normal number stays below."""
    from scipy.special import ndtr

    return np.asarray(ndtr(standard))


LEAST = 1e-9
"""A measurement is taken to be no better than this, mm or rad, so that exact ones can be weighed as well."""


def fused_share(expected: Float, measured: float) -> Float:
    """Return the share of a measurement that is believed."""
    return np.asarray(expected**2 / np.maximum(expected**2 + measured**2, LEAST**2))


def scope_moves(expected: Float, position_mm: float, direction_rad: float) -> Float:
    """Return what one standard deviation of each error moves the pose of a scope's tip by, see `fused`."""
    moves = np.zeros((*expected.shape[:-2], 6, 5))
    moves[..., :3, :3] = position_mm * np.eye(3)
    moves[..., 3:, 3:] = direction_rad * expected[..., :3, :2]
    return moves


def tip_moves(lps_from_scope_tip: Float, expected: Float, left: kernel.Sizes) -> Float:
    """Return what one standard deviation of each error moves the pose of the tubes' tip by, see `fused`."""
    axes, ahead = np.moveaxis(lps_from_scope_tip[..., :3, :3], -1, 0), expected[..., :3, 2]
    arm = expected[..., :3, 3] - lps_from_scope_tip[..., :3, 3]
    about = np.cross(axes[2], ahead)
    about = about / np.maximum(np.linalg.norm(about, axis=-1, keepdims=True), LEAST)
    moves = np.zeros((*expected.shape[:-2], 6, 7))
    moves[..., :3, :3] = left.scope * np.eye(3)
    for column, size in enumerate((left.scope_turn, left.scope_turn, left.rotation)):
        moves[..., :3, 3 + column] = size * np.cross(axes[column], arm)
        moves[..., 3:, 3 + column] = size * axes[column]
    moves[..., :3, 6] = left.insertion * ahead
    moves[..., 3:, 6] = left.insertion * left.bend * about
    return moves


def fused(expected: Float, errors: Float, measured: Float, position_mm: float, direction_rad: float) -> Float:
    """Return the most likely poses of tips, with the roll of the measured ones.

    Args:
        expected, measured: (..., 4, 4) float64.
        errors ((..., 6, E) float64): What one standard deviation of each of E errors moves the expected pose
            by: mm, and rotation vector.
        position_mm, direction_rad: Standard deviations of the measurement, along each axis and about each of
            two axes.
    """
    if position_mm <= LEAST and direction_rad <= LEAST:
        return measured
    across = np.swapaxes(expected[..., :3, :2], -1, -2)
    seen = np.zeros((*expected.shape[:-2], 5, 6))
    seen[..., :3, :3], seen[..., 3:, 3:] = np.eye(3), across
    turned = (across @ _turn(expected[..., :3, 2], measured[..., :3, 2])[..., None])[..., 0]
    gap = np.concatenate([measured[..., :3, 3] - expected[..., :3, 3], turned], axis=-1)
    moves = seen @ errors
    noise = np.array([max(position_mm, LEAST)] * 3 + [max(direction_rad, LEAST)] * 2) ** 2
    weighed = np.linalg.solve(moves @ np.swapaxes(moves, -1, -2) + np.diag(noise), gap[..., None])
    step = (errors @ (np.swapaxes(moves, -1, -2) @ weighed))[..., 0]
    towards = _turned(expected[..., :3, 2], step[..., 3:])
    x, y, z = np.moveaxis((np.swapaxes(measured[..., :3, :3], -1, -2) @ towards[..., None])[..., 0], -1, 0)
    off = np.hypot(x, y)
    scale = np.arctan2(off, z) / np.maximum(off, LEAST)
    likely = tilted(measured, scale * x, scale * y)
    likely[..., :3, 3] = expected[..., :3, 3] + step[..., :3]
    return likely


def tilted(frames: Float, x: Float, y: Float) -> Float:
    """Return poses whose +z is tilted by angles in rad towards their own +x and +y."""
    turn = np.stack([-y, x, np.zeros_like(x)], axis=-1)
    out = np.array(frames)
    for column in range(3):
        local = np.zeros(3)
        local[column] = 1.0
        turned = _turned(np.broadcast_to(local, turn.shape), turn)
        out[..., :3, column] = (frames[..., :3, :3] @ turned[..., None])[..., 0]
    return out


def as_measured(frames: Float, position_mm: float, direction_deg: float, noise: Float) -> Float:
    """Return poses as they are measured with errors: `noise` has five standard normal numbers of each."""
    x, y = np.moveaxis(np.radians(direction_deg) * noise[..., :2], -1, 0)
    seen = tilted(frames, x, y)
    seen[..., :3, 3] += position_mm * noise[..., 2:5]
    return seen


def mean_pose(poses: Float) -> Float:
    """Return the mean place and direction of poses `(K, 4, 4)`, with the roll of the last."""
    last = poses[-1]
    x, y, z = last[:3, :3].T @ poses[:, :3, 2].mean(axis=0)
    off = np.hypot(x, y)
    scale = np.arctan2(off, z) / np.maximum(off, LEAST)
    mean = tilted(last, scale * x, scale * y)
    mean[:3, 3] = poses[:, :3, 3].mean(axis=0)
    return mean


def _turn(one: Float, other: Float) -> Float:
    """Return the rotation vectors of the shortest turns from unit vectors to others."""
    across = np.cross(one, other)
    size = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(size, (one * other).sum(axis=-1))
    return np.asarray(across * np.divide(angle, size, out=np.ones_like(size), where=size > 0.0)[..., None])


def _turned(vector: Float, turn: Float) -> Float:
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    along = (turn * vector).sum(axis=-1, keepdims=True) * turn * 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.cos(angle) * vector + np.cross(turn, vector) * np.sinc(angle / np.pi) + along)
