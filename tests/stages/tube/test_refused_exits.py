"""How far a hazard before the exit refuses exits: never one that the validator accepts."""

from __future__ import annotations

import numba
import numpy as np

from anatomy.base.typed import Float
from anatomy.poses import pose
from anatomy.structures import VESSEL
from stages.tube import Deployment, kernels
from stages.tube.kernels import refused_exits
from tests.stages.scenes import Canvas, brute_clearance
from tests.stages.tube.flat_wall import MARGIN, NUMBERS, validated

BASE, FORWARD = (-6.0, 0.0, -4.0), (0.95, 0.0, 0.31)
"""A start from which the tube meets the wall nearly at a right angle: it touches it for the least length."""
INSERTED_MM = 14.0
REQUIRED_MM = 0.6 + MARGIN
LOW, HIGH = np.array([-9.0, -4.0, -8.0]), np.array([11.0, 4.0, 8.0])
SCENES = 30


@numba.njit
def refused_until(tubes: Float, s: Float, lack: Float) -> float:
    """Up to where the places `s` `(N,)` of an inner tube alone refuse exits."""
    end = 0.0
    for n in range(len(s)):
        if lack[n] > 0.0:
            end = max(end, refused_exits(tubes, s[n], lack[n], 0.0))
    return end


def test_no_accepted_exit_is_refused_by_a_vessel_before_it() -> None:
    """Balls of vessel in the lumen, beside the tube's way to the wall."""
    tip = pose(BASE, FORWARD, (1.0, 0.0, 0.0))
    at = np.arange(0.0, INSERTED_MM, 0.05)
    plane = np.array([kernels.planar_point(NUMBERS, 0.0, INSERTED_MM, s) for s in at])
    points = tip[:3, 3] + plane[:, :1] * tip[:3, 0] + plane[:, 1:] * tip[:3, 2]
    exit_mm = float(at[np.flatnonzero(points[:, 0] < 0.0)[-1]])
    rng = np.random.default_rng(3)
    found = []
    for _ in range(SCENES):
        canvas = Canvas.empty(LOW, HIGH, 0.25)
        canvas.airway(canvas.points[..., 0] < 0.0, canvas.points[..., 0] < 1.0, 0)
        beside = points[np.searchsorted(at, exit_mm - rng.uniform(1.6, 2.4))]
        centre = beside + rng.uniform(0.4, 1.4) * np.array([0.0, 1.0, 0.0])
        canvas.add(canvas.ball(centre, 0.4) & (canvas.points[..., 0] < 0.0), VESSEL)
        lung = canvas.lung()
        if isinstance(validated(lung, 0.0, INSERTED_MM, base=BASE, forward=FORWARD), Deployment):
            before = at < exit_mm
            near = brute_clearance(lung.labels, lung.grid, points[before], VESSEL, 3.0)
            lack = REQUIRED_MM - near
            found.append(exit_mm - refused_until(NUMBERS, at[before], lack))
    assert min(found) > 0.0, "an accepted exit would be refused"
    assert min(found) < 0.2, "no vessel came near to refuse it"
