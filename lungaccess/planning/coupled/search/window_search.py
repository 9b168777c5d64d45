"""The search over the atlas for a window of breathing: every scope tip has an aim of its own."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.aimed_tubes import COST
from lungaccess.planning.coupled.search import base
from lungaccess.planning.coupled.search.aimed_tubes import (
    AimedTubes,
    TubeAiming,
    TubeSearch,
    aim_starts,
    chosen_of,
    near_mm,
)
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.plans.assemble import assemble, with_devices
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow, WindowLimit
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.moving import Aim, MovingTarget
from lungaccess.uncertainty.breathing.window import (
    TOLERANCE_MM,
    breathing_window,
    first_limit,
    require_motion,
)
from stages.needle import ArcPath
from stages.tube import ConcentricTubes, Deployment, deployed, design_arrays, shape_of_arrays

TURN_RAD, SHIFT_MM = math.radians(10.0), 2.0
"""Standard deviations of the first variations: less than the spacing of the atlas."""
SMALLEST = 0.02
"""Share of them below which a variation changes nothing that counts."""


def random_change(rng: np.random.Generator, size: float, tubes: ConcentricTubes) -> list[float]:
    """Return what `varied` changes, at random: a turn, two shifts, and turns of tubes against the others.

    The spreads are TURN_RAD and SHIFT_MM times `size`.
    """
    spreads = np.array([TURN_RAD, SHIFT_MM, SHIFT_MM, *[TURN_RAD] * len(tubes.nested)])
    changes: list[float] = (rng.standard_normal(len(spreads)) * spreads * size).tolist()
    return changes


def varied(
    evaluator: CandidateEvaluator,
    candidate: Candidate,
    turn_rad: float,
    shifts: Sequence[float],
    end: Float | None = None,
) -> Candidate | None:
    """Return a candidate that is turned and shifted; None if the tubes refuse it.

    With a needle its arc follows from the tubes.  Without one the tubes have to end where they are to: then
    the first shift is that of the scope along its motion, and the tubes are aimed from the changed ones.

    Args:
        turn_rad: By which all tubes are turned.
        shifts: Of outer and inner tube, mm; then how far each is turned against the others, the innermost
            first.
        end ((3,) float64): Where the devices end, LPS mm; what the evaluator aims at if None.
    """
    tubes, old, tip = evaluator.task.system.tubes, candidate.deployment, candidate.tip
    joints = _changed_joints(tubes, old, shifts)
    if evaluator.task.system.needle is None:
        return _aimed_anew(evaluator, candidate, shifts[0], joints, end)
    made = deployed(design_arrays(tubes), *np.split(joints, 2))
    if made is None:
        return None
    turned = (old.rotation_rad + turn_rad) % (2.0 * math.pi)
    return evaluator.direct(tip, turned, shape_of_arrays(made), end)


def _changed_joints(tubes: ConcentricTubes, old: Deployment, shifts: Sequence[float]) -> Float:
    """Return insertions and rotations `(2 n,)`."""
    n = len(tubes.nested)
    inserted = np.maximum(old.shape.insertions_mm + np.linspace(shifts[1], shifts[0], n), 0.0)
    turns = np.array(shifts[2:] or [0.0] * n)
    # The first bent tube is what the others are turned against.
    bent = np.array([bool(tube.bends) for tube in tubes.nested])
    turned = old.shape.rotations_rad + np.where(bent & (np.cumsum(bent) > 1), turns, 0.0)
    return np.concatenate([np.minimum.accumulate(inserted), turned])


def _aimed_anew(
    evaluator: CandidateEvaluator, candidate: Candidate, shift_mm: float, joints: Float, end: Float | None
) -> Candidate | None:
    """Return the tubes aimed from a scope tip farther along its motion, beginning with changed ones."""
    task, row = evaluator.task, evaluator.tip_rows.along(candidate.tip, [shift_mm])
    starts = aim_starts(task.system.tubes, joints, 1)
    if starts is None or not row.proved[0]:
        return None
    ends = evaluator.aim(row.tips[0, :3]) if end is None else end
    aiming = TubeAiming(task.lung, task.system, task.objective, with_fissures=task.with_fissures)
    found, _why = aiming.aim(ends, row.tips, row.proved, np.zeros(1, dtype=np.int64), starts)
    if not np.isfinite(found[0, COST]):
        return None
    return evaluator.aimed(evaluator.tip_rows.tip(row, 0), *chosen_of(task.system.tubes, found[0]))


STEPS = 200
"""Windows that differ by less than half a percent of the breath count as equally wide: then cost decides."""
OUTSIDE_COST = 1e9
"""Cost of a breath without a window: half a percent of it is more than any path costs."""
VARY_EVERY = 3
"""Steps of the other phases of the search for each variation of the window."""
_SETTINGS = base.SearchSettings(kept_slack=100.0)
"""The cheapest arcs need not be those that stay clear: nearly all of them may be starts."""


class WindowEvaluator(CandidateEvaluator):
    """Proves candidates also for a window of breathing, and aims at where the target moves about.

    Args:
        phases (tuple of 2 floats or None): Phases that every window has to hold.
        widest: Whether a wider window counts before cost.

    Attributes:
        window: That of the last candidate, where the widest is wanted.
        limit: What refused the last candidate whose proof in the masks' phase was good.
    """

    def __init__(
        self, task: Task, phases: tuple[float, float] | None, *, widest: bool, middle: float | None = None
    ) -> None:
        super().__init__(task)
        self.moving = MovingTarget(
            require_motion(task.lung), task.target.lps_mm, phases, widened=widest, middle=middle
        )
        self.phases, self.widest = phases, widest
        self.limit: WindowLimit | None = None
        self.window: BreathingWindow | None = None
        self._aims: dict[bytes, Aim] = {}
        self._model: Plan | None = None

    def aim_from(self, tip_lps: Float) -> Aim:
        """Return the aim from a place `(3,)` of the scope's tip."""
        key = tip_lps.tobytes()
        if key not in self._aims:
            self._aims[key] = self.moving.aim(tip_lps)
        return self._aims[key]

    def aim(self, tip_lps: Float) -> Float:
        """Return the aim from a place of the scope's tip, LPS mm."""
        return np.array(self.aim_from(tip_lps).point_lps)

    def end_of(self, path: ArcPath) -> Float:
        """Return the end of a path: its window says whether that is near enough to the moving target."""
        return np.asarray(path.frames()[-1][:3, 3])

    def accepts(self, candidate: Candidate) -> bool:
        """Tell whether a candidate is proved in the masks' phase, and has the window that is asked for."""
        self.limit = self.window = None
        if not super().accepts(candidate):
            return False
        self._model = self._model or assemble(self.task, candidate, iteration=0, timing={})
        plan = with_devices(self.task, candidate, self._model)
        if self.phases is not None:
            self.limit = first_limit(plan, self.task.lung, self.phases)
        if self.limit is None and self.widest:
            self.window = breathing_window(plan, self.task.lung)
            self.limit = None if len(self.window.phases) else self.window.limits[0]
        return self.limit is None

    def evaluate(self, candidate: Candidate) -> float:
        """Return the cost of a candidate with that of the breath outside its window; infinite without one."""
        cost = super().evaluate(candidate)
        return cost if self.window is None else cost + _cost_outside(self.window.share)


def _cost_outside(share: float) -> float:
    """Return what counts for the breath outside a window."""
    return OUTSIDE_COST * (1.0 - math.floor(STEPS * share) / STEPS)


@frozen_record
class WindowAims:
    """Where devices from each of S scope tips have to end for a window.

    Args:
        points ((S, 3) float64): LPS mm; nan for tips from which no devices get near.
        misses_mm ((S,) float64): Least miss of tips that are ruled out by it, else 0.
        shares ((S,) float64): No end of the devices has the target within the tolerance in more of the
            breath.
    """

    points: Float
    misses_mm: Float
    shares: Float

    @classmethod
    def of(cls, evaluator: WindowEvaluator, atlas: Atlas) -> "WindowAims":
        """Return those of the scope tips of an atlas."""
        motion, phases = require_motion(evaluator.task.lung), evaluator.phases
        held = phases is None or phases[0] <= motion.masks_phase <= phases[1]
        # An aim for phases without that of the masks may lie so far from the target: no lung moves by more.
        within_mm, target = 2.0 * TOLERANCE_MM if held else 20.0, evaluator.task.target.lps_mm
        if evaluator.task.system.needle is None:
            away = np.linalg.norm(atlas.deployments.positions - target, axis=1)
            near = np.flatnonzero(away <= near_mm(atlas, target)[atlas.deployments.site] + within_mm)
        else:
            limits = evaluator.environment.limits._replace(goal_tolerance_mm=within_mm)
            near = atlas.index.holding(replace(evaluator.environment, limits=limits), target)[0]
        found = np.full((atlas.motions.count, 6), np.nan)
        for site in np.unique(atlas.deployments.site[near]).tolist():
            aim = evaluator.aim_from(np.ascontiguousarray(atlas.motions.tips[site, :3]))
            found[site] = *aim.point_lps, aim.least_miss_mm, aim.allowed_mm, aim.most_share
        misses, allowed = found[:, 3], found[:, 4]
        return cls(points=found[:, :3], misses_mm=np.where(misses > allowed, misses, 0.0), shares=found[:, 5])

    @property
    def reached(self) -> Float:
        """The aims `(S, 3)` of tips that are not ruled out; nan for all others."""
        return np.where((self.misses_mm > 0.0)[:, None], np.nan, self.points)


class _WindowDirectSearch:
    """Evaluates the direct candidates of an atlas, those first that may be the best.

    Attributes:
        clear ((C,) int64): After the search the entries with a clear way, the best first.
        blockers ((N,) int64): What blocks the promising entries in the masks' phase.
        refused: What ends the window too early, by entry.
    """

    phase = "direct candidates"

    def __init__(
        self, arcs: DirectCandidates, evaluator: WindowEvaluator, shares: Float, incumbent: base.Incumbent
    ) -> None:
        self._arcs, self._evaluator = arcs, evaluator
        self.shares, self._incumbent = shares, incumbent
        self.clear: Int = np.zeros(0, dtype=np.int64)
        self.blockers: Int = np.zeros(0, dtype=np.int64)
        self.refused: dict[int, WindowLimit] = {}

    def steps(self) -> Iterator[base.Step]:
        """Yield a step for all entries together, then one for each clear one that may be the best."""
        near, evaluator = self._arcs.promising, self._evaluator
        self.blockers, costs, _least = self._arcs.evaluate(near, math.inf)
        evaluator.blocked.update(self._arcs.reasons(self.blockers))
        yield base.Step(iteration=0, phase=self.phase)
        clear = near[self.blockers == 0]
        bounds = costs[self.blockers == 0] / base.ESTIMATE_SLACK
        if evaluator.widest:
            most = self.shares[self._arcs.atlas.deployments.site[clear]]
            bounds += [_cost_outside(share) for share in most.tolist()]
        order = np.argsort(bounds, kind="stable")
        entries, bounds = clear[order], bounds[order]
        ranks = bounds + OUTSIDE_COST
        for n, entry in enumerate(entries.tolist()):
            if bounds[n] > self._incumbent.cost:
                break
            step = base.evaluated_step(evaluator, self.phase, self._arcs.candidate(entry))
            if step.candidate is not None:
                ranks[n] = step.cost
            elif evaluator.limit is not None:
                self.refused[entry] = evaluator.limit
            yield self._incumbent.improved(step)
        self.clear = entries[np.argsort(ranks, kind="stable")]


class WindowSearch(AtlasSearch):
    """Direct arcs to the aims of all scope tips, then rounds as of any search, and variations of the best."""

    def __init__(self, evaluator: WindowEvaluator, atlas: Atlas) -> None:
        self.window_evaluator, self.aims = evaluator, WindowAims.of(evaluator, atlas)
        arcs = DirectArcs(evaluator.task, atlas, evaluator, self.aims.reached)
        super().__init__(evaluator.task, atlas, _SETTINGS, arcs)
        self.windows = self.direct = _WindowDirectSearch(arcs, evaluator, self.aims.shares, self.incumbent)

    def _rounds(self) -> Iterator[base.Step]:
        varied_too = _variations(self.window_evaluator, self.incumbent, self.share[0])
        for number, step in enumerate(super()._rounds()):
            yield step
            if self.window_evaluator.widest and number % VARY_EVERY == 0:
                yield next(varied_too)


class WindowTubeSearch(TubeSearch):
    """The tubes aimed at the aims of all scope tips, then along each motion, and variations of the best."""

    def __init__(self, evaluator: WindowEvaluator, atlas: Atlas) -> None:
        self.window_evaluator, self.aims = evaluator, WindowAims.of(evaluator, atlas)
        arcs = AimedTubes(evaluator.task, atlas, evaluator, self.aims.reached)
        super().__init__(evaluator.task, atlas, arcs)
        self.windows = _WindowDirectSearch(arcs, evaluator, self.aims.shares, self.incumbent)

    def direct_steps(self) -> Iterator[base.Step]:
        """Aim from the tips of the atlas, those first that may be the best."""
        yield from self.windows.steps()
        self.clear = self.windows.clear

    def further_steps(self) -> Iterator[base.Step]:
        """Look along the motions, then vary the best; each motion and each variation is an iteration."""
        varied_too = _variations(self.window_evaluator, self.incumbent, self.share[0])
        # Variations with which the search of tubes alone ends, a few seconds: several times from wide to
        # small.
        steps = chain(super().further_steps(), islice(varied_too, 200))
        for iteration, step in enumerate(steps, start=1):
            yield self.incumbent.improved(replace(step, iteration=iteration))


def window_search(
    task: Task, atlas: Atlas, phases: tuple[float, float] | None, *, widest: bool, middle: float | None = None
) -> WindowSearch | WindowTubeSearch:
    """Return the search for a window of the breath, with the needle of a system or with its tubes alone.

    Args:
        phases, widest, middle: As of `WindowEvaluator`.
    """
    evaluator = WindowEvaluator(task, phases, widest=widest, middle=middle)
    return (WindowTubeSearch if task.system.needle is None else WindowSearch)(evaluator, atlas)


def _variations(evaluator: WindowEvaluator, incumbent: base.Incumbent, number: int) -> Iterator[base.Step]:
    """Vary deployment and aim of the best candidate, as long as its window is not the whole breath.

    The variations of each process, by its number, are others.
    """
    phase, size, task = "variation", 1.0, evaluator.task
    rng = np.random.Generator(np.random.PCG64([task.seed, VARY_EVERY, *([number] if number else [])]))
    middle, nothing = require_motion(task.lung).masks_phase, base.Step(iteration=0, phase=phase)
    while True:
        best = incumbent.candidate
        if best is None or (evaluator.widest and incumbent.cost < OUTSIDE_COST / STEPS):
            yield nothing
            continue
        size = size if size >= SMALLEST else 1.0
        turn, *shifts = random_change(rng, size, task.system.tubes)
        # Standard deviation of the first variations of the phase about which an aim is made.
        towards = min(max(middle + 0.15 * size * float(rng.standard_normal()), 0.0), 1.0)
        aim = evaluator.moving.aim(best.tip.lps_from_scope_tip[:3, 3], towards)
        before = incumbent.cost
        made = varied(evaluator, best, turn, shifts, np.array(aim.point_lps))
        step = base.evaluated_step(evaluator, phase, made)
        yield step
        better = step.cost < before
        # Variations become smaller with every one that fails, and are wide again when one succeeds.
        size, middle = (1.0, towards) if better else (0.9 * size, middle)
