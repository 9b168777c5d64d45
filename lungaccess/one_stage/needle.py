"""The needle stage alone: from a given pose to a target, with any of its planners."""

from __future__ import annotations

import math
from typing import Any

from anatomy.errors import SettingsError, TargetError
from anatomy.kernel_clock import working_s
from anatomy.kernels.field import exact_distance
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.structures import AIRWAY, BRANCH_SHIFT
from anatomy.suggestion import did_you_mean
from anatomy.typed import Float
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from stages.needle import (
    PLANNERS,
    ArcPath,
    NeedleEnvironment,
    Objective,
    Query,
    Search,
    needle_environment,
    path_costs,
)

SLICE = 500
"""Iterations between two looks at the clock: some milliseconds."""
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
"""Planners of OMPL itself.  They steer by chance, and end within OMPL_TOLERANCE_MM of the target."""
OMPL_TOLERANCE_MM = 1.0
"""Distance to the target that counts as reached; random steering hardly ever comes nearer."""
WALL_MM = 3.0
"""A start so near to an airway is taken to have pierced its wall."""


@frozen_record
class NeedleAnswer:
    """What a planner found.

    Parameters
    ----------
    outcome : str
        "path"; "no path", if there is a proof; a search's own words for its end; else "nothing found".
    path : ArcPath or None
        Proved clear and within all limits.
    cost : float
        Of the path under the objective, as estimated within the search.
    branch : int
        Branch of the airway tree whose wall the start is taken to have pierced, -1 for none.
    environment : NeedleEnvironment
        What the planner looked at.
    objective : Objective
        What it was asked to make small; planners of OMPL look at none.
    first_path_s : float or None
        Time to the first path.
    """

    outcome: str
    path: ArcPath | None
    cost: float
    branch: int
    environment: NeedleEnvironment
    objective: Objective
    first_path_s: float | None

    @property
    def costs(self) -> dict[str, float]:
        """Every cost of the path by its key, and that under the objective by its text; empty without a path.

        Exact, and evaluated at every call.
        """
        if self.path is None:
            return {}
        return self.objective.stated(
            path_costs(self.environment.obstacles, self.environment.cost_map, self.path)
        )

    def record(self) -> dict[str, Any]:
        """Return plain JSON values; poses in LPS mm, angles in rad."""
        path = self.path
        record: dict[str, Any] = {
            "outcome": self.outcome,
            "pierced_branch": self.branch if self.branch >= 0 else None,
            "path": None,
        }
        if path is None:
            return record
        record["path"] = {
            "first_path_s": self.first_path_s,
            "length_mm": path.length_mm,
            "max_angle_from_start_rad": path.max_angle_from_start_rad(),
            "accumulated_turn_rad": path.accumulated_turn_rad,
            "costs": {name: float(cost) for name, cost in self.costs.items()},
            "lps_from_start": path.lps_from_start.tolist(),
            "arcs": [
                {"length_mm": length, "roll_rad": roll, "curvature_per_mm": curvature}
                for length, roll, curvature in path.arcs.tolist()
            ],
        }
        return record


def plan_needle(
    lung: Lung,
    system: System,
    lps_from_start: Float,
    target: Target,
    *,
    planner: str = "decide",
    objective: str | Objective = "length",
    seed: int = 0,
    iterations: int | None = None,
    time_s: float | None = None,
) -> NeedleAnswer:
    """Plan the needle of a system, with its margins, from a pose to a target.

    Parameters
    ----------
    lps_from_start : (4, 4) float64
        +z is the direction of insertion.
    planner : str
        One of `search.planners.PLANNERS`, or of `OMPL_PLANNERS`: those look at no objective, end by time
        alone, and can be seeded once in a process, so each call needs a process of its own.
    objective : str or Objective
        What is made small; see `stages.needle.objective.Objective.of`.
    iterations, time_s : optional
        The search ends by whichever comes first, or by itself.  At least one is needed.

    Raises
    ------
    SettingsError
        If there is no such planner or objective, no limit, or a cost map is missing; if OMPL has been used
        in this process.
    TargetError
        If the start lies outside the images.
    """
    known = (*PLANNERS, *OMPL_PLANNERS)
    weighed = Objective.of(objective)
    if planner not in known:
        raise SettingsError(
            f"There is no needle planner {planner!r}",
            expected=f"one of {', '.join(known)}",
            remedy=did_you_mean(planner, known),
        )
    if time_s is None and (iterations is None or planner in OMPL_PLANNERS):
        raise SettingsError(
            f"The needle search {planner} has no limit",
            expected="a time in seconds" if planner in OMPL_PLANNERS else "iterations or a time in seconds",
        )
    if not lung.grid.contains(lps_from_start[:3, 3]).all():
        raise TargetError(
            f"The start lies outside the images, at LPS {lps_from_start[:3, 3].round(1).tolist()}",
            expected="a pose inside the lung",
            remedy="Check the frame of its numbers: RAS or LPS",
        )
    environment = needle_environment(
        lung, system.needle, system.margins, with_fissures=not system.fissures_allowed
    )
    branch = pierced_branch(lung, lps_from_start[:3, 3])
    query = Query(lps_from_start=lps_from_start, target=target.lps_mm, branch=branch)
    if planner in OMPL_PLANNERS:
        return _by_ompl(environment, query, planner, weighed, seed, time_s or 0.0)
    search = PLANNERS[planner](environment, query, seed, weighed)
    first_path_s = None
    began = working_s()
    left = iterations
    while not search.finished and (left is None or left > 0):
        if time_s is not None and working_s() - began >= time_s:
            break
        portion = SLICE if left is None else min(SLICE, left)
        search.advance(portion)
        left = None if left is None else left - portion
        if first_path_s is None and search.path is not None:
            first_path_s = working_s() - began
    return NeedleAnswer(
        outcome=_outcome(search),
        path=search.path,
        cost=search.cost,
        branch=branch,
        environment=environment,
        objective=weighed,
        first_path_s=first_path_s,
    )


def _by_ompl(
    environment: NeedleEnvironment, query: Query, planner: str, objective: Objective, seed: int, time_s: float
) -> NeedleAnswer:
    """Let a planner of OMPL search; its cost is the length of the path."""
    from stages.needle.ompl import NeedleProblem, seed_ompl

    seed_ompl(seed + 1)
    problem = NeedleProblem(environment)
    problem.setup.setPlanner(problem.planners()[planner](problem.si))
    problem.pose(query, goal_tolerance_mm=OMPL_TOLERANCE_MM)
    began = working_s()
    problem.setup.solve(time_s)
    first_path_s = working_s() - began
    path = problem.solution()
    return NeedleAnswer(
        outcome="nothing found" if path is None else "path",
        path=path,
        cost=math.inf if path is None else path.length_mm,
        branch=query.branch,
        environment=environment,
        objective=objective,
        first_path_s=None if path is None else first_path_s,
    )


def _outcome(search: Search) -> str:
    stated = str(getattr(search, "outcome", "running"))
    if stated != "running":
        return stated
    return "nothing found" if search.path is None else "path"


def pierced_branch(lung: Lung, point: Float) -> int:
    """Return the airway branch within `WALL_MM` of a point that is nearest to it, -1 if there is none."""
    x, y, z = (float(c) for c in point)
    _distance, label = exact_distance(lung.labels, lung.geometry, x, y, z, AIRWAY, -1, WALL_MM)
    return (int(label) >> BRANCH_SHIFT) - 1 if label else -1
