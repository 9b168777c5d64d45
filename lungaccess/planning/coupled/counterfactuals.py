"""Counterfactuals: the change of one device parameter that makes a target reachable, shown by a plan."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from anatomy.base.records import frozen_record
from lungaccess.planning.coupled.atlas import Atlas, build_atlas
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.direct_candidates import direct_candidates, separated_candidates
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.task import Task
from stages.scope import Bronchoscope, ScopeMotion, prover_of
from stages.tube import DEFAULT_ROTATIONS, DEFAULT_STOP_MM

SCOPE_STEP_MM = 0.1
"""Step in which the diameter of the scope is given."""
ROTATIONS = DEFAULT_ROTATIONS // 2
STOP_MM = 2.0 * DEFAULT_STOP_MM
"""A thinner scope has many more tips; its deployments are enumerated more coarsely to save time."""

_THIN: WeakKeyDictionary[Atlas, Atlas] = WeakKeyDictionary()
"""Atlases of the thinnest scopes by the atlases they belong to: they take seconds to make."""


@frozen_record
class Counterfactual:
    """A change of one device parameter with which the target is reached.

    Args:
        present, needed: Its value, and the nearest one found with which a plan exists; mm.
    """

    parameter: str
    present: float
    needed: float
    plan: Plan

    @property
    def relative_change(self) -> float:
        """The change as a share of the present value."""
        return abs(self.needed - self.present) / self.present

    def __str__(self) -> str:
        return f"{self.parameter} of {self.needed:g} mm instead of {self.present:.4g} mm"


def find_counterfactuals(task: Task, atlas: Atlas) -> tuple[Counterfactual, ...]:
    """Return the changes of one parameter that reach the target by its simplest way, the smallest first.

    Each of curvature and diameter of the needle and diameter of the scope is changed alone, no more than a
    single arc of the needle, or without one the tubes aimed at the target, demand.  Whether such a device
    exists, and what else it would need, is not asked.
    """
    of_needle = [] if task.system.needle is None else needle_changes(task, atlas)
    found = [*of_needle, *scope_changes(task, atlas)]
    return tuple(sorted(found, key=lambda change: change.relative_change))


def needle_changes(task: Task, atlas: Atlas) -> Iterator[Counterfactual]:
    """Yield the changes of the needle alone: a tighter curvature, then a thinner needle.

    A thinner needle that lies in the tubes while they are deployed bends them less, so that the atlas does
    not hold: of it nothing is said.
    """
    needle = task.system.require_needle("A change of the needle")

    def tighter(radius_mm: float) -> System:
        return _changed(task.system, needle=replace(needle, max_curvature_per_mm=1.0 / radius_mm))

    def thinner(diameter_mm: float) -> System:
        bore_mm = needle.inner_diameter_mm * diameter_mm / needle.diameter_mm
        return _changed(
            task.system, needle=replace(needle, diameter_mm=diameter_mm, inner_diameter_mm=bore_mm)
        )

    name, present = "a needle with a radius of curvature", needle.min_radius_of_curvature_mm
    # Both are given in steps, of 1 and 0.05 mm, and no device is proposed beyond 20 and 0.3 mm.
    yield from _least_change(task, atlas, name, present, 20.0, 1.0, tighter)
    if task.system.tubes.needle_shaft is not None:
        return
    name, present = "a needle with a diameter", needle.diameter_mm
    yield from _least_change(task, atlas, name, present, 0.3, 0.05, thinner)


def _least_change(
    task: Task,
    atlas: Atlas,
    name: str,
    present: float,
    limit: float,
    step: float,
    made: Callable[[float], System],
) -> Iterator[Counterfactual]:
    """Bisect the range of a parameter of the needle: what a value reaches, a smaller one reaches too."""
    low, high = limit, math.floor(present / step + 1e-9) * step
    if low >= high or (best := _planned(task, atlas, made(low))) is None:
        return
    needed = low
    while high - needed > 1.5 * step:
        middle = round(0.5 * (needed + high) / step) * step
        plan = _planned(task, atlas, made(middle))
        if plan is None:
            high = middle
        else:
            needed, best = middle, plan
    yield Counterfactual(parameter=name, present=present, needed=round(needed, 6), plan=best)


def scope_changes(
    task: Task, atlas: Atlas, progress: Callable[[float], None] | None = None
) -> Iterator[Counterfactual]:
    """Enumerate what the thinnest scope could do; where it reaches the target, find how thick it may be.

    Args:
        progress: Told the share of the enumeration done, which takes seconds; it may raise to end it.
    """
    scope = task.system.scope
    thin_atlas = _with_the_thinnest_scope(atlas, progress)
    if thin_atlas is None:
        return
    thin = direct_candidates(replace(task, system=_with_scope(task.system, _thinnest_mm(scope))), thin_atlas)
    clear, site = thin.clear(), thin_atlas.deployments.site
    prover = prover_of(task.lung, thin_atlas.system.scope)
    for entry in clear[np.argsort(-thin_atlas.motions.room_mm[site[clear]], kind="stable")]:
        candidate = thin.proved(int(entry))
        if candidate is None:
            continue
        room_mm = prover.prove(candidate.tip.motion)
        if isinstance(room_mm, str):
            continue
        needed = _widest_mm(
            task, candidate.tip.motion, thin_atlas.system.scope.outer_diameter_mm + 2.0 * room_mm
        )
        plan = _assembled(replace(task, system=_with_scope(task.system, needed)), thin_atlas, candidate)
        yield Counterfactual(
            parameter="a bronchoscope with an outer diameter",
            present=scope.outer_diameter_mm,
            needed=needed,
            plan=plan,
        )
        return


def _widest_mm(task: Task, motion: ScopeMotion, known_mm: float) -> float:
    """Return the largest diameter, in steps and below the present one, for which a motion is proved.

    `known_mm` is known to do: the room that a proof met is a lower bound.
    """
    steps = math.floor(known_mm / SCOPE_STEP_MM + 1e-9)
    while (wider := round((steps + 1) * SCOPE_STEP_MM, 6)) < task.system.scope.outer_diameter_mm:
        if isinstance(prover_of(task.lung, _with_scope(task.system, wider).scope).prove(motion), str):
            break
        steps += 1
    return round(steps * SCOPE_STEP_MM, 6)


def _thinnest_mm(scope: Bronchoscope) -> float:
    # Beyond these sizes no device is proposed.
    # A scope is thicker than its channel by so much at least.
    return max(2.2, scope.channel_diameter_mm + 0.2)


def _with_the_thinnest_scope(atlas: Atlas, progress: Callable[[float], None] | None) -> Atlas | None:
    """Return the atlas of the thinnest scope around the same channel, made once; None if it is no thinner."""
    thinnest = _thinnest_mm(atlas.system.scope)
    if thinnest >= atlas.system.scope.outer_diameter_mm:
        return None
    if atlas not in _THIN:
        thin = _with_scope(atlas.system, thinnest)
        _THIN[atlas] = build_atlas(
            atlas.lung, thin, rotations=ROTATIONS, stop_spacing_mm=STOP_MM, progress=progress
        )
    return _THIN[atlas]


def _with_scope(system: System, outer_diameter_mm: float) -> System:
    return _changed(system, scope=replace(system.scope, outer_diameter_mm=outer_diameter_mm))


def _changed(system: System, **parts: Any) -> System:
    """Return a system with another part, and a name that says that it is not the preset."""
    return replace(system, **parts, name=f"{system.name} (changed)")


def _planned(task: Task, atlas: Atlas, system: System) -> Plan | None:
    """Return the plan of a direct arc with another system, None if there is none."""
    changed = replace(task, system=system)
    for candidate in separated_candidates(DirectArcs(changed, replace(atlas, system=system)), 1, 1.0):
        return _assembled(changed, atlas, candidate)
    return None


def _assembled(task: Task, atlas: Atlas, candidate: Candidate) -> Plan:
    return assemble(task, candidate, iteration=0, timing={"atlas_s": atlas.build_s})
