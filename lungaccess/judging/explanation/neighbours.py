"""What is reached near a target that is not: the nearest point, and the share of points around it."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import percent, range_of_hundred
from anatomy.poses import spread_directions
from anatomy.structures import obstacle_bits
from lungaccess.judging.explanation.blocking import region_of
from lungaccess.planning.coupled import reach_scan
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.planning.one_system import run
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Limits, Request
from lungaccess.problem.target import Target
from lungaccess.uncertainty.risk import Share
from stages.needle import DIRECT

RADII_MM = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0, 22.0, 30.0, 40.0)
"""Radii of the spheres on which points are tried; beyond the last, a point is no neighbour."""
AROUND_MM = 20.0
"""Radius of the surroundings of a target whose reached share is told."""
DRAWS = 120
"""Random points of which a share is told: its 95 % interval is then at most 18 % wide."""
ORDER_SEED = 7


@frozen_record
class Neighbour:
    """The nearest point to the target that was found to be reached."""

    plan: Plan
    from_target_mm: float


@frozen_record
class ReachedShare:
    """How many of random points of a region a single arc reaches."""

    region: str
    share: Share

    @property
    def words(self) -> str:
        """The share and its interval, in words."""
        share = self.share
        return (
            f"{percent(share.value)} of {share.samples} random points "
            f"(95 % interval {range_of_hundred(share.interval)} %)"
        )


class Surroundings:
    """The points around a target, asked one after the other whether a simple way reaches them."""

    def __init__(self, direct: DirectCandidates) -> None:
        self._task, self._atlas = direct.task, direct.atlas
        self._scan = reach_scan(direct.atlas, arcs=1)

    def reached(self, point: Float) -> bool:
        """Tell whether the simplest way from some entry of the atlas is proved clear to a point (3,)."""
        found = self._scan.reach(point[None], np.zeros(1, dtype=np.uint64))
        return int(found.kinds[0]) == DIRECT

    def nearest(self, alive: Callable[[], None]) -> Neighbour | None:
        """Return a plan to the nearest point found; None if there is none within the largest of RADII_MM.

        Points on spheres around the target are tried, the smaller sphere first; from the first that is
        reached the distance is halved towards the target.  A nearer point may exist between those tried.
        `alive` is called before each point, and raises to end the search.
        """
        target = self._task.target.lps_mm
        before = 0.0
        for radius in RADII_MM:
            # Points of a sphere, about 25 degrees apart.
            for direction in spread_directions(64):
                alive()
                if self._free(target + radius * direction) and self.reached(target + radius * direction):
                    distance = self._nearer(direction, before, radius, alive)
                    found = self._planned(target + distance * direction)
                    return None if found is None else Neighbour(plan=found, from_target_mm=distance)
            before = radius
        return None

    def _nearer(self, direction: Float, low: float, high: float, alive: Callable[[], None]) -> float:
        """Return the least distance along a direction that is reached, by halving."""
        target = self._task.target.lps_mm
        # The distance between the sphere that is reached and the one before it is halved this often.
        for _ in range(4):
            alive()
            middle = 0.5 * (low + high)
            point = target + middle * direction
            if self._free(point) and self.reached(point):
                high = middle
            else:
                low = middle
        return high

    def _planned(self, point: Float) -> Plan | None:
        task = self._task
        target = Target(lps_mm=point, origin=f"neighbour of {task.target.origin}")
        try:
            return next(
                run(
                    Request.by_cost(replace(task, target=target), limits=Limits(iterations=0)),
                    atlas=self._atlas,
                    counterfactuals=False,
                )
            )
        except NoPlan:
            return None

    def shares(self, alive: Callable[[], None]) -> Iterator[ReachedShare]:
        """Yield how many random points around the target, then of its lobe or lung, are reached."""
        lung, target = self._task.lung, self._task.target.lps_mm
        rng = np.random.Generator(np.random.PCG64(ORDER_SEED))
        region = region_of(lung, target)

        def around() -> Float:
            offset = rng.uniform(-1.0, 1.0, 3)
            return target + AROUND_MM * offset if offset @ offset <= 1.0 else np.full(3, np.nan)

        def anywhere() -> Float:
            point = lung.grid.lps(rng.uniform(-0.5, np.array(lung.grid.shape) - 0.5))
            return point if self._free(point) and region_of(lung, point) == region else np.full(3, np.nan)

        for name, draw in ((f"within {AROUND_MM:g} mm of the target", around), (region, anywhere)):
            points = _drawn(self._free, draw)
            reached = 0
            for point in points:
                alive()
                reached += self.reached(point)
            if points:
                yield ReachedShare(region=name, share=Share(count=reached, samples=len(points)))

    def _free(self, point: Float) -> bool:
        task = self._task
        return task.lung.label_at(point) & obstacle_bits(task.with_fissures) == 0


def _drawn(free: Callable[[Float], bool], draw: Callable[[], Float]) -> list[Float]:
    """Return DRAWS random points in free tissue, fewer where there is hardly any."""
    found: list[Float] = []
    for _ in range(100 * DRAWS):
        point = draw()
        if np.isfinite(point).all() and free(point):
            found.append(point)
            if len(found) == DRAWS:
                break
    return found
