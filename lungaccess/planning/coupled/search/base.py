"""What the planner needs of a search for whole plans, and what it gets from it."""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.tube import Deployments

ESTIMATE_SLACK = 1.03
"""Estimates of the kernels that exceed the best cost by more are dropped: few are over 1 % too large."""


@settings
class SearchSettings:
    """How the search shares its iterations among its phases; `docs/explanation/planning.md` explains them.

    The defaults are free choices; the results on that page were measured with them.

    Args:
        kept_slack: Direct arcs that cost up to so many times the cheapest may be starts of local searches.
        starts: Direct arcs with which the first successive halving begins.  More of them find a good region
            more surely, and leave less work for each.
        rung_iterations: Iterations of each local search on the first rung; they double from rung to rung.
        samplings: Iterations of local sampling in each round; with one or more, every round has an iteration.
        needle_iterations: Iterations of a needle search in the first pass over the deployments; they double
            three times.
        intensifications: How often a round evaluates the local search from the best candidate in full.
        refine_every: Rounds between two joint refinements, which take as long as several rounds.
    """

    kept_slack: Annotated[float, quantity("slack of kept direct arcs", at_least=1.0, at_most=100.0)] = 1.5
    starts: Annotated[int, quantity("starts of the first halving", at_least=1, at_most=10_000)] = 8
    rungs: Annotated[int, quantity("rungs of a halving", at_least=1, at_most=30)] = 5
    rung_iterations: Annotated[int, quantity("iterations on the first rung", at_least=1, at_most=10_000)] = 3
    perturbations: Annotated[int, quantity("perturbed copies a round", at_least=0, at_most=1000)] = 2
    samplings: Annotated[int, quantity("local samplings a round", at_least=1, at_most=1000)] = 6
    needle_searches: Annotated[int, quantity("needle searches a round", at_least=0, at_most=1000)] = 4
    needle_iterations: Annotated[
        int, quantity("iterations of a needle search", at_least=1, at_most=1_000_000)
    ] = 300
    intensifications: Annotated[int, quantity("intensifications a round", at_least=0, at_most=1000)] = 2
    intensification_iterations: Annotated[
        int, quantity("iterations of an intensification", at_least=1, at_most=10_000)
    ] = 20
    refine_every: Annotated[int, quantity("rounds between joint refinements", at_least=1)] = 16


@frozen_value
class Step:
    """One step of a search, with what it did in words for the user, and a proved candidate if it found one.

    Its iteration is 0 for what comes before the iterations; without a candidate the cost is infinite.
    """

    iteration: int
    phase: str
    candidate: Candidate | None = None
    cost: float = math.inf


class PlanSearch(Protocol):
    """A search for whole plans: the planner drives it and makes plans of its candidates.

    A search is made from a `Task` and an `Atlas`.  Its name in `lungaccess.planning.searches.planners` is the
    `method` of planner and command line.  `blocked` counts what stopped direct arcs, for the reasons of a
    `NoPlan`; it may stay empty.
    """

    blocked: Counter[str]

    def steps(self) -> Iterator[Step]:
        """Search until the caller stops, or until it is certain that nothing will be found.

        A step has a candidate only if that is proved and cheaper than all before.  The same task and the
        same number of steps have to give the same candidates.
        """


@runtime_checkable
class AtlasBound(PlanSearch, Protocol):
    """A search that begins with the simplest ways from all entries of an atlas."""

    arcs: Any


class DirectSearch(Protocol):
    """What looks at the simplest ways from the entries of an atlas before a search goes on from the best.

    Attributes:
        clear ((C,) int64): After its steps the entries with a clear way, the best first.
    """

    clear: Int

    def steps(self) -> Iterator[Step]:
        """Look at all entries, a few in each step; a step has a candidate if it is the best so far."""


SearchFactory = Callable[[Task, Atlas], PlanSearch]
"""What makes a search, for instance its class."""


class Incumbent:
    """The best step so far of a search, shared by its phases."""

    def __init__(self) -> None:
        self.step: Step | None = None

    @property
    def cost(self) -> float:
        """Cost of the best candidate, infinite without one."""
        return math.inf if self.step is None else self.step.cost

    @property
    def candidate(self) -> Candidate | None:
        """The best candidate."""
        return None if self.step is None else self.step.candidate

    def improved(self, step: Step) -> Step:
        """Take over a step if it is better, else return it without its candidate."""
        if step.candidate is not None and step.cost < self.cost:
            self.step = step
            return step
        return Step(iteration=step.iteration, phase=step.phase)


class ParallelSearch(ABC):
    """A search that can be continued in several processes; see `lungaccess.planning.searches`.

    Attributes:
        share (tuple of 2 int): The part of the work that it does, and of how many.
    """

    def __init__(self, blocked: Counter[str]) -> None:
        self.blocked, self.incumbent, self.share = blocked, Incumbent(), (0, 1)

    def steps(self) -> Iterator[Step]:
        """Search until the caller stops or all is tried."""
        yield from self.direct_steps()
        for step in self.further_steps():
            yield step
            if self.is_futile(step.iteration):
                return

    def direct_steps(self) -> Iterator[Step]:
        """Do what one process does alone, before the others begin: nothing."""
        return iter(())

    @abstractmethod
    def further_steps(self) -> Iterator[Step]:
        """Continue from there, without end or until all is tried; each step is an iteration."""

    def take_part(self, number: int, parts: int) -> None:
        """Do part `number` of `parts` of the work from here on, with random numbers of its own."""
        self.share = (number, parts)

    def is_futile(self, iteration: int) -> bool:
        """Tell whether nothing will be found after so many iterations without a candidate: never."""
        return False


def evaluated_step(
    evaluator: CandidateEvaluator, phase: str, candidate: Candidate | None, iteration: int = 0
) -> Step:
    """Return a step with a candidate and its cost, without one if there is none or its proof fails."""
    cost = math.inf if candidate is None else evaluator.evaluate(candidate)
    if not math.isfinite(cost):
        return Step(iteration=iteration, phase=phase)
    return Step(iteration=iteration, phase=phase, candidate=candidate, cost=cost)


CELL_MM = 5.0
"""Size of the cells within which tips of the tubes count as similar: about the reach of a local search."""


def different(entries: Deployments, ordered: Int) -> Int:
    """Return the first of every group of similar deployments, in the order given, (N,).

    Similar are those that leave the same branch and end in the same cell of CELL_MM with about the same
    tangent.
    """
    places = np.floor(entries.positions[ordered] / CELL_MM)
    # Tangents are similar if each component, times this, rounds to the same whole number.
    towards = np.rint(entries.tangents[ordered] * 2.0)
    keys = np.column_stack([entries.branch[ordered], places, towards]).astype(np.int64)
    _groups, first = np.unique(keys, axis=0, return_index=True)
    return ordered[np.sort(first)]
