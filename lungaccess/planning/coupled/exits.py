"""The feasible exits of a target: where tubes can leave the airway so that it is reached directly."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas, require_same
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates, direct_candidates
from lungaccess.planning.coupled.search.reach_scans import tubes_clearance_mm
from lungaccess.plans.costs import obstacle_clearance_mm
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from stages.needle import DEFAULT, Objective
from stages.tube import exit_points

PLACE_MM = 2.0
"""Exits of one branch in a cube of this side are one place: about the diameter of the tubes."""
CHUNK = 2000
"""Arcs that are tried between two answers: some ten milliseconds."""
SAMPLES = 128
"""Points of an arc at which its clearance is looked up; between them it is less by half their distance."""


@frozen_record
class FeasibleExits:
    """The deployments of an atlas from which a direct arc to a target is clear, by their place of exit.

    C deployments are feasible, at P places.  An arc is proved clear of every obstacle; that the deployment
    with its arc becomes a plan is proved when it is planned.  Without a needle the deployments are those from
    which the tubes were aimed at the target, and what is said of arcs holds for the tubes in tissue.

    Args:
        entries ((C,) int64): Numbers of the deployments in the atlas, the least costly of each place first.
        place ((C,) int64): Place of exit of each, from 0 by the least cost of the place.
        cost ((C,) float64): Estimated under the objective.
        exit_lps, clearance_mm ((P, 3) and (P,) float64): Of the least costly deployment of each place: where
            its axis leaves the lumen, LPS mm, and a lower bound of the distance of its arc from every
            obstacle, beyond the exempt length in the pierced wall.
        in_workspace, tried: Deployments from which the target may be reached, and those this answer is of.
        blocked: How many arcs were stopped, by what stopped them.
    """

    entries: Int
    place: Int
    cost: Float
    length_mm: Float
    exit_lps: Float
    clearance_mm: Float
    in_workspace: int
    tried: int
    blocked: Mapping[str, int]

    @property
    def count(self) -> int:
        """Number of places, P."""
        return len(self.exit_lps)

    @property
    def is_complete(self) -> bool:
        """Whether every deployment from which the target may be reached was tried."""
        return self.tried == self.in_workspace

    @cached_property
    def best(self) -> Int:
        """Rows `(P,)` of the least costly deployment of each place."""
        return np.flatnonzero(np.diff(self.place, prepend=-1))

    @cached_property
    def sizes(self) -> Int:
        """Number of deployments `(P,)` of each place."""
        return np.bincount(self.place, minlength=self.count)


def feasible_exits(
    lung: Lung,
    system: System,
    target: Target,
    *,
    atlas: Atlas,
    objective: str | Objective = DEFAULT,
    scope_tips: Int | None = None,
) -> Iterator[FeasibleExits]:
    """Yield the feasible exits of a target, more and more of them; the last answer is complete.

    Deployments are tried place by place in turn, the nearest of each scope tip first, so that an early
    answer shows most places already.  The same input gives the same answers.

    Args:
        scope_tips ((T,) int64): Only exits from these tips of the atlas.

    Raises:
        SettingsError: If the atlas belongs to another lung or system.
        TargetError: If the target lies outside the lung or inside an obstacle.
    """
    require_same(atlas, lung, system)
    task = Task(lung=lung, system=system, target=target, objective=objective_of(lung, objective))
    arcs = direct_candidates(task, replace(atlas, system=system))
    near = arcs.promising
    if scope_tips is not None:
        near = near[np.isin(atlas.deployments.site[near], scope_tips)]
    # The first entry of every scope tip comes before the second of any, and so on.
    order = np.argsort(atlas.deployments.site[near], kind="stable")
    at = atlas.deployments.site[near][order]
    first = np.flatnonzero(np.diff(at, prepend=-1))
    rank = np.zeros(len(near), dtype=np.int64)
    rank[order] = np.arange(len(near)) - np.repeat(first, np.diff(np.append(first, len(at))))
    near = near[np.argsort(rank, kind="stable")]
    found, blocked = None, Counter[str]()
    for begin in range(0, max(len(near), 1), CHUNK):
        chunk = near[begin : begin + CHUNK]
        blockers, cost, _least = arcs.evaluate(chunk, np.inf)
        blocked.update(arcs.reasons(blockers))
        clear = np.flatnonzero(blockers == 0)
        these = _Found.of(arcs, chunk[clear], cost[clear])
        found = these if found is None else found.joined(these)
        yield found.answer(arcs, len(near), begin + len(chunk), blocked)


@frozen_record
class _Found:
    """Clear arcs as they are found: entries, costs, lengths and points of exit."""

    entries: Int
    cost: Float
    length_mm: Float
    points: Float

    @classmethod
    def of(cls, arcs: DirectCandidates, entries: Int, cost: Float) -> "_Found":
        atlas = arcs.atlas
        if isinstance(arcs, DirectArcs):
            lengths = arcs.blockers(entries)[1]
            points = exit_points(atlas.system.tubes, atlas.motions.tips, atlas.deployments, entries)
        else:
            lines = arcs.lines(entries, SAMPLES)
            lengths, points = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1), lines[:, 0]
        return cls(entries=entries, cost=cost, length_mm=lengths, points=points)

    def joined(self, other: "_Found") -> "_Found":
        return _Found(**{name: np.concatenate([own, vars(other)[name]]) for name, own in vars(self).items()})

    def answer(
        self, arcs: DirectCandidates, in_workspace: int, tried: int, blocked: Counter[str]
    ) -> FeasibleExits:
        """Return what is found by place, the least costly place first."""
        branch = arcs.atlas.deployments.branch[self.entries]
        cells = np.column_stack([branch, np.floor(self.points / PLACE_MM).astype(np.int64)])
        _cells, group = np.unique(cells, axis=0, return_inverse=True)
        least = np.full(group.max(initial=-1) + 1, np.inf)
        np.minimum.at(least, group.ravel(), self.cost)
        rank = np.zeros(len(least), dtype=np.int64)
        rank[np.argsort(least, kind="stable")] = np.arange(len(least))
        place = rank[group.ravel()]
        order = np.lexsort((self.entries, self.cost, place))
        best = order[np.flatnonzero(np.diff(place[order], prepend=-1))]
        return FeasibleExits(
            entries=self.entries[order],
            place=place[order],
            cost=self.cost[order],
            length_mm=self.length_mm[order],
            exit_lps=self.points[best],
            clearance_mm=_clearance_mm(arcs, self.entries[best], self.length_mm[best]),
            in_workspace=in_workspace,
            tried=tried,
            blocked=dict(blocked),
        )


def _clearance_mm(arcs: DirectCandidates, entries: Int, lengths: Float) -> Float:
    """Return lower bounds `(N,)` of the distance of arcs to obstacles, beyond what is exempt in the wall."""
    task = arcs.task
    needle = task.system.needle
    if needle is None:
        made = [arcs.candidate(entry) for entry in entries.tolist()]
        return np.array(
            [tubes_clearance_mm(arcs.atlas, one.path, one.deployment.branch) if one else 0.0 for one in made]
        )
    points = arcs.lines(entries, SAMPLES)
    clearance = obstacle_clearance_mm(task.lung, points.reshape(-1, 3), with_fissures=task.with_fissures)
    step = lengths[:, None] / (SAMPLES - 1)
    exempt = np.arange(SAMPLES) * step < np.minimum(needle.exit_exemption_mm, lengths[:, None] - 1e-9)
    bound = np.where(exempt, np.inf, clearance.reshape(-1, SAMPLES) - 0.5 * step)
    return np.maximum(bound.min(axis=1, initial=np.inf), 0.0) if len(entries) else np.zeros(0)
