"""The anytime coupled planner: an iterator of better and better plans."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

from anatomy.base.errors import SettingsError
from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.cost_bound import CostBound, GapGoal, guided
from lungaccess.planning.coupled.kuntz2015_fcl.search import ReferenceSearch
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import ParallelSearch, PlanSearch, SearchFactory, Step
from lungaccess.planning.coupled.search.kuntz2015 import KuntzSearch
from lungaccess.planning.coupled.search.tube_search import TubeSearch
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, require_own_name
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from stages.needle import DEFAULT, Objective, require_planner


def _over_the_atlas(task: Task, atlas: Atlas) -> PlanSearch:
    """Return the search over the atlas: for paths of the needle, or without one for the tubes alone."""
    return TubeSearch(task, atlas) if task.system.needle is None else AtlasSearch(task, atlas)


METHODS: dict[str, SearchFactory] = {
    "atlas": _over_the_atlas,
    "kuntz2015": KuntzSearch,
    "kuntz2015-without-rejection": partial(KuntzSearch, rejects=False),
    "reference": ReferenceSearch,
    "reference-without-rejection": partial(ReferenceSearch, rejects=False),
}
"""The searches by their names.  A search of your own becomes a method of `plan` when you add it here."""
NEED_A_NEEDLE = tuple(name for name in METHODS if name != "atlas")
"""The methods that draw paths of a needle from placements of the tubes."""
PROGRESS_EVERY_S = 0.1
"""Time between two progress reports: a display looks smooth, and the reports cost no time worth mention."""


@frozen_value
class ProgressEvent:
    """The progress of a search.

    Parameters
    ----------
    elapsed_s : float
        Planning time, without that of the atlas.
    best_cost : float or None
        None as long as there is no plan.
    phase, message : str
        What the search does; the message replaces the phase where it is not empty.
    """

    iteration: int
    elapsed_s: float
    best_cost: float | None
    phase: str
    message: str = ""


def plan(
    lung: Lung,
    system: System,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    method: str = "atlas",
    needle_planner: str = "",
    seed: int = 0,
    iterations: int | None = None,
    time_s: float | None = None,
    first_plan_s: float | None = None,
    atlas: Atlas | None = None,
    processes: int = 1,
    gap: float | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> Iterator[Plan]:
    """Plan all stages of a system; yield each plan that is better than the one before.

    Parameters
    ----------
    objective : str or Objective
        "inverse_clearance" [Kuntz2015, eq. 1], "cost_map", "voxel_sum" [Fu2018, eq. 1], "length_mm", or a
        weighted sum of them such as "length=1,cost-map=0.5".  "default": the first, and the second as well
        where the patient has a cost map; see `stages.needle.objective`.
    method : str
        One of METHODS, to which you can add a search of your own; see
        `coupled.search.base.PlanSearch`.  "atlas": direct arcs from every deployment of the atlas,
        then local search from the best of them, local sampling of deployments between, the needle's own
        search from others, and joint refinement; without a needle, the tubes aimed at the target from all
        scope tips of the atlas, then from tips between.  "kuntz2015": Algorithm 1 of that paper;
        "kuntz2015-without-rejection": the same without its workspace test.  "reference" and
        "reference-without-rejection": the same as printed, with FCL on meshes, slow; see
        `lungaccess.planning.coupled.kuntz2015_fcl`.
    needle_planner : str
        One of `stages.needle.NEEDLE_PLANNERS`, ours or OMPL's, instead of the method's own: for the needle
        search of "atlas" ("ao-rrt") and line 9 of "kuntz2015" ("rrt").  All of them are planners of one
        problem of OMPL.  OMPL can be seeded once in a process, so a search with a planner of OMPL needs a
        process of its own.
    seed : int
        The same seed and `iterations` give the same plans.
    iterations : int, optional
        Stop after so many iterations beyond the direct arcs.
    time_s : float, optional
        Stop after so many seconds of planning, but not without a plan before the direct arcs have been tried.
        With neither limit the caller stops the iterator.
    first_plan_s : float, optional
        Stop after so many seconds if there is no plan by then.
    atlas : Atlas, optional
        Made with `build_atlas` beforehand; made here if None.
    processes : int
        How many processes vary the best candidate at the same time.  The same seed, number of processes and
        `iterations` give the same plans.
    gap : float, optional
        Stop once the plan's cost is proved to be at most this share above the best from the scope tips of the
        atlas.  The last plan then comes once more, with its `cost_bound`, also where a limit ends the search.
        See `lungaccess.planning.coupled.cost_bound.CostBound`.
    counterfactuals : bool
        Whether a `NoPlan` looks for the change of device that would help, which takes up to some ten seconds.
    on_progress : callable, optional
        Gets a `ProgressEvent` about ten times a second.

    Raises
    ------
    NoPlan
        If the search ends without a plan; counts the reasons.
    SettingsError
        If objective, method or needle planner is unknown, the method takes no needle planner or needs a
        needle that the system does not have, the atlas belongs to another lung or system, there cannot be so
        many processes, the gap is negative or no bound is known for the tubes and the needle, or OMPL was
        used before in this process.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    weighed = objective_of(lung, objective)
    if method not in METHODS:
        raise SettingsError(
            f"There is no method {method!r}",
            expected=f"one of {', '.join(METHODS)}",
            remedy="Choose one of them",
        )
    if needle_planner:
        require_planner(needle_planner)
        system.require_needle(f"The needle planner {needle_planner}")
    if method in NEED_A_NEEDLE:
        system.require_needle(f"The method {method}")
    require_own_name(system)
    tell = on_progress or (lambda _event: None)
    task = Task(
        lung=lung,
        system=system,
        target=target,
        objective=weighed,
        method=method,
        needle_planner=needle_planner,
        seed=seed,
    )
    if atlas is not None:
        require_same(atlas, lung, system)
    atlas = atlas or build_atlas(lung, system, progress=lambda share: tell(atlas_event(share)))
    search = METHODS[method](task, atlas)
    steps = search.steps() if processes == 1 else _parallel(search, method, processes)

    def made(candidate: Candidate, iteration: int, elapsed_s: float) -> Plan:
        timing = {"planning_s": elapsed_s, "atlas_s": atlas.build_s}
        return assemble(task, candidate, iteration=iteration, timing=timing)

    def no_plan(iteration: int) -> NoPlan:
        from lungaccess.planning.coupled.explanation import explain

        return explain(task, atlas, search.blocked, iteration, counterfactuals=counterfactuals)

    limits = Limits.of(iterations, time_s, first_plan_s)
    goal = None if gap is None else GapGoal(CostBound(task, atlas), gap)
    if goal is not None and processes == 1 and isinstance(search, AtlasSearch):
        steps = guided(search, steps, goal.bound)
    return drive(steps, limits, tell, made, no_plan, goal)


@frozen_value
class Limits:
    """How long a search may take: in iterations, in seconds, and in seconds without a plan."""

    iterations: int | None
    time_s: float
    first_plan_s: float

    @classmethod
    def of(cls, iterations: int | None, time_s: float | None, first_plan_s: float | None = None) -> Limits:
        """Return limits as a caller states them; None is no limit."""
        whole, first = (math.inf if each is None else each for each in (time_s, first_plan_s))
        return cls(iterations=iterations, time_s=whole, first_plan_s=first)

    def are_reached(self, iteration: int, elapsed_s: float, found: bool) -> bool:
        """Tell whether the search ends; never without a plan before the direct arcs have been tried."""
        if found:
            return elapsed_s > self.time_s
        return iteration > 0 and elapsed_s > min(self.time_s, self.first_plan_s)


def _parallel(search: PlanSearch, method: str, processes: int) -> Iterator[Step]:
    """Return the steps of a search in several processes."""
    from lungaccess.planning.coupled.parallel import parallel_steps

    if not isinstance(search, ParallelSearch):
        raise SettingsError(
            f"{processes} processes are asked for with {method}",
            expected="one process, or method atlas with a system that has a needle",
            remedy="Leave out --processes, or choose --method atlas and such a system",
        )
    return parallel_steps(search, processes)


def atlas_event(share: float) -> ProgressEvent:
    """Return the progress event of an atlas of which a share is made."""
    return ProgressEvent(
        iteration=0,
        elapsed_s=0.0,
        best_cost=None,
        phase="atlas",
        message=f"deployment atlas, {share:.0%} of the scope tips",
    )


def drive(
    steps: Iterator[Step],
    limits: Limits,
    tell: Callable[[ProgressEvent], None],
    made: Callable[[Candidate, int, float], Plan],
    no_plan: Callable[[int], NoPlan],
    goal: GapGoal | None = None,
) -> Iterator[Plan]:
    """Drive a search within its budget; yield what `made` makes of its candidates.

    Parameters
    ----------
    made : callable
        Gets a candidate, its iteration and the planning time in seconds.
    no_plan : callable
        Returns what is raised after so many iterations without a candidate.
    goal : GapGoal, optional
        Ends the search once it is met; the last plan then comes once more, with its bound.
    """
    clock = Clock()
    best: float | None = None
    last: Plan | None = None
    iteration = 0
    for step in steps:
        if limits.iterations is not None and step.iteration > limits.iterations:
            break
        iteration = step.iteration
        if step.candidate is not None:
            best = step.cost
            last = made(step.candidate, iteration, clock.elapsed_s)
            yield last
        if goal is not None and best is not None and iteration > 0 and goal.is_met(best):
            break
        if limits.are_reached(iteration, clock.elapsed_s, best is not None):
            break
        if clock.due():
            tell(
                ProgressEvent(
                    iteration=iteration, elapsed_s=clock.elapsed_s, best_cost=best, phase=step.phase
                )
            )
    if best is None:
        raise no_plan(iteration)
    if goal is not None and last is not None:
        timing = dict(last.timing) | {"planning_s": clock.elapsed_s}
        yield replace(last, cost_bound=goal.bound.value, iterations=iteration, timing=timing)


class Clock:
    """Measures planning time, in which kernels are neither compiled nor loaded.

    Time in which the caller holds a yielded plan counts too.
    """

    def __init__(self) -> None:
        self._began = working_s()
        self._reported = self._began

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return working_s() - self._began

    def due(self) -> bool:
        """Tell whether the next progress report is due, and start counting anew if so."""
        now = working_s()
        if now - self._reported < PROGRESS_EVERY_S:
            return False
        self._reported = now
        return True
