"""Rounds of local searches: successive halving among starts, and intensification of the best candidate."""

from __future__ import annotations

from collections.abc import Iterator

from lungaccess.planning.coupled.search.base import Incumbent, Step, evaluated_step
from lungaccess.planning.coupled.search.local_search import LocalSearch, LocalSearchRun
from lungaccess.planning.coupled.search.settings import ESTIMATE_SLACK, SearchSettings
from lungaccess.plans.evaluator import CandidateEvaluator
from stages.needle import successive_halving

TRIES = 50
"""Variations of an iteration, which takes about a millisecond."""
WORTH_EVALUATING = 0.999
"""A run is evaluated in full only when its estimated cost has fallen by this factor, which saves time."""


class LocalSearchRounds:
    """Shares iterations among local searches."""

    phase = "local search"

    def __init__(
        self,
        local_search: LocalSearch,
        evaluator: CandidateEvaluator,
        incumbent: Incumbent,
        settings: SearchSettings,
    ) -> None:
        self._local_search, self._evaluator = local_search, evaluator
        self._incumbent, self._settings = incumbent, settings

    def halve(self, runs: list[LocalSearchRun]) -> Iterator[Step]:
        """Advance runs by successive halving: after each rung the better half goes on."""
        rungs = successive_halving(
            runs,
            lambda run: run.cost,
            work=self._settings.rung_iterations,
            survivors=lambda _count, finite: (finite + 1) // 2,
            rungs=self._settings.rungs,
        )
        for left, iterations in rungs:
            for run in left:
                yield from self._advanced(run, iterations)

    def intensify(self) -> Iterator[Step]:
        """Continue the local search from the best candidate."""
        run = self._local_search.begin(self._incumbent.candidate)
        if run is not None:
            for _ in range(self._settings.intensifications):
                yield from self._advanced(run, self._settings.intensification_iterations)

    def perturbed(self) -> list[LocalSearchRun]:
        """Return runs that begin at random some distance from the best candidate."""
        best = self._incumbent.candidate
        begun = [self._local_search.begin(best) for _ in range(self._settings.perturbations)]
        runs = [run for run in begun if run is not None]
        for run in runs:
            self._local_search.perturb(run)
        return runs

    def _advanced(self, run: LocalSearchRun, iterations: int) -> Iterator[Step]:
        """Advance a run by iterations; the last step has what it has found."""
        for n in range(1, iterations + 1):
            self._local_search.advance(run, TRIES)
            yield self._evaluated(run) if n == iterations else Step(iteration=0, phase=self.phase)

    def _evaluated(self, run: LocalSearchRun) -> Step:
        """Return what a run has found, if that may be the best."""
        limit = min(WORTH_EVALUATING * run.evaluated_cost, ESTIMATE_SLACK * self._incumbent.cost)
        if not run.cost < limit:
            return Step(iteration=0, phase=self.phase)
        run.evaluated_cost = run.cost
        return evaluated_step(self._evaluator, self.phase, self._local_search.candidate(run))
