"""`Explanation`: what was learned from a search that found no plan, and what is reached near the target."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, replace
from itertools import islice

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.base.words import of_hundred, percent, range_of_hundred
from anatomy.poses import spread_directions
from anatomy.structures import obstacle_bits
from lungaccess.judging.answering import Attempt
from lungaccess.judging.explanation.blocking import ArcBeyondLimits, BlockedArc, Blocking, StartMap, region_of
from lungaccess.planning.coupled import Counterfactual, reach_scan
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.planning.one_system import run
from lungaccess.planning.reachability import ReachVerdict
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.preset_order import presets_by_invasiveness
from lungaccess.problem.request import Limits, Request
from lungaccess.problem.system import System
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
        return int(self._scan.reach(point[None], np.zeros(1, dtype=np.uint64)).kinds[0]) == DIRECT

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
            asked = Request.by_cost(replace(task, target=target), limits=Limits(iterations=0))
            return next(run(asked, atlas=self._atlas, counterfactuals=False))
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
            # There are fewer points in free tissue where there is hardly any.
            drawn = (point for point in (draw() for _ in range(100 * DRAWS)) if np.isfinite(point).all())
            points = list(islice(filter(self._free, drawn), DRAWS))
            reached = 0
            for point in points:
                alive()
                reached += self.reached(point)
            if points:
                yield ReachedShare(region=name, share=Share(count=reached, samples=len(points)))

    def _free(self, point: Float) -> bool:
        task = self._task
        return task.lung.label_at(point) & obstacle_bits(task.with_fissures) == 0


DONE, NOT_TRIED = "done", "not tried"
TIME_IS_UP = "the time was up"


@frozen_value
class Part:
    """One part of an explanation: whether it was tried, and why not."""

    name: str
    outcome: str
    why: str = ""


@frozen_record
class Change:
    """A change of one device parameter with which the target is reached, and whether the check accepts it."""

    change: Counterfactual
    accepted: bool


@frozen_record
class Explanation:
    """What was learned from a search that found no plan.

    What is None or empty was looked for and not found, or was not tried: `parts` tells which.

    Args:
        starts: Where needles can start, and why each start fails.
        blocking: What stops the direct arcs, most first.
        blocked_arc: The arc to the target that violates least, of those within the needle's limits.
        arc_beyond_limits: Where there is no such arc: the one that exceeds the limits least.
        neighbour: The nearest point to the target that was found to be reached, with its plan.
        changes: Changes of one device parameter that reach the target, the smallest first.
        through_fissures: Whether a single arc reaches the target if fissures may be crossed; None if they may
            be or there are none.
        chances: How many of the simulated procedures succeed with each of `plans`, by the names of their
            files, under the default errors.
        ultrasound: What radial ultrasound is expected to show of the nodule, in words.
        parts: What was done and what was not, in the order of doing.
        time_s: Seconds of processor time that it took, without getting kernels.
    """

    patient_name: str
    system: System
    target: Target
    with_fissures: bool
    failure: NoPlan
    starts: StartMap | None = None
    blocking: tuple[Blocking, ...] = ()
    blocked_arc: BlockedArc | None = None
    arc_beyond_limits: ArcBeyondLimits | None = None
    neighbour: Neighbour | None = None
    attempts: tuple[Attempt, ...] = ()
    untried: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()
    through_fissures: bool | None = None
    shares: tuple[ReachedShare, ...] = ()
    chances: Mapping[str, Share] = field(default_factory=dict)
    verdict: ReachVerdict | None = None
    ultrasound: str = ""
    parts: tuple[Part, ...] = ()
    time_s: float = 0.0

    @property
    def headline(self) -> str:
        """One sentence: that there is no plan, the main reason, and the preset that would do."""
        name, attempts = self.system.name, self.failure.attempts
        if not attempts:
            return f"No plan found with {name}: {self.failure.main_reason}; {self._way_on}"
        why = attempts.get(name, "").removeprefix("no plan: ")
        change = f"; {self._change} would reach it" if self._change else ""
        return f"No plan found with any of {len(attempts)} systems; with {name}: {why}{change}"

    @property
    def _change(self) -> str:
        """The smallest change of the device whose plan the check accepts, and how often it succeeds."""
        accepted = (each.change for each in self.changes if each.accepted)
        return next((f"{change}{self._how_often(change.plan)}" for change in accepted), "")

    @property
    def advice(self) -> str:
        """What would reach the target, in one sentence; empty if nothing that was tried does."""
        systems = [
            f"--system {attempt.system.name}{self._how_often(attempt.plan)}"
            for attempt in self.attempts
            if attempt.succeeded
        ]
        changes = [
            f"{each.change}{self._how_often(each.change.plan)}" for each in self.changes if each.accepted
        ]
        fissures = ["crossing a fissure (--allow-fissures; not planned)"] if self.through_fissures else []
        helps = [*systems, *changes, *fissures]
        return f"It is reached with {', or with '.join(helps)}" if helps else ""

    def _how_often(self, plan: Plan | None) -> str:
        """Say how often a plan succeeds: that it exists says too little."""
        chance = self.chances.get(self.file_of(plan) or "")
        return "" if chance is None else f" (succeeds in {of_hundred(chance.value)} of 100)"

    @property
    def _way_on(self) -> str:
        names = list(self.presets)
        reach = next((name for name, each in self.presets.items() if each and each.succeeded), "")
        less = {name for name in self.untried if reach and names.index(name) < names.index(reach)}
        untried = ", ".join(f"{name} (less invasive)" if name in less else name for name in self.untried)
        tried = f"{len(self.attempts)} of {len(names)} other presets tried"
        tried += f"; not tried: {untried}" if untried else ""
        if reach:
            least = "" if less else ", the least invasive other preset with a plan"
            plan = next(each.plan for each in self.attempts if each.system.name == reach)
            return f"{reach} would reach it{self._how_often(plan)}{least} ({tried})"
        if self.verdict is not None and self.verdict.proved:
            return "this system is proved not to reach it"
        change = f", but {self._change} would reach it" if self._change else ""
        if not self.untried:
            return f"with no other preset was a plan found ({tried}){change}"
        failed = ", ".join(f"no plan with {each.system.name}" for each in self.attempts)
        return f"{failed} ({tried}){change}" if failed else f"{tried}{change}"

    @property
    def presets(self) -> Mapping[str, Attempt | None]:
        """The other presets, the least invasive first, and what became of each; None if it was not tried."""
        tried = {attempt.system.name: attempt for attempt in self.attempts}
        names = (each.name for each in presets_by_invasiveness(tool=self.system.tool))
        return {name: tried.get(name) for name in names if name in tried or name in self.untried}

    @property
    def plans(self) -> Mapping[str, Plan]:
        """The plans that came about, by the names of their files: each is one that the check accepts."""
        found = {
            f"plan-{_file_stem(attempt.system.name)}.json": attempt.plan
            for attempt in self.attempts
            if attempt.succeeded and attempt.plan is not None
        }
        if self.neighbour is not None:
            found["plan-nearest.json"] = self.neighbour.plan
        found |= {
            f"plan-change-{number}.json": each.change.plan
            for number, each in enumerate(self.changes, start=1)
            if each.accepted
        }
        return found

    @property
    def miss(self) -> BlockedArc | ArcBeyondLimits | None:
        """The path to the target that violates least: within the needle's limits if there is one."""
        return self.blocked_arc or self.arc_beyond_limits

    def file_of(self, plan: object) -> str | None:
        """Return the name of the file of a plan, None if it has none."""
        return next((name for name, each in self.plans.items() if each is plan), None)

    @property
    def not_tried(self) -> tuple[Part, ...]:
        """The parts that were not done: nothing follows from them."""
        return tuple(part for part in self.parts if part.outcome == NOT_TRIED)

    @property
    def ran_out_of_time(self) -> bool:
        """Whether more time would have let something be tried."""
        return any(part.why == TIME_IS_UP for part in self.parts)


def _file_stem(name: str) -> str:
    """Return a name without what the name of a file may not hold."""
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
