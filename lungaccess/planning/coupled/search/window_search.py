"""The search over the atlas for a window of breathing: every scope tip has an aim of its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import Incumbent, Step, evaluated_step
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs, DirectArcSearch
from lungaccess.planning.coupled.search.settings import ESTIMATE_SLACK, SearchSettings
from lungaccess.planning.coupled.search.variation import SHIFT_MM, SMALLEST, TURN_RAD, varied
from lungaccess.plans.assemble import assemble, with_devices
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow, WindowLimit
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.aim import Aim, MovingTarget
from lungaccess.uncertainty.breathing.window import (
    TOLERANCE_MM,
    breathing_window,
    first_limit,
    require_motion,
)
from stages.needle import ArcPath, direct_path
from stages.scope import ScopeTip

STEPS = 200
"""Windows that differ by less than half a percent of the breath count as equally wide: then cost decides."""
OUTSIDE_COST = 1e9
"""Cost of a breath without a window: half a percent of it is more than any path costs."""
FAR_MM = 20.0
"""An aim for phases without that of the masks may lie so far from the target: no lung moves by more."""
TOWARDS = 0.15
"""Standard deviation of the first variations of the phase about which an aim is made."""
VARY_EVERY = 3
"""Steps of the other phases of the search for each variation of the window."""
SHRINK = 0.9
"""Variations become smaller with every one that fails, and are wide again when one succeeds."""
_SETTINGS = SearchSettings(kept_slack=100.0)
"""The cheapest arcs need not be those that stay clear: nearly all of them may be starts."""


class WindowEvaluator(CandidateEvaluator):
    """Proves candidates also for a window of breathing, and aims at where the target moves about.

    Parameters
    ----------
    task : Task
        Of a patient with motion.
    phases : tuple of 2 floats or None
        Phases that every window has to hold.
    widest : bool
        Whether a wider window counts before cost.
    middle : float, optional
        See `MovingTarget`.

    Attributes
    ----------
    window : BreathingWindow or None
        That of the last candidate, where the widest is wanted.
    limit : WindowLimit or None
        What refused the last candidate whose proof in the masks' phase was good.
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

    def aim(self, tip: ScopeTip) -> Float:
        """Return the aim from a scope tip."""
        return np.array(self.aim_from(tip.lps_from_scope_tip[:3, 3]).point_lps)

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
        return cost if self.window is None else cost + cost_outside(self.window.share)


def cost_outside(share: float) -> float:
    """Return what counts for the breath outside a window."""
    return OUTSIDE_COST * (1.0 - math.floor(STEPS * share) / STEPS)


def aims_by_site(evaluator: WindowEvaluator, atlas: Atlas) -> tuple[Float, Float, Float, Float]:
    """Return aims `(S, 3)`, least misses, what is allowed, in mm, and most shares `(S,)` by scope tip.

    They are nan for tips from which no needle gets near.
    """
    motion, phases = require_motion(evaluator.task.lung), evaluator.phases
    held = phases is None or phases[0] <= motion.masks_phase <= phases[1]
    environment = evaluator.environment
    limits = environment.limits._replace(goal_tolerance_mm=2.0 * TOLERANCE_MM if held else FAR_MM)
    near, _lengths = atlas.index.holding(replace(environment, limits=limits), evaluator.task.target.lps_mm)
    found = np.full((atlas.motions.count, 6), np.nan)
    for site in np.unique(atlas.deployments.site[near]).tolist():
        aim = evaluator.aim_from(np.ascontiguousarray(atlas.motions.tips[site, :3]))
        found[site] = *aim.point_lps, aim.least_miss_mm, aim.allowed_mm, aim.most_share
    return found[:, :3], *found[:, 3:].T


class WindowArcSearch(DirectArcSearch):
    """Evaluates the direct arcs of an atlas, those first that may be the best.

    Attributes
    ----------
    blockers : (N,) int64
        What blocks the arcs from the deployments whose workspace holds their aim; see `DirectArcs.evaluate`.
    refused : dict of int to WindowLimit
        What ends the window too early, by deployment.
    """

    def __init__(self, arcs: DirectArcs, evaluator: WindowEvaluator, shares: Float, incumbent: Incumbent):
        super().__init__(arcs, incumbent, _SETTINGS)
        self._evaluator, self._shares = evaluator, shares
        self.blockers: Int = np.zeros(0, dtype=np.int64)
        self.refused: dict[int, WindowLimit] = {}

    def steps(self) -> Iterator[Step]:
        """Yield a step for all arcs together, then one for each clear arc that may be the best."""
        near, evaluator = self._arcs.in_workspace, self._evaluator
        self.blockers = self._arcs.blockers(near)[0]
        evaluator.count_blockers(self.blockers)
        yield Step(iteration=0, phase=self.phase)
        clear = near[self.blockers == 0]
        costs = self._arcs.evaluate(clear, math.inf)[1]
        bounds = costs / ESTIMATE_SLACK
        if evaluator.widest:
            most = self._shares[self._arcs.atlas.deployments.site[clear]]
            bounds += [cost_outside(share) for share in most.tolist()]
        order = np.argsort(bounds, kind="stable")
        entries, bounds = clear[order], bounds[order]
        ranks = bounds + OUTSIDE_COST
        for n, entry in enumerate(entries.tolist()):
            if bounds[n] > self._incumbent.cost:
                break
            step = evaluated_step(evaluator, self.phase, self._arcs.candidate(entry))
            if step.candidate is not None:
                ranks[n] = step.cost
            elif evaluator.limit is not None:
                self.refused[entry] = evaluator.limit
            yield self._incumbent.improved(step)
        self.clear = entries[np.argsort(ranks, kind="stable")]


class WindowSearch(AtlasSearch):
    """Direct arcs to the aims of all scope tips, then rounds as of any search, and variations of the best.

    Parameters
    ----------
    task, atlas
        As of `AtlasSearch`.
    phases, widest, middle
        As of `WindowEvaluator`.

    Attributes
    ----------
    aims : (S, 3) float64
        By scope tip, LPS mm; nan for tips from which no needle gets near.
    misses_mm : (S,) float64
        Least miss of tips that are ruled out by it, else 0.
    """

    def __init__(
        self,
        task: Task,
        atlas: Atlas,
        phases: tuple[float, float] | None,
        *,
        widest: bool,
        middle: float | None = None,
    ) -> None:
        evaluator = WindowEvaluator(task, phases, widest=widest, middle=middle)
        aims, misses, allowed, shares = aims_by_site(evaluator, atlas)
        reached = np.where((misses <= allowed)[:, None], aims, np.nan)
        super().__init__(task, atlas, _SETTINGS, DirectArcs(task, atlas, evaluator, reached))
        self.window_evaluator, self.aims = evaluator, aims
        self.misses_mm = np.where(misses > allowed, misses, 0.0)
        self.direct: WindowArcSearch = WindowArcSearch(self.arcs, evaluator, shares, self.incumbent)

    def _rounds(self) -> Iterator[Step]:
        varied_too = self._varied()
        for number, step in enumerate(super()._rounds()):
            yield step
            if self.window_evaluator.widest and number % VARY_EVERY == 0:
                yield next(varied_too)

    def _varied(self) -> Iterator[Step]:
        """Vary deployment and aim of the best candidate, as long as its window is not the whole breath."""
        phase, evaluator, size = "variation", self.window_evaluator, 1.0
        rng = np.random.Generator(np.random.PCG64([self.task.seed, VARY_EVERY]))
        middle, nothing = self._middle, Step(iteration=0, phase=phase)
        while True:
            best = self.incumbent.candidate
            if best is None or self.incumbent.cost < OUTSIDE_COST / STEPS:
                yield nothing
                continue
            size = size if size >= SMALLEST else 1.0
            turn, *shifts = (rng.standard_normal(3) * (TURN_RAD, SHIFT_MM, SHIFT_MM) * size).tolist()
            towards = min(max(middle + TOWARDS * size * float(rng.standard_normal()), 0.0), 1.0)
            made = varied(evaluator, best, turn, shifts)
            if made is not None:
                aim = evaluator.moving.aim(best.tip.lps_from_scope_tip[:3, 3], towards)
                path = direct_path(made.deployment.lps_from_tip, np.array(aim.point_lps))
                made = replace(made, path=path)
            before = self.incumbent.cost
            step = evaluated_step(evaluator, phase, made)
            yield step
            better = step.cost < before
            size, middle = (1.0, towards) if better else (SHRINK * size, middle)

    @property
    def _middle(self) -> float:
        return require_motion(self.task.lung).masks_phase
