"""Which change of one device parameter would make a target reachable, shown by a plan with that change."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lungaccess.coupled.atlas import Atlas, build_atlas
from lungaccess.coupled.search import AtlasSearch
from lungaccess.coupled.search.diverse import different_candidates
from lungaccess.plans.assemble import Candidate, Task, assemble
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from stages.needle import direct_arcs
from stages.scope import Bronchoscope
from stages.tube import DEFAULT_ROTATIONS, DEFAULT_STOP_MM

TIGHTEST_RADIUS_MM = 20.0
THINNEST_NEEDLE_MM = 0.3
THINNEST_SCOPE_MM = 2.2
LEAST_WALL_MM = 0.2
"""A scope is thicker than its channel by so much at least."""
RADIUS_STEP_MM = 1.0
DIAMETER_STEP_MM = 0.05
SCOPE_STEP_MM = 0.1
ROTATIONS = DEFAULT_ROTATIONS // 2
STOP_MM = 2.0 * DEFAULT_STOP_MM
"""A thinner scope has many more places to stand; what it could do there is enumerated more coarsely."""

_THIN: WeakKeyDictionary[Atlas, Atlas] = WeakKeyDictionary()


@dataclass(frozen=True, kw_only=True, eq=False)
class Remedy:
    """A change of one device parameter with which the target is reached.

    Parameters
    ----------
    parameter : str
        In words.
    present, needed : float
        Its value, and the nearest one found with which a plan exists; mm.
    plan : Plan
        A plan with that change alone.
    """

    parameter: str
    present: float
    needed: float
    plan: Plan

    @property
    def relative_change(self) -> float:
        """By which part of itself the parameter has to change."""
        return abs(self.needed - self.present) / self.present

    def __str__(self) -> str:
        return f"{self.parameter} of {self.needed:g} mm instead of {self.present:.4g} mm"


def remedies(search: AtlasSearch) -> tuple[Remedy, ...]:
    """Return what would help, the smallest relative change first.

    Tighter curvature and a thinner needle, with the deployments of the atlas, and a thinner scope, with what
    it could reach beyond them: each changed alone, no more than a single arc of the needle demands.  Whether
    such a device exists, and what else it would need, is not asked.
    """
    found = [*_curvature(search), *_needle_diameter(search), *_scope_diameter(search)]
    return tuple(sorted(found, key=lambda remedy: remedy.relative_change))


def _curvature(search: AtlasSearch) -> Iterator[Remedy]:
    needle = search.task.system.needle
    present = needle.min_radius_of_curvature_mm

    def made(radius_mm: float) -> System:
        tighter = replace(needle, max_curvature_per_mm=1.0 / radius_mm)
        return _changed(search.task.system, needle=tighter)

    yield from _least_change(
        search, "a needle with a radius of curvature", present, TIGHTEST_RADIUS_MM, RADIUS_STEP_MM, made
    )


def _needle_diameter(search: AtlasSearch) -> Iterator[Remedy]:
    needle = search.task.system.needle

    def made(diameter_mm: float) -> System:
        return _changed(search.task.system, needle=replace(needle, diameter_mm=diameter_mm))

    yield from _least_change(
        search, "a needle with a diameter", needle.diameter_mm, THINNEST_NEEDLE_MM, DIAMETER_STEP_MM, made
    )


def _least_change(
    search: AtlasSearch, name: str, present: float, limit: float, step: float, made: Callable[[float], System]
) -> Iterator[Remedy]:
    """Halve the range of a parameter of the needle: what a value reaches, a smaller one reaches too."""
    low, high = limit, math.floor(present / step + 1e-9) * step
    if low >= high or (best := _planned(search, search.atlas, made(low))) is None:
        return
    needed = low
    while high - needed > 1.5 * step:
        middle = round(0.5 * (needed + high) / step) * step
        plan = _planned(search, search.atlas, made(middle))
        if plan is None:
            high = middle
        else:
            needed, best = middle, plan
    yield Remedy(parameter=name, present=present, needed=round(needed, 6), plan=best)


def _scope_diameter(search: AtlasSearch) -> Iterator[Remedy]:
    """Enumerate what a very thin scope could do; of what reaches the target take what lets it be thickest."""
    task = search.task
    scope = task.system.scope
    atlas = _with_the_thinnest_scope(search.atlas)
    if atlas is None:
        return
    thin = AtlasSearch(replace(task, system=_with_scope(task.system, _thinnest_mm(scope))), atlas)
    entries, near = atlas.deployments, thin.in_workspace
    blockers, _lengths, _costs = direct_arcs(
        thin.desk.environment, entries.positions[near], entries.tangents[near], entries.branch[near],
        task.target.lps_mm,
    )  # fmt: skip
    clear = near[blockers == 0]
    radius_mm = atlas.sites.narrowest_radius_mm[entries.site[clear]] - scope.lumen_margin_mm
    for entry in clear[np.argsort(-radius_mm, kind="stable")]:
        candidate = thin.finished(int(entry))
        if candidate is None:
            continue
        widest = 2.0 * float(radius_mm[clear == entry][0])
        needed = round(math.floor(widest / SCOPE_STEP_MM + 1e-9) * SCOPE_STEP_MM, 6)
        system = _with_scope(task.system, needed)
        plan = _assembled(replace(task, system=system), atlas, candidate)
        yield Remedy(
            parameter="a bronchoscope with an outer diameter",
            present=scope.outer_diameter_mm,
            needed=needed,
            plan=plan,
        )
        return


def _thinnest_mm(scope: Bronchoscope) -> float:
    return max(THINNEST_SCOPE_MM, scope.channel_diameter_mm + LEAST_WALL_MM)


def _with_the_thinnest_scope(atlas: Atlas) -> Atlas | None:
    """Return the atlas of the thinnest scope around the same channel, made once; None if it is no thinner."""
    thinnest = _thinnest_mm(atlas.system.scope)
    if thinnest >= atlas.system.scope.outer_diameter_mm:
        return None
    if atlas not in _THIN:
        thin = _with_scope(atlas.system, thinnest)
        _THIN[atlas] = build_atlas(atlas.lung, thin, rotations=ROTATIONS, stop_spacing_mm=STOP_MM)
    return _THIN[atlas]


def _with_scope(system: System, outer_diameter_mm: float) -> System:
    return _changed(system, scope=replace(system.scope, outer_diameter_mm=outer_diameter_mm))


def _changed(system: System, **parts: Any) -> System:
    """Return a system with another part, and a name that says so: it is no longer the preset."""
    return replace(system, **parts, name=f"{system.name} (changed)")


def _planned(search: AtlasSearch, atlas: Atlas, system: System) -> Plan | None:
    task = replace(search.task, system=system)
    other = AtlasSearch(task, replace(atlas, system=system))
    for candidate in different_candidates(other, 1, 1.0):
        return _assembled(task, atlas, candidate)
    return None


def _assembled(task: Task, atlas: Atlas, candidate: Candidate) -> Plan:
    return assemble(task, atlas.sites, candidate, iteration=0, timing={"atlas_s": atlas.build_s})
