"""The proof that a needle reaches its target from every start pose near the planned one."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import start_region as kernel
from stages.needle.kernels.limits import Limits
from stages.needle.path import ArcPath
from stages.needle.query import Query
from stages.needle.start_region import ProvedStarts

OFFSETS = 25
"""Offsets for which the largest proved tilt is computed: steps of 4 % of the largest."""
MOST_VIAS = 4
"""Ends of arcs of the plan that the proved family may go through: plans have one to three arcs."""


def prove_starts(environment: NeedleEnvironment, query: Query, path: ArcPath) -> ProvedStarts:
    """Prove for a ball of places times a cone of directions that every start in it has a clear path.

    The paths end within the environment's goal tolerance.  docs/explanation/start_region.md has the
    theorem.

    Parameters
    ----------
    path : ArcPath
        The planned path from the query's start: its corners are what the proved paths may go through.
    """
    limits, branch = environment.limits, query.branch
    families = [_Family(environment, query, vias) for vias in _vias_of(path, query.target)]
    most = kernel.SEARCHED_MM * max(each.factor(limits, branch, kernel.SEARCHED_MM, 0.0) for each in families)
    if not any(each.count for each in families):
        return ProvedStarts(offsets_mm=np.zeros(0), tilts_rad=np.zeros(0), vias=())
    offsets = np.linspace(0.0, most, OFFSETS) if most > 0.0 else np.zeros(1)
    tilts = np.stack([each.largest_tilts(limits, branch, offsets) for each in families])
    chosen = np.argmax(tilts, axis=0)
    kept = np.flatnonzero(tilts.max(axis=0) >= 0.0)
    return ProvedStarts(
        offsets_mm=read_only(offsets[kept]),
        tilts_rad=read_only(tilts.max(axis=0)[kept]),
        vias=tuple(families[n].points[:-1] for n in chosen[kept]),
    )


def proved_factor(
    environment: NeedleEnvironment, query: Query, path: ArcPath, *, offset_mm: float, tilt_rad: float
) -> float:
    """Return the largest share of a deviation, at most 1, up to which all start poses are proved.

    For many paths this is a fast measure of how much of a deviation of the start they bear: it takes a
    fraction of `prove_starts`.

    Parameters
    ----------
    offset_mm, tilt_rad : float
        The whole deviation, such as three times the errors that are expected; above 0.
    """
    limits, branch = environment.limits, query.branch
    families = (_Family(environment, query, vias) for vias in _vias_of(path, query.target))
    return max(each.factor(limits, branch, offset_mm, tilt_rad) for each in families)


class _Family:
    """The paths by single arcs through the same points, one from each start pose."""

    def __init__(self, environment: NeedleEnvironment, query: Query, vias: Float) -> None:
        frame = query.lps_from_start
        self.points = np.ascontiguousarray(np.vstack([vias, query.target]))
        self.arcs = np.zeros((len(self.points), kernel.ARC_COLUMNS))
        self.stations = np.zeros((kernel.MOST_STATIONS, kernel.STATION_COLUMNS))
        self.count, self.angle = kernel.lay_stations(
            environment.obstacles, environment.limits, query.branch,
            np.concatenate([frame[:3, 3], frame[:3, 2]]), self.points, self.arcs, self.stations,
        )  # fmt: skip

    def factor(self, limits: Limits, branch: int, offset_mm: float, tilt_rad: float) -> float:
        """Return the largest factor, at most 1, by which offset and tilt are proved together."""
        if not self.count:
            return 0.0
        args = (limits, branch, self.arcs, self.stations, self.count, self.angle)
        return float(kernel.largest_factor(*args, offset_mm, tilt_rad))

    def largest_tilts(self, limits: Limits, branch: int, offsets: Float) -> Float:
        """Return the largest proved tilt in rad at each offset, -1 where there is none."""
        tilts = np.full(len(offsets), -1.0)
        if self.count:
            kernel.largest_tilts(
                limits, branch, self.arcs, self.stations, self.count, self.angle, offsets, tilts
            )
        return tilts


def _vias_of(path: ArcPath, target: Float) -> list[Float]:
    """Return the sets of via points `(V, 3)` that the proved paths may go through."""
    corners = path.frames()[1:-1, :3, 3][-MOST_VIAS:]
    return [corners[first:] for first in range(len(corners) + 1)]
