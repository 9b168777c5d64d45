"""The simplest ways to a target from the deployments of an atlas, with a needle and without one."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from anatomy.base.typed import Float, Int, UInt64
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.aimed_tubes import AimedTubes
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.tube_reach import TubeReachScan
from lungaccess.planning.coupled.search.window_reach import WindowReachScan
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle import DEFAULT_ARCS, Reached, ReachScan, needle_environment


class DirectCandidates(Protocol):
    """Ways to the target of a task, at most one from each entry of an atlas.

    They are the direct arcs of the needle, or without one the tubes aimed at the target.
    """

    task: Task
    atlas: Atlas
    evaluator: CandidateEvaluator

    @property
    def promising(self) -> Int:
        """The entries (N,) from which the target may be reached, the nearest first."""

    def evaluate(self, chosen: Int, slack: float) -> tuple[Int, Float, float]:
        """Return for entries (E,) what blocks them, 0 for nothing, their estimated costs, and the least."""

    def clear(self) -> Int:
        """Return the entries (C,) with a clear way, the best first."""

    def proved(self, entry: int) -> Candidate | None:
        """Return the way from an entry as a candidate, None if its proof fails."""

    def lines(self, chosen: Int, samples: int) -> Float:
        """Return points (E, samples, 3) of what the costs are of, LPS mm."""


class Scan(Protocol):
    """Tells which of many points are reached, and how well."""

    def reach(self, points: ArrayLike, seeds: UInt64, near: Int | None = None) -> Reached:
        """Try points (N, 3), LPS mm; see `stages.needle.ReachScan.reach`."""


def reach_scan(
    atlas: Atlas,
    *,
    arcs: int = DEFAULT_ARCS,
    trees: int = 0,
    during: tuple[Lung, tuple[float, float]] | None = None,
) -> Scan:
    """Return what tells which points the system of an atlas reaches: by its needle, or by its tubes alone.

    Parameters
    ----------
    arcs, trees : int
        See `stages.needle.ReachScan`; without a needle there are no trees, and `arcs` counts deployments.
    during : tuple of Lung and phases, optional
        The lung with its motion, and phases in all of which points are to be reached; then all arcs count,
        and no trees.
    """
    if during is not None:
        return WindowReachScan(during[0], atlas, during[1])
    system, entries = atlas.system, atlas.deployments
    if system.needle is None:
        return TubeReachScan(atlas, deployments=arcs)
    environment = needle_environment(
        atlas.lung, system.needle, system.margins, with_fissures=atlas.with_fissures
    )
    return ReachScan(environment, entries.positions, entries.tangents, entries.branch, arcs=arcs, trees=trees)


def direct_candidates(task: Task, atlas: Atlas) -> DirectCandidates:
    """Return the simplest ways to the target of a task."""
    return AimedTubes(task, atlas) if task.system.needle is None else DirectArcs(task, atlas)
