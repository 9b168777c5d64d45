"""The contest: the plan that is best by draws of its success, or by any function of a plan.

Candidates come from all clear direct ways of the atlas and from the search by cost, whose first plan, best
plan and plans of several arcs take part and stay to the end: no winner is worse than any of them but by the
error of the draws that all have in common.
"""

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import count, islice, zip_longest
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.words import percent
from lungaccess.planning import searches
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.base import AtlasBound, Step
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates, direct_candidates
from lungaccess.planning.coupled.search.window_search import SMALLEST, random_change, varied
from lungaccess.planning.driver import Turn, holds, no_plan_beside
from lungaccess.planning.success import ratings
from lungaccess.planning.success.passes import with_passes
from lungaccess.plans.assemble import with_devices
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request
from lungaccess.problem.task import Task
from lungaccess.uncertainty.risk.statistics import Share

BY_COST = 300
"""Iterations of the search by cost whose plans take part: more make them only a little cheaper."""
RARE, ENOUGH = 0.05, 0.3
"""Where hardly a draw succeeds, the errors are made smaller until so many do: few successes tell nothing."""
SMALLER, LEAST_FACTOR = 0.7, 0.1
"""The step by which the errors are made smaller, and the least size."""
OFTEN_ENOUGH = 0.98
"""A plan that succeeds at least so often, with 95 %, ends the search: others gain too little."""


@frozen_record
class Contender:
    """A candidate in the contest.

    Args:
        plan: For chances, without what takes long to state: clearances and costs are those of another plan.
        gained, draws: What it has gained in all batches so far: successes, or the value of a function.
        shrunken: Its successes with smaller errors, by which the first rounds go where successes are rare.
        stays: Whether it takes part to the end.
    """

    candidate: Candidate
    plan: Plan
    scorer: ratings.Scorer
    gained: float = 0.0
    draws: int = 0
    shrunken: float = 0.0
    stays: bool = False

    @property
    def share(self) -> float:
        """What it gains a draw."""
        return self.gained / max(self.draws, 1)

    @property
    def order(self) -> tuple[float, float]:
        """By which contenders are put in order."""
        return self.shrunken, self.gained


class ContestFinder:
    """Finds plans that are better and better by a rating; see `lungaccess.planning.driver.Finder`."""

    def __init__(self, request: Request, task: Task, atlas: Atlas, counterfactuals: bool) -> None:
        self._request, self._task, self._atlas = request, task, atlas
        self._plan_of = partial(searches.plan_of, request, task, atlas)
        self._counterfactuals = counterfactuals
        self._rating = ratings.rating_of(request) or ratings.FunctionRating(request)
        self._search = searches.search_of(request, task, atlas)
        self._steps = self._search.steps()
        self._model: Plan | None = None
        self._leader: Contender | None = None
        self._shown: Plan | None = None
        self._beside = 0

    @property
    def _direct(self) -> DirectCandidates | None:
        """The direct ways of the atlas; None for a search that draws its own."""
        return self._search.arcs if isinstance(self._search, AtlasBound) else None

    def turns(self) -> Iterator[Turn]:
        """Yield the first clear plan, then what wins each contest, then what beats the winner."""
        first = yield from self._first()
        if first is None:
            return
        self._leader = first
        yield Turn(iteration=0, phase="search", make=partial(self._plan_of, first.candidate, 0))
        of_cost = yield from self._by_cost(first)
        entries = [] if self._direct is None else ratings.ranked(self._rating, self._direct).tolist()
        pool = (made for made in map(self._entry, entries) if made)
        # The contest begins in open loop where procedures are simulated that measure on their way.
        measures = isinstance(self._rating, ratings.ChanceRating) and not self._rating.procedure.is_open_loop
        screened = (yield from self._screened(of_cost)) if measures else []
        started = [*of_cost, *screened, *islice(pool, self._rating.rounds.pool)]
        order = yield from self._halved(self._rating, started)
        yield self._turn(0)
        yield from self._challenged(order[0], pool)

    def _first(self) -> Generator[Turn, None, Contender | None]:
        """Return the first plan of the search by cost that keeps the constraints, None if there is none."""
        for step in self._steps:
            found = self._of_step(step)
            if found is not None:
                return found
            yield Turn(iteration=max(step.iteration - BY_COST, 0), phase=step.phase)
        return None

    def _by_cost(self, first: Contender) -> Generator[Turn, None, list[Contender]]:
        """Return plans of the search by cost: the first and the last ones, which stay to the end."""
        found = [first]
        for step in self._steps:
            if step.iteration > BY_COST:
                break
            made = self._of_step(step)
            found += [] if made is None else [made]
            yield Turn(iteration=0, phase=step.phase)
        # Six of its plans take part: the first, and the last ones, which are the cheapest.
        some = [first, *found[1:][-5:]]
        return [replace(each, stays=each in (some[0], some[-1])) for each in some]

    def _screened(self, of_cost: Sequence[Contender]) -> Generator[Turn, None, list[Contender]]:
        """Return those that do best in open loop; the first of them stays to the end."""
        rating = ratings.ChanceRating(self._request, open_loop=True)
        direct = self._direct
        entries = [] if direct is None else ratings.ranked(rating, direct).tolist()
        others = (made for made in map(partial(self._entry, rating=rating), entries) if made)
        again = [self._contender(each.candidate, rating) for each in of_cost]
        order = yield from self._halved(rating, [*again, *islice(others, rating.rounds.pool)], leads=False)
        # Three of the best in open loop take part where a procedure measures.
        best = [self._contender(each.candidate) for each in order[:3]]
        return [replace(each, stays=n == 0) for n, each in enumerate(best)]

    def _of_step(self, step: Step) -> Contender | None:
        """Return what a step of the search by cost has found, if it keeps the constraints."""
        return None if step.candidate is None else self._contender(step.candidate)

    def _entry(self, entry: int, rating: ratings.Rating | None = None) -> Contender | None:
        direct = self._direct
        candidate = None if direct is None else direct.proved(entry)
        return None if candidate is None else self._contender(candidate, rating)

    def _contender(self, candidate: Candidate, rating: ratings.Rating | None = None) -> Any:
        """Return a candidate as a contender, None if it misses a constraint."""
        plan = self._plan(candidate)
        if not holds(self._request, plan):
            self._beside += 1
            return None
        return Contender(candidate=candidate, plan=plan, scorer=(rating or self._rating).scorer(plan))

    def _plan(self, candidate: Candidate) -> Plan:
        """Return a plan with the devices of a candidate, a whole one for a rating that may ask for all."""
        if isinstance(self._rating, ratings.FunctionRating) or self._model is None:
            self._model = self._plan_of(candidate, 0, 0.0)
            return self._model
        made = with_devices(self._task, candidate, self._model)
        return searches.with_aim(made, self._request) if self._request.is_for_window else made

    def _halved(
        self, rating: ratings.Rating, contenders: Sequence[Contender], *, leads: bool = True
    ) -> Generator[Turn, None, list[Contender]]:
        """Return contenders, the best first: in each round fewer of them have more draws."""
        left, factor = list(contenders), 1.0
        for number, (draws, kept) in enumerate(zip_longest(rating.rounds.draws, rating.rounds.kept)):
            counted = []
            for each in left:
                counted.append(_counted(each, number, draws))
                yield Turn(iteration=0, phase="contest", message=self._message)
            # Smaller errors decide two rounds where successes are rare: later rounds have enough draws.
            if draws > 1 and number < 2 and max(each.share for each in counted) < RARE:
                factor = factor if factor < 1.0 else _factor(counted, number, draws)
                counted = [replace(each, shrunken=each.scorer(number, draws, factor)) for each in counted]
            order = sorted(counted, key=lambda each: each.order, reverse=True)
            left = order[:kept] + [each for each in order[kept:] if kept and each.stays]
            if leads:
                self._leader = max(left, key=lambda each: each.gained)
            left = [replace(each, shrunken=0.0) for each in left]
        return left

    def _challenged(self, best: Contender, pool: Iterator[Contender]) -> Iterator[Turn]:
        """Let the rest of the pool, variations of the best, and the search by cost challenge the best."""
        rng = np.random.Generator(np.random.PCG64(self._task.seed))
        size, varies = 1.0, not (isinstance(self._rating, ratings.ChanceRating) and self._rating.replans)
        for tried in count(1):
            other = None
            if tried % 3 == 0:
                other = self._cheaper()
            elif tried % 3 == 1 or not varies or size < SMALLEST:
                other = next(pool, None)
            elif (shifted := self._varied(best, rng, size)) is not None:
                # Variations become smaller with every one that fails: after 35 they are half as large.
                other, size = shifted, 0.98 * size
            better = None if other is None else self._beats(best, other)
            if better is None:
                yield Turn(iteration=tried, phase="challenge", message=self._message)
                continue
            best, self._leader, size = better, better, 1.0
            yield self._turn(tried)

    def _cheaper(self) -> Contender | None:
        """Return what the search by cost finds next, in a few of its steps."""
        # Steps of the search by cost for one challenge, which take as long as some thousand draws.
        for step in islice(self._steps, 20):
            found = self._of_step(step)
            if found is not None:
                return found
        return None

    def _varied(self, best: Contender, rng: np.random.Generator, size: float) -> Contender | None:
        """Return the best with other rotation and insertions, if it is proved."""
        turn, *shifts = random_change(rng, size, self._task.system.tubes)
        direct = self._direct
        evaluator = CandidateEvaluator(self._task) if direct is None else direct.evaluator
        made = varied(evaluator, best.candidate, turn, shifts)
        return self._contender(made) if made is not None and evaluator.accepts(made) else None

    def _beats(self, best: Contender, other: Contender) -> Contender | None:
        """Return another contender if it gains more: after each round it has to be near the best."""
        for number, draws in enumerate(self._rating.rounds.draws):
            other = _counted(other, number, draws)
            # The standard error of the share, never 0; a function says what is certain.
            variance = max(best.share * (1.0 - best.share), 0.25 / other.draws) / other.draws
            error = math.sqrt(variance) if draws > 1 else 0.0
            if other.share < best.share - 2.0 * error:
                return None
        return other if other.gained > best.gained else None

    @property
    def _message(self) -> str:
        leader = self._leader
        if leader is None or not leader.draws or isinstance(self._rating, ratings.FunctionRating):
            return ""
        return f"succeeds in {percent(leader.share)} of the draws"

    def _turn(self, iteration: int) -> Turn:
        """Return a turn with the leader, if what it states is better than what was shown before."""
        leader = self._leader
        made = None if leader is None else self._stated(leader, iteration, 0.0)
        goal = self._request.goal
        if made is None or (self._shown is not None and goal.loss(made) >= goal.loss(self._shown)):
            return Turn(iteration=iteration, phase="contest", message=self._message)
        return Turn(
            iteration=iteration, phase="contest", message=self._message, make=partial(self._show, made)
        )

    def _show(self, plan: Plan, elapsed_s: float) -> Plan:
        self._shown = replace(plan, timing=dict(plan.timing) | {"planning_s": elapsed_s})
        return self._shown

    def _stated(
        self, contender: Contender, iteration: int, elapsed_s: float, most: int | None = None
    ) -> Plan:
        """Return the whole plan of a contender with what it states of the goal."""
        make = partial(self._plan_of, iteration=iteration, elapsed_s=elapsed_s)
        made, rating, direct = make(contender.candidate), self._rating, self._direct
        if self._request.passes > 1 and isinstance(rating, ratings.ChanceRating):
            ways = direct or direct_candidates(self._task, self._atlas)
            made = with_passes(self._request, rating, ways, contender.candidate, make)
        return rating.stated(made, most)

    def is_met(self, best: Plan, iteration: int) -> bool:
        """Tell whether draws that no search has seen leave less than two of hundred to gain."""
        if best.chance is None:
            return False
        counted = Share(count=best.chance.successes, samples=best.chance.samples)
        return counted.interval[0] >= OFTEN_ENOUGH

    def last(self, best: Plan, iteration: int, elapsed_s: float) -> Plan | None:
        """Return the leader with what it states, where the search ended before that was shown."""
        if self._shown is not None or self._leader is None:
            return None
        # Where the time is over, no more is counted than the contest did.
        # The chance that a plan states is of 250 draws at least: one half is then known to 3 %.
        return self._stated(self._leader, iteration, elapsed_s, max(self._leader.draws, 250))

    def no_plan(self, iteration: int) -> NoPlan:
        """Return why there is no plan."""
        if self._beside:
            return no_plan_beside(self._request)
        return searches.why_none(self._task, self._atlas, self._search, iteration, self._counterfactuals)


def _counted(contender: Contender, batch: int, draws: int) -> Contender:
    """Return a contender with what it gains in one more batch."""
    gained = contender.scorer(batch, draws, 1.0)
    return replace(contender, gained=contender.gained + gained, draws=contender.draws + draws)


def _factor(contenders: Sequence[Contender], batch: int, draws: int) -> float:
    """Return by how much errors have to be made smaller so that enough draws of the best succeed."""
    best = max(contenders, key=lambda each: each.gained)
    factor = 1.0
    while factor > LEAST_FACTOR and best.scorer(batch, draws, factor) < ENOUGH * draws:
        factor *= SMALLER
    return factor
