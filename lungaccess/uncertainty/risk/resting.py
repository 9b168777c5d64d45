"""Errors about where the shaft of the scope comes to rest on the wall, instead of about the plan."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Float
from anatomy.kept_records import kept_record
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import NORMAL, OF_SHAFT, RESTING, ErrorModel, Term
from stages.scope import (
    Bronchoscope,
    RestingShaft,
    ScopeMotion,
    TipSpread,
    WallContact,
    lumen_of,
    off_pose,
    spread_of_tip,
)

DECIMALS = 3
"""Sizes from the resting shaft are stated to a thousandth of a mm or degree, far finer than known."""
MOST = 50.0
"""A tip that is off by so many mm or degrees fails like one that is off by more."""
_Asked = tuple[bytes, bytes, Bronchoscope, WallContact]
_SPREADS: WeakKeyDictionary[Lung, dict[_Asked, TipSpread]] = WeakKeyDictionary()
"""What was found in a lung: plans with one motion of the scope, and all the errors of each, ask again."""
FORMAT = 1
"""Raise it when the same motion comes to rest elsewhere with the same kernels: what is kept is made anew."""


def resting_format() -> str:
    """Return what tells scopes at rest of this version and these kernels from all others."""
    return f"{FORMAT}-{kernel_digest('anatomy', 'stages.scope')}"


def resting_tip(plan: Plan, lung: Lung, wall: WallContact) -> TipSpread:
    """Return where the tip of a plan's scope comes to rest, as distribution about the planned pose."""
    scope, known = plan.scope, _SPREADS.setdefault(lung, {})
    entry, states = np.asarray(scope.lps_from_entry), np.asarray(scope.states)
    asked = entry.tobytes(), states.tobytes(), plan.system.scope, wall

    def make() -> TipSpread:
        motion = ScopeMotion(
            lps_from_entry=entry, states=states, bending_length_mm=plan.system.scope.bending_length_mm
        )
        shaft = RestingShaft(lumen_of(lung), plan.system.scope, wall)
        return spread_of_tip(shaft, motion, wall, np.asarray(scope.lps_from_scope_tip))

    if asked not in known:
        known[asked] = make() if lung.folder is None else _kept(plan, lung, lung.folder, wall, make)
    return known[asked]


def _kept(
    plan: Plan, lung: Lung, folder: Path, wall: WallContact, make: Callable[[], TipSpread]
) -> TipSpread:
    """Return what is kept of a motion in a lung of the cache: every command asks for the same plans again."""
    depends_on = {
        "lung": lung.key,
        "entry": plan.scope.lps_from_entry,
        "states": plan.scope.states,
        "tip": plan.scope.lps_from_scope_tip,
        "scope": to_mapping(plan.system.scope),
        "wall": to_mapping(wall),
    }
    return kept_record(
        "resting", resting_format(), depends_on, TipSpread, make=make, cache=folder.parent, name=lung.name,
        in_use=(folder,),
    )  # fmt: skip


@frozen_value
class RestingRow:
    """One finding of what the shaft at rest does to a plan, with its limit if it has one."""

    name: str
    value: float
    unit: str
    limit: float | None = None

    @property
    def words(self) -> str:
        """The limit, and whether it is kept; "" without one."""
        if self.limit is None:
            return ""
        return f"{self.limit:g} {self.unit}{'' if self.value <= self.limit else ', EXCEEDED'}"


def resting_rows(spread: TipSpread, wall: WallContact) -> tuple[RestingRow, ...]:
    """Return what the shaft at rest does to a plan, for people."""
    off, nominal, other = spread.nominal_off, spread.nominal, spread.other
    forces = [nominal.wall_force_n, *spread.wall_force_n.tolist()]
    spread_mm, spread_deg = (
        math.hypot(spread.patient_mm, spread.attempt_mm),
        math.hypot(spread.patient_deg, spread.attempt_deg),
    )
    rows = [
        RestingRow(name="tip off its planned place", value=_length(off[:3]), unit="mm"),
        RestingRow(name="tip turned", value=_length(off[3:]), unit="deg"),
        RestingRow(name="bias of the place", value=_length(spread.bias_mm), unit="mm"),
        RestingRow(name="bias of the direction", value=_length(spread.bias_deg), unit="deg"),
        RestingRow(name="spread of the place along an axis", value=spread_mm, unit="mm"),
        RestingRow(name="spread of the direction about an axis", value=spread_deg, unit="deg"),
        RestingRow(
            name="force on 10 mm of wall", value=nominal.wall_force_n, unit="N", limit=wall.max_wall_force_n
        ),
        RestingRow(name="the same, at most", value=max(forces), unit="N", limit=wall.max_wall_force_n),
        RestingRow(
            name="wall pressed in", value=nominal.most_give_mm, unit="mm", limit=wall.max_wall_give_mm
        ),
        RestingRow(name="at rest with the tip at its depth", value=100.0 * spread.held_share, unit="%"),
    ]
    if other is not None:
        apart = off_pose(nominal.lps_from_scope_tip, other.lps_from_scope_tip)
        what = "another shape at rest" if other.settled else "slips if it came with a straight section"
        rows += [
            RestingRow(name=f"{what}: tip apart", value=_length(apart[:3]), unit="mm"),
            RestingRow(name=f"{what}: tip turned", value=_length(apart[3:]), unit="deg"),
        ]
    return tuple(rows)


def _length(vector: Float) -> float:
    return float(np.linalg.norm(vector))


def about_resting_tip(model: ErrorModel, plan: Plan, lung: Lung) -> ErrorModel:
    """Return an error model in which what is about the resting shaft of a plan is stated about the plan."""
    kinds = [kind for kind in OF_SHAFT if model.term(kind).distribution == RESTING]
    if model.wall is None or not kinds:
        return model
    spread = resting_tip(plan, lung, model.wall)
    found = {
        "scope_position": (spread.bias_mm, spread.patient_mm, spread.attempt_mm),
        "scope_direction": (spread.bias_deg, spread.patient_deg, spread.attempt_deg),
    }
    about: dict[str, Any] = {
        kind: _about(model.term(kind), model.wall.source, *found[kind]) for kind in kinds
    }
    return replace(model, wall=None, place=(), **about)


def _about(term: Term, source: str, bias: Float, patient: float, attempt: float) -> Term:
    """Return an error about the plan: the bias and spread of the resting tip on top of what is stated."""
    stated = term.bias or (0.0,) * len(bias)
    both = f"{term.source}; " if term.rms else ""
    changed: dict[str, Any] = {
        "distribution": NORMAL,
        "source": f"{both}shaft at rest on the wall: {source}",
        f"patient_{term.unit}": round(math.hypot(term.patient, patient), DECIMALS),
        f"attempt_{term.unit}": round(math.hypot(term.attempt, attempt), DECIMALS),
        f"bias_{term.unit}": tuple(
            round(float(np.clip(of_shaft + own, -MOST, MOST)), DECIMALS)
            for of_shaft, own in zip(bias, stated, strict=True)
        ),
    }
    return replace(term, **changed)
