"""Devices of another name, consistent in themselves, that do not pass the scope's bends."""

from __future__ import annotations

from dataclasses import replace

from anatomy.base.errors import SettingsError
from anatomy.base.settings import override
from experiments.support.mutants.draws import Rng, far
from experiments.support.mutants.mutant import Case, Mutant, Mutation, with_system


def limit_lower(case: Case, rng: Rng) -> Mutant | None:
    """The material stands less strain, or the channel less bend, than the way through the scope asks."""
    factor = 1.0 / far(rng, 1.05, 2.0)
    if rng.integers(2):
        measured = max(_value(case, f"tube.strain.{name}") for name, _tube in case.plan.system.tubes.named)
        edits = {"tubes.max_strain": measured * factor, "tubes.max_channel_curvature_per_mm": None}
    else:
        edits = {"tubes.max_channel_curvature_per_mm": _value(case, "tube.channel") * factor}
    try:
        return Mutant(plan=with_system(case.plan, override(case.plan.system, {**edits, "name": "own"})))
    except SettingsError:
        return None


def slots_stripped(case: Case, rng: Rng) -> Mutant | None:
    """Tubes that use much of their limit of strain have lost the slots that keep them within it."""
    tubes = case.plan.system.tubes
    if tubes.outer is None or not tubes.outer.slotted_segments:
        return None
    measured = max(_value(case, "tube.strain.outer"), _value(case, "tube.strain.inner"))
    weakest = max(tube.slotted_segments[0].strain_factor for tube in (tubes.outer, tubes.inner))
    try:
        bare = replace(
            tubes,
            outer=replace(tubes.outer, slotted_segments=()),
            inner=replace(tubes.inner, slotted_segments=()),
            max_channel_curvature_per_mm=None,
            max_strain=measured * float(rng.uniform(1.0, max(0.95 / weakest, 1.0))),
        )
    except SettingsError:
        return None
    if weakest > 0.9:
        return None
    return Mutant(plan=with_system(case.plan, replace(case.plan.system, tubes=bare, name="own")))


def handle_weaker(case: Case, rng: Rng) -> Mutant | None:
    """The handle bends the section less far than section and tubes together need."""
    wanted = _value(case, "scope.handle")
    up = case.plan.scope.states[-1, 2] >= 0.0
    degrees = wanted / far(rng, 1.05, 2.0) * 57.29577951308232
    if degrees < 1.0:
        return None
    key = "scope.bend_up_deg" if up else "scope.bend_down_deg"
    return Mutant(plan=with_system(case.plan, override(case.plan.system, {key: degrees, "name": "own"})))


def section_softer(case: Case, rng: Rng) -> Mutant | None:
    """The bending section is so soft that the tubes straighten it beyond what the handle can set."""
    limit = case.limit("scope.handle")
    bend = abs(float(case.plan.scope.states[-1, 2]))
    if limit is None or bend < 0.02:
        return None
    stiffness = case.plan.system.scope.bending_stiffness_n_mm2
    tubes = stiffness * (_value(case, "scope.handle") / bend - 1.0)
    softest = tubes / (limit / bend - 1.0)
    edits = {"scope.bending_stiffness_n_mm2": softest / far(rng, 1.1, 5.0), "name": "own"}
    return Mutant(plan=with_system(case.plan, override(case.plan.system, edits)))


def _value(case: Case, finding: str) -> float:
    return next((each.value for each in case.report.findings if each.name == finding), None) or 0.0


MUTATIONS: tuple[Mutation, ...] = (limit_lower, slots_stripped, handle_weaker, section_softer)
