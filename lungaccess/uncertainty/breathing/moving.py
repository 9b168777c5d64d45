"""Where the tissue of a lung and the devices of a plan are in a phase, and where the needle has to end then.

How far a deployment misses the moving target depends on the place of the tip of the scope and on where the
devices end, and on nothing else; see docs/theory/proofs.md.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow
from lungaccess.uncertainty.breathing.kernels.aim import aim_between, most_shares
from lungaccess.uncertainty.breathing.kernels.rigid import Rigid, turned
from lungaccess.uncertainty.breathing.window import (
    TOLERANCE_MM,
    WHOLE_BREATH,
    carrier,
    device_points,
    distance_mm,
    miss_allowed,
    require_motion,
)


@frozen_record
class Moving:
    """Tissue and devices of one plan in any phase.

    The lung of the target moves as the plan's window has it.  The other lung has its own displacement, which
    takes over smoothly beyond the middle, so that a picture of both has no tear.
    """

    tissue: Motion
    rigid: Rigid

    @classmethod
    def of(cls, plan: Plan, lung: Lung) -> Self:
        """Return what moves with the breathing of the patient of a plan; AnatomyError without a motion."""
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


PHASES = 41
"""Phases of the breath that are looked at, and of each stretch of the window a quarter as many."""


@frozen_value
class CarriedNeedle:
    """What the breath does to a needle that was inserted in the window and moves with the tissue from there.

    All are the worst over the phases of insertion and of the breath that were looked at.

    Args:
        end_miss_mm: Distance of its end from the moving target.
        shift_at_tubes_mm: How far tissue moves the needle's begin from the end of the tubes, which the scope
            carries.
        bend_at_tubes_deg: Angle between the needle's begin and the end of the tubes.
        least_radius_mm: Smallest radius of curvature of the needle, over 10 mm.
        length_factor: Length of its way through tissue by that at insertion, the one farthest from 1: the
            needle itself does not stretch, and slides by the rest.
    """

    end_miss_mm: float
    shift_at_tubes_mm: float
    bend_at_tubes_deg: float
    least_radius_mm: float
    length_factor: float


def carried_needle(plan: Plan, lung: Lung, window: BreathingWindow) -> CarriedNeedle:
    """Return what the breath does to the needle of a plan that tissue carries from its insertion on.

    Raises:
        SettingsError: If the plan has no needle, or its window no phase to insert it in.
        AnatomyError: If the patient has no motion.
    """
    if plan.needle is None or not len(window.phases):
        raise SettingsError(
            "The plan has no needle" if plan.needle is None else "The window holds no phase to insert in",
            expected="a plan with a needle, and a window in which it is inserted",
            remedy="Plan with a needle: lungaccess plan PATIENT --objective window",
        )
    moving, devices = Moving.of(plan, lung), device_points(plan)
    needle = devices.points[devices.arc_mm >= devices.tube_mm][1:]
    # Bends are looked at over two such chords: the distance of a motion's nodes.
    step = max(int(5.0 / np.linalg.norm(needle[1] - needle[0])), 1)
    tubes, target = plan.needle.lps_from_start[:3, 3], np.asarray(plan.target_lps)[None]
    ahead, breath = plan.needle.lps_from_start[:3, 2], np.linspace(0.0, 1.0, PHASES)
    seen = []
    for begin, end in window.phases:
        for inserted in np.linspace(begin, end, PHASES // 4):
            tissue = moving.pulled_back(moving.carried(needle, inserted), inserted)
            length = _length(moving.moved(tissue, inserted))
            for phase in breath:
                curve, pose = moving.moved(tissue, float(phase)), moving.pose(float(phase))
                away = curve[0] - (pose[:3, :3] @ tubes + pose[:3, 3])
                miss = curve[-1] - moving.moved(target, float(phase))[0]
                a = curve[min(step, len(curve) - 1)] - curve[0]
                b = pose[:3, :3] @ ahead
                bend = float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
                shifts = np.linalg.norm(miss), np.linalg.norm(away)
                seen.append((*shifts, bend, _least_radius_mm(curve[::step]), _length(curve) / length))
    misses, shifted, bent, radii, factors = np.array(seen).T
    return CarriedNeedle(
        end_miss_mm=float(misses.max()),
        shift_at_tubes_mm=float(shifted.max()),
        bend_at_tubes_deg=float(bent.max()),
        least_radius_mm=float(radii.min()),
        length_factor=float(factors[np.abs(factors - 1.0).argmax()]),
    )


def _length(curve: Float) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def _least_radius_mm(points: Float) -> float:
    """Return the smallest radius of the circles through three points on end; infinite if they are in line."""
    a, b = points[1:-1] - points[:-2], points[2:] - points[1:-1]
    area = np.linalg.norm(np.cross(a, b), axis=1)
    sides = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) * np.linalg.norm(a + b, axis=1)
    with np.errstate(divide="ignore"):
        return float((sides / (2.0 * area)).min(initial=np.inf))


SAMPLES = 33
"""Phases that are looked at: between two of them the target strays from a line by micrometres."""
HALVINGS = 10
"""Of the width of phases that an aim is made for: to 0.1 % of the breath."""


@frozen_value
class Aim:
    """Where the needle has to end from one place of the scope's tip, and for which phases.

    Args:
        point_lps (tuple of 3 floats): LPS mm in the masks' phase.
        phases (tuple of 2 floats): First and last phase that it is made for.
        least_miss_mm: No end of the devices comes nearer to the target in all of them.
        allowed_mm: No end of the devices may miss the target by more: the tolerance, less what tissue strays.
        most_share: No end of the devices has the target within the tolerance in more of the breath.
    """

    point_lps: tuple[float, float, float]
    phases: tuple[float, float]
    least_miss_mm: float
    allowed_mm: float
    most_share: float


class MovingTarget:
    """A target and its motion, as the devices see it.

    Args:
        target_lps ((3,) float64, LPS mm): Place of the masks.
        phases (tuple of 2 floats): Phases that every aim is made for.
        widened: Whether aims are made for more phases about these, as many as the tolerance allows.
        middle: The phase about which they are made where none are given, the masks' if None.
    """

    def __init__(
        self,
        motion: Motion,
        target_lps: Float,
        phases: tuple[float, float] | None = None,
        *,
        widened: bool,
        middle: float | None = None,
    ) -> None:
        self._motion, self._target = motion, np.array(target_lps, dtype=np.float64)
        self._side = motion.side_of(target_lps)
        self._moves = motion.displacements_mm(self._target[None], self._side)[0]
        self._phases, self._widened = phases, widened
        self._middle = motion.masks_phase if middle is None else middle

    def aim(self, tip_lps: Float, towards: float | None = None) -> Aim:
        """Return the aim from a place `(3,)` of the scope's tip, about a phase in place of `middle`."""
        rigid = carrier(self._motion, tip_lps, self._side)
        point = np.zeros(3)

        def made_for(phases: tuple[float, float]) -> tuple[float, float]:
            begin, end = (self._motion.share(phase) for phase in phases)
            half, miss = aim_between(rigid, self._target, self._moves, begin, end, SAMPLES, point)
            return float(half), float(miss)

        def fits(phases: tuple[float, float]) -> bool:
            miss = made_for(phases)[1]
            # Share of the tolerance that an aim uses: the proof needs some room for rounding.
            return miss <= miss_allowed(self._motion, 0.999 * TOLERANCE_MM, distance_mm(point, tip_lps))

        middle = self._middle if towards is None else towards
        phases = self._phases or (middle, middle)
        if self._widened and fits(phases):
            phases = _widest(fits, phases, middle if self._phases is None else 0.5 * sum(phases))
        least_mm, _miss = made_for(phases)
        begin, end = (self._motion.share(phase) for phase in WHOLE_BREATH)
        apart = max(abs(begin), abs(end)) * distance_mm(self._moves, rigid.displacement)
        allowed = TOLERANCE_MM - self._motion.hysteresis * max(
            distance_mm(self._target, tip_lps) - apart, 0.0
        )
        shares = most_shares(rigid, self._target, self._moves, begin, end, SAMPLES, allowed)
        x, y, z = point.tolist()
        return Aim(
            point_lps=(x, y, z),
            phases=phases,
            least_miss_mm=least_mm,
            allowed_mm=allowed,
            most_share=shares / (end - begin) if end > begin else 1.0,
        )


def _widest(
    fits: Callable[[tuple[float, float]], bool], least: tuple[float, float], middle: float
) -> tuple[float, float]:
    """Return the widest phases about a middle, as far as the breath goes, that fit and hold the least."""

    def of_width(width: float) -> tuple[float, float]:
        begin = min(max(middle - 0.5 * width, least[1] - width, 0.0), least[0], 1.0 - width)
        return begin, begin + width

    low, high = least[1] - least[0], 1.0
    if fits(WHOLE_BREATH):
        return WHOLE_BREATH
    for _ in range(HALVINGS):
        width = 0.5 * (low + high)
        low, high = (width, high) if fits(of_width(width)) else (low, width)
    return of_width(low)
