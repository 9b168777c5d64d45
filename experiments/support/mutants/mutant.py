"""What a mutation of a plan works on, what it makes, and the random sizes it draws.

A mutation takes a case and a random generator and returns a mutant, or None where the plan leaves it nothing
to falsify (the roll of a straight needle, say).  A mutant is false or unsafe by a size that docs/check.md
says is refused; its digest fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.typed import Float
from lungaccess.checking import CheckReport
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, system_fingerprint

Rng = np.random.Generator


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
    """A plan that must be refused, perhaps because of one voxel.

    Parameters
    ----------
    plan : Plan
    voxel : (3,) int64, optional
        Index of a voxel of the lung that has another label.
    label : int
        That label.
    asked : bool
        Whether the check is told for which system and target the plan has to be.
    """

    plan: Plan
    voxel: Any = None
    label: int = 0
    asked: bool = False


Mutation = Callable[[Case, Rng], Mutant | None]


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
    margin = system.margins.total_mm
    return changed(
        plan,
        system=system,
        system_fingerprint=system_fingerprint(system),
        required_clearance_mm={
            "outer_tube": system.tubes.outer.radius_mm + margin,
            "inner_tube": system.tubes.inner.radius_mm + margin,
            "needle": system.needle.radius_mm + margin,
        },
    )


def direction(rng: Rng) -> Float:
    """Return a random direction `(3,)`."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def far(rng: Rng, low: float, high: float) -> float:
    """Return a random size; small ones are as likely as large ones."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def signed(rng: Rng, low: float, high: float) -> float:
    """Return a random size of either sign."""
    return far(rng, low, high) * float(rng.choice([-1.0, 1.0]))


def rotation(axis: Float, angle_rad: float) -> Float:
    """Return the `(3, 3)` rotation about an axis [Rodrigues]."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle_rad) * cross + (1.0 - np.cos(angle_rad)) * cross @ cross)
