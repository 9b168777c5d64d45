"""Which of many points a system reaches: by its needle, by its tubes alone, or in phases of the breath."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Int, UInt64
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.tube_reach import TubeReachScan, tubes_clearance_mm
from lungaccess.planning.coupled.search.window_search import window_search
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import breathing_window
from stages.needle import DEFAULT_ARCS, DIRECT, UNREACHED, Reached, ReachScan, needle_environment

STEP_MM = 0.25
"""Spacing of the points at which the clearance of a needle is looked up; half of it is taken off."""


class WindowReachScan:
    """The direct ways of an atlas, to be asked about any number of points; as `stages.needle.ReachScan`.

    A point is reached if an arc of the needle, or the tubes alone, to an aim beside it is proved clear and on
    target in all of the phases.

    Args:
        lung: With a motion, which that of the atlas need not have.
    """

    def __init__(self, lung: Lung, atlas: Atlas, phases: tuple[float, float]) -> None:
        self._lung, self._atlas, self._phases = lung, atlas, phases
        self._field = lung.obstacle_field(with_fissures=atlas.with_fissures)

    def reach(self, points: ArrayLike, seeds: UInt64, near: Int | None = None) -> Reached:
        """Try all points, one after the other; neither seeds nor neighbours matter.

        Args:
            points: (N, 3) float64, LPS mm.
        """
        places = np.array(points, dtype=np.float64, order="C").reshape(-1, 3)
        kinds = np.full(len(places), UNREACHED, dtype=np.uint8)
        cost, clearance, share = np.zeros(len(places)), np.zeros(len(places)), np.zeros(len(places))
        for n, point in enumerate(places):
            target = Target(lps_mm=point, origin="point")
            task = Task(lung=self._lung, system=self._atlas.system, target=target)
            search = window_search(task, self._atlas, self._phases, widest=False)
            found = [step for step in search.direct_steps() if step.candidate is not None]
            if found and found[-1].candidate is not None:
                kinds[n], cost[n] = DIRECT, found[-1].cost
                clearance[n] = self._clearance_mm(found[-1].candidate)
                candidate = found[-1].candidate
                plan = assemble(task, candidate, iteration=0, timing={})
                share[n] = breathing_window(plan, self._lung).share
        entries = np.full(len(places), -1, dtype=np.int64)
        return Reached(kinds=kinds, cost=cost, clearance_mm=clearance, entries=entries, window_share=share)

    def _clearance_mm(self, candidate: Candidate) -> float:
        """Return a lower bound of the clearance of a needle beyond the exempt length, or of the tubes."""
        needle = self._atlas.system.needle
        if needle is None:
            return tubes_clearance_mm(self._atlas, candidate.path, candidate.deployment.branch)
        points, lengths = candidate.path.sample(STEP_MM)
        beyond = self._field.lower_bound_mm(points[lengths >= needle.exit_exemption_mm])
        return max(float(beyond.min(initial=math.inf)) - 0.5 * STEP_MM, 0.0) if len(beyond) else 0.0


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

    Args:
        arcs, trees: See `stages.needle.ReachScan`; without a needle there are no trees, and `arcs` counts
            deployments.
        during (tuple of Lung and phases): The lung with its motion, and phases in all of which points are to
            be reached; then all arcs count, and no trees.
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
