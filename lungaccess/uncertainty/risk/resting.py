"""Errors about where the shaft of the scope comes to rest on the wall, instead of about the plan."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import NORMAL, OF_SHAFT, RESTING, ErrorModel, Term
from stages.scope import Bronchoscope, RestingShaft, ScopeMotion, TipSpread, WallContact, lumen_of, tip_spread

DECIMALS = 3
"""Sizes from the resting shaft are stated to a thousandth of a mm or degree: far finer than they are known."""
MOST = 50.0
"""A tip that lies farther off than so many mm, or looks so many degrees aside, fails like one that does more."""
_Asked = tuple[bytes, bytes, Bronchoscope, WallContact]
_SPREADS: WeakKeyDictionary[Lung, dict[_Asked, TipSpread]] = WeakKeyDictionary()
"""What was found in a lung: plans with one motion of the scope, and all the errors of each, ask again."""


def resting_tip(plan: Plan, lung: Lung, wall: WallContact) -> TipSpread:
    """Return where the tip of a plan's scope comes to rest, as distribution about the planned pose."""
    scope, known = plan.scope, _SPREADS.setdefault(lung, {})
    entry, states = np.asarray(scope.lps_from_entry), np.asarray(scope.states)
    asked = entry.tobytes(), states.tobytes(), plan.system.scope, wall
    if asked not in known:
        motion = ScopeMotion(
            lps_from_entry=entry, states=states, bending_length_mm=plan.system.scope.bending_length_mm
        )
        shaft = RestingShaft(lumen_of(lung), plan.system.scope, wall)
        known[asked] = tip_spread(shaft, motion, wall, np.asarray(scope.lps_from_scope_tip))
    return known[asked]


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
    about: dict[str, Any] = {kind: _about(model.term(kind), model.wall.source, *found[kind]) for kind in kinds}
    return replace(model, wall=None, place=(), **about)


def _about(term: Term, source: str, bias: Float, patient: float, attempt: float) -> Term:
    """Return an error about the plan: the bias and spread of the resting tip on top of what is stated."""
    stated = term.bias or (0.0,) * len(bias)
    sizes = {
        f"patient_{term.unit}": round(math.hypot(term.patient, patient), DECIMALS),
        f"attempt_{term.unit}": round(math.hypot(term.attempt, attempt), DECIMALS),
        f"bias_{term.unit}": tuple(
            round(float(np.clip(of_shaft + own, -MOST, MOST)), DECIMALS)
            for of_shaft, own in zip(bias, stated, strict=True)
        ),
    }
    both = f"{term.source}; " if term.rms else ""
    changed: dict[str, Any] = {"distribution": NORMAL, "source": f"{both}shaft at rest on the wall: {source}"}
    return replace(term, **changed, **sizes)
