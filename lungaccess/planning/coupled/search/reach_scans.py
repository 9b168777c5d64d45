"""Which of many points a system reaches: by its needle, by its tubes alone, or in phases of the breath."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from anatomy.base.typed import Int, UInt64
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.tube_reach import TubeReachScan
from lungaccess.planning.coupled.search.window_reach import WindowReachScan
from stages.needle import DEFAULT_ARCS, Reached, ReachScan, needle_environment


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
