"""The two searches: over the deployment atlas, and Algorithm 1 of [Kuntz2015]."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from anatomy.grid import Float
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from lungaccess.assemble import Candidate, Task
from lungaccess.atlas import Atlas
from lungaccess.costs import path_cost
from stages.needle.path import ArcPath, blocker_on_path, direct_path, estimated_inverse_clearance
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace, direct_arcs, needle_space, workspace_lengths
from stages.scope.sites import can_stand
from stages.scope.tips import MedialAxis, ScopeTip, looks_ahead, walk
from stages.tube.deployments import Deployment, TubeJudge, tracking_length_mm

if TYPE_CHECKING:
    from stages.needle.ompl_planner import NeedleProblem

CHUNK = 1000
FINALISTS = 20
RRT_ITERATIONS = 300
EXPLORE_EVERY = 4
JOINT_EVERY = 400
"""Iterations after which what was found is refined by a nonlinear program, once."""
SITE_SPREAD_MM = 2.0
ROTATION_SPREAD_RAD = math.radians(8.0)
INSERTION_SPREAD_MM = 1.5
COUNTED_SPREADS = (1.0, 0.3, 0.1)
ESTIMATE_SLACK = 1.1
"""How far above the best cost an estimated one may lie: it is rarely more than a tenth too large."""

BLOCKERS = ((VESSEL, "a vessel"), (OUTSIDE, "the pleura"), (FISSURE, "a fissure"), (AIRWAY, "an airway"))


@dataclass(frozen=True, kw_only=True)
class Step:
    """What one step of a search did: its number, and a better candidate if it found one."""

    iteration: int
    phase: str
    candidate: Candidate | None = None
    cost: float = math.inf


class NeedleDesk:
    """Judges needle paths for one task: is it in the workspace, is it clear, what does it cost."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.space: NeedleSpace = needle_space(
            task.lung, task.system.needle, task.system.margins, with_fissures=task.with_fissures
        )
        self.blocked: Counter[str] = Counter()

    def cost(self, path: ArcPath) -> float:
        """Return the cost of a path under the task's objective."""
        task = self.task
        return path_cost(task.lung, path, task.objective, with_fissures=task.with_fissures)

    def is_worth_a_look(self, path: ArcPath, best_cost: float) -> bool:
        """Tell from an estimate, a hundred times faster than the cost, whether a path may be better."""
        if self.task.objective == "inverse_clearance":
            return estimated_inverse_clearance(self.space, path) <= ESTIMATE_SLACK * best_cost
        return self.task.objective != "length_mm" or path.length_mm < best_cost

    def reaches(self, lps_from_tip: Float) -> bool:
        """Tell whether the target lies in the workspace of a start pose."""
        length = workspace_lengths(
            self.space, lps_from_tip[None, :3, 3], lps_from_tip[None, :3, 2], self.task.target.lps_mm
        )
        return bool(np.isfinite(length[0]))

    def direct(self, deployment: Deployment) -> ArcPath | None:
        """Return the single arc to the target, if it is within the limits and proved clear."""
        frame = deployment.lps_from_tip
        blockers, _lengths, _costs = direct_arcs(
            self.space,
            frame[None, :3, 3],
            frame[None, :3, 2],
            np.array([deployment.branch]),
            self.task.target.lps_mm,
        )
        self.count_blockers(blockers)
        return direct_path(frame, self.task.target.lps_mm) if blockers[0] == 0 else None

    def search(self, deployment: Deployment, seed: int, iterations: int) -> ArcPath | None:
        """Return a path of the RRT, if it finds one."""
        query = Query(
            lps_from_start=deployment.lps_from_tip, target=self.task.target.lps_mm, branch=deployment.branch
        )
        return self._problem.plan(query, seed=seed, iterations=iterations)

    @cached_property
    def _problem(self) -> NeedleProblem:
        from stages.needle.ompl_planner import NeedleProblem

        return NeedleProblem(self.space)

    def proved(self, deployment: Deployment, path: ArcPath) -> bool:
        """Prove the path once more, from the numbers that the plan will state.

        A voxel of infinite cost may not be entered, whatever the objective is.
        """
        if blocker_on_path(self.space, path, deployment.branch) != 0:
            return False
        mapped = path_cost(self.task.lung, path, "cost_map", with_fissures=self.task.with_fissures)
        return math.isfinite(mapped)

    def count_blockers(self, blockers: NDArray[np.int64]) -> None:
        """Count what stands in the way of direct arcs."""
        labels, counts = np.unique(blockers, return_counts=True)
        for label, count in zip(labels, counts, strict=True):
            self.blocked[blocker_name(int(label))] += int(count)


def blocker_name(label: int) -> str:
    """Name what blocks an arc: 0 nothing, -1 the limits of the needle, else a voxel label."""
    if label == 0:
        return "nothing"
    if label < 0:
        return "the needle's limits"
    return next(name for bit, name in BLOCKERS if label & bit)


class AtlasSearch:
    """Direct arcs from the whole atlas, then refinement around the best and RRT from the rest.

    Parameters
    ----------
    task : Task
    atlas : Atlas
    """

    def __init__(self, task: Task, atlas: Atlas) -> None:
        self.task = task
        self.atlas = atlas
        self.desk = NeedleDesk(task)
        self._judge = TubeJudge(
            task.lung, task.system.tubes, task.system.margins, with_fissures=task.with_fissures
        )
        entries = atlas.deployments
        lengths = workspace_lengths(self.desk.space, entries.positions, entries.tangents, task.target.lps_mm)
        order = np.argsort(lengths, kind="stable")
        self.in_workspace = order[: int(np.isfinite(lengths).sum())]
        self._rng = np.random.Generator(np.random.PCG64(task.seed))
        self._refined: Candidate | None = None

    def steps(self) -> Iterator[Step]:
        """Search forever; the caller stops."""
        best: Step | None = None
        for step in self.direct_steps():
            best = step if step.candidate is not None else best
            yield step
        iteration = 0
        while True:
            iteration += 1
            step = self.vary(iteration, best)
            if step.candidate is not None and (best is None or step.cost < best.cost):
                best = step
            else:
                step = replace(step, candidate=None)
            yield step

    def direct_steps(self) -> Iterator[Step]:
        """Try the direct arcs; a step has a candidate if it is better than all before."""
        best = math.inf
        for step in self._direct_arcs():
            better = step.candidate is not None and step.cost < best
            best = step.cost if better else best
            yield step if better else replace(step, candidate=None)

    def seed_with(self, rng: np.random.Generator) -> None:
        """Take the random numbers from another generator from now on."""
        self._rng = rng

    def _direct_arcs(self) -> Iterator[Step]:
        """Try the single arc from every deployment with the target in its workspace, nearest first."""
        entries = self.atlas.deployments
        target = self.task.target.lps_mm
        for begin in range(0, len(self.in_workspace), CHUNK):
            chunk = self.in_workspace[begin : begin + CHUNK]
            blockers, lengths, inverse = direct_arcs(
                self.desk.space,
                entries.positions[chunk],
                entries.tangents[chunk],
                entries.branch[chunk],
                target,
            )
            self.desk.count_blockers(blockers)
            clear = np.flatnonzero(blockers == 0)
            rank = {"length_mm": lengths, "inverse_clearance": inverse}.get(self.task.objective, lengths)
            finalists = clear[np.argsort(rank[clear], kind="stable")[:FINALISTS]]
            for n in finalists:
                yield self._finish(0, "direct arcs", *self._entry(int(chunk[n])))
            if not len(finalists):
                yield Step(iteration=0, phase="direct arcs")

    def _entry(self, entry: int) -> tuple[ScopeTip, Deployment | None, ArcPath | None]:
        """Return an atlas entry in full, with its direct arc."""
        entries = self.atlas.deployments
        tip = self.atlas.sites.tip(self.task.lung.tree, int(entries.site[entry]))
        deployment = self._judged(
            tip,
            float(entries.rotation_rad[entry]),
            float(entries.outer_mm[entry]),
            float(entries.inner_mm[entry]),
        )
        path = None if deployment is None else direct_path(deployment.lps_from_tip, self.task.target.lps_mm)
        return tip, deployment, path

    def finished(self, entry: int) -> Candidate | None:
        """Return an atlas entry with its direct arc, proved; None if the proof fails."""
        return self._finish(0, "direct arcs", *self._entry(entry)).candidate

    def _judged(self, tip: ScopeTip, rotation: float, outer: float, inner: float) -> Deployment | None:
        verdict = self._judge.judge(tip.lps_from_scope_tip, rotation, outer, inner)
        return None if isinstance(verdict, str) else verdict

    def _finish(
        self, iteration: int, phase: str, tip: ScopeTip, deployment: Deployment | None, path: ArcPath | None
    ) -> Step:
        """Prove and price a path; a step without candidate if anything is missing."""
        if deployment is None or path is None or not self.desk.proved(deployment, path):
            return Step(iteration=iteration, phase=phase)
        candidate = Candidate(tip=tip, deployment=deployment, path=path)
        return Step(iteration=iteration, phase=phase, candidate=candidate, cost=self.desk.cost(path))

    def vary(self, iteration: int, best: Step | None) -> Step:
        """Refine the best candidate, or explore from another deployment."""
        if best is not None and iteration % JOINT_EVERY == 0 and best.candidate is not self._refined:
            return self.refined(iteration, best)
        explore = best is None or iteration % EXPLORE_EVERY == 0
        if explore and iteration % 2 == 0 and len(self.in_workspace):
            return self._rrt(iteration, best)
        around = self._random_candidate() if explore else best.candidate if best else None
        if around is None:
            return Step(iteration=iteration, phase="refinement")
        spread = COUNTED_SPREADS[int(self._rng.integers(len(COUNTED_SPREADS)))]
        return self._perturbed(iteration, around, spread, math.inf if best is None else best.cost)

    def refined(self, iteration: int, best: Step) -> Step:
        """Improve site, tubes and needle of the best candidate together, by a nonlinear program."""
        from lungaccess.refinement import refine

        self._refined = best.candidate
        nothing = Step(iteration=iteration, phase="joint refinement")
        # A turned tip has no smooth way along the axis.
        if best.candidate is None or best.candidate.tip.turned:
            return nothing
        found = refine(self.task, self.atlas.sites, best.candidate)
        if found is None:
            return nothing
        step = self._finish(iteration, "joint refinement", found.tip, found.deployment, found.path)
        if step.candidate is not None and step.cost < best.cost:
            self._refined = step.candidate
        return step

    def _random_candidate(self) -> Candidate | None:
        """Return a deployment to vary, from those with the target in their workspace or near it."""
        pool = self.in_workspace if len(self.in_workspace) else np.arange(self.atlas.deployments.count)
        if not len(pool):
            return None
        tip, deployment, path = self._entry(int(pool[self._rng.integers(len(pool))]))
        if deployment is None or path is None:
            return None
        return Candidate(tip=tip, deployment=deployment, path=path)

    def _perturbed(self, iteration: int, around: Candidate, spread: float, best_cost: float) -> Step:
        """Vary site, rotation and insertions of a candidate, and try its direct arc."""
        rng, system = self._rng, self.task.system
        shift, turn, outer, inner = rng.standard_normal(4) * spread
        tip = walk(self.task.lung.tree, around.tip, shift * SITE_SPREAD_MM, rng)
        nothing = Step(iteration=iteration, phase="refinement")
        if not can_stand(self.task.lung, system.scope, self.atlas.sites, tip):
            return nothing
        outer_mm = max(0.0, around.deployment.outer_mm + outer * INSERTION_SPREAD_MM)
        inner_mm = around.deployment.inner_mm + inner * INSERTION_SPREAD_MM
        inner_mm = min(max(inner_mm, outer_mm), system.tubes.max_extension_mm)
        rotation = around.deployment.rotation_rad + turn * ROTATION_SPREAD_RAD
        deployment = self._judged(tip, rotation, min(outer_mm, inner_mm), inner_mm)
        if deployment is None:
            return nothing
        path = self.desk.direct(deployment)
        if path is None or not self.desk.is_worth_a_look(path, best_cost):
            return nothing
        return self._finish(iteration, "refinement", tip, deployment, path)

    def _rrt(self, iteration: int, best: Step | None) -> Step:
        """Run the RRT from a deployment drawn from those with the target in their workspace."""
        entry = int(self.in_workspace[self._rng.integers(len(self.in_workspace))])
        seed = int(self._rng.integers(2**63))
        tip, deployment, _direct = self._entry(entry)
        if deployment is None:
            return Step(iteration=iteration, phase="RRT")
        path = self.desk.search(deployment, seed, RRT_ITERATIONS)
        if path is None or (best is not None and not self.desk.is_worth_a_look(path, best.cost)):
            return Step(iteration=iteration, phase="RRT")
        return self._finish(iteration, "RRT", tip, deployment, path)


class KuntzSearch(AtlasSearch):
    """Algorithm 1 of [Kuntz2015]: random placement, workspace rejection, RRT, keep the best.

    Lines 3-7 draw site, rotation and translations; line 8 rejects placements whose workspace does not
    hold the target; line 9 runs the RRT, here for a fixed number of iterations so that runs repeat.
    """

    rejects = True
    """Whether line 8 is carried out."""

    def steps(self) -> Iterator[Step]:
        """Search forever; the caller stops."""
        best = math.inf
        axis = MedialAxis(self.task.lung.tree, self.atlas.sites.passable & self.atlas.sites.exits_ahead)
        iteration = 0
        while axis.length_mm > 0.0:
            iteration += 1
            step = self._algorithm_1(iteration, axis)
            if step.candidate is not None and step.cost < best:
                best = step.cost
            else:
                step = replace(step, candidate=None)
            yield step

    def _algorithm_1(self, iteration: int, axis: MedialAxis) -> Step:
        rng, tubes = self._rng, self.task.system.tubes
        tip = axis.sample(rng)
        rotation = float(rng.uniform(0.0, 2 * math.pi))
        outer, inner = np.sort(rng.uniform(0.0, tracking_length_mm(tubes), 2))
        seed = int(rng.integers(2**63))
        if not looks_ahead(self.task.lung.tree, tip):
            return Step(iteration=iteration, phase="Algorithm 1")
        deployment = self._judged(tip, rotation, float(outer), float(inner))
        if deployment is None or (self.rejects and not self.desk.reaches(deployment.lps_from_tip)):
            return Step(iteration=iteration, phase="Algorithm 1")
        path = self.desk.search(deployment, seed, RRT_ITERATIONS)
        return self._finish(iteration, "Algorithm 1", tip, deployment, path)


class KuntzSearchWithoutRejection(KuntzSearch):
    """The same without line 8: the paper's measure of what rejection saves."""

    rejects = False
