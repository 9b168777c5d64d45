"""The reach of a system as a stream: points of a grid, those around a place first."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Int, UInt8
from anatomy.grid import Grid
from anatomy.lung import Lung
from lungaccess.planning.coupled import reach_scan
from lungaccess.planning.coupled.atlas import Atlas, require_same
from lungaccess.planning.reachability.layers import counted_voxels, voxel_seeds
from lungaccess.planning.reachability.reach_map import reach_grid
from lungaccess.problem.system import System
from stages.needle import DIRECT, NeedleEnvironment, direct_arcs, needle_environment

FIRST_POINTS, MOST_POINTS = 32, 256
"""Points of the first part, and of any: a point takes a millisecond or several, and a viewer waits."""


@frozen_record
class ReachPart:
    """What became of N points of a grid.

    Args:
        voxels ((N,) int64): Numbers of the voxels in the grid, C order.
        kinds ((N,) uint8): One of `lungaccess.planning.reachability.KINDS`.
        entries ((N,) int64): The deployment of the atlas whose arc is proved clear; -1 where there is none.
        share: Share of the grid's counted voxels that is known with this part.
    """

    voxels: Int
    kinds: UInt8
    entries: Int
    share: float


class ReachStream:
    """Tells which points of a coarse grid a system reaches by single arcs, part by part.

    Args:
        atlas: The deployments, made for this lung, scope and tubes.

    Attributes:
        counted ((M,) int64): Numbers of the voxels whose centre lies in lung tissue that is no obstacle.

    Raises:
        SettingsError: If the atlas belongs to another lung or system.
    """

    def __init__(self, lung: Lung, system: System, atlas: Atlas) -> None:
        require_same(atlas, lung, system)
        # At 8 mm a whole lung takes seconds; a map of 3 mm is `map_reach`.
        self.grid: Grid = reach_grid(lung, 8.0)
        self.counted: Int = np.flatnonzero(counted_voxels(lung, self.grid, atlas.with_fissures))
        self._lung, self._system, self._atlas = lung, system, atlas

    def parts(self, around_lps: ArrayLike, known: Int | None = None) -> Iterator[ReachPart]:
        """Yield all counted voxels, those nearest to a point `(3,)` LPS mm first.

        What neighbouring points have in common is found once, so that parts become larger.

        Args:
            known ((V,) int64): A deployment for each voxel of the grid, -1 for none, from which another
                needle reached it: where its arc is clear for this needle, too, the voxel is in the first
                part.
        """
        points = self.grid.lps(np.stack(np.unravel_index(self.counted, self.grid.shape), axis=1))
        order = np.argsort(np.linalg.norm(points - np.asarray(around_lps), axis=1), kind="stable")
        voxels, points = self.counted[order], points[order]
        done = 0
        if known is not None and self._system.needle is not None:
            again = self._again(points, known[voxels])
            done = int(np.count_nonzero(again))
            entries = known[voxels[again]]
            kinds = np.full(done, DIRECT, dtype=np.uint8)
            yield ReachPart(
                voxels=voxels[again], kinds=kinds, entries=entries, share=done / max(len(voxels), 1)
            )
            voxels, points = voxels[~again], points[~again]
        scan = reach_scan(replace(self._atlas, system=self._system), arcs=1)
        begin, count = 0, FIRST_POINTS
        while begin < len(voxels):
            part = slice(begin, begin + count)
            ijk = np.stack(np.unravel_index(voxels[part], self.grid.shape), axis=1)
            found = scan.reach(points[part], voxel_seeds(self.grid, ijk))
            begin += count
            share = min(1.0, (done + begin) / len(self.counted))
            yield ReachPart(voxels=voxels[part], kinds=found.kinds, entries=found.entries, share=share)
            count = min(2 * count, MOST_POINTS)

    def _again(self, points: ArrayLike, entries: Int) -> Bool:
        """Tell which points `(N, 3)` the arc from a deployment reaches with the needle of the system."""
        environment, places = self._environment, np.asarray(points)
        deployments, reached = self._atlas.deployments, np.zeros(len(entries), dtype=bool)
        for row in np.flatnonzero(entries >= 0).tolist():
            at = entries[row : row + 1]
            blockers, _lengths, _costs = direct_arcs(
                environment,
                deployments.positions[at],
                deployments.tangents[at],
                deployments.branch[at],
                places[row],
            )
            reached[row] = blockers[0] == 0
        return reached

    @property
    def _environment(self) -> NeedleEnvironment:
        needle = self._system.require_needle("A direct arc")
        return needle_environment(
            self._lung, needle, self._system.margins, with_fissures=self._atlas.with_fissures
        )
