"""What a mutation of a plan works on and what it makes.

A mutation takes a case and a random generator and returns a mutant, or None where the plan leaves it nothing
to falsify (the roll of a straight needle, say).  A mutant is false or unsafe by a size that
docs/explanation/check.md says is refused; its digest fits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from experiments.support.mutants.draws import Rng
from lungaccess.judging.checking import CheckReport
from lungaccess.plans.assemble import required_clearance_mm
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, system_fingerprint
from stages.tube import points_on_arcs


@frozen_record
class Case:
    """An accepted plan, what the check said of it, and another plan of the same lung."""

    lung: Lung
    plan: Plan
    report: CheckReport
    other: Plan

    def limit(self, finding: str) -> float | None:
        """Return what a finding of the accepted plan was compared with."""
        return next((each.limit for each in self.report.findings if each.name == finding), None)


@frozen_record
class Mutant:
    """A plan that must be refused, perhaps because one voxel `(3,)` of the lung has another label.

    The check is told for which system and target the plan has to be if `asked`.
    """

    plan: Plan
    voxel: Any = None
    label: int = 0
    asked: bool = False


def tube_points(plan: Plan, arc_lengths_mm: Float) -> Float:
    """Return points `(N, 3)` LPS mm of a plan's tubes at arc lengths `(N,)` from the scope tip."""
    tube, pose = plan.tube, plan.scope.lps_from_scope_tip
    return points_on_arcs(tube.shape.arcs, pose, tube.rotation_rad, arc_lengths_mm)


Mutation = Callable[[Case, Rng], Mutant | None]


def of_needle(mutation: Mutation) -> Mutation:
    """Make a mutation of the needle apply only to plans that have one."""

    @functools.wraps(mutation)
    def applied(case: Case, rng: Rng) -> Mutant | None:
        return None if case.plan.needle is None else mutation(case, rng)

    return applied


def changed(record: Any, **values: Any) -> Any:
    """Replace values in nested records, as `changed(plan, tube__exit__branch=2)`."""
    nested: dict[str, dict[str, Any]] = {}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        head, _, rest = key.partition("__")
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            flat[head] = value
    flat.update({head: changed(getattr(record, head), **inner) for head, inner in nested.items()})
    return replace(record, **flat)


def with_system(plan: Plan, system: System) -> Plan:
    """Return a plan whose system, fingerprint and required clearances agree."""
    return changed(
        plan,
        system=system,
        system_fingerprint=system_fingerprint(system),
        required_clearance_mm=required_clearance_mm(system),
    )
