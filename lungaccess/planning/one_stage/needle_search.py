"""One search for a needle path, by our planners or those of OMPL, and what stands in the way of it."""

import math
from collections.abc import Callable
from dataclasses import replace

from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_record
from stages.needle import (
    OMPL_PLANNERS,
    OMPL_TOLERANCE_MM,
    SHORTEST,
    ArcPath,
    NeedleEnvironment,
    Objective,
    Obstruction,
    Passage,
    Query,
    Search,
    easiest_obstruction,
    find_obstruction,
    searches,
)

SLICE = 500
"""Iterations between two looks at the clock: some milliseconds."""


@frozen_record
class PathSearch:
    """What one search found.

    Args:
        outcome: "path"; "no path", if there is a proof; a search's own words for its end; else "nothing
            found".
        path, first_path: The best path and the first one: proved clear and within all limits.
        cost: Of the path under the objective, as estimated within the search.
        open_passage: Where a path would have to pass, if neither a path was found nor a proof that there is
            none.
    """

    outcome: str
    path: ArcPath | None = None
    first_path: ArcPath | None = None
    cost: float = math.inf
    first_path_s: float | None = None
    obstruction: Obstruction | None = None
    open_passage: Passage | None = None

    @property
    def proved(self) -> bool:
        """Whether it is proved that no path exists."""
        return self.outcome == "no path"


def search_path(
    environment: NeedleEnvironment,
    query: Query,
    planner: str,
    *,
    objective: Objective = SHORTEST,
    seed: int | None = 0,
    iterations: int | None = None,
    time_s: float | None = None,
    clock: Callable[[], float] = working_s,
    portion: int = SLICE,
) -> PathSearch:
    """Search a path; what is proved to have none at reach, start or target is not searched.

    Args:
        planner: One of `stages.needle.NEEDLE_PLANNERS`; those of OMPL end by time alone.
        seed: OMPL can be seeded once in a process; without a seed, its planners draw anew at each call.
        iterations, time_s (optional): The search ends by whichever comes first, or by itself.
        clock: Returns seconds: of the wall without compilation of kernels, or of this process.
        portion: Iterations between two looks at the clock.
    """
    blocked = find_obstruction(environment, query)
    if blocked is not None and blocked.proved:
        return PathSearch(outcome="no path", obstruction=blocked)
    if planner in OMPL_PLANNERS:
        found = _by_ompl(environment, query, planner, seed, time_s or 0.0, clock)
    else:
        search = searches()[planner](environment, query, seed or 0, objective)
        found = _advance(search, iterations, time_s, clock, portion)
    if found.path is not None:
        return found
    return replace(found, obstruction=blocked or easiest_obstruction(environment, query))


def _advance(
    search: Search, iterations: int | None, time_s: float | None, clock: Callable[[], float], portion: int
) -> PathSearch:
    first, first_path_s = None, None
    began, left = clock(), iterations
    while not search.finished and (left is None or left > 0):
        if time_s is not None and clock() - began >= time_s:
            break
        count = portion if left is None else min(portion, left)
        search.advance(count)
        left = None if left is None else left - count
        if first is None and search.path is not None:
            first, first_path_s = search.path, clock() - began
    return PathSearch(
        outcome=_outcome(search),
        path=search.path,
        first_path=first,
        cost=search.cost,
        first_path_s=first_path_s,
        open_passage=getattr(search, "passage", None),
    )


def _by_ompl(
    environment: NeedleEnvironment,
    query: Query,
    planner: str,
    seed: int | None,
    time_s: float,
    clock: Callable[[], float],
) -> PathSearch:
    """Let a planner of OMPL search; its cost is the length of the path."""
    from stages.needle.ompl import NeedleProblem, seed_ompl

    if seed is not None:
        seed_ompl(seed + 1)
    problem = NeedleProblem(environment)
    problem.setup.setPlanner(problem.planners()[planner](problem.si))
    problem.pose(query, goal_tolerance_mm=max(OMPL_TOLERANCE_MM, environment.goal_tolerance_mm))
    began = clock()
    problem.setup.solve(time_s)
    first_path_s = clock() - began
    path = problem.solution()
    if path is None:
        return PathSearch(outcome="nothing found")
    return PathSearch(
        outcome="path", path=path, first_path=path, cost=path.length_mm, first_path_s=first_path_s
    )


def _outcome(search: Search) -> str:
    stated = str(getattr(search, "outcome", "running"))
    if stated != "running":
        return stated
    return "nothing found" if search.path is None else "path"
