"""Joint values for a wanted tip pose, or for the pose nearest to it that the tubes can take."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import qmc

from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.equilibrium import Equilibrium
from stages.tube.mechanics import TubeMechanics

Match = Literal["position", "direction", "pose"]

SHORTEST_MM = 1e-3
"""The innermost tube is ahead of the front plate by at least this."""


@frozen_record
class InverseSolution:
    """What the tubes can do towards a wanted tip pose: a stable equilibrium within the limits.

    They have reached the pose if the errors are within the tolerances.  The direction error is the angle
    between the tip's axis and the wanted one, 0 if only the position is wanted; the roll error is that of the
    remaining turn about the axis, 0 unless the whole pose is wanted.

    Parameters
    ----------
    base_angles_rad, beta_mm : (n,) float64
        Joint values.
    """

    reached: bool
    equilibrium: Equilibrium
    base_angles_rad: Float
    beta_mm: Float
    position_error_mm: float
    direction_error_rad: float
    roll_error_rad: float


def inverse_kinematics(
    mechanics: TubeMechanics,
    base_from_tip: ArrayLike,
    *,
    match: Match = "direction",
    max_extension_mm: float = 60.0,
    mm_per_rad: float = 40.0,
    position_tolerance_mm: float = 0.01,
    angle_tolerance_rad: float = 1e-3,
    starts: int = 12,
    seed: int = 0,
) -> InverseSolution:
    """Find joint values that bring the tip to a pose, or as near to it as the tubes come.

    Nearness is distance in mm and angle in rad times `mm_per_rad`, as a root of squares.  Tip angles and
    lengths ahead of the front plate are varied, in which tubes never fail to have a shape; limits hold at
    every step.  The best of several starts is taken; what is unstable is not.

    Parameters
    ----------
    base_from_tip : (4, 4) float64
        Wanted pose of the innermost tube's tip, +z along its axis.
    match : {"position", "direction", "pose"}
        What of it counts: the point; that and the axis; these and the turn about the axis.
    max_extension_mm : float
        Largest length of tube ahead of the front plate.
    position_tolerance_mm, angle_tolerance_rad : float
        What counts as reached.
    starts, seed : int
        How many of the sampled configurations are refined, and the seed of the samples.

    Raises
    ------
    FrameError
        If the pose is not rigid and finite.
    SettingsError
        If a number is not above 0, the extension is longer than the innermost tube, or no configuration
        that is stable was met.

    Examples
    --------
    >>> from stages.tube import Tube, TubeMechanics, inverse_kinematics
    >>> tube = Tube(
    ...     outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=680.0, curved_length_mm=40.0,
    ...     precurvature_per_mm=0.025,
    ... )
    >>> mechanics = TubeMechanics([tube])
    >>> wanted = mechanics.given_base_angles([0.3], [-640.0]).base_from_tip
    >>> found = inverse_kinematics(mechanics, wanted)
    >>> found.reached, found.beta_mm.round(2).tolist()
    (True, [-640.0])
    """
    wanted = _checked_pose(base_from_tip)
    reach = _checked_extension(mechanics, max_extension_mm)
    if not (mm_per_rad > 0.0 and starts > 0):
        raise SettingsError(f"mm_per_rad is {mm_per_rad:g}, starts {starts}", expected="both above 0")
    problem = _Problem(mechanics, wanted, match, reach, mm_per_rad)
    best: tuple[float, Equilibrium] | None = None
    for start in problem.starts(starts, seed):
        result = least_squares(
            problem.residual, start, problem.jacobian, bounds=problem.bounds, x_scale="jac", xtol=1e-13,
            ftol=1e-13, gtol=1e-13, max_nfev=120,
        )  # fmt: skip
        found = problem.at(result.x)
        # Where several are the same but for rounding, the first one is kept.
        if found.stable and (best is None or result.cost < best[0] - 1e-12):
            best = result.cost, found
    if best is None:
        raise SettingsError(
            "No stable configuration of the tubes was met",
            expected="tubes that are stable in some configurations",
            remedy="lower the precurvature, or raise the number of starts",
        )
    return _solution(best[1], wanted, match, position_tolerance_mm, angle_tolerance_rad)


SAMPLES = 256
"""Configurations sampled before the best of them are refined: enough to meet every kind of bend."""


class _Problem:
    """Residuals over tip angles and lengths ahead, with limits that are a box.

    The variables are the n tip angles, the length ahead of the front plate as a share of its limit, and for
    each further tube the share of the range that its neighbour inside leaves it.
    """

    def __init__(
        self, mechanics: TubeMechanics, wanted: Float, match: Match, reach_mm: float, mm_per_rad: float
    ) -> None:
        n = mechanics.count
        self._mechanics, self._wanted, self._reach = mechanics, wanted, reach_mm
        self._columns = {"position": [], "direction": [2], "pose": [0, 1, 2]}[match]
        # The square of the angle between two frames is half the sum of the squares of what three axes move.
        self._weight = mm_per_rad * (math.sqrt(0.5) if match == "pose" else 1.0)
        low = np.concatenate([np.full(n, -np.inf), np.zeros(n)])
        high = np.concatenate([np.full(n, np.inf), np.ones(n)])
        low[n] = SHORTEST_MM / reach_mm
        self.bounds = (low, high)
        self._last: tuple[bytes, Equilibrium] | None = None

    def shifts(self, x: Float) -> tuple[Float, Float]:
        """Return beta `(n,)` and its derivatives `(n, n)` by the shares."""
        n = self._mechanics.count
        lengths = self._mechanics.lengths_mm
        ahead, derivative = np.zeros(n), np.zeros((n, n))
        ahead[0], derivative[0, 0] = x[n] * self._reach, self._reach
        for i in range(1, n):
            least = ahead[i - 1] - (lengths[i - 1] - lengths[i])
            follows = derivative[i - 1] if least > 0.0 else np.zeros(n)
            least = max(least, 0.0)
            ahead[i] = least + x[n + i] * (ahead[i - 1] - least)
            derivative[i] = follows + x[n + i] * (derivative[i - 1] - follows)
            derivative[i, i] += ahead[i - 1] - least
        return np.minimum(ahead - lengths, 0.0), derivative

    def at(self, x: Float) -> Equilibrium:
        """Return the configuration; the last one is kept."""
        if self._last is None or self._last[0] != x.tobytes():
            beta = self.shifts(x)[0]
            self._last = x.tobytes(), self._mechanics.given_tip_angles(x[: len(beta)], beta)
        return self._last[1]

    def residual(self, x: Float) -> Float:
        """Return what is missing, mm."""
        tip = self.at(x).base_from_tip
        turned = (tip - self._wanted)[:3, self._columns].T.ravel()
        return np.concatenate([(tip - self._wanted)[:3, 3], self._weight * turned])

    def jacobian(self, x: Float) -> Float:
        """Return the derivatives of the residuals."""
        found = self.at(x)
        n = self._mechanics.count
        free = found.jacobian_of_tip_angles
        moved = np.concatenate([free[:, :n], free[:, n:] @ self.shifts(x)[1]], axis=1)
        axes = [found.base_from_tip[:3, c] for c in self._columns]
        turned = [self._weight * np.cross(moved[3:].T, axis).T for axis in axes]
        return np.concatenate([moved[:3], *turned])

    def starts(self, count: int, seed: int) -> list[Float]:
        """Return the nearest of many configurations, each turned so that its tip is on the wanted side."""
        n = self._mechanics.count
        low, high = self.bounds
        samples = qmc.Sobol(2 * n, rng=np.random.default_rng(seed)).random(SAMPLES)
        ranked = []
        for sample in samples:
            x = np.concatenate([2.0 * math.pi * sample[:n], low[n:] + sample[n:] * (high[n:] - low[n:])])
            tip = self.at(x).base_from_tip[:3, 3]
            aside = self._wanted[:3, 3] if np.hypot(*self._wanted[:2, 3]) > 1e-9 else self._wanted[:3, 2]
            x[:n] += math.atan2(aside[1], aside[0]) - math.atan2(tip[1], tip[0])
            ranked.append((float(np.square(self.residual(x)).sum()), tuple(x)))
        return [np.array(x) for _cost, x in sorted(ranked)[:count]]


def _checked_pose(base_from_tip: ArrayLike) -> Float:
    pose = np.array(base_from_tip, dtype=np.float64)
    rigid = pose.shape == (4, 4) and bool(np.isfinite(pose).all())
    if rigid:
        rotation = pose[:3, :3]
        rigid = bool(np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-6 and np.linalg.det(rotation) > 0)
    if not rigid:
        raise FrameError("The wanted tip pose is not rigid", expected="a finite 4x4 matrix with a rotation")
    return pose


def _checked_extension(mechanics: TubeMechanics, max_extension_mm: float) -> float:
    longest = float(mechanics.lengths_mm[0])
    if not SHORTEST_MM < max_extension_mm <= longest:
        raise SettingsError(
            f"max_extension_mm is {max_extension_mm:g}",
            expected=f"above {SHORTEST_MM:g}, at most the length of the innermost tube, {longest:g}",
        )
    return float(max_extension_mm)


def _solution(
    found: Equilibrium, wanted: Float, match: Match, position_tolerance_mm: float, angle_tolerance_rad: float
) -> InverseSolution:
    tip = found.base_from_tip
    away = float(np.linalg.norm(tip[:3, 3] - wanted[:3, 3]))
    direction = roll = 0.0
    if match != "position":
        axes = np.cross(tip[:3, 2], wanted[:3, 2])
        direction = math.atan2(float(np.linalg.norm(axes)), float(tip[:3, 2] @ wanted[:3, 2]))
    if match == "pose":
        # Of the turn that is missing, what is left once the axes agree.
        between = tip[:3, :3].T @ wanted[:3, :3]
        roll = abs(math.atan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1]))
    reached = away <= position_tolerance_mm and max(direction, roll) <= angle_tolerance_rad
    return InverseSolution(
        reached=reached,
        equilibrium=found,
        base_angles_rad=read_only(found.base_angles_rad.copy()),
        beta_mm=found.beta_mm,
        position_error_mm=away,
        direction_error_rad=direction,
        roll_error_rad=roll,
    )
