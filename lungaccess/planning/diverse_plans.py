"""A diverse plan set: plans to one target that are separated, and which of them are Pareto-optimal."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.search.base import AtlasBound
from lungaccess.planning.coupled.search.direct_candidates import separated_candidates
from lungaccess.planning.driver import ProgressEvent, holds, place_part
from lungaccess.planning.one_system import run
from lungaccess.planning.searches import plan_of, search_of
from lungaccess.planning.success.ratings import rating_of
from lungaccess.plans.chance import Chance
from lungaccess.plans.insertion import with_simplest_motion
from lungaccess.plans.plan import Plan
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.request import Limits, Request
from lungaccess.uncertainty.breathing.window import with_window

COUNT = 15
SEPARATION_MM = 5.0
"""Fig. 6 of [Kuntz2015] shows as many plans; the separation is a free choice."""

WINDOW = "window_share"
ITERATIONS = 100
"""Iterations of the search for the best plan: some seconds."""
METHOD = "alternatives"
"""What the method of the other plans is called."""

SMALL_IS_GOOD = ("inverse_clearance", "cost_map", "length_in_tissue_mm")
LARGE_IS_GOOD = ("success", "clearance_mm", "pleura_mm", WINDOW)
"""Which way the criteria go."""
GEOMETRIC = (*SMALL_IS_GOOD, "clearance_mm", "pleura_mm")
TRADE_OFF = ("success", "length_in_tissue_mm", "clearance_mm")
"""The criteria of the Pareto front: without chances of success, and with them."""


@frozen_record
class Alternative:
    """One plan of a diverse plan set.

    Args:
        criteria: "clearance_mm" and "pleura_mm", least distance of tube and needle from any obstacle and from
            the pleura; "length_in_tissue_mm"; "inverse_clearance" and "cost_map" as the plan states them;
            "success", the share of procedures that succeed, and "window_share", that of the breath in which
            the plan is proved, where they are known.
        on_front: Whether no other plan of the set is at least as good in all criteria of the front and better
            in one: success, length and clearance where the chances of success are known, else all others; and
            the window where every plan has one.
    """

    plan: Plan
    criteria: dict[str, float]
    on_front: bool
    chance: Chance | None = None


def alternatives(
    request: Request,
    *,
    count: int = COUNT,
    separation_mm: float = SEPARATION_MM,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> tuple[Alternative, ...]:
    """Return a diverse plan set: the needles of every two of its plans are separated by `separation_mm`.

    Two needles are separated if some point of either is at least so far from all points of the other.  The
    first plan is the best that the request's search finds within its limits; if it states none, in ITERATIONS
    of a search by cost, or in the rounds of a contest.  The others are direct ways from the atlas, those
    without a needle tubes aimed at the target, whose parts beyond the lumen are separated: the best through
    each airway branch comes first, then the others.  Each plan is proved and complete as any other, and
    states what the goal is of it.  Further parameters are those of `lungaccess.planning.one_system.run`.

    Raises:
        NoPlan: If no plan was found.
        SettingsError: If a number is not above 0, or as `run`.
        TargetError: If the target lies outside the lung or inside an obstacle.
    """
    if count < 1 or not separation_mm > 0.0:
        raise SettingsError(
            f"{count} plans with a separation of {separation_mm:g} mm are asked for",
            expected="both above 0",
            remedy="State both, such as --count 15 --separation 5",
        )
    if atlas is not None:
        require_same(atlas, request.lung, request.system)
    atlas = atlas or build_atlas(request.lung, request.system)
    limited = request
    if request.limits == Limits():
        # The contest of whole plans is over before its iterations begin.
        limited = replace(request, limits=Limits(iterations=0 if request.counts else ITERATIONS))
    *_, best = run(limited, atlas=atlas, counterfactuals=counterfactuals, on_progress=on_progress)
    plans = [best]
    for each in _others(request, place_part(request, atlas), count, separation_mm):
        if len(plans) < count and _are_separated(best, each, separation_mm):
            plans.append(each)
    plans[1:] = [with_simplest_motion(plan, request.lung) for plan in plans[1:]]
    made = [with_window(plan, request.lung) if plan.window is None else plan for plan in plans]
    return with_front(made, [each.chance for each in made] if request.goal is SUCCESS else None)


def _others(request: Request, atlas: Atlas, count: int, separation_mm: float) -> Iterator[Plan]:
    """Yield direct ways that are separated, with what they state of the goal."""
    task = replace(request.task, method=METHOD)
    search, rating = search_of(request, task, atlas), rating_of(request)
    if not isinstance(search, AtlasBound):
        return
    expected = None if rating is None else partial(rating.expected, search.arcs)
    for each in separated_candidates(search.arcs, count, separation_mm, expected):
        made = plan_of(request, task, atlas, each, 0, 0.0)
        if holds(request, made):
            # Draws of the chance that each of the other plans states: one half is then known to 1.5 %.
            yield made if rating is None else rating.stated(made, 1000)


def _are_separated(one: Plan, other: Plan, separation_mm: float) -> bool:
    """Tell whether some point of what the costs of either plan are of is so far from the other's."""
    a, b = (each.costed_poses(1.0)[0][:, :3, 3] for each in (one, other))
    away = np.linalg.norm(a[:, None] - b, axis=2)
    return bool(max(away.min(axis=1).max(), away.min(axis=0).max()) >= separation_mm)


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

    Args:
        chances: The chance of success of each plan.  A plan of which none is known is on no front.
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
