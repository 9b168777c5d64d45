"""What the action server answers, as plain values in the layout of the messages; no ROS is needed here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import lungaccess as la
from lungaccess.problem.target import point_target
from lungaccess.showing.live import plan_trajectory
from lungaccess.showing.live.trajectory import PATH_FILES, joint_trajectory, tip_path

MM_PER_M = 1000.0
DEFAULT_SYSTEM = "lung-default"


def answer(goal: Any, tell: Callable[[float], object] = lambda _cost: None) -> dict[str, Any]:
    """Plan, check and estimate, and return the result of `PlanAccess` as plain values.

    Args:
        goal: the goal of `PlanAccess`.
        tell: Receives the cost of each better plan.
    """
    none = {"found": False, "accepted": False, "success": -1.0, "plan": ""}
    try:
        lung = la.load_patient(goal.patient)
        system = la.load_system(goal.system or DEFAULT_SYSTEM)
        place = goal.target
        target = point_target(lung, [MM_PER_M * place.x, MM_PER_M * place.y, MM_PER_M * place.z])
        plan = None
        for plan in la.plan(lung, system, target, time_s=goal.budget_s):
            tell(plan.cost)
    except (la.NoPlan, la.LungaccessError) as refusal:
        return {**none, "text": str(refusal)}
    assert plan is not None  # A search without a plan raises NoPlan.
    appraisal = la.appraise(plan, lung)
    success = appraisal.headline.success
    found = {
        "found": True,
        "accepted": appraisal.accepted,
        "text": appraisal.headline.text,
        "success": -1.0 if success is None else success.value,
        "plan": plan.to_json(),
    }
    if not appraisal.accepted:
        return found
    trajectory = plan_trajectory(plan)
    paths = {stage: tip_path(trajectory, stage) for stage in PATH_FILES if stage in trajectory.stages}
    return {**found, "joints": joint_trajectory(trajectory), **paths}
