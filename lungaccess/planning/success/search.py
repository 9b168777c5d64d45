"""The search for the plan that most often succeeds: ranking, successive halving, variation of the best."""

from __future__ import annotations

import collections
import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from itertools import count, islice

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.planner import plan
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.variation import SHIFT_MM, SMALLEST, TURN_RAD, varied
from lungaccess.planning.procedure.spread import Spread
from lungaccess.planning.success.estimate import ChanceEstimator, Counter
from lungaccess.plans.assemble import assemble, with_devices
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task

MANY = 10.0
"""Clear deployments that a scope tip needs so that one is likely to be left after measuring: ten lie some
millimetres or degrees apart, as far as the errors move the tip.  It only ranks."""
BY_COST = 300
"""Iterations of the search by cost, whose best plan takes part: more make it only a little cheaper."""
SHRINK = 0.98
"""Variations become smaller with every one that fails: after 35 they are half as large."""


@frozen_record
class Contender:
    """A candidate or a whole plan with its successes.

    Parameters
    ----------
    candidate : Candidate or None
        None for a plan that another search made.
    plan : Plan
        Where there is a candidate, without what takes long to state: clearances, costs and the margin of
        the motion are those of another plan.
    counter : Counter
        Of the plan.
    successes, samples : int
        By the draws that all have in common.
    """

    candidate: Candidate | None
    plan: Plan
    counter: Counter
    successes: int = 0
    samples: int = 1

    @property
    def share(self) -> float:
        """Share of successes."""
        return self.successes / self.samples

    def clearly_beats(self, other: Contender) -> bool:
        """Tell whether it succeeds more often by more than the standard error of the difference.

        The error is that of draws of their own, which is more than that of common random numbers.
        """
        variance = sum(max(each.share * (1.0 - each.share), 0.01) / each.samples for each in (self, other))
        return self.share - other.share > math.sqrt(variance)


class SuccessSearch:
    """Finds plans to one target that succeed more and more often.

    Parameters
    ----------
    task : Task
    atlas : Atlas
    estimator : ChanceEstimator
    counterfactuals : bool
        See `lungaccess.plan`, which looks for plans where no direct arc is clear.
    """

    def __init__(
        self, task: Task, atlas: Atlas, estimator: ChanceEstimator, *, counterfactuals: bool
    ) -> None:
        self._task, self._atlas, self._estimator = task, atlas, estimator
        self._counterfactuals = counterfactuals
        self._arcs = DirectArcs(task, atlas)
        self._model: Plan | None = None
        self._by_cost: Contender | None = None

    def steps(self) -> Iterator[tuple[Contender, int]]:
        """Yield the best contender so far, often, and the number of variations tried.

        Raises
        ------
        NoPlan
            If no direct arc is clear and the search by cost finds nothing.
        """
        halving, ranked = self._estimator.halving, self._ranked(self._arcs.clear())
        pool = (made for made in map(self._contender, ranked.tolist()) if made)
        first = next(pool, None)
        first = None if first is None else self._counted(first, halving.samples[0])
        if first is not None:
            yield first, 0
        started = [each for each in (first, *islice(pool, halving.pool - 1)) if each]
        best = yield from self._halved([*started, self._cheapest()], first)
        yield self._sure(best), 0
        for challenged, tried in self._challenged(best, pool):
            yield self._sure(challenged), tried

    def finished(self, contender: Contender, iteration: int, elapsed_s: float) -> Plan:
        """Return the whole plan of a contender."""
        timing = {"planning_s": elapsed_s, "atlas_s": self._atlas.build_s}
        if contender.candidate is None:
            return replace(contender.plan, timing=timing)
        return assemble(self._task, contender.candidate, iteration=iteration, timing=timing)

    def _ranked(self, clear: Int) -> Int:
        """Return entries of the atlas with a clear arc, the most promising first, some of each scope tip."""
        estimator, target = self._estimator, self._task.target.lps_mm
        chosen = self._atlas.deployments.only(clear)
        site = chosen.site
        spread = Spread(
            self._task.lung, self._task.system, self._atlas.motions.tips[site], chosen, target,
            estimator.errors, estimator.procedure, estimator.radius_mm,
        )  # fmt: skip
        chances = spread.chances
        if estimator.procedure.scope.measured:
            _sites, which, counts = np.unique(site, return_inverse=True, return_counts=True)
            chances = chances * -np.expm1(-counts[which] / MANY)
        order = np.argsort(-chances, kind="stable")
        taken: collections.Counter[int] = collections.Counter()
        kept = []
        for entry, at in zip(clear[order].tolist(), site[order].tolist(), strict=True):
            taken[at] += 1
            if taken[at] <= estimator.halving.of_a_tip:
                kept.append(entry)
        return np.array(kept, dtype=np.int64)

    def _contender(self, entry: int) -> Contender | None:
        candidate = self._arcs.proved(entry)
        return None if candidate is None else self._of(candidate)

    def _of(self, candidate: Candidate) -> Contender:
        """Return a candidate as a contender without any draws."""
        self._model = self._model or assemble(self._task, candidate, iteration=0, timing={})
        made = with_devices(self._task, candidate, self._model)
        return Contender(candidate=candidate, plan=made, counter=self._estimator.counter(made))

    def _cheapest(self) -> Contender:
        """Return the plan of least cost."""
        task = self._task
        plans = plan(
            task.lung, task.system, task.target, objective=task.objective, seed=task.seed,
            iterations=BY_COST, atlas=self._atlas, counterfactuals=self._counterfactuals,
        )  # fmt: skip
        cheapest = list(plans)[-1]
        return Contender(candidate=None, plan=cheapest, counter=self._estimator.counter(cheapest))

    def _counted(self, contender: Contender, samples: int) -> Contender:
        """Return a contender with its successes of so many draws."""
        successes = self._estimator.successes(contender.counter, samples)
        return replace(contender, successes=successes, samples=samples)

    def _halved(
        self, contenders: Sequence[Contender], first: Contender | None
    ) -> Generator[tuple[Contender, int], None, Contender]:
        """Return the best of several: in each round fewer of them have more draws.

        The plan of least cost is in all rounds: nothing that is worse may win by the luck of few draws.
        Yield the best of the last whole round again and again, at first `first`, for a caller whose time
        ends.
        """
        halving, leader = self._estimator.halving, first
        for samples, kept in zip(halving.samples, (*halving.kept, 1), strict=True):
            counted = []
            for each in contenders:
                counted.append(self._counted(each, samples))
                if leader is not None:
                    yield leader, 0
            self._by_cost = next(each for each in counted if each.candidate is None)
            contenders = sorted(counted, key=lambda each: -each.successes)
            by_cost = [each for each in contenders[kept:] if each.candidate is None and kept > 1]
            contenders = [*contenders[:kept], *by_cost]
            leader = self._sure(contenders[0])
        return contenders[0]

    def _sure(self, best: Contender) -> Contender:
        """Return the best contender, or the plan of least cost if it does not clearly beat that.

        So no plan is worse than that of least cost by the luck of few draws.
        """
        cheapest = self._by_cost
        return best if cheapest is None or best.clearly_beats(cheapest) else cheapest

    def _challenged(self, best: Contender, others: Iterator[Contender]) -> Iterator[tuple[Contender, int]]:
        """Let variations of the best contender challenge it, and every other time one of the pool's rest.

        Yield the best after each of them, and how many there were.
        """
        rng = np.random.Generator(np.random.PCG64(self._task.seed))
        # What the tubes do is chosen anew from a measured scope: variations of it change little.
        size, replanned = 1.0, self._estimator.procedure.scope.measured
        for tried in count(1):
            other = next(others, None) if tried % 2 or replanned or best.candidate is None else None
            if other is None and (best.candidate is None or size < SMALLEST):
                return
            if other is not None:
                best = self._beats(best, other) or best
            elif best.candidate is not None:
                turn, *shifts = (rng.standard_normal(3) * (TURN_RAD, SHIFT_MM, SHIFT_MM) * size).tolist()
                better = self._beats(best, self._variation(best.candidate, turn, shifts))
                size, best = (size, better) if better else (SHRINK * size, best)
            yield best, tried

    def _variation(
        self, candidate: Candidate, turn_rad: float, shifts_mm: Sequence[float]
    ) -> Contender | None:
        """Return a candidate with other rotation and insertions, if it is proved."""
        evaluator = self._arcs.evaluator
        made = varied(evaluator, candidate, turn_rad, shifts_mm)
        if made is None or not evaluator.proves(made.deployment, made.path):
            return None
        return self._of(made)

    def _beats(self, best: Contender, other: Contender | None) -> Contender | None:
        """Return another contender if it succeeds more often: with few draws first, then with all of them."""
        if other is None:
            return None
        few = self._estimator.halving.samples[1]
        spread = math.sqrt(max(best.share * (1.0 - best.share), 0.01) / few)
        if self._counted(other, few).share < best.share - 2.0 * spread:
            return None
        whole = self._counted(other, best.samples)
        return whole if whole.successes > best.successes else None
