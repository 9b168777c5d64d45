"""Ratings of a contest of plans: by draws of their chance of success, or by a function of the plan."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.planning.procedure import Policy, simulated
from lungaccess.planning.procedure.spread import Spread
from lungaccess.planning.success.estimate import FRESH_SEED, MEASURED_PROCEDURE, chance_of, estimate_success
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.goals import SUCCESS, Goal
from lungaccess.problem.procedures import Procedure, load_procedure
from lungaccess.problem.request import Request
from lungaccess.uncertainty.risk import RiskAssessor
from lungaccess.uncertainty.risk.patient_errors import model_for

Scorer = Callable[[int, int, float], float]
"""Returns what a plan gains: the successes of so many draws of a batch, with errors of a factor times their
size."""


@frozen_value
class Rounds:
    """Successive halving: how many candidates take part, and with how many draws [Jamieson2016].

    Args:
        pool: Candidates that it begins with.
        of_a_tip: So many of one scope tip: its deployments are alike, and other tips fail otherwise.
        draws: Draws that each round adds.
        kept: Contenders that are left after each round but the last.
        fresh: Draws of the estimate that a plan states, which decide nothing in the search.
    """

    pool: int
    of_a_tip: int
    draws: tuple[int, ...]
    kept: tuple[int, ...]
    fresh: int


OPEN_LOOP = Rounds(pool=150, of_a_tip=8, draws=(256, 768, 3072, 16384), kept=(24, 8, 4), fresh=20_000)
"""The order of first order is rough, so the pool is several times what is kept; after 20,000 draws a share of
one half is known to a third of a percent."""
MEASURED = Rounds(pool=24, of_a_tip=1, draws=(48, 144, 448, 640), kept=(10, 6, 4), fresh=2000)
"""A procedure that plans again takes a hundred times as long as one that does not, and the deployment is
chosen anew at the tip as measured: tips compete, with few draws."""
SCREENING = Rounds(pool=60, of_a_tip=4, draws=(256, 768), kept=(12,), fresh=0)
"""The contest in open loop before one under a procedure: its best take part in that."""
EXACT = Rounds(pool=150, of_a_tip=8, draws=(1,), kept=(), fresh=0)
"""What a function says of a plan is certain."""


class ChanceRating:
    """Counts successes under errors and a procedure; larger is better, as of every rating.

    Args:
        open_loop: Whether the request's procedure is left out, and only few draws are made, to find who takes
            part.
    """

    def __init__(self, request: Request, *, open_loop: bool = False) -> None:
        self._lung, self._seed, self._given_mm = request.lung, request.seed, request.radius_mm
        self.errors: ErrorModel = request.errors or load_errors()
        stated: Procedure = request.procedure or load_procedure(MEASURED_PROCEDURE)
        self.procedure = load_procedure() if open_loop else stated
        self._target = request.target.lps_mm
        self._radius_mm = goal_radius(request.lung, self._target, request.radius_mm)[0]
        self.rounds = SCREENING if open_loop else OPEN_LOOP if self.procedure.is_open_loop else MEASURED
        self._processes = request.processes

    @property
    def replans(self) -> bool:
        """Whether the tubes are planned anew from a measured scope: variations of them then change little."""
        return self.procedure.scope.measured

    def expected(self, direct: DirectCandidates, entries: Int) -> Float:
        """Return the chances of entries `(E,)` of an atlas to first order: they only rank them."""
        atlas = direct.atlas
        chosen = atlas.deployments.only(entries)
        chances = Spread(
            self._lung, atlas.system, atlas.motions.tips[chosen.site], chosen, self._target, self.errors,
            self.procedure, self._radius_mm,
        ).chances  # fmt: skip
        if self.procedure.scope.measured:
            _sites, which, counts = np.unique(chosen.site, return_inverse=True, return_counts=True)
            # Clear deployments that a scope tip needs so that one is likely to be left after measuring: ten
            # lie some millimetres or degrees apart, as far as the errors move the tip.  It only ranks.
            chances = chances * -np.expm1(-counts[which] / 10.0)
        return chances

    def scorer(self, plan: Plan) -> Scorer:
        """Return what counts the successes of a plan in a batch of draws that all plans have in common.

        What it prepares serves all batches.
        """
        if self.procedure.is_open_loop:
            assessor = RiskAssessor(plan, self._lung, radius_mm=self._given_mm)
            model = model_for(self.errors, plan, self._lung)

            def deviated(batch: int, draws: int, factor: float) -> float:
                errors = model if factor == 1.0 else model.scaled(factor)
                return assessor.success(assessor.draws(draws, self.seed_of(batch)), errors).count

            return deviated
        policy = Policy(plan, self._lung, self.errors, self.procedure, radius_mm=self._given_mm)

        def counted(batch: int, draws: int, _factor: float) -> float:
            # Procedures that several processes share: fewer take less time than to begin processes.
            processes = self._processes if draws >= 400 else 1
            return simulated(policy, draws, self.seed_of(batch), processes).succeeds.count

        return counted

    def seed_of(self, batch: int) -> int:
        """Return the seed of a batch of draws."""
        # Distance between the seeds of two batches of draws: no seed of a search comes to that of another
        # batch.
        return self._seed + (1 << 24) * (batch + 1)

    def stated(self, plan: Plan, most: int | None = None) -> Plan:
        """Return a plan with its chance, counted on draws that no round has seen, at most so many."""
        samples = min(self.rounds.fresh, most or self.rounds.fresh)
        found = estimate_success(
            plan, self._lung, errors=self.errors, procedure=self.procedure, samples=samples,
            seed=self._seed + FRESH_SEED, radius_mm=self._given_mm, processes=self._processes,
        )  # fmt: skip
        return replace(plan, chance=chance_of(found))


class FunctionRating:
    """Asks a function of the plan, or what the plan states of a goal."""

    def __init__(self, request: Request) -> None:
        self._goal: Goal = request.goal
        self._lung, self.rounds = request.lung, EXACT

    def expected(self, direct: DirectCandidates, entries: Int) -> Float:
        """Return the same of all: nothing is known of a function."""
        return np.zeros(len(entries))

    def scorer(self, plan: Plan) -> Scorer:
        """Return what says the value of a plan; it is certain."""
        goal = self._goal
        value = goal.computed(plan, self._lung) if goal.is_function else goal.value(plan)
        signed = -np.inf if value is None else value if goal.larger_is_better else -value
        return lambda _batch, _draws, _factor: float(signed)

    def stated(self, plan: Plan, most: int | None = None) -> Plan:
        """Return a plan with the value of its function."""
        if not self._goal.is_function:
            return plan
        return replace(plan, goals={self._goal.name: self._goal.computed(plan, self._lung)})


Rating = ChanceRating | FunctionRating
"""A rating says how good plans are: the contest asks both kinds the same."""


def rating_of(request: Request) -> Rating | None:
    """Return the rating of a request's goal; None where cost or window decide."""
    if request.goal is SUCCESS:
        return ChanceRating(request)
    return FunctionRating(request) if request.counts else None


def ranked(rating: Rating, direct: DirectCandidates) -> Int:
    """Return entries (E,) of an atlas with a clear way, the most promising first, some of each scope tip."""
    clear, taken, kept = direct.clear(), Counter[int](), []
    order = clear[np.argsort(-rating.expected(direct, clear), kind="stable")]
    sites = direct.atlas.deployments.site[order].tolist()
    for entry, site in zip(order.tolist(), sites, strict=True):
        taken[site] += 1
        if taken[site] <= rating.rounds.of_a_tip:
            kept.append(entry)
    return np.array(kept, dtype=np.int64)
