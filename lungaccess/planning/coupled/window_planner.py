"""Plan for a window of the breath: clear and on target in given phases, or in as many as possible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from anatomy.motion.motion import require_phase
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.coupled.planner import Limits, ProgressEvent, atlas_event, drive
from lungaccess.planning.coupled.search.window_search import WindowSearch
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim
from lungaccess.problem.system import System, require_own_name
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from lungaccess.uncertainty.breathing.window import breathing_window, require_motion
from stages.needle import DEFAULT, Objective

METHOD = "window"
"""What the method of such plans is called."""


def plan_for_window(
    lung: Lung,
    system: System,
    target: Target,
    phases: tuple[float, float] | None = None,
    *,
    widest: bool | None = None,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    iterations: int | None = None,
    time_s: float | None = None,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> Iterator[Plan]:
    """Plan all stages for a window of the breath; yield each plan that is better than the one before.

    The needle ends at an aim that depends on where the scope's tip is: so that the moving target stays within
    2 mm of it.  A plan states aim and window; in the masks' phase it may end beside the target.

    Parameters
    ----------
    lung : Lung
        With a motion.
    phases : tuple of 2 floats, optional
        First and last phase, from 0 (end-exhale) to 1 (end-inhale), in all of which a plan has to be proved.
    widest : bool, optional
        Whether the widest window is wanted before the least cost: without phases, if None.
    objective : str or Objective
        What is made small among equally wide windows; see `lungaccess.plan`.
    seed, iterations, time_s, atlas, counterfactuals, on_progress
        As for `lungaccess.plan`.

    Raises
    ------
    AnatomyError
        If the patient has no motion.
    NoPlan
        If the search ends without a plan; says which phase and which structure stop it.
    SettingsError
        If the phases are not two of 0 to 1 in order, neither phases nor the widest window is asked for, the
        system has no needle, or the atlas belongs to another lung or system.
    TargetError
        If the target lies outside the lung or inside an obstacle.
    """
    system.require_needle("Planning for a window of the breath")
    require_own_name(system)
    require_motion(lung)
    asked = None if phases is None else require_phases(*phases)
    widest = asked is None if widest is None else widest
    if asked is None and not widest:
        raise SettingsError(
            "A plan for a window is asked for without one",
            expected="phases, or the widest window",
            remedy="Give phases=(0.0, 0.3), or widest=True",
        )
    tell = on_progress or (lambda _event: None)
    if atlas is not None:
        require_same(atlas, lung, system)
    atlas = atlas or build_atlas(lung, system, progress=lambda share: tell(atlas_event(share)))
    weighed = objective_of(lung, objective)
    task = Task(lung=lung, system=system, target=target, objective=weighed, method=METHOD, seed=seed)
    search = WindowSearch(task, atlas, asked, widest=widest)

    def made(candidate: Candidate, iteration: int, elapsed_s: float) -> Plan:
        timing = {"planning_s": elapsed_s, "atlas_s": atlas.build_s}
        return with_aim(assemble(task, candidate, iteration=iteration, timing=timing), lung, asked)

    def no_plan(iteration: int) -> NoPlan:
        from lungaccess.planning.coupled.explanation import explain
        from lungaccess.planning.coupled.window_explanation import explain_window

        stopped = explain_window(search, iteration)
        if stopped is not None:
            return stopped
        return explain(task, atlas, search.blocked, iteration, counterfactuals=counterfactuals)

    return drive(search.steps(), Limits.of(iterations, time_s), tell, made, no_plan)


def with_aim(plan: Plan, lung: Lung, phases: tuple[float, float] | None) -> Plan:
    """Return a plan that was made for a window with where its needle ends as its aim, and its window."""
    asked = np.array([] if phases is None else [phases]).reshape(-1, 2)
    end = plan.end_lps if plan.needle is None else plan.needle.end_lps
    aimed = replace(plan, aim=BreathingAim(point_lps=end, phases=asked))
    return replace(aimed, window=breathing_window(aimed, lung))


def require_phases(first: float, last: float) -> tuple[float, float]:
    """Return two phases, or raise SettingsError unless they are two of 0 to 1 in order."""
    if not require_phase(first) < require_phase(last):
        raise SettingsError(
            f"The phases are {first:g} to {last:g}",
            expected="the first before the last",
            remedy="Write 0.0:0.3 for the first 30 % of the breath from end-exhale",
        )
    return float(first), float(last)
