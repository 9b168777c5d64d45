"""Chances of success: deviated plans and simulated procedures of one plan, and a plan for success."""

from __future__ import annotations

import time

import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from lungaccess.planning.procedure import simulated
from lungaccess.uncertainty.risk import RiskAssessor

DEVIATED = 1_000_000
PROCEDURES = 50
RADIUS_MM = 5.0


class Chances:
    """A plan to the nodule of a synthetic lung, under the errors of `gated-ct`; CPU time."""

    timeout = 600
    number = 1
    repeat = (2, 5, 20.0)
    warmup_time = 0.0
    timer = time.process_time

    def setup(self) -> None:
        """Make the plan, and compile the kernels."""
        self.lung = build_lung(make_phantom(seed=3, size="small").images)
        self.system = la.load_system("ultrathin")
        self.target = la.resolve_target(self.lung, nodule=1)
        self.errors = la.load_errors("gated-ct")
        self.atlas = la.build_atlas(self.lung, self.system)
        plan = next(la.plan(self.lung, self.system, self.target, atlas=self.atlas, goal="default"))
        self.assessor = RiskAssessor(plan, self.lung, radius_mm=RADIUS_MM)
        system = la.with_tool(self.system, la.load_tool("core"))
        tooled = next(la.plan(self.lung, system, self.target, atlas=self.atlas, goal="default"))
        self.tooled = RiskAssessor(tooled, self.lung)
        procedure = la.load_procedure("measured-tip")
        self.policy = la.Policy(plan, self.lung, self.errors, procedure, radius_mm=RADIUS_MM)
        simulated(self.policy, 2, 1)
        self.time_plan_for_success()

    def time_deviated_plans(self) -> None:
        """A million deviated plans, carried out blindly."""
        self.assessor.success(self.assessor.draws(DEVIATED, 0), self.errors)

    def time_deviated_plans_with_a_core_needle(self) -> None:
        """A million deviated plans whose core is counted in the nodule; 4 s are half a million a second."""
        self.tooled.success(self.tooled.draws(DEVIATED, 0), self.errors)

    def time_procedures(self) -> None:
        """Fifty procedures that measure scope and tubes and plan the rest again."""
        simulated(self.policy, PROCEDURES, 0)

    def time_plan_for_success(self) -> None:
        """The first plan that states its chance, in open loop, from the atlas."""
        plans = la.plan(
            self.lung, self.system, self.target, errors=self.errors, procedure=la.load_procedure("open-loop"),
            radius_mm=RADIUS_MM, atlas=self.atlas, counterfactuals=False,
        )  # fmt: skip
        next(each for each in plans if each.chance is not None)
