"""The request: everything that is asked of the planner, as one thing.

Commands, studies, the explorer and Python make one, and one driver answers it
(`lungaccess.planning.driver`).  Goal and constraints compose: what cannot be is refused here, or where the
search is made, and only for a reason of physics or mathematics, which the error states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.base.words import did_you_mean
from lungaccess.problem.goals import REGISTERED, SUCCESS, WINDOW, Goal, PlanFunction, goals
from stages.needle import OMPL_PLANNERS, TERMS, Objective, require_planner

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from anatomy.organ import Organ
    from lungaccess.problem.errors import ErrorModel
    from lungaccess.problem.procedures import Procedure
    from lungaccess.problem.system import System
    from lungaccess.problem.target import Target
    from lungaccess.problem.task import Task

ATLAS = "atlas"
"""The method of whoever states none: the search over all that scope and tubes can do."""
MOST_PASSES = 8
"""Nobody reports more passes at one nodule: yield hardly grows after the sixth."""
AUTO = "auto"
"""Stands for all presets, of which the least invasive that reaches the target is chosen."""


@frozen_value
class Limits:
    """How long a search may take; None is no limit.

    Args:
        iterations: The only limit with which the same request gives the same plans.
        time_s, cpu_s: Seconds of the clock, and of this process's processor time; neither counts compiling
            kernels.
        first_plan_s: Seconds of the clock without a plan.
    """

    iterations: int | None = None
    time_s: float | None = None
    cpu_s: float | None = None
    first_plan_s: float | None = None

    def are_reached(self, iteration: int, elapsed_s: float, cpu_s: float, found: bool) -> bool:
        """Tell whether the search ends; never without a plan before the direct arcs have been tried."""
        time_s, most_cpu_s, first_s = (
            math.inf if each is None else each for each in (self.time_s, self.cpu_s, self.first_plan_s)
        )
        if not found:
            time_s = min(time_s, first_s)
        return (found or iteration > 0) and (elapsed_s > time_s or cpu_s > most_cpu_s)


@frozen_record
class StatedPlace:
    """A point (3,) that a plan passes so near: "exit", where the tubes leave the lumen, or "scope tip"."""

    kind: Literal["exit", "scope tip"]
    lps_mm: Float
    within_mm: float

    def __post_init__(self) -> None:
        if not 0.0 < self.within_mm < np.inf:
            raise SettingsError(
                f"The {self.kind} may be {self.within_mm} mm away", expected="a distance above 0"
            )


@frozen_record
class Request:
    """What is asked: a target in a lung, devices, a goal, constraints, and how to search.

    `Request.of` makes one from names and plain values.

    Args:
        systems: One, or several of which the least invasive that reaches the target is chosen.
        errors, procedure (optional): Under which success is counted; presets `breath-hold` and `measured-tip`
            if None.
        radius_mm: Radius within which a procedure has to end; see `lungaccess.uncertainty.risk.RiskAssessor`.
        passes: So many times at most the tool goes into the nodule, from one place of the scope.
        phases (tuple of 2 floats): Phases of the breath, 0 end-exhale to 1 end-inhale, in all of which the
            plan is proved.
        gap: The search ends once the cost is proved to be at most this share above the least.
        method, needle_planner: The searches for plans and for the needle's path; see
            `lungaccess.planning.driver.planners`.

    Raises:
        SettingsError: If a value is wrong, or goal and constraints exclude each other; says why.
        AnatomyError: If phases or a window are asked of a patient without a motion.
    """

    lung: Lung
    target: Target
    systems: tuple[System, ...]
    goal: Goal = SUCCESS
    errors: ErrorModel | None = None
    procedure: Procedure | None = None
    radius_mm: float | None = None
    passes: int = 1
    phases: tuple[float, float] | None = None
    place: StatedPlace | None = None
    gap: float | None = None
    method: str = ATLAS
    needle_planner: str = ""
    seed: int = 0
    processes: int = 1
    limits: Limits = Limits()

    @classmethod
    def of(
        cls,
        lung: Lung,
        system: System | str | Sequence[System | str],
        target: Target,
        *,
        goal: str | Goal | Objective | PlanFunction = SUCCESS,
        fissures_allowed: bool | None = None,
        least_clearance_mm: float = 0.0,
        max_fissure_chance: float | None = None,
        phases: Sequence[float] | None = None,
        iterations: int | None = None,
        time_s: float | None = None,
        cpu_s: float | None = None,
        first_plan_s: float | None = None,
        **others: Any,
    ) -> Request:
        """Return the request that plain values state; others are fields of `Request`.

        Args:
            system (System, str, or sequence of them): Devices, the name of a preset, the path of a file, or
                "auto" for all presets.
            fissures_allowed: Whether fissures may be crossed, instead of what the systems say.
            least_clearance_mm: Every axis in tissue keeps at least this distance from every obstacle.
            max_fissure_chance: Fissures may be crossed where the chance to do so is at most this.
        """
        return cls(
            lung=lung, target=target, goal=goal_of(goal, lung),
            systems=systems_of(system, fissures_allowed, least_clearance_mm, max_fissure_chance),
            phases=None if phases is None else require_phases(*phases),
            limits=Limits(iterations=iterations, time_s=time_s, cpu_s=cpu_s, first_plan_s=first_plan_s),
            **others,
        )  # fmt: skip

    @classmethod
    def by_cost(cls, task: Task, **others: Any) -> Request:
        """Return the request of a task: small costs, with other fields of `Request`."""
        return cls(
            lung=task.lung, target=task.target, systems=(task.system,), goal=Goal.of_costs(task.objective),
            seed=task.seed, **others,
        )  # fmt: skip

    def __post_init__(self) -> None:
        from lungaccess.problem.system import require_own_name

        for system in self.systems:
            require_own_name(system)
        if self.needle_planner:
            require_planner(self.needle_planner)
        if self.processes < 1:
            raise SettingsError(f"{self.processes} processes are asked for", expected="at least 1")
        if (self.phases is not None or self.goal is WINDOW) and self.lung.motion is None:
            raise AnatomyError(
                f"How {self.lung.name} breathes is not known, and a window of the breath is asked for",
                expected="a patient with a motion: [motion] in its patient.toml",
                remedy="Leave phases and window out, or state a motion; see docs/how_to/breathing.md",
            )
        if any(each.max_fissure_chance for each in self.systems) and self.lung.fissure_band is None:
            raise AnatomyError(
                f"Where the fissures of {self.lung.name} may lie is not known, and a chance is asked for",
                expected="a patient with fissure_band in its patient.toml, as `segment` writes it",
                remedy="Leave out the chance, or segment the CT again",
            )
        tools = [system.tool.name for system in self.systems if system.tool is not None]
        if self.is_for_window and tools:
            raise SettingsError(
                f"A window of the breath is asked for with the {tools[0]}",
                expected="no tool: a window promises where the tip is in moving tissue, not what it takes",
                remedy="Leave out the tool, or plan for success, which counts breathing",
            )
        if not 1 <= self.passes <= MOST_PASSES:
            raise SettingsError(f"{self.passes} passes are asked for", expected=f"1 to {MOST_PASSES}")
        if self.passes > 1 and (len(tools) < len(self.systems) or self.goal is not SUCCESS):
            raise SettingsError(
                f"{self.passes} passes are asked for without a tool, or with the goal {self.goal.name}",
                expected="a tool, which takes tissue in every pass, and the goal success: no cost says where "
                "another pass helps",
                remedy="Add --tool core, and leave out --goal",
            )
        if self.gap is not None and self.goal.objective is None:
            raise SettingsError(
                f"A gap is asked for with the goal {self.goal.name}: no bound of the best possible is known",
                expected="a gap with a cost",
                remedy="Leave out the gap, or choose a cost such as inverse-clearance",
            )
        if len({system.name for system in self.systems}) < len(self.systems):
            raise SettingsError("Two systems have the same name", expected="a name of its own for each")
        if len(self.systems) > 1 and self.needle_planner in OMPL_PLANNERS:
            raise SettingsError(
                f"{self.needle_planner} is to plan with {len(self.systems)} systems, one after the other",
                expected="one system: OMPL can be seeded once in a process",
                remedy="Name the system, or choose another needle planner",
            )

    @property
    def system(self) -> System:
        """The first system."""
        return self.systems[0]

    @property
    def is_for_window(self) -> bool:
        """Whether plans end at an aim for the moving target."""
        return self.phases is not None or self.goal is WINDOW

    @property
    def counts(self) -> bool:
        """Whether whole plans compete, by chance or by a function, and no cost."""
        return self.goal is SUCCESS or self.goal.is_function or (self.goal is WINDOW and self.method != ATLAS)

    @property
    def task(self) -> Task:
        """What a search by cost is asked with the first system; TargetError if the target is not free."""
        from lungaccess.problem.task import Task, objective_of

        named = self.goal.name if self.counts else WINDOW.name if self.is_for_window else self.method
        return Task(
            lung=self.lung, system=self.system, target=self.target,
            objective=self.goal.objective or objective_of(self.lung), method=named,
            needle_planner=self.needle_planner, seed=self.seed,
        )  # fmt: skip

    def with_system(self, system: System) -> Request:
        """Return the request for one system alone."""
        return replace(self, systems=(system,))


def register_goal(goal: Goal) -> Goal:
    """Make a goal known by its name, as packages do by entry points; SettingsError if the name is taken."""
    taken = {SUCCESS.name, WINDOW.name, *(name for term in TERMS for name in (term.key, term.option))}
    if goal.name in taken or not goal.name.isidentifier():
        raise SettingsError(
            f"A goal cannot be called {goal.name!r}",
            expected=f"a name of letters, digits and _, and none of {', '.join(sorted(taken))}",
        )
    REGISTERED[goal.name] = goal
    return goal


def goal_of(stated: str | Goal | Objective | PlanFunction, lung: Organ | None = None) -> Goal:
    """Return the goal that is stated: by its name, as costs, or as a function of plan and lung.

    Args:
        stated: A name of `goals`; a cost or a weighted sum of costs as `stages.needle.objective.Objective.of`
            reads them; or a function, which is made small and named as in the code.
        lung: The default cost weighs a cost map only where the patient has one.

    Raises:
        SettingsError: If there is no such goal.
    """
    if isinstance(stated, Goal):
        return stated
    if isinstance(stated, str) and stated in goals():
        return goals()[stated]
    if callable(stated):
        name = getattr(stated, "__name__", "function")
        name = name if name.isidentifier() else "function"
        return Goal(name=name, words=name.replace("_", " "), of=stated)
    from lungaccess.problem.task import objective_of

    try:
        weighed = Objective.of(stated) if lung is None else objective_of(lung, stated)
    except SettingsError as error:
        near = did_you_mean(str(stated), list(goals()))
        raise SettingsError(
            error.found, expected=f"{error.expected}; or {', '.join(goals())}", remedy=near or error.remedy
        ) from None
    return Goal.of_costs(weighed)


def systems_of(
    stated: System | str | Sequence[System | str],
    fissures_allowed: bool | None = None,
    least_clearance_mm: float = 0.0,
    max_fissure_chance: float | None = None,
) -> tuple[System, ...]:
    """Return the systems that are stated, the least invasive first; see `Request.of`."""
    from lungaccess.problem.preset_order import least_invasive_first, presets_by_invasiveness
    from lungaccess.problem.system import System, load_system, with_fissure_chance, with_fissure_rule

    if stated == AUTO:
        found = presets_by_invasiveness(fissures_allowed=fissures_allowed)
    else:
        several = [stated] if isinstance(stated, System | str) else list(stated)
        loaded = [load_system(each) if isinstance(each, str) else each for each in several]
        found = tuple(with_fissure_rule(each, fissures_allowed) for each in loaded)
    found = tuple(with_fissure_chance(each, max_fissure_chance) for each in found)
    kept = tuple(with_least_clearance(each, least_clearance_mm) for each in found)
    return kept if len(kept) == 1 else least_invasive_first(kept)


def with_least_clearance(system: System, least_clearance_mm: float) -> System:
    """Return a system of another name whose margins keep so far from obstacles, or a SettingsError."""
    thinnest = system.track_radius_mm if system.needle is None else system.needle.radius_mm
    more = least_clearance_mm - thinnest - system.margins.total_mm
    if not 0.0 <= least_clearance_mm < math.inf:
        raise SettingsError(
            f"The least clearance is {least_clearance_mm} mm", expected="a distance of 0 or more, in mm"
        )
    if more <= 0.0:
        return system
    return replace(
        system,
        name=f"{system.name} (at least {least_clearance_mm:g} mm from obstacles)",
        margins=replace(system.margins, registration_margin_mm=system.margins.registration_margin_mm + more),
    )


def require_phases(first: float, last: float) -> tuple[float, float]:
    """Return two phases, or raise SettingsError unless they are two of 0 to 1 in order."""
    from anatomy.motion.motion import require_phase

    if not require_phase(first) < require_phase(last):
        raise SettingsError(
            f"The phases are {first:g} to {last:g}",
            expected="the first before the last",
            remedy="Write 0.0:0.3 for the first 30 % of the breath from end-exhale",
        )
    return float(first), float(last)
