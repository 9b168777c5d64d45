"""The search for the plan that most often succeeds: a ranked pool, a race, and variation of the best."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from anatomy.records import frozen_record
from anatomy.typed import Int
from lungaccess.coupled.atlas import Atlas
from lungaccess.coupled.planner import plan
from lungaccess.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.assemble import assemble, needle_part, tube_part
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.parts import Exemption
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.success.estimate import ChanceEstimator
from lungaccess.success.spread import Spread

POOL = 150
"""Candidates that a race begins with: the best is nearly always among so many of first order."""
A_TIP = 8
"""Of one scope tip so many: its deployments are alike, and other tips fail otherwise."""
KEPT = (24, 6)
"""Candidates that are left after the first and the second round of a race."""
BY_COST = 100
"""Iterations of the search by cost, whose best plan takes part."""
TURN_RAD, SHIFT_MM = math.radians(10.0), 2.0
"""Standard deviations of the first variations: less than the spacing of the atlas."""
SHRINK = 0.98
"""Variations become smaller with every one that fails: after 35 they are half as large."""
SMALLEST = 0.02


@frozen_record
class Contender:
    """A candidate or a whole plan in the race, with its successes.

    Parameters
    ----------
    candidate : Candidate or None
        None for a plan that another search made.
    plan : Plan
        Where there is a candidate, without what takes long to state: clearances, costs and the margin of
        the motion are those of another plan.
    successes, samples : int
        By the draws that all have in common.
    """

    candidate: Candidate | None
    plan: Plan
    successes: int
    samples: int

    @property
    def share(self) -> float:
        """Share of successes."""
        return self.successes / self.samples


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

    def steps(self) -> Iterator[tuple[Contender, int]]:
        """Yield the best contender after each part of the search, and the number of variations tried.

        Raises
        ------
        NoPlan
            If no direct arc is clear and the search by cost finds nothing.
        """
        rounds, best = self._estimator.rounds, None
        pool = self._ranked(self._arcs.clear())
        first = next((made for made in map(self._contender, pool.tolist()) if made), None)
        if first is not None:
            best = self._raced(first, rounds[0])
            yield best, 0
        started = [made for made in map(self._contender, pool.tolist()) if made]
        best = self._race([*started, self._cheapest()])
        yield best, 0
        yield from self._varied(best)

    def finished(self, contender: Contender, iteration: int, elapsed_s: float) -> Plan:
        """Return the whole plan of a contender."""
        if contender.candidate is None:
            return contender.plan
        timing = {"planning_s": elapsed_s, "atlas_s": self._atlas.build_s}
        return assemble(self._task, contender.candidate, iteration=iteration, timing=timing)

    def _ranked(self, clear: Int) -> Int:
        """Return the entries of the atlas that the race begins with, the most promising first."""
        radius = self._radius_mm(clear)
        target, procedure = self._task.target.lps_mm, self._estimator.procedure
        chances = Spread(self._atlas, clear, target, self._estimator.errors, procedure, radius).chances
        order = np.argsort(-chances, kind="stable")
        site = self._atlas.deployments.site[clear[order]]
        # The how manieth of its scope tip each is.
        by_site = np.argsort(site, kind="stable")
        starts = np.flatnonzero(np.append(True, np.diff(site[by_site]) != 0))[: len(site)]
        rank = np.zeros(len(site), dtype=np.int64)
        rank[by_site] = np.arange(len(site)) - np.repeat(starts, np.diff(np.append(starts, len(site))))
        return np.asarray(clear[order][rank < A_TIP][:POOL])

    def _radius_mm(self, clear: Int) -> float:
        """Return the radius of the goal."""
        for entry in clear.tolist():
            candidate = self._arcs.proved(entry)
            if candidate is not None:
                self._model = assemble(self._task, candidate, iteration=0, timing={})
                return self._estimator.radius_mm(self._model)
        return 1.0

    def _contender(self, entry: int) -> Contender | None:
        candidate = self._arcs.proved(entry)
        return None if candidate is None else self._of(candidate)

    def _of(self, candidate: Candidate) -> Contender:
        """Return a candidate as a contender without any draws."""
        task, frame, deployment = self._task, candidate.tip.lps_from_scope_tip, candidate.deployment
        model = self._model or assemble(task, candidate, iteration=0, timing={})
        self._model = model
        tube, needle = tube_part(task, frame, deployment), needle_part(candidate.path)
        exemption = Exemption(
            branch=deployment.branch,
            exit_point_lps=tube.exit.point_lps,
            needle_length_mm=model.exemption.needle_length_mm,
        )
        scope = replace(model.scope, lps_from_scope_tip=frame)
        made = replace(model, scope=scope, tube=tube, needle=needle, exemption=exemption)
        return Contender(candidate=candidate, plan=made, successes=0, samples=1)

    def _cheapest(self) -> Contender:
        """Return the plan of least cost."""
        task = self._task
        plans = plan(
            task.lung, task.system, task.target, objective=task.objective, seed=task.seed,
            iterations=BY_COST, atlas=self._atlas, counterfactuals=self._counterfactuals,
        )  # fmt: skip
        return Contender(candidate=None, plan=list(plans)[-1], successes=0, samples=1)

    def _raced(self, contender: Contender, samples: int) -> Contender:
        """Return a contender with its successes of so many draws."""
        successes = self._estimator.successes(contender.plan, samples)
        return replace(contender, successes=successes, samples=samples)

    def _race(self, contenders: Sequence[Contender]) -> Contender:
        """Return the best of several: in each round fewer of them have more draws."""
        for samples, kept in zip(self._estimator.rounds, (*KEPT, 1), strict=True):
            raced = [self._raced(each, samples) for each in contenders]
            contenders = sorted(raced, key=lambda each: -each.successes)[:kept]
        return contenders[0]

    def _varied(self, best: Contender) -> Iterator[tuple[Contender, int]]:
        """Vary the best contender for ever; yield it after each variation, and how many were tried."""
        rng = np.random.Generator(np.random.PCG64(self._task.seed))
        size, tried = 1.0, 0
        while best.candidate is not None and size > SMALLEST:
            tried += 1
            turn, *shifts = (rng.standard_normal(3) * (TURN_RAD, SHIFT_MM, SHIFT_MM) * size).tolist()
            better = self._beats(best, self._variation(best.candidate, turn, shifts))
            size = size if better else SHRINK * size
            best = better or best
            yield best, tried

    def _variation(
        self, candidate: Candidate, turn_rad: float, shifts_mm: Sequence[float]
    ) -> Contender | None:
        """Return a candidate with other rotation and insertions, if it is proved."""
        old, evaluator = candidate.deployment, self._arcs.evaluator
        if old.shape is not None:
            return None
        outer = max(old.outer_mm + shifts_mm[0], 0.0)
        inner = max(old.inner_mm + shifts_mm[1], outer)
        if self._task.system.tubes.outer is None:
            outer = inner
        turned = (old.rotation_rad + turn_rad) % (2.0 * math.pi)
        made = evaluator.direct(candidate.tip, turned, outer, inner)
        if made is None or not evaluator.proves(made.deployment, made.path):
            return None
        return self._of(made)

    def _beats(self, best: Contender, other: Contender | None) -> Contender | None:
        """Return another contender if it succeeds more often: with few draws first, then with all of them."""
        if other is None:
            return None
        few = self._estimator.rounds[1]
        spread = math.sqrt(max(best.share * (1.0 - best.share), 0.01) / few)
        if self._raced(other, few).share < best.share - 2.0 * spread:
            return None
        whole = self._raced(other, best.samples)
        return whole if whole.successes > best.successes else None
