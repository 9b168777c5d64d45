"""Simulate a procedure many times: how often it succeeds, what fails, and what each stage corrects."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable
from dataclasses import replace
from multiprocessing.connection import Connection
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from anatomy.base.child_process import end_with_parent
from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from lungaccess.planning.procedure.history import STAGES, History
from lungaccess.planning.procedure.policy import Policy
from lungaccess.planning.procedure.report import NO_PATH, ProcedureReport, StageReport
from lungaccess.planning.procedure.settings import Procedure, load_procedure
from lungaccess.planning.procedure.truth import ARCS, Attempt
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.risk import MISSES, Deviations, ErrorModel, RiskAssessor, Share, load_errors
from lungaccess.uncertainty.risk.assessment import MISS_QUANTILES
from lungaccess.uncertainty.risk.breathing import model_for
from lungaccess.uncertainty.risk.deviations import deviated_starts
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.statistics import share_of

DEFAULT_SAMPLES = 1000
"""A share of one half is then known to 3 % with 95 % confidence."""
_MEASURING = 1000
"""Stream of the errors of measuring, beyond those of the kinds of error."""
SUCCESS = "success"
ORDER = ("pleura", "vessel", "airway", "fissure", "stays in the airway")
"""What a procedure with several failures is counted under: the first, the worst for the patient."""


class _Found(NamedTuple):
    """What came of N procedures: flags touched, distance from the target, no path left, and histories."""

    touched: Int
    miss_mm: Float
    stopped: Bool
    histories: tuple[History, ...]


def simulate_procedure(
    plan: Plan,
    lung: Lung,
    *,
    errors: ErrorModel | None = None,
    procedure: Procedure | None = None,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    radius_mm: float | None = None,
    processes: int = 1,
) -> ProcedureReport:
    """Return how often a procedure succeeds that measures on its way and plans the rest again.

    Each sample is a new patient.  The scope is placed, measured, tubes and needle are planned again by
    `replan_from_scope`; the tubes go out and are measured, the needle is planned again by
    `replan_from_tube`; the needle is inserted, blindly or measured and planned again.  What the devices then
    really did is looked at by the kernel of `assess`.  The same seed gives the same report, whatever the
    number of processes; without measuring it is that of `assess` with these draws.

    Parameters
    ----------
    plan, lung
        The plan, and the patient that it is for.
    errors : ErrorModel, optional
        The preset `breath-hold` if None.
    procedure : Procedure, optional
        The preset `open-loop` if None.
    samples, seed : int
    radius_mm : float, optional
        Radius of the goal; see `RiskAssessor`.
    processes : int
        How many processes share the work; one does all where the system cannot fork, as on Windows.

    Raises
    ------
    PlanFileError, SettingsError
        See `RiskAssessor`; also if there are no samples or processes.
    """
    model, followed = errors or load_errors(), procedure or load_procedure()
    return Simulator(plan, lung, model, followed, radius_mm=radius_mm).report(samples, seed, processes)


class Simulator:
    """Simulates procedures of one plan, see `simulate_procedure`; what it prepares serves all draws.

    Attributes
    ----------
    assessor : RiskAssessor
    errors : ErrorModel
    procedure : Procedure
    """

    def __init__(
        self,
        plan: Plan,
        lung: Lung,
        errors: ErrorModel,
        procedure: Procedure,
        *,
        radius_mm: float | None = None,
    ) -> None:
        self.assessor = RiskAssessor(plan, lung, radius_mm=radius_mm)
        errors = model_for(errors, plan, lung)
        self.errors, self.procedure, self._lung = errors, procedure, lung
        self._policy = Policy(self.assessor, lung, errors, procedure)

    def report(self, samples: int, seed: int, processes: int = 1) -> ProcedureReport:
        """Return what comes of so many procedures."""
        if processes < 1:
            raise SettingsError(f"{processes} processes are asked for", expected="at least 1")
        found = _Run(self.assessor, self._policy, self._lung, samples, seed).all(processes)
        return _report(self, found, samples, seed)


class _Run:
    """Procedures of one plan with the draws of one seed."""

    def __init__(self, assessor: RiskAssessor, policy: Policy, lung: Lung, samples: int, seed: int) -> None:
        self.assessor, self._policy = assessor, policy
        self.samples, self._seed = samples, seed
        plan, procedure = assessor.plan, policy.procedure
        count = procedure.scope.placements if procedure.scope.measured or procedure.tubes.measured else 1
        n_arcs = ARCS if plan.needle is not None else 0
        self._attempts: list[Deviations] = [
            assessor.draws(samples, seed, attempt=number, n_arcs=n_arcs).deviations(policy.errors)
            for number in range(count)
        ]
        self._starts = [deviated_starts(plan, lung, each) for each in self._attempts]

    def all(self, processes: int) -> _Found:
        """Return what comes of all procedures."""
        if self._policy.procedure.is_open_loop:
            return self._open_loop()
        parts = np.array_split(np.arange(self.samples), processes)
        if processes == 1 or "fork" not in multiprocessing.get_all_start_methods():
            return _joined(map(self._part, parts))
        context = multiprocessing.get_context("fork")
        pipes = [context.Pipe(duplex=False) for _ in parts]
        workers = [
            context.Process(target=self._send_part, args=(part, there), daemon=True)
            for part, (_here, there) in zip(parts, pipes, strict=True)
        ]
        for worker, (_here, there) in zip(workers, pipes, strict=True):
            worker.start()
            there.close()
        try:
            return _joined([_received(here) for here, _there in pipes])
        finally:
            for worker in workers:
                worker.terminate()
                worker.join()

    def _send_part(self, numbers: Int, end: Connection) -> None:
        """Go through some procedures in a process of their own."""
        end_with_parent()
        end.send(self._part(numbers))

    def _open_loop(self) -> _Found:
        """Carry out the plan as it stands, as `assess` does."""
        errors, arcs = self._attempts[0], self.assessor.n_arcs
        fitted = replace(errors, roll_rad=errors.roll_rad[:, :arcs], stop_mm=errors.stop_mm[:, :arcs])
        outcomes = self.assessor.outcomes(fitted)
        return _Found(outcomes.touched, outcomes.miss_mm, np.zeros(self.samples, dtype=bool), ())

    def _part(self, numbers: Int) -> _Found:
        histories = tuple(self._history(int(number)) for number in numbers)
        touched, miss = np.zeros(len(numbers), dtype=np.int64), np.full(len(numbers), np.inf)
        for place, (number, history) in enumerate(zip(numbers, histories, strict=True)):
            touched[place], miss[place] = self._looked_at(int(number), history)
        stopped = np.array([each.stopped or not each.complete for each in histories], dtype=bool)
        return _Found(touched, miss, stopped, histories)

    def _history(self, number: int) -> History:
        """Go through one procedure: the scope is placed again where no path is left."""
        history = History()
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_MEASURING, number)))
        for errors, starts in zip(self._attempts, self._starts, strict=True):
            if self._policy.attempt(history, self._attempt(errors, starts, number), rng):
                break
        return history

    def _attempt(self, errors: Deviations, starts: Float, number: int) -> Attempt:
        row = slice(number, number + 1)
        one = Deviations(**{name: values[row] for name, values in vars(errors).items()})
        return Attempt(
            errors=one, start=starts[number], target_lps=self.assessor.plan.target_lps + one.target_mm[0]
        )

    def _looked_at(self, number: int, history: History) -> tuple[int, float]:
        """Return what the devices touched in all attempts, and how far from the target the last ended."""
        flags, miss = 0, np.inf
        for place, (start, pieces, n_tube) in enumerate(history.chains):
            last = history.complete and place == len(history.chains) - 1
            touched, ends = self.assessor.follow(start[None], pieces[None], n_tube)
            # Tubes that were drawn back again may have stayed in the airway: nothing came of it.
            flags |= int(touched[0]) if last else int(touched[0]) & ~kernel.STAYS_INSIDE
            if last:
                attempt = self._attempts[history.placements - 1]
                target = self.assessor.plan.target_lps + attempt.target_mm[number]
                miss = float(np.linalg.norm(ends[0] - target))
        return flags, miss


def _received(end: Connection) -> _Found:
    """Return what a process has found."""
    try:
        found: _Found = end.recv()
    except EOFError as reason:
        raise AnatomyError(
            "A process of the simulation has ended before its time",
            expected="processes that run until the simulation ends",
            remedy="Give it more memory, or fewer processes with --processes",
        ) from reason
    return found


def _joined(parts: Iterable[_Found]) -> _Found:
    found = list(parts)
    touched, miss, stopped = (np.concatenate([each[n] for each in found]) for n in range(3))
    return _Found(touched, miss, stopped, tuple(history for each in found for history in each.histories))


def _report(simulator: Simulator, found: _Found, samples: int, seed: int) -> ProcedureReport:
    assessor, procedure = simulator.assessor, simulator.procedure
    reaches = found.miss_mm <= assessor.radius_mm
    touched = {name: (found.touched & flag) != 0 for name, flag in assessor.structures.items()}
    inserted = found.miss_mm[np.isfinite(found.miss_mm)]
    quantiles = {q: float(np.quantile(inserted, q)) for q in MISS_QUANTILES} if len(inserted) else {}
    left = np.ones(samples, dtype=bool)
    ends = {}
    causes = [(name, touched[name]) for name in ORDER if name in assessor.forbidden]
    for name, mask in (*causes, (NO_PATH, found.stopped & ~reaches), (MISSES, ~reaches), (SUCCESS, left)):
        ends[name] = share_of(left & mask)
        left = left & ~mask
    return ProcedureReport(
        model=simulator.errors,
        procedure=procedure,
        samples=samples,
        seed=seed,
        radius_mm=assessor.radius_mm,
        radius_origin=assessor.radius_origin,
        succeeds=ends[SUCCESS],
        touches=MappingProxyType({name: share_of(mask) for name, mask in touched.items()}),
        ends=MappingProxyType(ends),
        miss_mm=MappingProxyType(quantiles),
        placements=float(np.mean([each.placements for each in found.histories])) if found.histories else 1.0,
        stages=tuple(_stage(stage, found.histories) for stage in STAGES if _used(procedure, stage)),
        with_needle=assessor.plan.needle is not None,
    )


def _used(procedure: Procedure, stage: str) -> bool:
    used = (procedure.scope.measured, procedure.tubes.measured, procedure.needle.closed_loop)
    return dict(zip(STAGES, used, strict=True))[stage]


def _stage(stage: str, histories: tuple[History, ...]) -> StageReport:
    found = [each for history in histories for each in history.replans[stage]]
    corrected = [each for history in histories for each in history.corrected_mm[stage]]
    return StageReport(
        stage=stage,
        replans=len(found),
        without_path=Share(count=len(found) - sum(found), samples=max(len(found), 1)),
        corrected_mm=float(np.median(corrected)) if corrected else float("nan"),
    )
