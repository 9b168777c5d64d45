"""The independent check: it computes everything in a finished plan anew and accepts or refuses the plan."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.lobes import FISSURES_UNKNOWN_HERE
from lungaccess.judging.checking import shapes
from lungaccess.judging.checking.boxes import Environment
from lungaccess.judging.checking.completion import Motions, completed_plan
from lungaccess.judging.checking.deployment import check_deployment
from lungaccess.judging.checking.findings import PASS, CheckReport, Finding, Findings
from lungaccess.judging.checking.outcome import TISSUE, check_needle_load, check_tubes_at_target
from lungaccess.judging.checking.record import check_record
from lungaccess.judging.checking.scope import check_scope
from lungaccess.judging.checking.steering import check_needle
from lungaccess.judging.checking.window import check_window
from lungaccess.plans.plan import Plan
from lungaccess.problem.goals import goals
from lungaccess.problem.system import System

if TYPE_CHECKING:
    from anatomy.lung import Lung


class Checker:
    """Checks many plans of one lung, whose arrays must not change: what follows from it is computed once."""

    def __init__(self, lung: "Lung") -> None:
        self._environment = Environment(lung)

    def check(
        self, plan: Plan, system: System | None = None, *, target_lps: ArrayLike | None = None
    ) -> CheckReport:
        """Check one plan, each of its passes; see `lungaccess.judging.checking.check`."""
        first, *others = (self._check_pass(each, system, target_lps) for each in plan.passes)
        # What is known by the names of findings is that of the first pass.
        named = [
            _of_further(one, number) for number, report in enumerate(others, 2) for one in report.findings
        ]
        accepted = first.accepted and all(each.ok is not False for each in named)
        return CheckReport(accepted=accepted, findings=(*first.findings, *named))

    def _check_pass(self, plan: Plan, system: System | None, target_lps: ArrayLike | None) -> CheckReport:
        """Check a plan of one pass."""
        found = Findings()
        target = None if target_lps is None else np.asarray(target_lps, dtype=np.float64)
        if check_record(plan, self._environment.lung, found, system, target):
            check_scope(plan.scope, plan.system, self._environment, found)
            tube_tip = check_deployment(plan, self._environment, found)
            check_needle_load(plan, found)
            needle, device = plan.needle, plan.system.needle
            if needle is None or device is None:
                check_tubes_at_target(plan, self._environment, tube_tip, found)
            else:
                check_needle(plan, needle, device, self._environment, tube_tip, found)
            _check_fissure_chance(plan, self._environment.lung, found)
            check_window(plan, self._environment, found)
            _check_functions(plan, self._environment.lung, found)
        return found.report()

    def completed(self, motions: Motions, system: System, target_lps: ArrayLike, *, method: str) -> Plan:
        """Return the plan that bare motions make; see `completion.completed_plan`."""
        target = np.asarray(target_lps, dtype=np.float64)
        return completed_plan(motions, self._environment, system, target, method=method)


def _of_further(one: Finding, number: int) -> Finding:
    """Return a finding of a further pass: the first takes enough as planned, and others may lie beside it."""
    if one.name == TISSUE:
        detail = "what this pass takes as planned, beside the first, which takes enough"
        one = Finding(name=one.name, ok=True, value=one.value, unit=one.unit, detail=detail)
    return replace(one, name=f"{PASS}{number}.{one.name}")


def check(
    plan: Plan, lung: "Lung", system: System | None = None, *, target_lps: ArrayLike | None = None
) -> CheckReport:
    """Check a plan against the masks of a patient, independently of how it was made.

    The kinematics are re-integrated, clearances are measured with FCL to the exact surface of the voxel
    boxes, containment is looked up in the label volume, and every stated value is recomputed.  Nothing
    of the planners' arithmetic is used, nor the clearance fields.  `docs/explanation/check.md` explains every
    finding.  For many plans of one lung use `Checker`.

    Args:
        system: The devices that will be used; the plan's must be the same.  Without it only a plan whose
            system has the name of a preset is compared with something.
        target_lps ((3,) array_like): The target that was asked for, LPS mm; the plan's must be the same.
    """
    return Checker(lung).check(plan, system, target_lps=target_lps)


def _check_fissure_chance(plan: Plan, lung: "Lung", found: Findings) -> None:
    """Recompute the chance of crossing a fissure along the axes, and compare it with what is allowed."""
    name, stated, most = "fissure.chance", plan.fissure_chance, plan.system.max_fissure_chance
    if lung.fissure_band is None:
        found.true(f"{name}.known", stated is None and most is None, "no band of a fissure is known")
        return
    tubes = shapes.integrate(plan.scope.lps_from_scope_tip, shapes.tube_pieces(plan))
    points = [shapes.beyond(tubes, plan.tube.exit.arc_length_mm).points]
    if plan.needle is not None:
        points.append(shapes.integrate(plan.needle.lps_from_start, plan.needle.arcs).points)
    chance = lung.fissure_chance(np.concatenate(points))
    if chance is None:
        found.true(f"{name}.known", most is None, FISSURES_UNKNOWN_HERE)
        found.unchecked("patient.fissures", FISSURES_UNKNOWN_HERE)
        return
    if found.true(f"{name}.known", stated is not None, "a band of the fissures is known"):
        # Places that differ by a part of a step may lie in voxels of other chances.
        found.at_most(f"{name}.stated", chance, stated or 0.0, "", "recomputed against stated", 0.03)
    if most is not None:
        found.at_most(name, chance, most, "", "chance that tubes or needle cross a fissure", 0.03)
    else:
        found.measured(name, chance, "", "chance that tubes or needle cross a fissure")


def _check_functions(plan: Plan, lung: "Lung", found: Findings) -> None:
    """Compute every function that the plan states a value of, where it is known here."""
    known = goals()
    for name, stated in plan.goals.items():
        goal = known.get(name)
        if goal is None or not goal.is_function:
            found.unchecked(f"goals.{name}", "no such goal is known here: import the code that registers it")
            continue
        value = goal.computed(plan, lung)
        # A function of the same plan may differ by this share of its value on another machine.
        found.agrees(f"goals.{name}", stated, value, 1e-9 * abs(value), goal.unit)
