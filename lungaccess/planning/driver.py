"""The driver of all searches, whatever the goal and the constraints, within the limits of a request."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import TargetError
from anatomy.base.kernel_clock import working_cpu_s, working_s
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float, Int
from anatomy.base.words import percent
from lungaccess.planning.coupled.atlas import Atlas, atlas_part
from lungaccess.plans.insertion import with_simplest_motion
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request, StatedPlace
from stages.tube import exit_points

TIP_WITHIN_MM = 1.5
"""How near a scope tip is to a stated one: tips of the atlas are 1 mm apart along the airway."""


def holds(request: Request, plan: Plan) -> bool:
    """Tell whether a plan keeps the place, the chance of a fissure and the phases that are asked for."""
    place = request.place
    if place is not None and float(np.linalg.norm(place_of(plan, place) - place.lps_mm)) > place.within_mm:
        return False
    most = plan.system.max_fissure_chance
    if most is not None and (plan.fissure_chance is None or plan.fissure_chance > most):
        return False
    return request.phases is None or (plan.window is not None and plan.window.holds_all(request.phases))


def place_of(plan: Plan, place: StatedPlace) -> Float:
    """Return where a plan has what is stated, `(3,)` LPS mm."""
    if place.kind == "exit":
        return np.asarray(plan.tube.exit.point_lps)
    return np.asarray(plan.scope.lps_from_scope_tip)[:3, 3]


def place_part(request: Request, atlas: Atlas) -> Atlas:
    """Return the part of an atlas that goes through the stated place; TargetError says how far any is."""
    place = request.place
    if place is None:
        return atlas
    return _of_tips(atlas, place) if place.kind == "scope tip" else _of_exits(atlas, place)


def tips_near(atlas: Atlas, tip_lps: ArrayLike) -> Int:
    """Return the scope tips of an atlas near a point, by their numbers `(N,)`: one place, all directions."""
    away = np.linalg.norm(atlas.motions.tips[:, :3] - np.asarray(tip_lps), axis=1)
    return np.flatnonzero(away <= TIP_WITHIN_MM)


def _of_tips(atlas: Atlas, place: StatedPlace) -> Atlas:
    distances = np.linalg.norm(atlas.motions.tips[:, :3] - place.lps_mm, axis=1)
    tips = np.flatnonzero(distances <= place.within_mm)
    if not len(tips):
        nearest = f"the nearest is {distances.min():.1f} mm away" if len(distances) else "there is none"
        raise TargetError(
            f"No tip of the scope of {atlas.system.name} is within {place.within_mm:g} mm of the stated "
            f"place: {nearest}",
            expected="a point of the airway that the scope reaches",
            remedy="Move it along the airway, or allow a larger distance",
        )
    return atlas_part(atlas, np.flatnonzero(np.isin(atlas.deployments.site, tips)))


def _of_exits(atlas: Atlas, place: StatedPlace) -> Atlas:
    """Return an atlas of the deployments alone that leave the lumen near a point."""
    away = np.linalg.norm(atlas.motions.tips[atlas.deployments.site, :3] - place.lps_mm, axis=1)
    # A tube is no shorter than the straight line to its exit, so the others cannot come near.
    near = np.flatnonzero(away <= atlas.deployments.exit_mm + place.within_mm)
    points = exit_points(atlas.system.tubes, atlas.motions.tips, atlas.deployments, near)
    distances = np.linalg.norm(points - place.lps_mm, axis=1)
    chosen = near[distances <= place.within_mm]
    if not len(chosen):
        nearest = f"the nearest leaves it {distances.min():.1f} mm away" if len(near) else "none comes near"
        raise TargetError(
            f"No deployment of {atlas.system.name} leaves the airway within {place.within_mm:g} mm of the "
            f"exit: {nearest}",
            expected="a point of an airway wall that the tubes can pierce",
            remedy="Move the exit along the airway, or allow a larger distance",
        )
    return atlas_part(atlas, chosen)


PROGRESS_EVERY_S = 0.1
"""Time between two progress reports: a display looks smooth, and the reports cost no time worth mention."""


@frozen_value
class ProgressEvent:
    """The progress of a search; its time is without that of the atlas, and a message replaces the phase.

    `best_cost` is what is left to improve of the best plan, see `Goal.loss`; None without one.
    """

    iteration: int
    elapsed_s: float
    best_cost: float | None
    phase: str
    message: str = ""


@frozen_record
class Turn:
    """One step of a finder: its iteration is 0 for what comes before the iterations.

    `make` returns a plan that is better than all before, of the planning time in seconds.
    """

    iteration: int
    phase: str
    message: str = ""
    make: Callable[[float], Plan] | None = None


class Finder(Protocol):
    """What the driver drives: it finds better and better plans of one request."""

    def turns(self) -> Iterator[Turn]:
        """Search until the caller stops, or all is tried; the same request gives the same turns."""

    def is_met(self, best: Plan, iteration: int) -> bool:
        """Tell whether the best plan is good enough to stop."""

    def last(self, best: Plan, iteration: int, elapsed_s: float) -> Plan | None:
        """Return what comes at the end, after the best plan; None for nothing."""

    def no_plan(self, iteration: int) -> NoPlan:
        """Return what is raised after so many iterations without a plan."""


def atlas_event(share: float) -> ProgressEvent:
    """Return the progress event of an atlas of which a share is made."""
    return ProgressEvent(
        iteration=0,
        elapsed_s=0.0,
        best_cost=None,
        phase="atlas",
        message=f"deployment atlas, {percent(share)} of the scope tips",
    )


def drive(finder: Finder, request: Request, tell: Callable[[ProgressEvent], None]) -> Iterator[Plan]:
    """Drive a finder within the limits of a request; yield the plans that keep its constraints.

    The last one is the best, whose scope comes to its tip by the simplest motion that is found.
    """
    clock, limits = Clock(), request.limits
    best: Plan | None = None
    loss: float | None = None
    iteration = beside = 0
    for turn in finder.turns():
        if limits.iterations is not None and turn.iteration > limits.iterations:
            break
        iteration = turn.iteration
        if turn.make is not None:
            made = turn.make(clock.elapsed_s)
            if holds(request, made):
                best, loss = made, request.goal.loss(made)
                yield best
            else:
                beside += 1
        if best is not None and finder.is_met(best, iteration):
            break
        if limits.are_reached(iteration, clock.elapsed_s, clock.cpu_s, best is not None):
            break
        if clock.due():
            known = loss if loss is not None and math.isfinite(loss) else None
            tell(
                ProgressEvent(
                    iteration=iteration, elapsed_s=clock.elapsed_s, best_cost=known, phase=turn.phase,
                    message=turn.message,
                )
            )  # fmt: skip
    if best is None:
        raise no_plan_beside(request) if beside else finder.no_plan(iteration)
    simplest = with_simplest_motion(finder.last(best, iteration, clock.elapsed_s) or best, request.lung)
    if simplest is not best:
        yield replace(simplest, timing={**simplest.timing, "planning_s": clock.elapsed_s})


def no_plan_beside(request: Request) -> NoPlan:
    """Return why there is no plan where all that were found miss a constraint."""
    place = request.place
    if place is None and request.phases is None:
        return NoPlan(
            "Every plan that was found crosses a fissure with more chance than is allowed",
            reasons={"fissure: every plan found crosses it with more chance": 1},
            advice="Allow a greater --fissure-chance",
        )
    if place is None:
        return NoPlan(
            "Every plan that was found leaves the phases of the breath that are asked for",
            reasons={"window: every plan found has another one": 1},
            advice="Leave out --method, or ask for fewer phases",
        )
    does = "leaves the airway" if place.kind == "exit" else "has its scope tip"
    return NoPlan(
        f"No plan was found that {does} within {place.within_mm:g} mm of the stated {place.kind}",
        reasons={f"{place.kind}: every plan found {does} elsewhere": 1},
        advice=f"Allow a larger distance, or move the {place.kind}",
    )


class Clock:
    """Measures planning time, in which kernels are neither compiled nor loaded.

    Time in which the caller holds a yielded plan counts too.
    """

    def __init__(self) -> None:
        self._began, self._cpu_began = working_s(), working_cpu_s()
        self._reported = self._began

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return working_s() - self._began

    @property
    def cpu_s(self) -> float:
        """Seconds of this process's processor time since the start."""
        return working_cpu_s() - self._cpu_began

    def due(self) -> bool:
        """Tell whether the next progress report is due, and start counting anew if so."""
        now = working_s()
        if now - self._reported < PROGRESS_EVERY_S:
            return False
        self._reported = now
        return True
