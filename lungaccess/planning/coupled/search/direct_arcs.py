"""Direct arcs from the deployments of an atlas to a target: the first phase of a search."""

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.direct_arcs import PRUNED_BY_BOUND, cost_bounds, evaluate_arcs
from lungaccess.planning.coupled.kernels.tubes_cost import costs_in_tissue
from lungaccess.planning.coupled.search import base
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator, blocker_counts
from lungaccess.problem.task import Task
from stages.needle import NeedleEnvironment, direct_arcs, workspace_lengths
from stages.tube import Deployments, shapes_of

CHUNK = 1000
"""Arcs that are evaluated in one call of a kernel: between two calls the caller can end the search."""


class DirectArcs:
    """The single arcs of a needle from the deployments of an atlas to a target, or to aims beside it.

    Args:
        evaluator: Made of the task if None.
        aims ((S, 3) float64): Where arcs from each scope tip end, LPS mm, nan for none; at the target if
            None.

    Attributes:
        in_workspace ((N,) int64): The deployments that have the target in reach, the nearest first.
    """

    def __init__(
        self, task: Task, atlas: Atlas, evaluator: CandidateEvaluator | None = None, aims: Float | None = None
    ) -> None:
        self.task = task
        self.atlas = atlas
        self.evaluator = evaluator or CandidateEvaluator(task)
        self._aims = aims
        environment = self.evaluator.environment
        if aims is None:
            self.in_workspace, self._lengths = atlas.index.holding(environment, task.target.lps_mm)
            return
        entries = atlas.deployments
        lengths = np.full(entries.count, np.inf)
        near = np.flatnonzero(np.isfinite(aims[entries.site, 0]))
        for rows, aim in self._by_aim(near):
            at = near[rows]
            lengths[at] = workspace_lengths(environment, entries.positions[at], entries.tangents[at], aim)
        found = near[np.isfinite(lengths[near])]
        self.in_workspace = found[np.argsort(lengths[found], kind="stable")]
        self._lengths = lengths[self.in_workspace]

    def _by_aim(self, chosen: Int) -> Iterator[tuple[Int | slice, Float]]:
        """Yield rows of chosen deployments (N,) with the point `(3,)` at which their arcs end."""
        if self._aims is None:
            yield slice(None), self.task.target.lps_mm
            return
        site = self.atlas.deployments.site[chosen]
        order = np.argsort(site, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(site[order])) + 1):
            if len(rows):
                yield rows, self._aims[site[rows[0]]]

    def blockers(self, chosen: Int, environment: NeedleEnvironment | None = None) -> tuple[Int, Float, Float]:
        """Return what blocks the arcs from deployments (N,), their lengths and integrals of 1 / clearance.

        A blocker is 0 for an arc that is proved clear, -1 where no arc keeps the needle's limits, else a
        voxel label.
        """
        found = np.zeros(len(chosen), dtype=np.int64), np.zeros(len(chosen)), np.zeros(len(chosen))
        for rows, aim in self._by_aim(chosen):
            parts = direct_arcs(environment or self.evaluator.environment, *self._starts(chosen[rows]), aim)
            for whole, part in zip(found, parts, strict=True):
                whole[rows] = part
        return found

    def _starts(self, chosen: Int) -> tuple[Float, Float, Int]:
        """Return where the tubes of deployments end, in which direction, and the branches they pierce."""
        entries = self.atlas.deployments
        return entries.positions[chosen], entries.tangents[chosen], entries.branch[chosen]

    reasons = staticmethod(blocker_counts)
    """Returns how many arcs `(N,)` each blocker stops, by its name."""

    def clear(self) -> Int:
        """Return the deployments (C,) with a clear arc, the shortest first."""
        blockers, lengths, _costs = self.blockers(self.promising)
        clear = np.flatnonzero(blockers == 0)
        return self.promising[clear[np.argsort(lengths[clear], kind="stable")]]

    def lines(self, chosen: Int, samples: int) -> Float:
        """Return points (N, samples, 3) of the arcs from deployments."""
        entries = self.atlas.deployments
        start, tangent = entries.positions[chosen], entries.tangents[chosen]
        offset = np.zeros_like(start)
        for rows, aim in self._by_aim(chosen):
            offset[rows] = aim - start[rows]
        ahead = (offset * tangent).sum(axis=1, keepdims=True)
        aside = offset - ahead * tangent
        off = np.linalg.norm(aside, axis=1, keepdims=True)
        normal = np.divide(aside, off, out=np.zeros_like(aside), where=off > 1e-9)
        turn = 2.0 * np.arctan2(off, ahead)
        share = np.linspace(0.0, 1.0, samples)
        angle = turn[:, :, None] * share[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.where(off > 1e-9, 0.5 * (off**2 + ahead**2) / off, 0.0)[:, :, None]
        straight = (off <= 1e-9)[:, :, None] * ahead[:, :, None] * share[:, None]
        along = radius * np.sin(angle) + straight
        bent = radius * (1.0 - np.cos(angle))
        return np.asarray(start[:, None] + along * tangent[:, None] + bent * normal[:, None])

    @property
    def promising(self) -> Int:
        """The deployments from which the target may be reached: `in_workspace`."""
        return self.in_workspace

    def candidate(self, entry: int) -> Candidate | None:
        """Return a deployment of the atlas in full with its arc, None if the tubes are refused."""
        entries = self.atlas.deployments
        return self.evaluator.direct(self.atlas.motions.tip(int(entries.site[entry])), *entries.choice(entry))

    def proved(self, entry: int) -> Candidate | None:
        """Return a deployment of the atlas with its arc, None if the proof fails."""
        candidate = self.candidate(entry)
        return candidate if candidate is not None and self.evaluator.accepts(candidate) else None

    @cached_property
    def by_bound(self) -> tuple[Int, Float]:
        """The deployments with the target in their workspace, the least lower bound of the cost first.

        The second array `(E,)` has the bounds by deployment; they are 0 for all others.
        """
        entries = self.atlas.deployments
        bounds = np.zeros(len(self.in_workspace))
        for rows, aim in self._by_aim(self.in_workspace):
            positions, lengths = entries.positions[self.in_workspace[rows]], self._lengths[rows]
            part, goal = np.zeros(len(lengths)), tuple(aim.tolist())
            cost_bounds(self.evaluator.needle_arrays, positions, np.array(lengths), goal, part)
            bounds[rows] = part + self.before(self.in_workspace[rows])
        by_entry = np.zeros(entries.count)
        by_entry[self.in_workspace] = bounds
        return self.in_workspace[np.argsort(bounds, kind="stable")], by_entry

    def before(self, chosen: Int) -> Float:
        """Return what the tubes of deployments (N,) cost before their arcs."""
        entries = self.atlas.deployments.only(chosen)
        return costs_of_tubes(self.evaluator, self.atlas.motions.tips[entries.site], entries)

    def evaluate(self, chosen: Int, slack: float, best: float = math.inf) -> tuple[Int, Float, float]:
        """Evaluate the arcs from deployments, less and less of them as cheap ones are found.

        Args:
            slack, best: Arcs that cost more than `slack` times the cheapest so far, at first `best`, are not
                tested.

        Returns:
            - blockers ((N,) int64) - As those of the method `blockers`, or PRUNED_BY_BOUND.
            - costs ((N,) float64) - Estimated costs, infinite where a lower bound was enough.
            - best - Cost of the cheapest clear arc, or `best`.
        """
        arrays = self.evaluator.needle_arrays
        blockers, costs = np.zeros(len(chosen), dtype=np.int64), np.zeros(len(chosen))
        for rows, aim in self._by_aim(chosen):
            at = chosen[rows]
            stopped, cost = np.zeros(len(at), dtype=np.int64), np.zeros(len(at))
            starts, goal = (*self._starts(at), self.before(at)), tuple(aim.tolist())
            best = evaluate_arcs(arrays, *starts, goal, slack, best, stopped, cost)
            blockers[rows], costs[rows] = stopped, cost
        return blockers, costs, best


def costs_of_tubes(evaluator: CandidateEvaluator, tips: Float, entries: Deployments) -> Float:
    """Return what the tubes of N deployments cost `(N,)`: 0 under an objective of the needle alone.

    Args:
        tips ((N, 9) float64): The scope tip of each; see `lungaccess.planning.coupled.kernels.candidate`.
    """
    costs = np.zeros(entries.count)
    if evaluator.objective.tissue == 0.0:
        return costs
    system, arrays = evaluator.task.system, evaluator.needle_arrays
    shapes = shapes_of(system.tubes)
    deployed = np.stack([entries.rotation_rad, entries.exit_mm + entries.wall_run_mm], axis=1)
    costs_in_tissue(
        arrays.obstacles, arrays.of_tubes, np.array(tips), deployed, np.array(entries.shape),
        np.array(shapes.arcs), np.array(shapes.first_arc), costs,
    )  # fmt: skip
    return costs


class DirectArcSearch:
    """Evaluates the direct arcs of an atlas chunk by chunk, the nearest deployments first.

    Attributes:
        clear ((C,) int64): After the search the deployments with a clear arc, the cheapest first.
    """

    phase = "direct arcs"

    def __init__(self, arcs: DirectArcs, incumbent: base.Incumbent, settings: base.SearchSettings) -> None:
        self._arcs, self._incumbent, self._settings = arcs, incumbent, settings
        self.clear: Int = np.zeros(0, dtype=np.int64)

    def steps(self) -> Iterator[base.Step]:
        """Yield a step for each chunk, and one for each arc of it that is proved in full."""
        found, estimates, cheapest = [], [], math.inf
        near, evaluator = self._arcs.in_workspace, self._arcs.evaluator
        for begin in range(0, len(near), CHUNK):
            chunk = near[begin : begin + CHUNK]
            blockers, costs, cheapest = self._arcs.evaluate(chunk, self._settings.kept_slack, cheapest)
            evaluator.count_blockers(blockers[blockers != PRUNED_BY_BOUND])
            clear = np.flatnonzero((blockers == 0) & np.isfinite(costs))
            found.append(chunk[clear])
            estimates.append(costs[clear])
            yield base.Step(iteration=0, phase=self.phase)
            # Proved arcs of a chunk: the estimated costs by which they are chosen may be in the wrong order.
            left = 3
            for n in clear[np.argsort(costs[clear], kind="stable")].tolist():
                if not left or costs[n] > base.ESTIMATE_SLACK * self._incumbent.cost:
                    break
                step = base.evaluated_step(evaluator, self.phase, self._arcs.candidate(int(chunk[n])))
                left -= step.candidate is not None
                yield self._incumbent.improved(step)
        if found:
            clear, costs = np.concatenate(found), np.concatenate(estimates)
            self.clear = clear[np.argsort(costs, kind="stable")]
