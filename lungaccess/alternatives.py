"""A menu of plans to one target that are really different, and which of them no other beats."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anatomy.errors import SettingsError
from anatomy.grid import Float
from anatomy.lung import Lung
from lungaccess.assemble import Candidate, Task, assemble
from lungaccess.atlas import Atlas, build_atlas, require_same
from lungaccess.costs import require_objective
from lungaccess.kernels.apart import choose_apart
from lungaccess.plans import Plan
from lungaccess.searches import AtlasSearch
from lungaccess.system import System
from lungaccess.target import Target, require_free
from stages.needle.space import direct_arcs

Int = NDArray[np.int64]

COUNT = 15
APART_MM = 5.0
SAMPLES = 17
"""Points of each path that are compared; between two of them a path strays less than 1 mm from a line."""
NEAREST, SAMPLED, LEAST_OF_BRANCH = 1000, 2000, 100
"""Deployments that are looked at: the nearest ones, and about so many of all, evenly spaced; at least so many
of every branch."""

SMALL_IS_GOOD = ("inverse_clearance", "cost_map", "length_in_tissue_mm")
LARGE_IS_GOOD = ("clearance_mm", "pleura_mm")


@dataclass(frozen=True, kw_only=True, eq=False)
class Alternative:
    """One way to a target.

    Parameters
    ----------
    plan : Plan
    criteria : dict of str to float
        "clearance_mm" and "pleura_mm", least distance of tube and needle from any obstacle and from the
        pleura; "length_in_tissue_mm"; "inverse_clearance" and "cost_map" of the needle.
    on_front : bool
        Whether no other one of the menu is at least as good in all criteria and better in one.
    """

    plan: Plan
    criteria: dict[str, float]
    on_front: bool


def alternatives(
    lung: Lung,
    system: System,
    target: Target,
    *,
    objective: str = "inverse_clearance",
    count: int = COUNT,
    apart_mm: float = APART_MM,
    atlas: Atlas | None = None,
) -> tuple[Alternative, ...]:
    """Return up to `count` plans of which the needles of every two lie at least `apart_mm` apart somewhere.

    Direct arcs from the atlas are taken, the cheapest first, the cheapest through each airway branch before
    others; each is proved and complete as any plan.

    Parameters
    ----------
    lung : Lung
    system : System
    target : Target
    objective : str
        What "cheap" means; see `lungaccess.planner.plan`.
    count : int
    apart_mm : float
        Somewhere a point of the needle of one plan is so far from all of the other's.
    atlas : Atlas, optional
        Made with `build_atlas` beforehand.

    Raises
    ------
    NoPlan
        If no direct arc reaches the target.
    SettingsError
        If a number is not above 0, the objective is unknown, or the atlas belongs to another lung or system.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    require_objective(objective)
    if count < 1 or not apart_mm > 0.0:
        raise SettingsError(f"{count} plans {apart_mm:g} mm apart are asked for", expected="both above 0")
    require_free(lung, target.lps_mm)
    if atlas is not None:
        require_same(atlas, lung, system)
    atlas = atlas or build_atlas(lung, system)
    task = Task(
        lung=lung, system=system, target=target, objective=objective, with_fissures=atlas.with_fissures,
        method="alternatives", seed=0,
    )  # fmt: skip
    began = time.perf_counter()
    search = AtlasSearch(task, atlas)
    chosen = list(different_candidates(search, count, apart_mm))
    if not chosen:
        from lungaccess.explain import explain

        raise explain(search, 0)
    timing = {"planning_s": time.perf_counter() - began, "atlas_s": atlas.build_s}
    plans = [assemble(task, atlas.sites, each, iteration=0, timing=timing) for each in chosen]
    return judged(plans)


def different_candidates(search: AtlasSearch, count: int, apart_mm: float) -> Iterator[Candidate]:
    """Yield proved direct arcs that differ, the cheapest of each branch first, then the others.

    The nearest deployments are looked at, and an even sample of the others; of these all, sample by sample,
    only as long as there are not enough plans.
    """
    near, target = search.in_workspace, search.task.target.lps_mm
    entries = search.atlas.deployments
    pool, prices = np.zeros(0, dtype=np.int64), np.zeros(0)
    proved: dict[int, Candidate | None] = {}
    chosen: list[int] = []
    for sample in _samples(entries.branch[near]):
        looked = near[sample]
        blockers, lengths, inverse = direct_arcs(
            search.desk.space,
            entries.positions[looked],
            entries.tangents[looked],
            entries.branch[looked],
            target,
        )
        search.desk.count_blockers(blockers)
        clear = np.flatnonzero(blockers == 0)
        price = {"length_mm": lengths, "inverse_clearance": inverse}.get(search.task.objective, lengths)
        pool, prices = np.append(pool, looked[clear]), np.append(prices, price[clear])
        chosen = _chosen(search, pool[np.argsort(prices, kind="stable")], count, apart_mm, proved)
        if len(chosen) == count:
            break
    for entry in chosen:
        candidate = proved[entry]
        if candidate is not None:
            yield candidate


def _samples(branch: Int) -> Iterator[Int]:
    """Yield parts of deployments, given by their branches (N,), that together are all of them.

    The first part holds the first deployments, and evenly spaced ones of every branch.
    """
    everyone = np.arange(len(branch))
    grouped = np.argsort(branch, kind="stable")
    _names, first, group, sizes = np.unique(
        branch[grouped], return_index=True, return_inverse=True, return_counts=True
    )
    strides = np.maximum(np.minimum(len(branch) // SAMPLED, sizes // LEAST_OF_BRANCH), 1)
    part = np.zeros(len(branch), dtype=np.int64)
    part[grouped] = (everyone - first[group]) % strides[group]
    part[:NEAREST] = 0
    for number in range(int(part.max(initial=0)) + 1):
        yield np.flatnonzero(part == number)


def _chosen(
    search: AtlasSearch, ordered: Int, count: int, apart_mm: float, proved: dict[int, Candidate | None]
) -> list[int]:
    """Return the deployments of a menu, chosen from clear ones by rising cost; `proved` keeps the proofs."""
    lines = _lines(search, ordered)
    order = _branches_first(search.atlas.deployments.branch[ordered])
    while True:
        refused = [n for n, entry in enumerate(ordered.tolist()) if proved.get(entry, True) is None]
        places = np.zeros(count, dtype=np.int64)
        found = choose_apart(lines, order[~np.isin(order, refused)], float(apart_mm), places)
        chosen: list[int] = ordered[places[:found]].tolist()
        unproved = [entry for entry in chosen if entry not in proved]
        for entry in unproved:
            proved[entry] = search.finished(entry)
        if all(proved[entry] is not None for entry in chosen):
            return chosen


def _branches_first(branch: Int) -> Int:
    """Return the order in which the first of every branch comes before all others."""
    _names, first = np.unique(branch, return_index=True)
    first = np.sort(first)
    rest = np.setdiff1d(np.arange(len(branch)), first)
    return np.concatenate([first, rest])


def _lines(search: AtlasSearch, chosen: Int) -> Float:
    """Return points (E, SAMPLES, 3) of the direct arcs."""
    entries, target = search.atlas.deployments, search.task.target.lps_mm
    start, tangent = entries.positions[chosen], entries.tangents[chosen]
    way = target - start
    ahead = (way * tangent).sum(axis=1, keepdims=True)
    aside = way - ahead * tangent
    off = np.linalg.norm(aside, axis=1, keepdims=True)
    normal = np.divide(aside, off, out=np.zeros_like(aside), where=off > 1e-9)
    turn = 2.0 * np.arctan2(off, ahead)
    share = np.linspace(0.0, 1.0, SAMPLES)
    angle = turn[:, :, None] * share[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(off > 1e-9, 0.5 * (off**2 + ahead**2) / off, 0.0)[:, :, None]
    straight = (off <= 1e-9)[:, :, None] * ahead[:, :, None] * share[:, None]
    along = radius * np.sin(angle) + straight
    bent = radius * (1.0 - np.cos(angle))
    return np.asarray(start[:, None] + along * tangent[:, None] + bent * normal[:, None])


def criteria(plan: Plan) -> dict[str, float]:
    """Return what plans are compared by; see `Alternative`."""
    clearances = [values for stage in ("tube", "needle") for values in (plan.clearance_mm[stage],)]
    judged_structures = [name for name in clearances[0] if name != "fissure" or plan.fissures_are_obstacles]
    return {
        "clearance_mm": min(values[name] for values in clearances for name in judged_structures),
        "pleura_mm": min(values["outside"] for values in clearances),
        "length_in_tissue_mm": plan.needle.length_mm
        + plan.tube.inner_insertion_mm
        - plan.tube.exit.arc_length_mm,
        "inverse_clearance": plan.costs["inverse_clearance"],
        "cost_map": plan.costs["cost_map"],
    }


def judged(plans: list[Plan]) -> tuple[Alternative, ...]:
    """Return plans with their criteria, and which of them are on the Pareto front."""
    values = [criteria(plan) for plan in plans]
    signed = np.array(
        [[v[name] for name in SMALL_IS_GOOD] + [-v[name] for name in LARGE_IS_GOOD] for v in values]
    )
    beaten = [bool(((signed <= row).all(axis=1) & (signed < row).any(axis=1)).any()) for row in signed]
    return tuple(
        Alternative(plan=plan, criteria=value, on_front=not worse)
        for plan, value, worse in zip(plans, values, beaten, strict=True)
    )
