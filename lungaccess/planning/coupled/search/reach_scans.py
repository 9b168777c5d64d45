"""Which of many points a system reaches: by its needle, by its tubes alone, or in phases of the breath."""

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float, Int, UInt64
from anatomy.lung import Lung
from anatomy.structures import FIELD_BITS
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.aimed_tubes import COST
from lungaccess.planning.coupled.search.aimed_tubes import (
    TubeAiming,
    chosen_of,
    near_mm,
    nearest_of_each_tip,
    starts_of,
    tips_of,
)
from lungaccess.planning.coupled.search.window_search import window_search
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate, tubes_in_tissue
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import breathing_window
from stages.needle import (
    DEFAULT_ARCS,
    DIRECT,
    UNREACHED,
    ArcPath,
    Objective,
    Reached,
    ReachScan,
    needle_environment,
)
from stages.tube import DeploymentValidator

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

FIRST_MM, LAST_MM = 6.0, 12.0
"""Deployments that end so near are tried first, because they are few and most points that are reached have
one; then those up to the second distance, beyond which there are too many to try for every point."""
STEP_MM = 0.25
"""Spacing of the points at which the clearance of a needle or of tubes is looked up; half is taken off."""


class _PointByPoint(ABC):
    """Asks about points one after the other; as `stages.needle.ReachScan`."""

    _in_phases = False

    def reach(self, points: ArrayLike, seeds: UInt64, near: Int | None = None) -> Reached:
        """Try points (N, 3), LPS mm; neither seeds nor neighbours matter."""
        places = np.array(points, dtype=np.float64, order="C").reshape(-1, 3)
        kinds, entries = np.full(len(places), UNREACHED, dtype=np.uint8), np.full(len(places), -1)
        cost, clearance, share = (np.zeros(len(places)) for _ in range(3))
        for n, point in enumerate(places):
            found = self._best(point)
            if found is not None:
                kinds[n] = DIRECT
                entries[n], cost[n], clearance[n], share[n] = found
        window_share = share if self._in_phases else None
        return Reached(
            kinds=kinds, cost=cost, clearance_mm=clearance, entries=entries, window_share=window_share
        )

    @abstractmethod
    def _best(self, point: Float) -> tuple[int, float, float, float] | None:
        """Return entry, cost, clearance and share of the breath of the best way to a point."""


class TubeReachScan(_PointByPoint):
    """The deployments of an atlas, to be asked about any number of points; as `stages.needle.ReachScan`.

    A point is reached directly if the tubes, aimed at it from the scope tip of some deployment that ends
    nearby, are proved clear.  Of so many `deployments` to a point the cheapest is told.  It may be used by
    several threads at once.
    """

    def __init__(self, atlas: Atlas, *, deployments: int = DEFAULT_ARCS) -> None:
        from scipy.spatial import cKDTree

        self._atlas, self._enough = atlas, deployments
        self._aiming = TubeAiming(
            atlas.lung, atlas.system, Objective(inverse_clearance=1.0), with_fissures=atlas.with_fissures
        )
        self._tips = cKDTree(atlas.deployments.positions) if atlas.deployments.count else None

    def _best(self, point: Float) -> tuple[int, float, float, float] | None:
        if self._tips is None:
            return None
        found = self._best_within(self._tips, point, FIRST_MM)
        return found or self._best_within(self._tips, point, LAST_MM)

    def _best_within(
        self, places: "cKDTree", point: Float, within_mm: float
    ) -> tuple[int, float, float, float] | None:
        """Return the cheapest of some deployments that end within a distance of the point."""
        atlas, made = self._atlas, self._atlas.deployments
        close = np.array(places.query_ball_point(point, within_mm, return_sorted=True), dtype=np.int64)
        away_mm = np.linalg.norm(made.positions[close] - point, axis=1)
        near = away_mm <= near_mm(atlas, point)[made.site[close]]
        chosen = nearest_of_each_tip(atlas, close[near], away_mm[near])
        if not len(chosen):
            return None
        _sites, tips, row_of = tips_of(atlas, chosen)
        found, _why = self._aiming.aim(
            point, tips, np.ones(len(tips), dtype=np.bool_), row_of, starts_of(atlas, chosen), self._enough
        )
        best = int(found[:, COST].argmin())
        if not np.isfinite(found[best, COST]):
            return None
        entry, cost = int(chosen[best]), float(found[best, COST])
        return entry, cost, self._clearance_mm(entry, found[best]), 0.0

    def _clearance_mm(self, entry: int, found: Float) -> float:
        """Return a lower bound of the clearance of what was found."""
        atlas = self._atlas
        frame = atlas.motions.tip(int(atlas.deployments.site[entry])).lps_from_scope_tip
        system, fissures = atlas.system, atlas.with_fissures
        tubes = DeploymentValidator(atlas.lung, system.tubes, system.margins, with_fissures=fissures)
        made = tubes.choose(frame, *chosen_of(system.tubes, found))
        if isinstance(made, str):
            return 0.0
        return tubes_clearance_mm(atlas, tubes_in_tissue(frame, made), made.branch)


def tubes_clearance_mm(atlas: Atlas, path: ArcPath, branch: int) -> float:
    """Return a lower bound of the clearance of tubes in tissue, the pierced branch passed over."""
    points, _mm = path.sample(STEP_MM)
    names = ("airway", "vessel", "pleura", *(("fissure",) if atlas.with_fissures else ()))
    # Clearances below this are exact: larger ones never limit a plan.
    least = min(
        atlas.lung.least_clearance_mm(points, name, FIELD_BITS[name], cap_mm=5.0, exempt_branch=branch)
        for name in names
    )
    return max(least - 0.5 * STEP_MM, 0.0)


class WindowReachScan(_PointByPoint):
    """The direct ways of an atlas, to be asked about any number of points; as `stages.needle.ReachScan`.

    A point is reached if an arc of the needle, or the tubes alone, to an aim beside it is proved clear and on
    target in all of the phases.  The lung has a motion, which that of the atlas need not have.
    """

    _in_phases = True

    def __init__(self, lung: Lung, atlas: Atlas, phases: tuple[float, float]) -> None:
        self._lung, self._atlas, self._phases = lung, atlas, phases
        self._field = lung.obstacle_field(with_fissures=atlas.with_fissures)

    def _best(self, point: Float) -> tuple[int, float, float, float] | None:
        task = Task(lung=self._lung, system=self._atlas.system, target=Target(lps_mm=point, origin="point"))
        search, best = window_search(task, self._atlas, self._phases, widest=False), None
        for step in search.direct_steps():
            best = best if step.candidate is None else step
        if best is None or best.candidate is None:
            return None
        window = breathing_window(assemble(task, best.candidate, iteration=0, timing={}), self._lung)
        return -1, best.cost, self._clearance_mm(best.candidate), window.share

    def _clearance_mm(self, candidate: Candidate) -> float:
        """Return a lower bound of the clearance of a needle beyond the exempt length, or of the tubes."""
        needle = self._atlas.system.needle
        if needle is None:
            return tubes_clearance_mm(self._atlas, candidate.path, candidate.deployment.branch)
        points, lengths = candidate.path.sample(STEP_MM)
        beyond = self._field.lower_bound_mm(points[lengths >= needle.exit_exemption_mm])
        return max(float(beyond.min(initial=math.inf)) - 0.5 * STEP_MM, 0.0) if len(beyond) else 0.0


Scan = ReachScan | TubeReachScan | WindowReachScan
"""A scan tells which of many points are reached, and how well."""


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
