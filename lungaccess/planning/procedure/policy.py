"""One simulated procedure: measure after each stage, plan the rest again, and carry it out with errors."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from functools import cached_property
from itertools import product

import numpy as np

from anatomy import poses
from anatomy.base.errors import TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.one_stage import RestOfPlan, ScopeReplanner, replan_from_tube
from lungaccess.planning.procedure.foresight import Foresight
from lungaccess.planning.procedure.fusion import fused, fused_share, scope_moves, tip_moves
from lungaccess.planning.procedure.history import NEEDLE, SCOPE, TUBE, History
from lungaccess.planning.procedure.residuals import Residuals
from lungaccess.planning.procedure.settings import Procedure
from lungaccess.planning.procedure.spread import ASIDE, bend_per_mm
from lungaccess.planning.procedure.truth import (
    Attempt,
    as_measured,
    carried_out,
    insert_needle,
    needle_pieces,
    path_of,
    unknown_of,
)
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, require_free
from lungaccess.problem.task import Task
from lungaccess.uncertainty.risk import ErrorModel, RiskAssessor
from lungaccess.uncertainty.risk.deviations import deviated_starts
from lungaccess.uncertainty.risk.errors import BREATHING
from stages.needle import (
    ArcPath,
    Failure,
    NeedleEnvironment,
    Objective,
    Query,
    Replan,
    Replanner,
    ReplanSettings,
    needle_environment,
)

SIDES = np.concatenate([np.eye(3), -np.eye(3)])
ASIDES = 2
"""So many points beside the target are tried, the two that the needle has to bend least for."""
SHARES = 9
"""Shares of an error of measuring that are tried until a scope's tip lies in the lumen."""
AIMING_ITERATIONS = 100
"""Iterations from a tip of the tubes as measured: most targets are reached by one arc, which they improve."""
SEARCH_ITERATIONS = 1500
"""Iterations where that finds no path, or the plan that is left cannot be aimed again on the way."""
IMAGINED = 16
"""Placements of the scope that are imagined beforehand: their mean chance is then known to some percent."""
_SEED = 2
"""Of their draws, which have nothing to do with those of a simulated procedure."""


class Policy:
    """Carries out a plan in simulated procedures.

    Parameters
    ----------
    assessor : RiskAssessor
        Of the plan.
    lung : Lung
        The patient that it is for.
    errors : ErrorModel
        By which measurements are weighed against what was expected, and deployments chosen.
    procedure : Procedure
    """

    def __init__(self, assessor: RiskAssessor, lung: Lung, errors: ErrorModel, procedure: Procedure) -> None:
        self._plan = plan = assessor.plan
        self._assessor, self._lung, self.errors, self.procedure = assessor, lung, errors, procedure
        # Where the centre of the goal cannot be reached, other points in it are aimed at.
        self._aside_mm = ASIDE * assessor.radius_mm
        self._foresight = Foresight(assessor, lung, errors, procedure)
        self._left = Residuals.of(errors, procedure, assessor.stretch)
        # Fissures are obstacles of the replan exactly where they are of the plan.
        whole = replace(plan.system, fissures_allowed=not plan.fissures_are_obstacles)
        share = procedure.least_margin_share
        self._systems = (whole,) if share == 1.0 else (whole, _with_margins(whole, share))
        self._environments = [
            needle_environment(lung, system.needle, system.margins, with_fissures=plan.fissures_are_obstacles)
            for system in self._systems
            if system.needle is not None
        ]

    def attempt(self, history: History, attempt: Attempt, rng: np.random.Generator) -> bool:
        """Place the scope once and go on from there; tell whether the procedure is over.

        Parameters
        ----------
        history : History
            Receives what happens.
        attempt : Attempt
        rng : numpy.random.Generator
            Of the errors of measuring.
        """
        history.placements += 1
        placing, plan = self.procedure.scope, self._plan
        noise = rng.standard_normal((3, 5))
        if placing.measured:
            found = self._from_scope(history, self._scope_measured(attempt.frame(), noise[0]))
            left = placing.placements - history.placements
            if found is None or self._foresight.best < self.worth[left]:
                return False
            plan = found
        pieces = attempt.pieces(plan)
        if plan.needle is None:
            history.chains.append((attempt.start, pieces, len(pieces)))
            history.complete = True
            return True
        n_tube = len(pieces) - len(plan.needle.arcs)
        if self.procedure.tubes.measured or self.procedure.needle.closed_loop:
            after = self._from_tube(history, attempt, plan, pieces, noise[1:], rng)
            if after is None:
                history.chains.append((attempt.start, pieces[:n_tube], n_tube))
                return False
            pieces = np.concatenate([pieces[:n_tube], after])
        history.chains.append((attempt.start, pieces, n_tube))
        history.complete = True
        return True

    @cached_property
    def worth(self) -> tuple[float, ...]:
        """The chance of success that so many more placements of the scope promise, from 0 on.

        A placement is worth going on from if its own chance is not less: then stopping is optimal, as far as
        placements are alike and chances are those foreseen.
        """
        worth, scope = [0.0], self.procedure.scope
        if scope.measured and scope.placements > 1:
            drawn = self._assessor.draws(IMAGINED, _SEED).deviations(self.errors)
            starts = deviated_starts(self._plan, self._lung, drawn)
            rng = np.random.default_rng(_SEED)
            chances = [self._chance_from(poses.pose(*np.split(each, 3)), rng) for each in starts]
            for _ in range(scope.placements - 1):
                worth.append(float(np.maximum(chances, worth[-1]).mean()))
        return (*worth, *[0.0] * (scope.placements - len(worth)))

    def _chance_from(self, true: Float, rng: np.random.Generator) -> float:
        """Return the chance that is foreseen where the scope's tip truly stands at a pose."""
        found = self._from_scope(History(), self._scope_measured(true, rng.standard_normal(5)))
        return 0.0 if found is None else self._foresight.best

    def _scope_measured(self, true: Float, noise: Float) -> Float:
        """Return where the scope's tip most likely is: in the lumen, where it is known to be."""
        placing, plan = self.procedure.scope, self._plan
        measured = as_measured(true, placing.position_mm, placing.direction_deg, noise)
        measured[:3, 3] = self._in_lumen(measured[:3, 3], true[:3, 3])
        expected, errors = np.asarray(plan.scope.lps_from_scope_tip), self.errors
        sizes = errors.term("scope_position").rms, math.radians(errors.term("scope_direction").rms)
        moves = scope_moves(expected, *sizes)
        likely = fused(expected, moves, measured, placing.position_mm, math.radians(placing.direction_deg))
        likely[:3, 3] = self._in_lumen(likely[:3, 3], measured[:3, 3])
        return likely

    def _in_lumen(self, point: Float, inside: Float) -> Float:
        """Return the first point on the way inside where the lumen is as deep as the scope, or as inside."""
        points = inside + np.linspace(1.0, 0.0, SHARES)[:, None] * (point - inside)
        depths = self._lung.lumen_depth.lower_bound_mm(points)
        enough = min(self._plan.system.scope.radius_mm, float(depths[-1]))
        return np.asarray(points[np.argmax(depths >= enough)])

    def _from_scope(self, history: History, measured: Float) -> Plan | None:
        """Return the plan with tubes and needle from the scope's tip as measured, None if there is none."""
        plan = self._plan
        history.corrected_mm[SCOPE].append(self._miss_from(measured))
        try:
            rest = self._replanner.replan(measured)
        except NoPlan:
            history.replans[SCOPE].append(False)
            return None
        history.replans[SCOPE].append(True)
        scope = replace(plan.scope, lps_from_scope_tip=rest.lps_from_measured)
        exemption = replace(plan.exemption, branch=rest.branch)
        tube = plan.tube if rest.tube is None else rest.tube
        return replace(plan, scope=scope, tube=tube, needle=rest.needle, exemption=exemption)

    @cached_property
    def _replanner(self) -> ScopeReplanner:
        """Plans tubes and needle again, by direct arcs: what else could be searched is left to the needle.

        The chance of a deployment weighs clearance by itself, so that the least margins suffice.
        """
        plan = self._plan
        task = Task(
            lung=self._lung,
            system=self._systems[-1],
            target=Target(lps_mm=np.asarray(plan.target_lps), origin=plan.target_origin),
            objective=Objective.of(plan.objective),
            method="replan",
            seed=plan.seed,
        )
        return ScopeReplanner(task, searches=0, rank=self._foresight)

    def _from_tip(self, history: History, measured: Float, target: Target) -> RestOfPlan | None:
        """Return the needle from a tip as measured: to the target or beside it, with all margins or fewer."""
        aims = [target, *self._aside(measured, target)]
        first, last = (AIMING_ITERATIONS, self._systems), (SEARCH_ITERATIONS, self._systems[-1:])
        for iterations, systems in (first, last):
            for system, aim in product(systems, aims):
                try:
                    rest = replan_from_tube(
                        self._lung, system, measured, aim, objective=self._plan.objective,
                        seed=self._plan.seed, iterations=iterations,
                    )  # fmt: skip
                except (NoPlan, TargetError):
                    continue
                history.replans[TUBE].append(True)
                return rest
        history.replans[TUBE].append(False)
        return None

    def _aside(self, frame: Float, target: Target) -> list[Target]:
        """Return the points of the goal to aim at where its centre cannot be reached, straightest first."""
        points = target.lps_mm + self._aside_mm * SIDES
        away = (points - frame[:3, 3]) @ frame[:3, :3]
        bends = 2.0 * np.hypot(away[:, 0], away[:, 1]) / (away**2).sum(axis=1)
        order = np.argsort(bends, kind="stable")[:ASIDES]
        return [Target(lps_mm=points[n], origin=target.origin) for n in order]

    def _miss_from(self, measured: Float) -> float:
        """Return how far from the target the plan ends, carried on without errors from another scope tip."""
        plan = self._plan
        planned = np.linalg.inv(np.asarray(plan.scope.lps_from_scope_tip))
        last = plan.tube.lps_from_tip[:3, 3] if plan.needle is None else plan.needle.end_lps
        moved = measured @ planned @ np.append(last, 1.0)
        return float(np.linalg.norm(moved[:3] - plan.target_lps))

    def _from_tube(
        self,
        history: History,
        attempt: Attempt,
        plan: Plan,
        pieces: Float,
        noise: Float,
        rng: np.random.Generator,
    ) -> Float | None:
        """Return the true arcs `(A, 4)` of the needle behind the tubes, None if no path was left."""
        stage, needle = self.procedure.tubes, plan.needle
        if needle is None:
            return None
        true_tip, rolled = attempt.needle_tip(plan, pieces)
        path, tip = path_of(needle), np.asarray(needle.lps_from_start)
        target = self._target(attempt, noise[1])
        moves = tip_moves(
            np.asarray(plan.scope.lps_from_scope_tip), tip, self._left, bend_per_mm(plan.system)
        )
        doubt = moves @ moves.T
        if stage.measured:
            sizes = stage.position_mm, math.radians(stage.direction_deg)
            measured = as_measured(true_tip, stage.position_mm, stage.direction_deg, noise[0])
            tip = fused(tip, moves, measured, *sizes)
            doubt = np.diag(np.repeat(sizes, 3) ** 2)
            history.corrected_mm[TUBE].append(
                _miss(ArcPath(lps_from_start=tip, arcs=path.arcs), target.lps_mm)
            )
            rest = self._from_tip(history, tip, target)
            if rest is None or rest.needle is None:
                return None
            path = path_of(rest.needle)
        if self.procedure.needle.closed_loop:
            arcs = self._steered(history, attempt, plan, path, true_tip, doubt, target, rng)
        else:
            arcs = carried_out(path, attempt)
        if not len(arcs):
            return np.zeros((0, 4))
        arcs[0, 1] += rolled
        return needle_pieces(arcs, plan.system.track_radius_mm)

    def _target(self, attempt: Attempt, noise: Float) -> Target:
        """Return the target as it is found in an image before the needle starts, or as planned."""
        plan, imaging = self._plan, self.procedure.imaging
        planned = Target(lps_mm=np.asarray(plan.target_lps), origin=plan.target_origin)
        if not imaging.measured:
            return planned
        errors, breath = self.errors.term("target_position").rms, self.errors.term(BREATHING).size
        expected = np.array([errors, errors, math.hypot(errors, self._assessor.stretch * breath)])
        shares = np.array([fused_share(each, imaging.position_mm) for each in expected.tolist()])
        measured = attempt.target_lps + imaging.position_mm * noise[:3]
        found = planned.lps_mm + shares * (measured - planned.lps_mm)
        try:
            require_free(self._lung, found)
        except TargetError:
            # The masks say that a nodule cannot be there: the measurement is not believed.
            return planned
        return Target(lps_mm=found, origin=plan.target_origin)

    def _steered(
        self,
        history: History,
        attempt: Attempt,
        plan: Plan,
        path: ArcPath,
        true_tip: Float,
        doubt: Float,
        target: Target,
        rng: np.random.Generator,
    ) -> Float:
        """Return the arcs `(A, 3)` of a needle that is measured and planned again on its way.

        `doubt` is the covariance `(6, 6)` of where it is taken to begin.
        """
        steering = self.procedure.needle
        start = np.asarray(path.lps_from_start)
        query = Query(lps_from_start=start, target=target.lps_mm, branch=plan.exemption.branch)
        preferred, environment = self._environments[0], self._environments[-1]
        allowed = ReplanSettings(largest_miss_mm=min(self._aside_mm, 10.0))
        replanner = _FrugalReplanner(preferred, environment, query, path, allowed)
        found = insert_needle(
            environment, query, path, replanner, attempt, true_tip, steering,
            unknown_of(self.errors, steering, doubt), rng,
        )  # fmt: skip
        history.replans[NEEDLE] += [each.path is not None for each in found.replans]
        history.stopped = found.stopped is not None
        return found.arcs


class _FrugalReplanner(Replanner):
    """Aims the plan that is left again, and searches only where that finds no path.

    Parameters
    ----------
    preferred : NeedleEnvironment
        The one with all margins, in which a path is looked for first.
    environment, query, plan, settings
        As those of `Replanner`.
    """

    def __init__(
        self,
        preferred: NeedleEnvironment,
        environment: NeedleEnvironment,
        query: Query,
        plan: ArcPath,
        settings: ReplanSettings,
    ) -> None:
        super().__init__(environment, query, plan, settings=settings)
        if preferred is not environment:
            self._variants.insert(0, preferred)

    def replan(
        self, lps_from_tip: Float, target: Float, inserted_mm: float, *, turned_rad: float | None = None
    ) -> Replan:
        """Plan from the pose that the tip is in; see `Replanner.replan`."""
        self._iterations = 0
        found = super().replan(lps_from_tip, target, inserted_mm, turned_rad=turned_rad)
        if found.failure is Failure.NOT_FOUND:
            self._iterations = SEARCH_ITERATIONS
            found = super().replan(lps_from_tip, target, inserted_mm, turned_rad=turned_rad)
        return found


def _with_margins(system: System, share: float) -> System:
    """Return a system with a share of its margins."""
    names = [each.name for each in fields(system.margins)]
    return replace(
        system,
        margins=replace(system.margins, **{name: share * getattr(system.margins, name) for name in names}),
    )


def _miss(path: ArcPath, target: Float) -> float:
    return float(np.linalg.norm(path.frames()[-1][:3, 3] - target))
