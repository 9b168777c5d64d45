"""A diverse plan set: plans to one target that are separated, and which of them are Pareto-optimal."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.explanation import explain
from lungaccess.planning.coupled.planner import plan as find_plans
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates, direct_candidates
from lungaccess.planning.coupled.search.separated_arcs import separated_candidates
from lungaccess.planning.coupled.search.window_search import WindowSearch
from lungaccess.planning.coupled.window_planner import plan_for_window, require_phases, with_aim
from lungaccess.plans.assemble import assemble
from lungaccess.plans.chance import Chance
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, require_own_name
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from lungaccess.uncertainty.breathing.window import with_window
from stages.needle import DEFAULT, Objective

COUNT = 15
SEPARATION_MM = 5.0
"""Fig. 6 of [Kuntz2015] shows as many plans; the separation is a free choice."""

WINDOW = "window_share"
ITERATIONS = 100
"""Of the planner where no direct arc reaches the target: some seconds."""

SMALL_IS_GOOD = ("inverse_clearance", "cost_map", "length_in_tissue_mm")
LARGE_IS_GOOD = ("success", "clearance_mm", "pleura_mm", WINDOW)
"""Which way the criteria go."""
GEOMETRIC = (*SMALL_IS_GOOD, "clearance_mm", "pleura_mm")
TRADE_OFF = ("success", "length_in_tissue_mm", "clearance_mm")
"""The criteria of the Pareto front: without chances of success, and with them."""


@frozen_record
class Alternative:
    """One plan of a diverse plan set.

    Parameters
    ----------
    criteria : dict of str to float
        "clearance_mm" and "pleura_mm", least distance of tube and needle from any obstacle and from the
        pleura; "length_in_tissue_mm"; "inverse_clearance" and "cost_map" as the plan states them; "success",
        the share of procedures that succeed, and "window_share", that of the breath in which the plan is
        proved, where they are known.
    on_front : bool
        Whether no other plan of the set is at least as good in all criteria of the front and better in one:
        success, length and clearance where the chances of success are known, else all others; and the window
        where every plan has one.
    chance : Chance or None
        The chance of success, where it is known.
    """

    plan: Plan
    criteria: dict[str, float]
    on_front: bool
    chance: Chance | None = None


def alternatives(
    lung: Lung,
    system: System,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    count: int = COUNT,
    separation_mm: float = SEPARATION_MM,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    phases: tuple[float, float] | None = None,
    widest: bool = False,
) -> tuple[Alternative, ...]:
    """Return a diverse plan set: the needles of every two of its plans are separated by `separation_mm`.

    Two needles are separated if some point of either is at least so far from all points of the other.  The
    plans are direct arcs from the atlas.  Without a needle they are tubes aimed at the target, whose parts
    beyond the lumen are separated.  Where there is none, the one plan is the best that `lungaccess.plan`
    finds in ITERATIONS.  The cheapest through each airway branch comes first, then the others by their cost.
    Each plan is proved and complete as any other.

    Parameters
    ----------
    lung, system, target, atlas, counterfactuals
        See `lungaccess.planning.coupled.planner.plan`.
    objective : str or Objective
        What "cheap" means; see there, too.
    count : int
        The most plans that are returned.
    separation_mm : float
        The least separation of the needles of two plans.
    phases, widest
        Plans for a window of the breath, as of `lungaccess.plan_for_window`.  Without them every plan of a
        patient with motion has a window all the same.

    Raises
    ------
    NoPlan
        If no plan was found, either.
    SettingsError
        If a number is not above 0, the objective is unknown, or the atlas belongs to another lung or system.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    weighed = objective_of(lung, objective)
    require_own_name(system)
    task = Task(lung=lung, system=system, target=target, objective=weighed, method="alternatives")
    if atlas is not None:
        require_same(atlas, lung, system)
    atlas = atlas or build_atlas(lung, system)
    if phases is None and not widest:
        direct = direct_candidates(task, atlas)
        return with_front(separated_plans(direct, count, separation_mm, counterfactuals=counterfactuals))
    system.require_needle("Planning for a window of the breath")
    search = WindowSearch(task, atlas, phases and require_phases(*phases), widest=widest)
    try:
        plans = separated_plans(search.arcs, count, separation_mm, counterfactuals=False, iterations=0)
    except NoPlan:
        *_, best = plan_for_window(
            lung,
            system,
            target,
            phases,
            widest=widest,
            objective=weighed,
            iterations=ITERATIONS,
            atlas=atlas,
            counterfactuals=counterfactuals,
        )
        return with_front([best])
    return with_front([with_aim(plan, lung, phases) for plan in plans])


def separated_plans(
    direct: DirectCandidates,
    count: int,
    separation_mm: float,
    *,
    counterfactuals: bool,
    iterations: int = ITERATIONS,
) -> list[Plan]:
    """Return the plans of a diverse plan set, chosen among direct candidates; see `alternatives`.

    Where there are none, the planner searches for so many iterations.

    Raises
    ------
    NoPlan
        If there is none.
    SettingsError
        If a number is not above 0.
    """
    if count < 1 or not separation_mm > 0.0:
        raise SettingsError(
            f"{count} plans with a separation of {separation_mm:g} mm are asked for",
            expected="both above 0",
            remedy="State both, such as --count 15 --separation 5",
        )
    began, task, atlas = time.perf_counter(), direct.task, direct.atlas
    chosen = list(separated_candidates(direct, count, separation_mm))
    if not chosen and iterations:
        *_, best = find_plans(
            task.lung,
            task.system,
            task.target,
            objective=task.objective,
            seed=task.seed,
            iterations=iterations,
            atlas=atlas,
            counterfactuals=counterfactuals,
        )
        return [with_window(best, task.lung)]
    if not chosen:
        raise explain(task, atlas, direct.evaluator.blocked, 0, counterfactuals=counterfactuals)
    timing = {"planning_s": time.perf_counter() - began, "atlas_s": atlas.build_s}
    plans = (assemble(task, each, iteration=0, timing=timing) for each in chosen)
    return [with_window(plan, task.lung) for plan in plans]


def criteria(plan: Plan) -> dict[str, float]:
    """Return what plans are compared by, but for their chance of success; see `Alternative`."""
    clearances = list(plan.clearance_mm.values())
    obstacles = [name for name in clearances[0] if name != "fissure" or plan.fissures_are_obstacles]
    return {
        "clearance_mm": min(values[name] for values in clearances for name in obstacles),
        "pleura_mm": min(values["outside"] for values in clearances),
        "length_in_tissue_mm": plan.tissue_mm,
        "inverse_clearance": plan.costs["inverse_clearance"],
        "cost_map": plan.costs["cost_map"],
    }


def with_front(
    plans: Sequence[Plan], chances: Sequence[Chance | None] | None = None
) -> tuple[Alternative, ...]:
    """Return plans with their criteria, and which of them are on the Pareto front.

    Parameters
    ----------
    chances : sequence of Chance or None, optional
        The chance of success of each plan.  A plan of which none is known is on no front.
    """
    names = GEOMETRIC if chances is None else TRADE_OFF
    known = [None] * len(plans) if chances is None else list(chances)
    if all(plan.window is not None for plan in plans):
        names = (*names, WINDOW)
    values = [
        criteria(plan)
        | ({} if plan.window is None else {WINDOW: plan.window.share})
        | ({} if chance is None else {"success": chance.share})
        for plan, chance in zip(plans, known, strict=True)
    ]
    rated = [n for n, chance in enumerate(known) if chances is None or chance is not None]
    signs = np.array([-1.0 if name in LARGE_IS_GOOD else 1.0 for name in names])
    signed = np.array([[values[n][name] for name in names] for n in rated]).reshape(-1, len(names)) * signs
    beaten = [bool(((signed <= row).all(axis=1) & (signed < row).any(axis=1)).any()) for row in signed]
    front = {n for n, worse in zip(rated, beaten, strict=True) if not worse}
    return tuple(
        Alternative(plan=plan, criteria=value, on_front=n in front, chance=chance)
        for n, (plan, value, chance) in enumerate(zip(plans, values, known, strict=True))
    )
