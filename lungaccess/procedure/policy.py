"""One simulated procedure: measure after each stage, plan the rest again, and carry it out with errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np

from anatomy.errors import TargetError
from anatomy.lung import Lung
from anatomy.typed import Float
from lungaccess.one_stage import RestOfPlan, ScopeReplanner, replan_from_tube
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, require_free
from lungaccess.problem.task import Task
from lungaccess.procedure.settings import Procedure
from lungaccess.procedure.spread import Spread
from lungaccess.procedure.truth import (
    Attempt,
    SteeredTruth,
    as_measured,
    carried_out,
    end_of,
    needle_pieces,
    path_of,
    with_stop,
)
from lungaccess.risk import ErrorModel
from stages.needle import (
    ArcPath,
    Belief,
    Failure,
    Objective,
    Query,
    Replan,
    Replanner,
    ReplanSettings,
    TrueNeedle,
    arc_transform,
    needle_environment,
    steer,
)
from stages.tube import Deployments

SCOPE, TUBE, NEEDLE = "scope", "tube", "needle"
STAGES = (SCOPE, TUBE, NEEDLE)
ASIDE = 0.6
"""Points beside the target are aimed at so far out, as a share of the goal's radius: what is left of it is
there for the errors that come after."""
SIDES = np.concatenate([np.eye(3), -np.eye(3)])
ASIDES = 2
"""So many points beside the target are tried, the two that the needle has to bend least for."""
SHARES = 9
"""Shares of an error of measuring that are tried until a scope's tip lies in the lumen."""
SEARCH_ITERATIONS = 1500
"""Iterations of a replan on the way, where the plan that is left cannot be aimed again."""


@dataclass
class History:
    """What happened in one procedure.

    Attributes
    ----------
    chains : list of (Float, Float, int)
        Of each attempt the true scope tip `(9,)`, the true arcs `(P, 4)` of what was inserted, and how many
        of them are the tubes'.
    complete : bool
        Whether the last chain has all its devices; otherwise no path was left.
    stopped : bool
        Whether the needle stopped on its way because no path was left.
    placements : int
        How often the scope was placed.
    system : System or None
        The system with the margins that the last replan kept; None before any.
    replans : dict of str to list of bool
        Of each stage, whether each of its replans found a path.
    corrected_mm : dict of str to list of float
        Of each stage, how far from the target the plan so far would have ended.
    """

    chains: list[tuple[Float, Float, int]] = field(default_factory=list)
    complete: bool = False
    stopped: bool = False
    placements: int = 0
    system: System | None = None
    replans: dict[str, list[bool]] = field(default_factory=lambda: {stage: [] for stage in STAGES})
    corrected_mm: dict[str, list[float]] = field(default_factory=lambda: {stage: [] for stage in STAGES})


class Policy:
    """Carries out a plan in simulated procedures.

    Parameters
    ----------
    plan, lung
        The plan, and the patient that it is for.
    errors : ErrorModel
        By which a deployment is chosen from a scope's tip as measured.
    procedure : Procedure
    radius_mm : float
        Radius of the goal: where its centre cannot be reached, other points in it are aimed at.
    """

    def __init__(
        self, plan: Plan, lung: Lung, errors: ErrorModel, procedure: Procedure, radius_mm: float
    ) -> None:
        self._plan, self._lung, self.procedure = plan, lung, procedure
        self.errors, self._radius_mm = errors, radius_mm
        self._aside_mm = ASIDE * radius_mm
        # Fissures are obstacles of the replan exactly where they are of the plan.
        whole = replace(plan.system, fissures_allowed=not plan.fissures_are_obstacles)
        share = procedure.least_margin_share
        self._systems = (whole,) if share == 1.0 else (whole, _with_margins(whole, share))
        self._replanners: dict[System, ScopeReplanner] = {}
        self._environments = {
            system: needle_environment(
                lung, system.needle, system.margins, with_fissures=plan.fissures_are_obstacles
            )
            for system in self._systems
            if system.needle is not None
        }

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
            found = self._from_scope(history, self._scope_measured(attempt, noise[0]))
            if found is None:
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

    def _scope_measured(self, attempt: Attempt, noise: Float) -> Float:
        """Return the scope's tip as measured: in the lumen, where it is known to be."""
        placing, true = self.procedure.scope, attempt.frame()
        measured = as_measured(true, placing.position_mm, placing.direction_deg, noise)
        shares = np.linspace(1.0, 0.0, SHARES)[:, None]
        points = true[:3, 3] + shares * (measured[:3, 3] - true[:3, 3])
        depths = self._lung.lumen_depth.lower_bound_mm(points)
        enough = min(self._plan.system.scope.radius_mm, float(depths[-1]))
        measured[:3, 3] = points[np.argmax(depths >= enough)]
        return measured

    def _chances(self, tip: Float, deployments: Deployments) -> Float:
        """Return how likely deployments from a scope tip `(1, 9)` as measured succeed, to first order."""
        plan, tips = self._plan, np.repeat(tip, deployments.count, axis=0)
        return Spread(
            self._lung, plan.system, tips, deployments, np.asarray(plan.target_lps), self.errors,
            self.procedure, self._radius_mm,
        ).chances  # fmt: skip

    def _from_scope(self, history: History, measured: Float) -> Plan | None:
        """Return the plan with tubes and needle from the scope's tip as measured, None if there is none."""
        plan = self._plan
        target = Target(lps_mm=np.asarray(plan.target_lps), origin=plan.target_origin)
        history.corrected_mm[SCOPE].append(self._miss_from(measured))
        rest = self._rest(history, SCOPE, self._from_scope_tip, measured, target)
        if rest is None:
            return None
        scope = replace(plan.scope, lps_from_scope_tip=rest.lps_from_measured)
        exemption = replace(plan.exemption, branch=rest.branch)
        tube = plan.tube if rest.tube is None else rest.tube
        return replace(plan, scope=scope, tube=tube, needle=rest.needle, exemption=exemption)

    def _from_scope_tip(self, system: System, measured: Float, target: Target) -> RestOfPlan:
        """Plan tubes and needle again, by direct arcs: what else could be searched is left to the needle."""
        if system not in self._replanners:
            task = self._task(system, target)
            self._replanners[system] = ScopeReplanner(task, searches=0, rank=self._chances)
        return self._replanners[system].replan(measured)

    def _from_tube_tip(self, system: System, measured: Float, target: Target) -> RestOfPlan:
        return replan_from_tube(
            self._lung, system, measured, target, objective=self._plan.objective, seed=self._plan.seed
        )

    def _task(self, system: System, target: Target) -> Task:
        objective = Objective.of(self._plan.objective)
        return Task(
            lung=self._lung, system=system, target=target, objective=objective, method="replan",
            seed=self._plan.seed,
        )  # fmt: skip

    def _rest(
        self, history: History, stage: str, replan: Callable[..., RestOfPlan], measured: Float, target: Target
    ) -> RestOfPlan | None:
        """Return the rest from a measured pose: to the target, else beside it; with all margins or fewer."""
        aims = [target, *self._aside(measured, target)] if stage == TUBE else [target]
        for system in self._systems:
            for aim in aims:
                try:
                    rest = replan(system, measured, aim)
                except (NoPlan, TargetError):
                    continue
                history.replans[stage].append(True)
                history.system = system
                return rest
        history.replans[stage].append(False)
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
        n_tube = len(pieces) - len(needle.arcs)
        # The needle is turned from outside: tubes that are turned too far do not take it along.
        rolled = float(pieces[n_tube, 1]) - needle.arcs[0].roll_rad - attempt.roll_rad(0)
        true_tip = end_of(attempt.frame(), pieces[:n_tube]) @ arc_transform(0.0, rolled, 0.0)
        path, tip = path_of(needle), np.asarray(needle.lps_from_start)
        target = self._target(attempt, noise[1])
        if stage.measured:
            tip = as_measured(true_tip, stage.position_mm, stage.direction_deg, noise[0])
            history.corrected_mm[TUBE].append(
                _miss(ArcPath(lps_from_start=tip, arcs=path.arcs), target.lps_mm)
            )
            rest = self._rest(history, TUBE, self._from_tube_tip, tip, target)
            if rest is None or rest.needle is None:
                return None
            path = path_of(rest.needle)
        if self.procedure.needle.closed_loop:
            arcs = self._steered(history, attempt, plan, path, true_tip, target, rng)
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
        found = attempt.target_lps + imaging.position_mm * noise[:3]
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
        target: Target,
        rng: np.random.Generator,
    ) -> Float:
        """Return the arcs `(A, 3)` of a needle that is measured and planned again on its way."""
        steering = self.procedure.needle
        start = np.asarray(path.lps_from_start)
        query = Query(lps_from_start=start, target=target.lps_mm, branch=plan.exemption.branch)
        truth = SteeredTruth(attempt, target.lps_mm, steering.position_mm, steering.direction_deg, rng)
        environment = self._environments[history.system or self._systems[0]]
        needle, belief = TrueNeedle(truth, true_tip, 0.0), Belief(query, steering.gain)
        replanner = _FrugalReplanner(
            environment, query, path, settings=ReplanSettings(largest_miss_mm=min(self._aside_mm, 10.0))
        )
        replans, stopped = steer(
            environment,
            truth,
            needle,
            belief,
            path,
            replanner,
            branch=query.branch,
            step_mm=steering.measure_every_mm,
            measure_every_mm=steering.measure_every_mm,
        )
        history.replans[NEEDLE] += [each.path is not None for each in replans]
        history.stopped = stopped is not None
        arcs = np.array(needle.arcs).reshape(-1, 3)
        return with_stop(arcs, float(attempt.errors.stop_mm[0, 0])) if len(arcs) else arcs


class _FrugalReplanner(Replanner):
    """Aims the plan that is left again, and searches only where that finds no path."""

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
