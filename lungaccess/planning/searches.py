"""The searches for whole plans by their names, in one process or several, and the plans of what they find."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count, islice
from multiprocessing.connection import Connection

import numpy as np

from anatomy.base.child_process import can_fork, end_with_parent, forked, received
from anatomy.base.errors import SettingsError
from anatomy.base.plugins import registered
from anatomy.base.words import did_you_mean
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.explanation import explain, explain_window
from lungaccess.planning.coupled.kuntz2015_fcl.search import ReferenceSearch
from lungaccess.planning.coupled.layer_bound import GapGoal, beside_in_window_mm, cost_bound, guided
from lungaccess.planning.coupled.search.aimed_tubes import TubeSearch
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import ParallelSearch, PlanSearch, SearchFactory, Step
from lungaccess.planning.coupled.search.needle_planner import KuntzSearch
from lungaccess.planning.coupled.search.window_search import WindowSearch, WindowTubeSearch, window_search
from lungaccess.planning.driver import Turn
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim
from lungaccess.problem.goals import WINDOW
from lungaccess.problem.request import ATLAS, Request
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import breathing_window

ROUND_ITERATIONS = 100
"""Iterations of one process before the best of all is shared."""


def parallel_steps(search: ParallelSearch, processes: int) -> Iterator[Step]:
    """Search in several processes until the caller stops, nothing can be found, or no process has more.

    The direct steps come first.  Then rounds: each process continues a search of its own, which begins from
    every so many of the direct ways and has random numbers that depend on the seed and its number, and the
    best of all goes into the next round.  So the same seed, number of processes and iterations give the same
    plans, whatever the machine's load.  SettingsError is raised if there are fewer than two processes, or
    this system cannot fork.
    """
    if processes < 2 or not can_fork():
        raise SettingsError(
            f"{processes} processes are asked for",
            expected="at least 2, on a system that can fork processes: not Windows",
            remedy="Leave out --processes; studies use several processes on every system",
        )
    yield from search.direct_steps()
    with forked(_work, [(search, number, processes) for number in range(processes)]) as ends:
        for turn in count(1):
            for end in ends:
                end.send(search.incumbent.step)
            found: list[tuple[Step | None, bool]] = [received(end, "search") for end in ends]
            iteration = turn * processes * ROUND_ITERATIONS
            better = min((step for step, _more in found if step), key=lambda step: step.cost, default=None)
            nothing = Step(iteration=iteration, phase="local search")
            yield search.incumbent.improved(replace(better, iteration=iteration)) if better else nothing
            if search.is_futile(iteration) or not any(more for _step, more in found):
                return


def _work(search: ParallelSearch, number: int, processes: int, end: Connection) -> None:
    """Continue the search in this process: a round for each message, which is the best of all.

    An interruption from the keyboard reaches every process; only the one that holds the best heeds it.
    """
    end_with_parent()
    search.take_part(number, processes)
    steps = search.further_steps()
    while True:
        try:
            best: Step | None = end.recv()
        except EOFError:
            return
        if best is not None:
            search.incumbent.improved(best)
        made = list(islice(steps, ROUND_ITERATIONS))
        found = [step for step in made if step.candidate is not None]
        end.send((found[-1] if found else None, len(made) == ROUND_ITERATIONS))


def _over_the_atlas(task: Task, atlas: Atlas) -> PlanSearch:
    """Return the search over the atlas: for paths of the needle, or without one for the tubes alone."""
    return TubeSearch(task, atlas) if task.system.needle is None else AtlasSearch(task, atlas)


_OWN: dict[str, SearchFactory] = {
    ATLAS: _over_the_atlas,
    "kuntz2015": KuntzSearch,
    "kuntz2015-without-rejection": partial(KuntzSearch, rejects=False),
    "reference": ReferenceSearch,
    "reference-without-rejection": partial(ReferenceSearch, rejects=False),
}
PLUGINS = "lungaccess.planners"
"""The group of entry points by which packages add searches."""
NEED_A_NEEDLE = tuple(name for name in _OWN if name != ATLAS)
"""The methods that draw paths of a needle from placements of the tubes."""


def planners() -> dict[str, SearchFactory]:
    """Return the searches for whole plans by their names, those of other packages with them.

    A package adds one by an entry point of the group `lungaccess.planners`: something that makes a
    `lungaccess.planning.coupled.search.base.PlanSearch` of a task and an atlas.
    """
    return _OWN | registered(PLUGINS)


def register_planner(name: str, search: SearchFactory) -> None:
    """Make a search known by its name in this process; SettingsError if this package has one of that name."""
    if name in (ATLAS, *NEED_A_NEEDLE):
        raise SettingsError(f"A planner cannot be called {name!r}", expected="a name of its own")
    _OWN[name] = search


def require_method(request: Request) -> None:
    """Raise SettingsError unless the request's method exists and can plan with its systems."""
    method = request.method
    if method not in planners():
        raise unknown_method(method)
    for system in request.systems:
        if request.needle_planner:
            system.require_needle(f"The needle planner {request.needle_planner}")
        if method in NEED_A_NEEDLE:
            system.require_needle(f"The method {method}")


def unknown_method(method: str) -> SettingsError:
    """Return the error of a method that does not exist."""
    known = planners()
    return SettingsError(
        f"There is no method {method!r}",
        expected=f"one of {', '.join(known)}",
        remedy=did_you_mean(method, known) or "Choose one of them",
    )


def search_of(request: Request, task: Task, atlas: Atlas) -> PlanSearch:
    """Return the search by cost, or for the widest window, of a request."""
    if request.is_for_window and request.method == ATLAS:
        return window_search(task, atlas, request.phases, widest=request.goal is WINDOW)
    return planners()[request.method](task, atlas)


class CostFinder:
    """Finds plans of small cost or, among those of a wide window, the widest."""

    def __init__(self, request: Request, task: Task, atlas: Atlas, counterfactuals: bool) -> None:
        self._request, self._task, self._atlas = request, task, atlas
        self._counterfactuals = counterfactuals
        self.search = search_of(request, task, atlas)
        self._gap = None
        if request.gap is not None:
            beside_mm = 0.0 if request.phases is None else beside_in_window_mm(task, request.phases)
            self._gap = GapGoal(cost_bound(task, atlas, beside_mm), request.gap)

    def turns(self) -> Iterator[Turn]:
        """Yield the steps of the search as turns."""
        search, processes = self.search, self._request.processes
        steps = search.steps() if processes == 1 else _parallel(search, self._request.method, processes)
        if self._gap is not None and processes == 1 and isinstance(search, AtlasSearch):
            steps = guided(search, steps, self._gap.bound)
        about = self._request, self._task, self._atlas
        for step in steps:
            made = None
            if step.candidate is not None:
                made = partial(plan_of, *about, step.candidate, step.iteration)
            yield Turn(iteration=step.iteration, phase=step.phase, make=made)

    def is_met(self, best: Plan, iteration: int) -> bool:
        """Tell whether the gap is proved."""
        return self._gap is not None and iteration > 0 and self._gap.is_met(best.cost)

    def last(self, best: Plan, iteration: int, elapsed_s: float) -> Plan | None:
        """Return the best plan with its bound, where a gap was asked for."""
        if self._gap is None:
            return None
        timing = dict(best.timing) | {"planning_s": elapsed_s}
        return replace(best, cost_bound=self._gap.bound.value, iterations=iteration, timing=timing)

    def no_plan(self, iteration: int) -> NoPlan:
        """Return why there is no plan."""
        return why_none(self._task, self._atlas, self.search, iteration, self._counterfactuals)


def why_none(task: Task, atlas: Atlas, search: PlanSearch, iteration: int, counterfactuals: bool) -> NoPlan:
    """Return why a search has found nothing, after so many iterations."""
    if isinstance(search, WindowSearch | WindowTubeSearch):
        stopped = explain_window(search, iteration)
        if stopped is not None:
            return stopped
    blocked: Counter[str] = search.blocked
    return explain(task, atlas, blocked, iteration, counterfactuals=counterfactuals)


def plan_of(
    request: Request, task: Task, atlas: Atlas, candidate: Candidate, iteration: int, elapsed_s: float
) -> Plan:
    """Return the plan of a candidate, with aim and window where it is for a window of the breath."""
    timing = {"planning_s": elapsed_s, "atlas_s": atlas.build_s}
    made = assemble(task, candidate, iteration=iteration, timing=timing)
    return with_aim(made, request) if request.is_for_window else made


def with_aim(plan: Plan, request: Request) -> Plan:
    """Return a plan that was made for a window with where its devices end as its aim, and its window."""
    asked = np.array([] if request.phases is None else [request.phases]).reshape(-1, 2)
    end = plan.tube.lps_from_tip[:3, 3] if plan.needle is None else plan.needle.end_lps
    aimed = replace(plan, aim=BreathingAim(point_lps=end, phases=asked))
    return replace(aimed, window=breathing_window(aimed, request.lung))


def _parallel(search: PlanSearch, method: str, processes: int) -> Iterator[Step]:
    if not isinstance(search, ParallelSearch):
        raise SettingsError(
            f"{processes} processes are asked for with {method}, each of whose samples depends on all before",
            expected="one process, or method atlas",
            remedy="Leave out --processes, or choose --method atlas",
        )
    return parallel_steps(search, processes)
