"""A run of the needle stage alone, from a start pose that came with the patient."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.planning.one_stage import plan_needle
from lungaccess.problem.target import point_target
from lungaccess.running.study.answers import EXACT, NO_PLAN, PATH, TIMEOUT, Answer, Improvement
from lungaccess.running.study.runs import Run
from stages.needle import OMPL_TOLERANCE_MM, Query, violation


def needle_answer(run: Run, lung: Lung) -> Answer:
    """Search for a needle path and let `stages.needle.violations.violation` look at it.

    Raises
    ------
    SettingsError
        If the patient came with no such start pose.
    TargetError
        If the target is not in free lung tissue.
    """
    problem = run.problem
    if not 1 <= problem.start <= len(lung.starts):
        raise SettingsError(
            f"There is no start pose {problem.start}",
            expected=f"1 to {len(lung.starts)}",
            remedy="Correct `starts` in the study's file",
        )
    pose = lung.starts[problem.start - 1]
    target = point_target(lung, np.array(problem.target_lps), origin=problem.origin)
    found = plan_needle(
        lung,
        problem.system,
        pose,
        target,
        planner=run.planner.method,
        objective=problem.objective,
        seed=run.seed,
        iterations=run.iterations,
        time_s=problem.time_s,
    )
    if found.path is None:
        return Answer(key=run.key, outcome=NO_PLAN, status=TIMEOUT, message=found.outcome)
    record = found.record()
    first_s = record["path"].pop("first_path_s")
    costs = record["path"]["costs"]
    text = json.dumps(record, sort_keys=True)
    query = Query(lps_from_start=pose, target=target.lps_mm, branch=found.branch)
    tolerance_mm = OMPL_TOLERANCE_MM if run.planner.is_of_ompl else found.environment.goal_tolerance_mm
    why = violation(found.environment, query, found.path, goal_tolerance_mm=tolerance_mm)
    return Answer(
        key=run.key,
        outcome=PATH,
        status=EXACT,
        message=why,
        accepted=not why,
        costs=costs,
        improvements=(Improvement(time_s=first_s, iteration=0, cost=costs[problem.objective]),),
        plan=text,
        digest=hashlib.sha256(text.encode()).hexdigest(),
    )
