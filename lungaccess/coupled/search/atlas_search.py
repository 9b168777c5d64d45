"""The search over the deployment atlas: direct arcs, climbs from the best, draws between, needle planners."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import chain, count, islice

import numpy as np

from anatomy.typed import Float, Int
from lungaccess.coupled.atlas import Atlas
from lungaccess.coupled.kernels.direct_arcs import PRUNED_BY_BOUND, evaluate_arcs
from lungaccess.coupled.search.entries import cost_bounds, different
from lungaccess.coupled.search.evaluator import NeedleDesk, Step
from lungaccess.coupled.search.local_sampling import MOST, Scatter, nearly_reaching
from lungaccess.coupled.search.local_search import Climb, Climber, needle_of, objective_of
from lungaccess.plans.assemble import Candidate, Task
from stages.needle import OptimalSearch, direct_path
from stages.tube import TubeJudge

CHUNK = 1000
FINALISTS = 3
ESTIMATE_SLACK = 1.03
"""How far above the best cost an estimated one may lie: it is rarely more than 1 % too large."""
KEPT_SLACK = 1.5
"""Direct arcs up to so many times as dear as the cheapest are where climbs begin."""
FRONT = 8
KICKED = 2
PLANNED = 4
DRAWS = 6
"""Iterations of a round in which deployments are drawn near those of the atlas."""
SLICE = 50
"""Tries of an iteration, about a millisecond."""
TRIES = 3 * SLICE
"""Tries of a climb in its first heat; twice as many in each heat that follows."""
HEATS = 5
POLISH_TRIES = 20 * SLICE
POLISHES = 2
PLANNER_ITERATIONS = 300
PLANNER_DOUBLINGS = 3
PLANNER_SLACK = 1.3
"""A needle planner may return what is so much dearer than the best: a climb will make it cheaper."""
WORTH_PRICING = 0.999
"""A climb is priced exactly when its estimated cost has fallen by this factor."""
HOPELESS_ITERATIONS = 1000
"""So many without a deployment that has the target in its needle's workspace, and the search is given up."""
JOINT_EVERY = 16
"""Rounds after which what was found is refined by a nonlinear program."""
WORTH_REFINING = 0.99
"""It takes as long as several rounds; the best must have become cheaper by this factor since the last one."""


class AtlasSearch:
    """Direct arcs from the whole atlas; then climbs, draws, needle planners and joint refinement in turns.

    Parameters
    ----------
    task : Task
    atlas : Atlas
    """

    from_atlas = True
    """Whether placements begin with the atlas, or are drawn at random for as long as the caller waits."""

    def __init__(self, task: Task, atlas: Atlas) -> None:
        self.task = task
        self.atlas = atlas
        self.desk = NeedleDesk(task)
        self.judge = TubeJudge(
            task.lung, task.system.tubes, task.system.margins, with_fissures=task.with_fissures
        )
        self.in_workspace, self._lengths = atlas.index.holding(self.desk.environment, task.target.lps_mm)
        self.best: Step | None = None
        self.rng = np.random.Generator(np.random.PCG64(task.seed))
        self._needle = needle_of(self.desk.environment, task)
        self._clear: Int = np.zeros(0, dtype=np.int64)
        self._share = (0, 1)
        self._refined_cost = math.inf

    def steps(self) -> Iterator[Step]:
        """Search forever; the caller stops."""
        yield from self.direct_steps()
        yield from self.further_steps()

    def is_hopeless(self, iteration: int) -> bool:
        """Tell whether going on is of no use: the target has come into no workspace."""
        if not self.from_atlas:
            return not self.atlas.sites.count
        if not self.atlas.deployments.count:
            return True
        return not len(self.in_workspace) and iteration >= HOPELESS_ITERATIONS

    def take_part(self, number: int, parts: int) -> None:
        """Do one part of the work of several processes, with random numbers of its own."""
        self._share = (number, parts)
        self.rng = np.random.Generator(np.random.PCG64([self.task.seed, number]))

    def adopt(self, best: Step) -> None:
        """Take over a step that another process found, if it is better."""
        if self.best is None or best.cost < self.best.cost:
            self.best = best

    def _kept(self, step: Step) -> Step:
        """Return a step with its candidate only if that is better than all before."""
        if step.candidate is not None and step.cost < self._best_cost:
            self.best = step
            return step
        return replace(step, candidate=None)

    @property
    def _best_cost(self) -> float:
        return math.inf if self.best is None else self.best.cost

    def direct_steps(self) -> Iterator[Step]:
        """Try the direct arcs, nearest first; a step has a candidate if it is better than all before.

        Those are left out whose lower bound or estimate is far above the best.
        """
        entries = self.atlas.deployments
        x, y, z = self.task.target.lps_mm.tolist()
        found, prices, cheapest = [], [], math.inf
        for begin in range(0, len(self.in_workspace), CHUNK):
            chunk = self.in_workspace[begin : begin + CHUNK]
            blockers, costs = np.zeros(len(chunk), dtype=np.int64), np.zeros(len(chunk))
            cheapest = evaluate_arcs(
                self._needle, entries.positions[chunk], entries.tangents[chunk],
                entries.branch[chunk], (x, y, z), KEPT_SLACK, cheapest, blockers, costs,
            )  # fmt: skip
            self.desk.count_blockers(blockers[blockers != PRUNED_BY_BOUND])
            clear = np.flatnonzero((blockers == 0) & np.isfinite(costs))
            found.append(chunk[clear])
            prices.append(costs[clear])
            yield Step(iteration=0, phase="direct arcs")
            left = FINALISTS
            for n in clear[np.argsort(costs[clear], kind="stable")].tolist():
                if not left or costs[n] > ESTIMATE_SLACK * self._best_cost:
                    break
                step = self.desk.finished(0, "direct arcs", self._entry(int(chunk[n])))
                left -= step.candidate is not None
                yield self._kept(step)
        if found:
            clear, costs = np.concatenate(found), np.concatenate(prices)
            self._clear = clear[np.argsort(costs, kind="stable")]

    def _entry(self, entry: int) -> Candidate | None:
        """Return an atlas entry in full, with its direct arc."""
        entries = self.atlas.deployments
        tip = self.atlas.sites.tip(self.task.lung.tree, int(entries.site[entry]))
        deployment = self.judge.judge(
            tip.lps_from_scope_tip,
            float(entries.rotation_rad[entry]),
            float(entries.outer_mm[entry]),
            float(entries.inner_mm[entry]),
        )
        if isinstance(deployment, str):
            return None
        path = direct_path(deployment.lps_from_tip, self.task.target.lps_mm)
        return Candidate(tip=tip, deployment=deployment, path=path)

    def finished(self, entry: int) -> Candidate | None:
        """Return an atlas entry with its direct arc, proved; None if the proof fails."""
        candidate = self._entry(entry)
        if candidate is None or not self.desk.proved(candidate.deployment, candidate.path):
            return None
        return candidate

    def further_steps(self) -> Iterator[Step]:
        """Go on for ever from what the direct arcs found; each step is an iteration."""
        for number, step in enumerate(self._rounds(), start=1):
            yield self._kept(replace(step, iteration=number))

    def _rounds(self) -> Iterator[Step]:
        """Let climbs from the best direct arcs race; then polish the best and race others, in turns."""
        if not self.atlas.deployments.count:
            return
        number, parts = self._share
        climber = Climber(self.desk, self.judge, self.atlas.sites, self.rng)
        front = self._front(climber, different(self.atlas.deployments, self._clear)[number::parts])
        yield from self._race(climber, list(islice(front, FRONT)))
        drawn = self._drawn(climber)
        planned = self._planned(climber)
        for turn in count(1):
            yield from self._polish(climber)
            if turn % JOINT_EVERY == 0 and number == 0:
                yield from self._joint()
            newcomers = [*islice(front, 1), *self._kicked(climber)]
            for step, climb in chain(islice(drawn, DRAWS), islice(planned, PLANNED)):
                newcomers += [] if climb is None else [climb]
                yield step
            yield from self._race(climber, newcomers)

    def _front(self, climber: Climber, entries: Int) -> Iterator[Climb]:
        """Yield climbs from clear direct arcs, the cheapest first, then any of them."""
        for entry in entries.tolist():
            yield from self._begun(climber, self._entry(entry))
        while len(self._clear):
            yield from self._begun(climber, self._entry(int(self.rng.choice(self._clear))))

    def _begun(self, climber: Climber, candidate: Candidate | None) -> Iterator[Climb]:
        climb = None if candidate is None else climber.begin(candidate)
        if climb is not None:
            yield climb

    def _kicked(self, climber: Climber) -> list[Climb]:
        """Return climbs that begin at random some way off the best."""
        if self.best is None or self.best.candidate is None:
            return []
        climbs = [next(self._begun(climber, self.best.candidate), None) for _ in range(KICKED)]
        for climb in climbs:
            if climb is not None:
                climber.kick(climb)
        return [climb for climb in climbs if climb is not None]

    def _race(self, climber: Climber, climbs: list[Climb]) -> Iterator[Step]:
        """Advance climbs; after each heat the better half goes on."""
        tries = TRIES
        for _heat in range(HEATS):
            for climb in climbs:
                yield from self._advanced(climber, climb, tries)
            climbs = sorted((c for c in climbs if math.isfinite(c.cost)), key=lambda c: c.cost)
            climbs, tries = climbs[: (len(climbs) + 1) // 2], 2 * tries

    def _polish(self, climber: Climber) -> Iterator[Step]:
        """Climb on from the best."""
        if self.best is None or self.best.candidate is None:
            return
        for climb in self._begun(climber, self.best.candidate):
            for _ in range(POLISHES):
                yield from self._advanced(climber, climb, POLISH_TRIES)

    def _advanced(self, climber: Climber, climb: Climb, tries: int) -> Iterator[Step]:
        """Spend tries on a climb, in slices; the last step has what it has found."""
        for spent in range(SLICE, tries + 1, SLICE):
            climber.advance(climb, SLICE)
            yield Step(iteration=0, phase="climb") if spent < tries else self._looked_at(climber, climb)

    def _looked_at(self, climber: Climber, climb: Climb) -> Step:
        """Return what a climb has found, if it may be the best."""
        worth = climb.cost < min(WORTH_PRICING * climb.priced, ESTIMATE_SLACK * self._best_cost)
        if not worth:
            return Step(iteration=0, phase="climb")
        climb.priced = climb.cost
        return self.desk.finished(0, "climb", climber.candidate(climb))

    def _planned(self, climber: Climber) -> Iterator[tuple[Step, Climb | None]]:
        """Run needle planners from deployments, the least lower bound first, longer in every pass."""
        nothing = Step(iteration=0, phase="needle planner")
        if not len(self.in_workspace):
            return
        entries, number, parts = self.atlas.deployments, *self._share
        by_bound, least = self._by_bound
        ordered = different(entries, by_bound)[number::parts]
        for level in count():
            iterations = PLANNER_ITERATIONS * 2 ** min(level, PLANNER_DOUBLINGS)
            for entry in ordered.tolist():
                if least[entry] >= self._best_cost:
                    break
                found = self._by_planner(self._entry(entry), iterations)
                if found is None:
                    yield nothing, None
                    continue
                step = nothing if self.best else self.desk.finished(0, "needle planner", found)
                yield step, next(self._begun(climber, found), None)
            yield nothing, None

    @cached_property
    def _by_bound(self) -> tuple[Int, Float]:
        """The deployments with the target in their workspace, the least lower bound of the cost first.

        And the bounds `(E,)` by deployment, 0 for all others.
        """
        target, entries = self.task.target.lps_mm, self.atlas.deployments
        bounds = cost_bounds(self._needle, entries, self.in_workspace, self._lengths, target)
        least = np.zeros(entries.count)
        least[self.in_workspace] = bounds
        return self.in_workspace[np.argsort(bounds, kind="stable")], least

    def _by_planner(self, candidate: Candidate | None, iterations: int) -> Candidate | None:
        """Return a deployment with a path of the needle planner that may become the best."""
        seed = int(self.rng.integers(2**63))
        if candidate is None:
            return None
        objective, query = objective_of(self.task), self.desk.query(candidate.deployment)
        search = OptimalSearch(self.desk.environment, query, seed=seed, objective=objective)
        search.cost = PLANNER_SLACK * self._best_cost
        search.advance(iterations)
        return None if search.path is None else replace(candidate, path=search.path)

    def _drawn(self, climber: Climber) -> Iterator[tuple[Step, Climb | None]]:
        """Draw deployments near those whose needle reaches the target, or nearly does, for ever."""
        inside = different(self.atlas.deployments, self._by_bound[0])[: MOST // 2]
        most = MOST - len(inside)
        outside = nearly_reaching(self.atlas, self.task.system.needle, self.task.target.lps_mm, most)
        chosen = np.concatenate([inside, outside])
        scatter = Scatter(climber, self.judge, self.atlas, chosen, self.rng)
        while True:
            found = scatter.draw(KEPT_SLACK * self._best_cost)
            step = Step(iteration=0, phase="draw")
            if self.best is None:
                step = self.desk.finished(0, "draw", found)
            yield step, next(self._begun(climber, found), None)

    def _joint(self) -> Iterator[Step]:
        """Improve site, tubes and needle of the best together, by a nonlinear program."""
        from lungaccess.refinement import refine

        best = self.best
        if best is None or best.candidate is None or best.cost >= WORTH_REFINING * self._refined_cost:
            return
        found = refine(self.task, self.atlas.sites, best.candidate)
        step = self.desk.finished(0, "joint refinement", found)
        self._refined_cost = min(best.cost, step.cost)
        yield step
