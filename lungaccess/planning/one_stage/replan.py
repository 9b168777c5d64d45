"""Plan the rest from a measured pose: tubes and needle from a scope's tip, or a needle from a tube's tip."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.base.errors import FrameError, TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.one_stage.from_scope import SEARCHED, TRIES, ScopeReplanner
from lungaccess.planning.one_stage.needle import needle_question
from lungaccess.planning.one_stage.obstruction import reason_in_words
from lungaccess.planning.one_stage.rest import RestOfPlan
from lungaccess.plans.candidate import with_tool_in_place
from lungaccess.plans.evaluator import TOO_LITTLE
from lungaccess.plans.kernels.tissue import taken_at
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.tissue import wanted_of
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from stages.needle import (
    DEFAULT,
    Objective,
    OptimalSearch,
    easiest_obstruction,
    find_obstruction,
    map_integral,
    violation,
)

SKEW = 0.02
"""A measured rotation may be off by so much, about a degree; it is replaced by the nearest rotation."""
NEEDLE_ITERATIONS = 1500
"""Iterations of the needle's search from a measured tip, as in a replan during insertion."""


def replan_from_scope(
    lung: Lung,
    system: System,
    lps_from_scope_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    tries: int = TRIES,
    searches: int = SEARCHED,
) -> RestOfPlan:
    """Plan tubes and needle from where the tip of the scope really is.

    With a tool the needle goes on until the tool is at the target, and takes enough of the nodule.  The
    deployments from this one pose are enumerated as in an atlas, as far as the target lies in the
    needle's workspace; the cheapest clear direct arc is the first answer, or what the needle's own search
    finds, and a local search improves it.  Without a needle the tubes are aimed at the target.  The same
    input and seed give the same answer.

    Args:
        lps_from_scope_tip ((4, 4) float64): The pose as measured: +z forward, +x the way a positive bend
            turns the tip, up in the picture.
        tries: Variations of rotation, insertions and needle that improve the first answer; 0 for a faster
            one.
        searches: Deployments from which the needle's own search starts where no direct arc is clear.

    Raises:
        NoPlan: If there is none; counts the reasons.
        FrameError: If the pose is not one, within SKEW.
        TargetError: If pose or target lie outside the images, or the target in an obstacle.
    """
    frame = measured_pose(lung, lps_from_scope_tip, "scope")
    task = _task(lung, system, target, objective, seed)
    return ScopeReplanner(task, tries=tries, searches=searches).replan(frame)


def replan_from_tube(
    lung: Lung,
    system: System,
    lps_from_tip: ArrayLike,
    target: Target,
    *,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    iterations: int = NEEDLE_ITERATIONS,
) -> RestOfPlan:
    """Plan the needle from where the tip of the tubes really is; see `replan_from_scope`.

    SettingsError is raised if the system has no needle: then nothing is left to plan.

    A tip near an airway is taken to have pierced its wall, as `plan_needle` does.

    Args:
        lps_from_tip ((4, 4) float64): The pose as measured; +z is the direction of insertion.
        iterations: Of the needle's search, which begins with the direct arc.
    """
    frame = measured_pose(lung, lps_from_tip, "tube")
    task = _task(lung, system, target, objective, seed)
    asked = needle_question(lung, system, frame, target.lps_mm)
    blocked = find_obstruction(asked.environment, asked.query)
    path = None
    if blocked is None or not blocked.proved:
        weighed = task.objective if lung.cost is not None else task.objective.without_map
        search = OptimalSearch(asked.environment, asked.query, seed=seed, objective=weighed)
        while search.iterations < iterations:
            before = search.iterations
            search.advance(iterations - before)
            if search.iterations == before:
                break
        path = search.path
    if path is not None:
        path = with_tool_in_place(system, path)
        last = path.frames()[-1]
        query = replace(asked.query, target=last[:3, 3]) if system.tool is not None else asked.query
        proved = math.isfinite(map_integral(lung.cost, path)) and not violation(
            asked.environment, query, path
        )
        path = path if proved else None
    wanted = None if system.tool is None else wanted_of(lung, target.lps_mm, system.tool)
    if path is not None and wanted is not None and taken_at(wanted, last) < wanted.least:
        raise NoPlan("No needle path from the tube's tip as measured", reasons={f"needle: {TOO_LITTLE}": 1})
    if path is None:
        blocked = blocked or easiest_obstruction(asked.environment, asked.query)
        why = "the search found no clear path" if blocked is None else reason_in_words(blocked)
        raise NoPlan(f"No needle path from the tube's tip as measured: {why}", reasons={f"needle: {why}": 1})
    return RestOfPlan(
        task=task, lps_from_measured=frame, deployment=None, path=path, branch=asked.query.branch
    )


def _task(lung: Lung, system: System, target: Target, objective: str | Objective, seed: int) -> Task:
    weighed = objective_of(lung, objective)
    return Task(lung=lung, system=system, target=target, objective=weighed, method="replan", seed=seed)


def measured_pose(lung: Lung, pose: ArrayLike, what: str) -> Float:
    """Return the nearest rigid pose `(4, 4)` to a measured one, LPS mm; `what` device it is of, for messages.

    Raises:
        FrameError: If it is not a rigid pose within SKEW.
        TargetError: If it lies outside the images.
    """
    matrix = np.array(pose, dtype=np.float64)
    good = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all())
    turn = matrix[:3, :3] if good else np.zeros((3, 3))
    left, _sizes, right = np.linalg.svd(turn)
    nearest = left @ right
    if not good or np.linalg.det(turn) <= 0.0 or np.abs(nearest - turn).max() > SKEW:
        raise FrameError(
            f"The measured pose of the {what}'s tip is not a rigid pose",
            expected=f"a 4x4 matrix with a right-handed rotation (off by at most {SKEW:g}) and mm",
            remedy="Check that the matrix is neither transposed, scaled nor mirrored",
        )
    if not lung.grid.contains(matrix[:3, 3]).all():
        raise TargetError(
            f"The {what}'s tip as measured lies outside the images, at LPS {matrix[:3, 3].round(1).tolist()}",
            expected="a pose inside the lung",
            remedy="Check the frame of its numbers, RAS or LPS, and the registration",
        )
    return poses.pose(matrix[:3, 3], nearest[:, 2], nearest[:, 0])
