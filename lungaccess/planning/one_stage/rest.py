"""The rest of a plan: what is left to do from a measured pose."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.assemble import (
    needle_clearance_mm,
    needle_part,
    stated_costs,
    tube_clearance_mm,
    tube_part,
)
from lungaccess.plans.parts import NeedlePath, TubeDeployment
from lungaccess.problem.task import Task
from stages.needle import ArcPath
from stages.tube import Deployment


@frozen_record
class RestOfPlan:
    """What is left to do from a measured pose: proved clear and within all limits.

    Args:
        lps_from_measured ((4, 4) float64): The pose as it was taken: that of the scope's tip, or of the
            tube's tip where there is no deployment.
        deployment: Of the tubes, where they are left to do.
        path: Of the needle, or without one of the tubes in tissue.
        branch: Branch whose wall is exempt at the exit; -1 for none.
    """

    task: Task
    lps_from_measured: Float
    deployment: Deployment | None
    path: ArcPath
    branch: int

    @cached_property
    def tube(self) -> TubeDeployment | None:
        """The tubes as a plan states them, None where they stand already."""
        if self.deployment is None:
            return None
        return tube_part(self.task, self.lps_from_measured, self.deployment)

    @cached_property
    def needle(self) -> NeedlePath | None:
        """The needle as a plan states it; None where the system has none, and the tubes end at the target."""
        return None if self.task.system.needle is None else needle_part(self.path)

    @cached_property
    def clearance_mm(self) -> Mapping[str, Mapping[str, float]]:
        """As that of a plan."""
        clearance = {}
        if self.task.system.needle is not None:
            clearance["needle"] = needle_clearance_mm(self.task, self.path, self.branch)
        if self.deployment is not None:
            clearance["tube"] = tube_clearance_mm(self.task, self.lps_from_measured, self.deployment)
        return clearance

    @cached_property
    def costs(self) -> Mapping[str, float]:
        """As those of a plan."""
        return stated_costs(self.task, self.lps_from_measured, self.deployment, self.path)

    @property
    def objective(self) -> str:
        """The objective in words."""
        return str(self.task.objective)

    @property
    def cost(self) -> float:
        """Cost under the objective."""
        return float(self.costs[self.objective])

    def record(self) -> dict[str, Any]:
        """Return plain JSON values; poses in LPS mm, angles in rad."""
        from lungaccess.plans.file import plain

        return {
            "found": True,
            "lps_from_measured": self.lps_from_measured.tolist(),
            "tube": None if self.tube is None else plain(self.tube),
            "needle": None if self.needle is None else plain(self.needle),
            "pierced_branch": self.branch,
            "clearance_mm": {name: dict(each) for name, each in self.clearance_mm.items()},
            "objective": self.objective,
            "costs": dict(self.costs),
        }
