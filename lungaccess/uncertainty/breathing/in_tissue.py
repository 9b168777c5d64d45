"""A needle that stays in place while the lung breathes: tissue carries it, the scope carries the tubes.

These are figures of samples, not a proof: no mechanics of needle and tissue is modelled.
"""

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow
from lungaccess.uncertainty.breathing.devices import device_points
from lungaccess.uncertainty.breathing.moving import Moving

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
    worst = np.array([0.0, 0.0, 0.0, np.inf])
    factor = 1.0
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
                radius = _least_radius_mm(curve[::step])
                seen = np.array([np.linalg.norm(miss), np.linalg.norm(away), bend])
                worst[:3] = np.maximum(worst[:3], seen)
                worst[3] = min(worst[3], radius)
                now = _length(curve) / length
                factor = now if abs(now - 1.0) > abs(factor - 1.0) else factor
    return CarriedNeedle(
        end_miss_mm=float(worst[0]),
        shift_at_tubes_mm=float(worst[1]),
        bend_at_tubes_deg=float(worst[2]),
        least_radius_mm=float(worst[3]),
        length_factor=float(factor),
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
