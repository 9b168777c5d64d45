"""Own look at what the needle's stiffness does to the tubes that aim it."""

import math

import numpy as np

from anatomy.base.errors import LungaccessError
from lungaccess.judging.checking.findings import Findings, angle_between
from lungaccess.plans.parts import NeedlePath
from lungaccess.plans.plan import Plan
from stages.tube.device import Tube

FINDING = "tube.needle_load"
"""The finding has this name: it states what the needle does to the tip of the tubes."""
STILL_MM = 1e-3
"""A tip that moves less is where the plan states it."""


def check_needle_load(plan: Plan, found: Findings) -> None:
    """Record where the tubes' tip is under the needle's load, if no tissue holds the tubes.

    A needle whose tip stays at that of the tubes while they are deployed bends with them: the stated shape is
    theirs together, and it must not move them any more while it is inserted.  What any other needle does is
    counted by no plan, is not checked here, and is said.
    """
    shaft, needle = plan.system.needle_tube, plan.needle
    if needle is None or shaft is None:
        return
    try:
        if plan.system.needle_preloaded:
            _check_inserted(plan, needle, shaft, found)
        else:
            _say_neglected(plan, shaft, found)
    except LungaccessError as error:
        found.unchecked(FINDING, f"no shape was found with the needle in the tubes: {error}")


def _check_inserted(plan: Plan, needle: NeedlePath, shaft: Tube, found: Findings) -> None:
    """The tip is where it is stated when the needle is inserted, too."""
    from stages.tube.casadi_shape import derive_inserted

    tube, tubes = plan.tube, plan.system.tubes
    loaded = derive_inserted(
        tubes.nested,
        shaft,
        tube.rotations_rad(tubes)[::-1],
        tube.insertions_mm(tubes)[::-1],
        needle.length_mm,
    )
    stated = np.linalg.solve(plan.scope.lps_from_scope_tip, tube.lps_from_tip)
    off_mm = float(np.linalg.norm(loaded[:3, 3] - stated[:3, 3]))
    detail = "from the stated tip of the tubes to that under the load of the inserted needle"
    found.at_most(FINDING, off_mm, 0.0, "mm", detail, STILL_MM)


def _say_neglected(plan: Plan, shaft: Tube, found: Findings) -> None:
    from stages.tube.casadi_shape import derive_arrival

    tubes = plan.system.tubes
    before, arrived = derive_arrival(
        tubes.nested, shaft, plan.tube.rotations_rad(tubes)[::-1], plan.tube.insertions_mm(tubes)[::-1]
    )
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
