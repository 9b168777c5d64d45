"""A plan with its appraisal as plain values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lungaccess.plans.costs import known_costs
from lungaccess.plans.scope_steps import motion_record

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.judging.appraisal.appraiser import Appraisal
    from lungaccess.plans.plan import Plan


def plan_record(
    plan: Plan, lung: Lung, appraisal: Appraisal, folder: Path, files: tuple[str, ...]
) -> dict[str, Any]:
    """Return what a search for a plan found and wrote; lengths in mm, times in s."""
    return {
        "found": True,
        **appraisal.to_mapping(),
        "refusals": [each.to_mapping() for each in appraisal.check.refusals],
        "not_checked": [each.name for each in appraisal.check.unchecked],
        "folder": str(folder),
        "files": list(files),
        "digest": plan.digest,
        "objective": plan.objective,
        "cost": plan.cost,
        "cost_bound": plan.cost_bound or None,
        "gap": plan.gap,
        "costs": known_costs(plan.costs, has_map=lung.cost is not None),
        "system": plan.system.name,
        "system_choice": list(plan.system_choice),
        "clearance_mm": {device: dict(values) for device, values in plan.clearance_mm.items()},
        "iterations": plan.iterations,
        "timing": dict(plan.timing),
        "scope_motion": motion_record(plan, lung),
    }
