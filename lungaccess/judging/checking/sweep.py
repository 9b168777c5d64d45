"""How far tubes get sideways while they are deployed, against the limit and against what a plan states."""

from lungaccess.judging.checking.findings import Findings
from lungaccess.plans.plan import Plan

SWEEP_TOLERANCE_MM = 0.02
"""So much less may a replay at steps find than a planner that takes the largest sweep."""


def check_sweep(plan: Plan, sweep: float, leader: float, steps: int, found: Findings) -> float:
    """Record sweep and error at the tip of a replay; return the sweep, mm, that clearance allows for.

    The sweep is the farthest that any place of the tubes gets from their final shape, `leader` the farthest
    that their tip does.
    """
    tube, limit = plan.tube, plan.system.tubes.max_lateral_sweep_mm
    detail = f"sideways motion while the tubes are deployed, {steps} steps replayed"
    found.at_most("tube.sweep.limit", sweep, limit, "mm", detail, SWEEP_TOLERANCE_MM)
    detail = "sideways motion as stated"
    found.at_most("tube.sweep.stated_limit", tube.lateral_sweep_mm, limit, "mm", detail)
    stated = ((tube.lateral_sweep_mm, sweep, "sweep"), (tube.follow_the_leader_error_mm, leader, "leader"))
    for value, recomputed, name in stated:
        detail = "not less than recomputed"
        found.at_least(f"tube.{name}.stated", value, recomputed, "mm", detail, SWEEP_TOLERANCE_MM)
    return max(sweep if sweep > SWEEP_TOLERANCE_MM else 0.0, tube.lateral_sweep_mm)
