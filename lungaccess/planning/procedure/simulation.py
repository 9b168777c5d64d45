"""Simulate a procedure many times: how often it succeeds, what fails, and what each stage corrects."""

from collections.abc import Iterable, Mapping, Sequence
from multiprocessing.connection import Connection
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from anatomy.base.child_process import can_fork, end_with_parent, forked, received
from anatomy.base.errors import SettingsError
from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from lungaccess.planning.procedure import truth
from lungaccess.planning.procedure.choices import scope_frames
from lungaccess.planning.procedure.policy import LEAST_CHANCE, Chosen, OnTheWay, Policy, rest_of
from lungaccess.planning.procedure.report import NO_PATH, ProcedureReport, StageReport
from lungaccess.planning.procedure.spread import as_measured
from lungaccess.plans.kernels.tissue import Wanted
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import CURVATURE, ErrorModel
from lungaccess.problem.procedures import Procedure
from lungaccess.uncertainty.risk import MISSES, Deviations, Share
from lungaccess.uncertainty.risk.assessment import MISS_QUANTILES
from lungaccess.uncertainty.risk.assessor import drawn_anew, taken_together
from lungaccess.uncertainty.risk.deviations import deviated_starts
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.statistics import share_of
from stages.needle import ArcPath, Query, Replan, Replanner, ReplanSettings

DEFAULT_SAMPLES = 1000
"""A share of one half is then known to 3 % with 95 % confidence."""
_MEASURING = 1000
"""Stream of the errors of measuring, beyond those of the kinds of error."""
SUCCESS = "success"
ORDER = ("pleura", "vessel", "airway", "fissure", "stays in the airway")
"""What a procedure with several failures is counted under: the first, the worst for the patient."""


STAGES = ("scope", "tube", "needle")
"""What may be measured, in its order."""


class _Decided(NamedTuple):
    """What was decided after measurements of one stage: which found nothing left, and what they corrected."""

    without_path: Bool
    corrected_mm: Float


class Found(NamedTuple):
    """What came of N procedures: flags touched, distance from the target, tissue in the tool, no path left,
    placements of the scope, where needles end and how far nodules have moved; and what was decided, by stage,
    which is not in the order of the procedures."""

    touched: Int
    miss_mm: Float
    taken: Float
    stopped: Bool
    placements: Int
    ends: Float
    shifts_mm: Float
    decided: dict[str, list[_Decided]]


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

    Each sample is a new patient.  The scope is placed and measured; the tubes go out and are measured; the
    needle is inserted, blindly or measured on its way.  After each measurement `Policy`, whose parameters
    these are, says what to do next.  What the devices then really did is looked at by the kernel of `assess`.
    The same seed gives the same report, whatever the number of processes, which is one where the system
    cannot fork; without measuring it is that of `assess` with these draws.  PlanFileError and SettingsError
    are raised as by `RiskAssessor`, also if there are no samples or processes.
    """
    return simulated(Policy(plan, lung, errors, procedure, radius_mm=radius_mm), samples, seed, processes)


def simulated(policy: Policy, samples: int, seed: int, processes: int = 1) -> ProcedureReport:
    """Return what comes of procedures under a policy, see `simulate_procedure`; it serves all draws."""
    if processes < 1:
        raise SettingsError(f"{processes} processes are asked for", expected="at least 1")
    found = passes_simulated(policy, samples, seed, processes)
    return _report(policy, _together(found, policy.assessor.wanted), samples, seed)


def passes_simulated(policy: Policy, samples: int, seed: int, processes: int = 1) -> list[Found]:
    """Return what comes of each pass of procedures: they have in common what is not drawn anew."""
    anew = drawn_anew(policy.whole)
    runs = [_Run(one, samples, seed, own) for one, own in zip(policy.passes, anew, strict=True)]
    return [each.all(processes) for each in runs]


def _together(passes: Sequence[Found], wanted: Wanted) -> Found:
    """Return what comes of procedures by what comes of each of their passes."""
    if len(passes) == 1:
        return passes[0]
    return passes[0]._replace(
        touched=np.bitwise_or.reduce([each.touched for each in passes]),
        miss_mm=np.min([each.miss_mm for each in passes], axis=0),
        taken=taken_together([each.taken for each in passes], wanted),
        stopped=np.all([each.stopped for each in passes], axis=0),
        placements=np.max([each.placements for each in passes], axis=0),
        decided={stage: [one for each in passes for one in each.decided.get(stage, [])] for stage in STAGES},
    )


class _Run:
    """Procedures of one pass with the draws of one seed, see `drawn_anew`."""

    def __init__(self, policy: Policy, samples: int, seed: int, anew: Mapping[str, int]) -> None:
        self._policy, self.assessor = policy, policy.assessor
        self.samples, self._seed = samples, seed
        plan, procedure = policy.plan, policy.procedure
        count = procedure.scope.placements if procedure.scope.measured or procedure.tubes.measured else 1
        n_arcs = truth.ARCS if plan.needle is not None else 0
        self._attempts: list[Deviations] = [
            policy.assessor.draws(samples, seed, attempt=number, n_arcs=n_arcs)
            .of_pass(n_arcs, anew)
            .deviations(policy.errors)
            for number in range(count)
        ]
        self._starts = [deviated_starts(plan, policy.lung, each) for each in self._attempts]
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_MEASURING,)))
        self._noise = rng.standard_normal((samples, count, 3, 5))
        number = anew[CURVATURE]
        self._number = (number,) if number else ()
        if number:
            # The tip of the tubes is measured in every pass; scope and target are seen once.
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_MEASURING + number,)))
            self._noise[:, :, 1] = rng.standard_normal((samples, count, 5))

    def all(self, processes: int) -> Found:
        """Return what comes of all procedures."""
        if self._policy.procedure.is_open_loop:
            # Carry out the plan as it stands, as `assess` does.
            outcomes = self.assessor.outcomes(truth.fitted_to(self.assessor.n_arcs, self._attempts[0]))
            ones = np.ones(self.samples, dtype=np.int64)
            none = np.zeros(self.samples, dtype=bool)
            shifts = self._attempts[0].target_mm
            return Found(
                outcomes.touched, outcomes.miss_mm, outcomes.taken, none, ones, outcomes.ends, shifts, {}
            )
        parts = np.array_split(np.arange(self.samples), processes)
        if processes == 1 or not can_fork():
            return _joined(map(self._part, parts))
        with forked(self._send_part, [(part,) for part in parts]) as ends:
            return _joined([received(end, "simulation") for end in ends])

    def _send_part(self, numbers: Int, end: Connection) -> None:
        end_with_parent()
        end.send(self._part(numbers))

    def _part(self, numbers: Int) -> Found:
        """Go through some procedures: the scope is placed again where the policy says so."""
        count = len(numbers)
        found = Found(
            np.zeros(count, dtype=np.int64), np.full(count, np.inf), np.zeros(count),
            np.ones(count, dtype=bool), np.zeros(count, dtype=np.int64), np.full((count, 9), np.nan),
            np.zeros((count, 3)), {stage: [] for stage in STAGES},
        )  # fmt: skip
        active = np.arange(count)
        for attempt in range(len(self._attempts)):
            if len(active):
                active = active[~self._attempt(attempt, numbers, active, found)]
        return found

    def _attempt(self, attempt: int, numbers: Int, active: Int, found: Found) -> Bool:
        """Place the scope once in the active procedures; tell which `(N,)` are over."""
        policy, procedure, rows = self._policy, self._policy.procedure, numbers[active]
        errors, noise = truth.rows_of(self._attempts[attempt], rows), self._noise[rows, attempt]
        starts, left = self._starts[attempt][rows], len(self._attempts) - 1 - attempt
        found.placements[active] += 1
        goes = np.arange(len(rows))
        if procedure.scope.measured:
            placing = procedure.scope
            seen = as_measured(scope_frames(starts), placing.position_mm, placing.direction_deg, noise[:, 0])
            likely = policy.scopes_measured(seen)
            chosen = policy.from_scopes(likely)
            plan = policy.plan
            planned = np.linalg.inv(np.asarray(plan.scope.lps_from_scope_tip)) @ np.append(plan.end_lps, 1.0)
            # How far from the target the plan would end without further errors from these scope tips.
            misses = np.linalg.norm((likely.frames @ planned)[:, :3] - plan.goal_lps, axis=1)
            found.decided["scope"].append(_Decided(~policy.goes_on(chosen.chances, 0), misses))
            goes = np.flatnonzero(policy.goes_on(chosen.chances, left))
            chosen = chosen.only(goes)
        else:
            chosen = policy.as_planned(len(rows))
        own, begun = truth.rows_of(errors, goes), np.ascontiguousarray(starts[goes])
        went = _Went(chosen, own, begun, noise[goes, 1:], rows[goes])
        complete = self._devices_out(went, left, active[goes], found)
        over = np.zeros(len(rows), dtype=bool)
        over[goes] = complete
        return over

    def _devices_out(self, went: "_Went", left: int, at: Int, found: Found) -> Bool:
        """Let tubes and needles out, and note what came of it; tell which needles were inserted."""
        policy, plan, procedure = self._policy, self._policy.plan, self._policy.procedure
        chosen, errors = went.chosen, went.errors
        tubes, rolled = truth.tube_pieces(plan, chosen, errors)
        done = np.ones(len(at), dtype=bool)
        pieces, n_tube = tubes, tubes.shape[1]
        if plan.needle is not None:
            true_tips = truth.turned_about(truth.ends_of(scope_frames(went.starts), tubes), -rolled)
            targets = np.tile(np.asarray(plan.goal_lps), (len(at), 1))
            if procedure.imaging.measured:
                shown = targets + errors.target_mm + procedure.imaging.position_mm * went.noise[:, 1, :3]
                targets = policy.targets_measured(shown)
            if procedure.tubes.measured:
                stage = procedure.tubes
                seen = as_measured(true_tips, stage.position_mm, stage.direction_deg, went.noise[:, 0])
                tips = policy.tips_measured(chosen, seen)
                ends = truth.ends_of(tips, truth.as_pieces(chosen.arcs, 0.0))[:, :3, 3]
                chosen = policy.from_tubes(chosen, tips, targets)
                corrected = np.linalg.norm(ends - targets, axis=1)
                found.decided["tube"].append(_Decided(~policy.goes_on(chosen.chances, 0), corrected))
                done = policy.goes_on(chosen.chances, left, tubes_out=True)
            if procedure.needle.closed_loop:
                arcs = self._steered(went, chosen, done, true_tips, targets, at, found)
            else:
                longest_mm = plan.system.require_needle("A procedure").max_length_mm
                arcs = truth.needles_carried_out(chosen.arcs, chosen.found[:, 1], errors, longest_mm)
            pieces = truth.as_pieces(arcs, plan.system.track_radius_mm)
            pieces[:, 0, kernel.ROLL] -= rolled
            pieces = np.concatenate([tubes, pieces], axis=1)
        outcomes = self.assessor.follow(went.starts, pieces, n_tube, errors.target_mm, errors.border_mm)
        touched = outcomes.touched.copy()
        back = np.flatnonzero(~done)
        if len(back):
            # Tubes that were drawn back again may have stayed in the airway: nothing came of it.
            starts, own = went.starts[back], np.ascontiguousarray(tubes[back])
            moved = errors.target_mm[back], errors.border_mm[back]
            touched[back] = self.assessor.follow(starts, own, n_tube, *moved).touched & ~kernel.STAYS_INSIDE
        found.touched[at] |= touched
        found.miss_mm[at[done]], found.taken[at[done]] = outcomes.miss_mm[done], outcomes.taken[done]
        found.ends[at[done]], found.shifts_mm[at[done]] = outcomes.ends[done], errors.target_mm[done]
        found.stopped[at[done]] &= went.stopped[done]
        return done

    def _steered(
        self,
        went: "_Went",
        chosen: Chosen,
        done: Bool,
        true_tips: Float,
        targets: Float,
        at: Int,
        found: Found,
    ) -> Float:
        """Return the true arcs of needles that are measured on their way, and note where they stopped."""
        policy, steering, made = self._policy, self._policy.procedure.needle, list[Float]()
        for n in range(len(at)):
            if not done[n]:
                made.append(np.zeros((0, 3)))
                continue
            path = ArcPath(lps_from_start=chosen.tips[n], arcs=chosen.arcs[n, : chosen.found[n, 1]])
            key = (_MEASURING, int(went.rows[n]), *self._number)
            errors = truth.rows_of(went.errors, np.array([n]))
            attempt = truth.Attempt(errors=errors, target_lps=policy.plan.goal_lps + errors.target_mm[0])
            branch = int(chosen.found[n, 2])
            query = Query(lps_from_start=path.lps_from_start, target=targets[n], branch=branch)
            doubt = policy.doubt_of(chosen.frames[n], chosen.tips[n])
            unknown = truth.unknown_of(policy.errors, steering, doubt)
            one = truth.insert_needle(
                policy.environment, query, path, _PolicyReplanner(policy, query, path), attempt, true_tips[n],
                steering, unknown, np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=key)),
            )  # fmt: skip
            made.append(one.arcs)
            went.stopped[n] = one.stopped is not None
            none = np.array([each.path is None for each in one.replans], dtype=bool)
            found.decided["needle"].append(_Decided(none, np.zeros(0)))
        arcs = np.zeros((len(at), max((len(each) for each in made), default=0) or 1, 3))
        for n, each in enumerate(made):
            arcs[n, : len(each)] = each
        return arcs


class _Went:
    """Procedures in which the tubes go out, N of them."""

    def __init__(self, chosen: Chosen, errors: Deviations, starts: Float, noise: Float, rows: Int) -> None:
        self.chosen, self.errors, self.starts, self.noise, self.rows = chosen, errors, starts, noise, rows
        self.stopped = np.zeros(len(rows), dtype=bool)


def _joined(parts: Iterable[Found]) -> Found:
    found = list(parts)
    joined = (np.concatenate([each[n] for each in found]) for n in range(7))
    decided = {stage: [one for each in found for one in each.decided.get(stage, [])] for stage in STAGES}
    return Found._make([*joined, decided])


def _report(policy: Policy, found: Found, samples: int, seed: int) -> ProcedureReport:
    assessor, procedure = policy.assessor, policy.procedure
    reaches = found.taken >= assessor.wanted.least
    touched = {name: (found.touched & flag) != 0 for name, flag in assessor.structures.items()}
    inserted = found.miss_mm[np.isfinite(found.miss_mm)]
    quantiles = {q: float(np.quantile(inserted, q)) for q in MISS_QUANTILES} if len(inserted) else {}
    measured = (procedure.scope.measured, procedure.tubes.measured, procedure.needle.closed_loop)
    used = [stage for stage, is_so in zip(STAGES, measured, strict=True) if is_so]
    left = np.ones(samples, dtype=bool)
    ends = {}
    causes = [(name, touched[name]) for name in ORDER if name in assessor.forbidden]
    for name, mask in (*causes, (NO_PATH, found.stopped & ~reaches), (MISSES, ~reaches), (SUCCESS, left)):
        ends[name] = share_of(left & mask)
        left = left & ~mask
    return ProcedureReport(
        model=policy.errors,
        procedure=procedure,
        samples=samples,
        seed=seed,
        radius_mm=assessor.radius_mm,
        radius_origin=assessor.radius_origin,
        succeeds=ends[SUCCESS],
        touches=MappingProxyType({name: share_of(mask) for name, mask in touched.items()}),
        ends=MappingProxyType(ends),
        miss_mm=MappingProxyType(quantiles),
        placements=float(found.placements.mean()),
        stages=tuple(_stage(stage, found.decided.get(stage, [])) for stage in used),
        tissue=assessor.tissue,
        with_needle=assessor.plan.needle is not None,
    )


def _stage(stage: str, decided: list[_Decided]) -> StageReport:
    without = np.concatenate([np.zeros(0, dtype=bool), *(each.without_path for each in decided)])
    corrected = np.concatenate([np.zeros(0), *(each.corrected_mm for each in decided)])
    return StageReport(
        stage=stage,
        replans=len(without),
        without_path=Share(count=int(np.count_nonzero(without)), samples=max(len(without), 1)),
        corrected_mm=float(np.median(corrected)) if len(corrected) else float("nan"),
    )


class _PolicyReplanner(Replanner):
    """Goes on by what the policy chooses; it searches where no path is proved, for one that ends nearer.

    Args:
        query, plan: As those of `Replanner`.
    """

    def __init__(self, policy: Policy, query: Query, plan: ArcPath) -> None:
        super().__init__(policy.environment, query, plan)
        self._policy, self._asked = policy, query
        self._followed, self._begun_mm, self._turned = plan.arcs, 0.0, 0.0

    def replan(
        self, lps_from_tip: Float, target: Float, inserted_mm: float, *, turned_rad: float | None = None
    ) -> Replan:
        """Plan from the pose that the tip is in; see `Replanner.replan`."""
        rest, turned = rest_of(self._followed, inserted_mm - self._begun_mm)
        asked, total = self._asked, self._turned + turned if turned_rad is None else turned_rad
        way = OnTheWay(rest, inserted_mm, total, asked.lps_from_start[:3, 2], asked.branch)
        arcs, chance, proved = self._policy.from_needle(way, lps_from_tip, target, self.curvature_share)
        path = ArcPath(lps_from_start=lps_from_tip, arcs=arcs)
        found = Replan(path=path, miss_mm=float(np.linalg.norm(path.frames()[-1][:3, 3] - target)))
        if chance < LEAST_CHANCE or not proved:
            other = self._searched(way, lps_from_tip, target)
            nearer = other.path is not None and other.miss_mm < found.miss_mm
            found = other if chance < LEAST_CHANCE or nearer else found
        if found.path is not None:
            self._followed, self._begun_mm, self._turned = found.path.arcs, inserted_mm, total
        return found

    def _searched(self, way: OnTheWay, lps_from_tip: Float, target: Float) -> Replan:
        query = Query(
            lps_from_start=lps_from_tip, target=target, branch=way.branch, inserted_mm=way.inserted_mm,
            turned_rad=way.turned_rad, reference=way.reference,
        )  # fmt: skip
        rest = ArcPath(lps_from_start=lps_from_tip, arcs=way.rest)
        # The most by which a replan may miss the target.
        allowed = ReplanSettings(largest_miss_mm=min(self._policy.aside_mm, 10.0))
        replanner = Replanner(self._policy.environment, query, rest, settings=allowed)
        replanner.curvature_share = self.curvature_share
        return replanner.replan(lps_from_tip, target, way.inserted_mm)
