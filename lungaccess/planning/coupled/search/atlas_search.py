"""The search over the deployment atlas: direct arcs first, then rounds of all ways to improve on them.

One of these ways is local sampling: random deployments near those of the atlas, each with a direct arc.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

import numpy as np

from anatomy.base.typed import Float, Int, UInt64
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.candidate import SCOPE_POSE
from lungaccess.planning.coupled.kernels.local_search import sample_deployments
from lungaccess.planning.coupled.search import base
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs, DirectArcSearch
from lungaccess.planning.coupled.search.local_search import LocalSearch, LocalSearchRun, TubeChoice
from lungaccess.planning.coupled.search.needle_planner import PLANNER, NamedNeedlePlanner, needle_searches
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.task import Task
from stages.needle import Needle, successive_halving
from stages.tube import many_shapes, shapes_of


class _LocalSearchRounds:
    """Shares iterations among local searches."""

    phase = "local search"

    def __init__(self, search: "AtlasSearch", local_search: LocalSearch) -> None:
        self._local_search, self._evaluator = local_search, search.evaluator
        self._incumbent, self._settings = search.incumbent, search.settings

    def halve(self, runs: list[LocalSearchRun]) -> Iterator[base.Step]:
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

    def intensify(self) -> Iterator[base.Step]:
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

    def _advanced(self, run: LocalSearchRun, iterations: int) -> Iterator[base.Step]:
        """Advance a run by iterations; the last step has what it has found."""
        for n in range(1, iterations + 1):
            # Variations of an iteration, which takes about a millisecond.
            self._local_search.advance(run, 50)
            # A run is evaluated in full only when its estimated cost has fallen by this factor, to save time.
            limit = min(0.999 * run.evaluated_cost, base.ESTIMATE_SLACK * self._incumbent.cost)
            if n < iterations or not run.cost < limit:
                yield base.Step(iteration=0, phase=self.phase)
            else:
                run.evaluated_cost = run.cost
                yield base.evaluated_step(self._evaluator, self.phase, self._local_search.candidate(run))


class AtlasSearch(base.ParallelSearch):
    """Direct arcs of the whole atlas, then rounds of local search, sampling, needle search and refinement."""

    def __init__(
        self,
        task: Task,
        atlas: Atlas,
        settings: base.SearchSettings | None = None,
        arcs: DirectArcs | None = None,
    ) -> None:
        self.task = task
        self.atlas = atlas
        self.settings = settings or base.SearchSettings()
        self.arcs = arcs or DirectArcs(task, atlas)
        self.evaluator = self.arcs.evaluator
        super().__init__(self.evaluator.blocked)
        self._needle_planner = NamedNeedlePlanner(self.evaluator, PLANNER)
        self.direct: base.DirectSearch = DirectArcSearch(self.arcs, self.incumbent, self.settings)
        self._rng = np.random.Generator(np.random.PCG64(task.seed))
        self._refined_cost = math.inf

    def is_futile(self, iteration: int) -> bool:
        """Tell whether there is no candidate, and the target has come into no needle's workspace."""
        if self.incumbent.step is not None or len(self.arcs.in_workspace):
            return False
        # So many iterations without a deployment that has the target in its needle's workspace end the
        # search.
        return iteration >= 1000 or not self.atlas.deployments.count

    def take_part(self, number: int, parts: int) -> None:
        """Do one part of the work of several processes, with random numbers of its own."""
        super().take_part(number, parts)
        self._rng = np.random.Generator(np.random.PCG64([self.task.seed, number]))

    def direct_steps(self) -> Iterator[base.Step]:
        """Evaluate the direct arcs, nearest first."""
        return self.direct.steps()

    def further_steps(self) -> Iterator[base.Step]:
        """Continue from the direct arcs without end; each step is an iteration."""
        for number, step in enumerate(self._rounds(), start=1):
            yield self.incumbent.improved(replace(step, iteration=number))

    def _rounds(self) -> Iterator[base.Step]:
        """Start from the best direct arcs, then intensify the best candidate and try new starts, in turns."""
        if not self.atlas.deployments.count:
            return
        settings, number = self.settings, self.share[0]
        local_search = LocalSearch(self.evaluator, self._rng)
        rounds = _LocalSearchRounds(self, local_search)
        starts = self._starts(local_search)
        sampled = self._sampled(local_search)
        searched = needle_searches(
            self.arcs, self._needle_planner, self.incumbent, settings, self._rng, self.share
        )
        yield from rounds.halve(list(islice(starts, settings.starts)))
        for turn in count(1):
            yield from rounds.intensify()
            if turn % settings.refine_every == 0 and number == 0:
                yield from self._refined()
            newcomers = [*islice(starts, 1), *rounds.perturbed()]
            for phase, iterations in ((sampled, settings.samplings), (searched, settings.needle_searches)):
                for step, candidate in islice(phase, iterations):
                    run = local_search.begin(candidate)
                    newcomers += [] if run is None else [run]
                    yield step
            yield from rounds.halve(newcomers)

    def _starts(self, local_search: LocalSearch) -> Iterator[LocalSearchRun]:
        """Yield local searches from clear direct arcs, different ones by their cost, then any of them.

        Tubes that the validation refuses although the atlas has them, on the edge of a limit, are not tried
        again, so that the search ends where no others are left.
        """
        number, parts = self.share
        clear = self.direct.clear
        first = base.different(self.atlas.deployments, clear)[number::parts].tolist()
        refused: set[int] = set()
        while first or len(refused) < len(clear):
            entry = first.pop(0) if first else int(self._rng.choice(clear))
            if entry in refused:
                continue
            run = local_search.begin(self.arcs.candidate(entry))
            if run is not None:
                yield run
            else:
                refused.add(entry)

    def _sampled(self, local_search: LocalSearch) -> Iterator[tuple[base.Step, Candidate | None]]:
        """Sample deployments near those of the atlas whose needle reaches the target, or nearly does."""
        sampling = _sampling_near_target(local_search, self.arcs, self._rng)
        nothing = base.Step(iteration=0, phase="local sampling")
        while True:
            found = sampling.sample(self.settings.kept_slack * self.incumbent.cost)
            first = self.incumbent.step is None
            yield base.evaluated_step(self.evaluator, nothing.phase, found) if first else nothing, found

    def _refined(self) -> Iterator[base.Step]:
        """Improve scope pose, tubes and needle of the best candidate together, by a nonlinear program."""
        from lungaccess.planning.refinement import refine

        best = self.incumbent.candidate
        # The best candidate is refined again once it is cheaper by this factor, as a refinement takes long.
        if best is None or self.incumbent.cost >= 0.99 * self._refined_cost:
            return
        before = self.incumbent.cost
        end = replace(self.task.target, lps_mm=self.evaluator.end_of(best.path))
        step = base.evaluated_step(
            self.evaluator, "joint refinement", refine(replace(self.task, target=end), best)
        )
        self._refined_cost = min(before, step.cost)
        yield step


MOST = 1000
"""Deployments of the atlas around which samples are drawn: about as many as one iteration has samples for."""
TRIES = 2000
"""Samples of an iteration, a few milliseconds at most: nearly all end at the limits of the needle."""
SPREADS = np.array([math.radians(15.0), 2.0])
"""How far rotation and insertions (mm) are varied: to the next entry of the atlas and beyond."""


class LocalSampling:
    """Samples deployments near entries `chosen` (N,) of an atlas, at least one."""

    def __init__(
        self, local_search: LocalSearch, arcs: DirectArcs, chosen: Int, rng: np.random.Generator
    ) -> None:
        self._local_search = local_search
        self._evaluator, self._rng = arcs.evaluator, rng
        entries, motions = arcs.atlas.deployments, arcs.atlas.motions
        numbers, pose_of = np.unique(entries.site[chosen], return_inverse=True)
        self._motions, self._numbers = motions, numbers
        shapes = many_shapes(shapes_of(arcs.task.system.tubes), entries.shape[chosen])
        poses, rotations = np.ascontiguousarray(motions.tips[numbers]), np.array(entries.rotation_rad[chosen])
        self._around = poses, pose_of, rotations, shapes, SPREADS, local_search.target, TRIES

    def sample(self, cost_limit: float) -> Candidate | None:
        """Return the cheapest of TRIES samples if its estimated cost is below a limit."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        search, best = self._local_search, TubeChoice.empty(self._local_search.design)
        tube = search.tube(TubeChoice.empty(search.design))
        cost = sample_deployments(tube, search.needle, *self._around, cost_limit, state, best.x, best.shape)
        if not cost < cost_limit:
            return None
        tip = self._motions.tip(int(self._numbers[int(best.x[SCOPE_POSE])]))
        return self._evaluator.direct(tip, *best.numbers)


def _sampling_near_target(
    local_search: LocalSearch, arcs: DirectArcs, rng: np.random.Generator
) -> LocalSampling:
    """Return local sampling around the deployments from which the needle reaches the target, or nearly does.

    Up to half of MOST are different ones that may reach it at the least cost; the others miss it by least.
    """
    inside = base.different(arcs.atlas.deployments, arcs.by_bound[0])[: MOST // 2]
    target, most = arcs.task.target.lps_mm, MOST - len(inside)
    outside = nearly_reaching(arcs.atlas, arcs.evaluator.environment.needle, target, most)
    return LocalSampling(local_search, arcs, np.concatenate([inside, outside]), rng)


def nearly_reaching(atlas: Atlas, needle: Needle, target: Float, most: int) -> Int:
    """Return `most` entries whose single arc to a target (LPS mm) exceeds the limits, nearest misses first.

    A miss is how far the target lies from the needle's workspace, or less.  It counts in relation to how far
    a variation of the deployment moves that workspace: a few mm, and more with the distance from the tubes.
    """
    entries = atlas.deployments
    offset = target - entries.positions
    away = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset), 1e-12))
    ahead = np.einsum("ni,ni->n", offset, entries.tangents)
    aside = np.sqrt(np.maximum(away**2 - ahead**2, 0.0))
    curvature, turn = 2.0 * aside / away**2, 2.0 * np.arctan2(aside, ahead)
    length = np.where(curvature > 1e-9, turn / np.maximum(curvature, 1e-9), np.abs(ahead))
    most_turn = math.radians(min(needle.max_angle_from_start_deg, needle.max_accumulated_turn_deg))
    radius = 1.0 / needle.max_curvature_per_mm
    miss = np.maximum(radius - np.hypot(ahead, aside - radius), (turn - most_turn) * away)
    miss = np.maximum(miss, length - needle.max_length_mm)
    miss[miss <= 0.0] = np.inf
    # By about this angle such a variation turns the tip of the tubes.
    return np.argsort(miss / (SPREADS[1] + 0.15 * away), kind="stable")[:most].astype(np.int64)
