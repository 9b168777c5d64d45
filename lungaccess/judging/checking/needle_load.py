"""Own look at what the needle's stiffness does to the tubes that aim it, which plans do not count."""

from __future__ import annotations

import math

import numpy as np

from anatomy.base.errors import LungaccessError
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.poses import angle_between
from lungaccess.plans.plan import Plan

FINDING = "tube.needle_load"
"""The finding has this name: it states the needle's load on the tubes, which no plan counts."""
STILL_MM = 1e-3
"""A tip that moves less is where the plan states it."""


def check_needle_load(plan: Plan, found: Findings) -> None:
    """Record how far the tubes' tip moves and turns when the needle arrives, if no tissue holds the tubes."""
    shaft, tubes = plan.system.needle_tube, plan.system.tubes
    if plan.needle is None or shaft is None:
        return
    from stages.tube.casadi_shape import derive_arrival

    try:
        before, arrived = derive_arrival(
            tubes.nested, shaft, plan.tube.rotations_rad(tubes)[::-1], plan.tube.insertions_mm(tubes)[::-1]
        )
    except LungaccessError as error:
        found.unchecked(FINDING, f"no shape was found with the needle in the tubes: {error}")
        return
    shift_mm = float(np.linalg.norm(arrived[:3, 3] - before[:3, 3]))
    turn_rad = float(angle_between(arrived[:3, 2], before[:3, 2]))
    detail = (
        f"when the needle arrives, the tubes' tip moves by {shift_mm:.1f} mm and turns by "
        f"{math.degrees(turn_rad):.0f}° in the air"
    )
    if shift_mm > STILL_MM:
        found.unchecked(FINDING, detail)
    else:
        found.measured(FINDING, shift_mm, "mm", "motion of the tubes' tip when the needle arrives")
