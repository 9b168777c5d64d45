"""What a patient adds to the errors: its breathing, the border of its vessels, and where the scope rests.

A place at height h of its lung (0 at the apex, 1 at the base) moves to the feet by `A g(h)` from end-exhale
to end-inhale, A being the patient's.  Scope and target move in the same phase.  The tip of the scope goes
along with the airway that holds it, so that only the difference of the two counts: in the frame of the
reference image the scope stays, and the target moves by `A f (g(h_target) - g(h_scope))`.  The phase f runs
from 0 at end-exhale, where the image was taken, to 1; the procedure is at any time of the cycle.  g is that
of `anatomy.motion.source`.  Where the motion of the patient is known, it takes the place of this model.  The
border of the vessels is that which the patient's segmentation states.
"""

import math
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Float
from anatomy.kept_records import kept_record
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from anatomy.motion.motion import LEFT, Motion
from lungaccess.plans.plan import Plan
from lungaccess.problem import errors
from lungaccess.uncertainty.breathing.window import carrier
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

    if asked in known:
        return known[asked]
    if lung.folder is None:
        known[asked] = make()
    else:
        # It is kept beside a lung of the cache: every command asks for the same plans again.
        depends_on = {
            "lung": lung.key, "entry": scope.lps_from_entry, "states": scope.states,
            "tip": scope.lps_from_scope_tip, "scope": to_mapping(plan.system.scope), "wall": to_mapping(wall),
        }  # fmt: skip
        known[asked] = kept_record(
            "resting", resting_format(), depends_on, TipSpread, make=make, cache=lung.folder.parent,
            name=lung.name, in_use=(lung.folder,),
        )  # fmt: skip
    return known[asked]


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
    spread_mm = math.hypot(spread.patient_mm, spread.attempt_mm)
    spread_deg = math.hypot(spread.patient_deg, spread.attempt_deg)
    rows: list[tuple[str, float, str, float | None]] = [
        ("tip off its planned place", _length(off[:3]), "mm", None),
        ("tip turned", _length(off[3:]), "deg", None),
        ("bias of the place", _length(spread.bias_mm), "mm", None),
        ("bias of the direction", _length(spread.bias_deg), "deg", None),
        ("spread of the place along an axis", spread_mm, "mm", None),
        ("spread of the direction about an axis", spread_deg, "deg", None),
        ("force on 10 mm of wall", nominal.wall_force_n, "N", wall.max_wall_force_n),
        ("the same, at most", max(forces), "N", wall.max_wall_force_n),
        ("wall pressed in", nominal.most_give_mm, "mm", wall.max_wall_give_mm),
        ("at rest with the tip at its depth", 100.0 * spread.held_share, "%", None),
    ]
    if other is not None:
        apart = off_pose(nominal.lps_from_scope_tip, other.lps_from_scope_tip)
        what = "another shape at rest" if other.settled else "slips if it came with a straight section"
        rows += [(f"{what}: tip apart", _length(apart[:3]), "mm", None)]
        rows += [(f"{what}: tip turned", _length(apart[3:]), "deg", None)]
    return tuple(
        RestingRow(name=name, value=value, unit=unit, limit=most) for name, value, unit, most in rows
    )


def _length(vector: Float) -> float:
    return float(np.linalg.norm(vector))


def about_resting_tip(model: errors.ErrorModel, plan: Plan, lung: Lung) -> errors.ErrorModel:
    """Return an error model in which what is about the resting shaft of a plan is stated about the plan."""
    kinds = [kind for kind in errors.OF_SHAFT if model.term(kind).distribution == errors.RESTING]
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


def _about(term: errors.Term, source: str, bias: Float, patient: float, attempt: float) -> errors.Term:
    """Return an error about the plan: the bias and spread of the resting tip on top of what is stated."""
    stated = term.bias or (0.0,) * len(bias)
    both = f"{term.source}; " if term.rms else ""
    changed: dict[str, Any] = {
        "distribution": errors.NORMAL,
        "source": f"{both}shaft at rest on the wall: {source}",
        f"patient_{term.unit}": round(math.hypot(term.patient, patient), DECIMALS),
        f"attempt_{term.unit}": round(math.hypot(term.attempt, attempt), DECIMALS),
        f"bias_{term.unit}": tuple(
            round(float(np.clip(of_shaft + own, -MOST, MOST)), DECIMALS)
            for of_shaft, own in zip(bias, stated, strict=True)
        ),
    }
    return replace(term, **changed)


BREATHS_LN = 0.36
"""Spread of the amplitude over breaths: 4.3 of 11.9 mm below the diaphragm, within a session [Liang2018]."""


def phase(share_of_time: Float) -> Float:
    """Return how far between end-exhale, 0, and end-inhale, 1, the lung is at shares of the cycle, 0 to 1."""
    # The phase in time is cos^6, the form that [Lujan1999] fits to quiet breathing: long at end-exhale.
    return np.asarray(np.cos(np.pi * share_of_time) ** 6)


def model_for(model: errors.ErrorModel, plan: Plan, lung: Lung) -> errors.ErrorModel:
    """Return an error model at the place of a plan, with the patient's own breathing and vessels.

    Errors about the resting shaft are stated about the plan.

    A model of free breathing keeps any phase of the breath, one without breathing is taken to insert in the
    plan's window, each with the patient's motion and the spread of amplitudes over breaths.  SettingsError is
    raised if the errors depend on the lobe and the patient came without lobes.
    """
    model = _with_border(about_resting_tip(_at_place(model, plan, lung), plan, lung), lung)
    motion, window, stated = lung.motion, plan.window, model.breathing
    if motion is None or motion.warning_only:
        return model
    gated = not stated.size or stated.distribution == errors.IN_WINDOW
    if gated and (window is None or not len(window.phases)):
        return model
    term = errors.BreathingError(
        distribution=errors.IN_WINDOW if gated else errors.BreathingError.distribution,
        median_mm=_size_mm(motion, plan),
        patient_ln=BREATHS_LN,
        source=f"the patient's own: {motion.source}; spread over breaths [Liang2018]",
    )
    return replace(model, breathing=term)


def _with_border(model: errors.ErrorModel, lung: Lung) -> errors.ErrorModel:
    """Return the errors with the border of the patient's own vessels, unless the model states another."""
    if not lung.vessel_border_mm or model.vessel_border.rms:
        return model
    mean, spread = lung.vessel_border_mm
    source = "the patient's own: `vessel_border_mm`, see `anatomy.segmentation.vessels.border_mm`"
    return replace(
        model, vessel_border=errors.PositionError(patient_mm=spread, bias_mm=(mean,), source=source)
    )


def _at_place(model: errors.ErrorModel, plan: Plan, lung: Lung) -> errors.ErrorModel:
    """Return the errors where the scope's tip of a plan stands."""
    if not model.place:
        return model
    if lung.lobes is None and any(each.lobe for each in model.place):
        raise SettingsError(
            f"The errors {model.label} depend on the lobe, and the patient has no masks of the lobes",
            expected="a patient with lobes, or places by generation alone",
            remedy="Segment the lobes with `lungaccess segment`, or leave out `lobe`",
        )
    tip, tree = np.asarray(plan.scope.lps_from_scope_tip)[:3, 3], lung.tree
    return model.at(lung.lobe_at(tip), int(tree.generation[tree.branch_of_point[tree.nearest_point(tip)]]))


def _size_mm(motion: Motion, plan: Plan) -> float:
    """Return the motion that 95 % of the points of the target's lung do not exceed."""
    return motion.figures["left_95_mm" if motion.side_of(plan.target_lps) == LEFT else "right_95_mm"]


class PatientMotion:
    """How the target of a plan moves against its devices, by the motion of the patient."""

    def __init__(self, plan: Plan, motion: Motion) -> None:
        side = motion.side_of(plan.target_lps)
        self._motion, self._target = motion, np.asarray(plan.target_lps)
        self._rigid = carrier(motion, plan.scope.lps_from_scope_tip[:3, 3], side)
        self._moves = motion.displacements_mm(self._target[None], side)[0]
        self._size_mm = _size_mm(motion, plan)
        self._phases = np.zeros((0, 2)) if plan.window is None else np.asarray(plan.window.phases)

    @property
    def has_window(self) -> bool:
        """Whether the plan has a window of breathing."""
        return bool(len(self._phases))

    def shifts_mm(self, motion_mm: Float, luck: Float, *, in_window: bool) -> Float:
        """Return the shifts of the target `(N, 3)` as the devices see it, LPS mm in the masks' frame.

        Args:
            motion_mm ((N,) float64): Motion of 95 % of the lung's points in each breath.
            luck ((N,) float64): From 0 to 1: the share of the cycle's time, or of the window's phases.
            in_window: Whether the phase is one of the plan's window.
        """
        motion, rigid = self._motion, self._rigid
        at = _in_stretches(self._phases, luck) if in_window else phase(luck)
        share = motion.amplitude * motion_mm / self._size_mm * (at - motion.masks_phase)
        left, _, right = np.linalg.svd(np.eye(3) + share[:, None, None] * rigid.gradient)
        seen = self._target - rigid.centre + share[:, None] * (self._moves - rigid.displacement)
        return np.asarray(np.einsum("nji,nj->ni", left @ right, seen) + rigid.centre - self._target)


def _in_stretches(stretches: Float, luck: Float) -> Float:
    """Return phases `(N,)` at shares of the length of all stretches `(M, 2)` together."""
    ends = np.cumsum(stretches[:, 1] - stretches[:, 0])
    along = luck * ends[-1]
    which = np.minimum(np.searchsorted(ends, along), len(ends) - 1)
    return np.asarray(stretches[which, 1] - (ends[which] - along))
