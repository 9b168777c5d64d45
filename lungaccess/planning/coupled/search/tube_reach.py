"""Which of many points the tip of the tubes reaches, for a system without a needle."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float, Int, UInt64
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
from lungaccess.plans.candidate import tubes_in_tissue
from stages.needle import DEFAULT_ARCS, DIRECT, UNREACHED, ArcPath, Objective, Reached
from stages.tube import DeploymentValidator

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

FIRST_MM, LAST_MM = 6.0, 12.0
"""Deployments that end so near are tried first, because they are few and most points that are reached have
one; then those up to the second distance, beyond which there are too many to try for every point."""
STEP_MM = 0.25
"""Spacing of the points at which the clearance of the tubes is looked up; half of it is taken off."""


class TubeReachScan:
    """The deployments of an atlas, to be asked about any number of points; as `stages.needle.ReachScan`.

    A point is reached directly if the tubes, aimed at it from the scope tip of some deployment that ends
    nearby, are proved clear.  It may be used by several threads at once.

    Args:
        deployments: Of so many deployments to a point the cheapest is told.
    """

    def __init__(self, atlas: Atlas, *, deployments: int = DEFAULT_ARCS) -> None:
        from scipy.spatial import cKDTree

        self._atlas, self._enough = atlas, deployments
        self._aiming = TubeAiming(
            atlas.lung, atlas.system, Objective(inverse_clearance=1.0), with_fissures=atlas.with_fissures
        )
        self._tips = cKDTree(atlas.deployments.positions) if atlas.deployments.count else None

    def reach(self, points: ArrayLike, seeds: UInt64, near: Int | None = None) -> Reached:
        """Try all points, one after the other; neither seeds nor neighbours matter.

        Args:
            points: (N, 3) float64, LPS mm.
        """
        places = np.array(points, dtype=np.float64, order="C").reshape(-1, 3)
        kinds, entries = np.full(len(places), UNREACHED, dtype=np.uint8), np.full(len(places), -1)
        cost, clearance = np.zeros(len(places)), np.zeros(len(places))
        for n, point in enumerate(places):
            found = self._best(point)
            if found is not None:
                entries[n], cost[n], clearance[n] = found
                kinds[n] = DIRECT
        return Reached(kinds=kinds, cost=cost, clearance_mm=clearance, entries=entries)

    def _best(self, point: Float) -> tuple[int, float, float] | None:
        """Return entry, cost and clearance of the cheapest of some deployments to a point."""
        if self._tips is None:
            return None
        for within_mm in (FIRST_MM, LAST_MM):
            found = self._best_within(self._tips, point, within_mm)
            if found is not None:
                return found
        return None

    def _best_within(
        self, places: "cKDTree", point: Float, within_mm: float
    ) -> tuple[int, float, float] | None:
        """Return the same for deployments that end within a distance of the point."""
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
        return int(chosen[best]), float(found[best, COST]), self._clearance_mm(int(chosen[best]), found[best])

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
