"""Make one run: in this process, or in one of its own with `python -m lungaccess.running.study.one_run`.

That command reads a pickled run from standard input and writes its pickled answer to standard output.
"""

import contextlib
import hashlib
import json
import pickle
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Unpack

import numba
import numpy as np
import psutil

from anatomy.base.child_process import end_with_parent
from anatomy.base.errors import AnatomyError, LungaccessError, PlanFileError, SettingsError, TargetError
from anatomy.lung import Lung
from lungaccess.judging.checking import Checker
from lungaccess.planning.coupled.atlas import Atlas, AtlasGrid, open_atlas
from lungaccess.planning.one_stage import plan_needle
from lungaccess.planning.one_system import run as plan
from lungaccess.planning.success.estimate import FRESH_SEED, chance_of, estimate_success
from lungaccess.planning.success.ratings import MEASURED, OPEN_LOOP
from lungaccess.plans.chance import Chance
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target
from lungaccess.running.study import runs
from lungaccess.running.study.settings import StudyError
from stages.needle import OMPL_TOLERANCE_MM, Query, violation

KEPT_PATIENTS = 2
"""Runs come case by case, so that a worker needs the last patient and sometimes the next."""
FIRST_CPU, SEARCH_CPU = "first_plan_cpu_s", "search_cpu_s"
"""A stored plan says both in its `timing`: processor time to the first plan, and of the whole search."""
ANSWERS = (AnatomyError, PlanFileError, SettingsError, TargetError)
"""Errors that the run would end with on any machine, at any time."""

_one_at_a_time = threading.Lock()


def answer(run: runs.Run, cache: Path | None = None) -> runs.Answer:
    """Make a run and return what it ended with.

    FileError is raised if a file cannot be read or written here; whatever else is not the run's own answer is
    raised, too.
    """
    if run.planner.own_process or run.planner.is_of_ompl:
        return _in_own_process(run, cache)
    return _here(run, cache)


def prepare(problem: runs.Problem, cache: Path | None = None) -> None:
    """Make sure that the cache has the patient and the atlas of a problem, unless its device allows none.

    LungaccessError is raised if the patient cannot be read or the cache cannot be written.
    """
    with _one_at_a_time:
        numba.set_num_threads(1)
        _opened(problem.patient, cache)
        with contextlib.suppress(*ANSWERS):
            _atlas_of(problem, cache)


def _here(run: runs.Run, cache: Path | None) -> runs.Answer:
    with _one_at_a_time:
        numba.set_num_threads(1)
        return _answered(run, _opened(run.problem.patient, cache), cache)


def _answered(run: runs.Run, opened: tuple[Lung, Checker], cache: Path | None) -> runs.Answer:
    began, cpu_began = time.perf_counter(), time.process_time()
    try:
        atlas = _atlas_of(run.problem, cache) if run.planner.kind == "plan" else None
        # The atlas belongs to the device and the patient, and its time to no run.
        began, cpu_began = time.perf_counter(), time.process_time()
        made = needle_answer(run, opened[0]) if atlas is None else _plan_answer(run, *opened, atlas)
    except NoPlan as failure:
        made = runs.Answer(
            key=run.key,
            outcome=runs.NO_PLAN,
            status=runs.TIMEOUT,
            message=failure.found,
            advice=failure.advice,
            rejections=dict(failure.reasons),
        )
    except ANSWERS as error:
        status = runs.INVALID_GOAL if isinstance(error, TargetError) else runs.UNKNOWN
        made = runs.Answer(key=run.key, outcome=type(error).__name__, status=status, message=str(error))
    return replace(
        made,
        time_s=time.perf_counter() - began,
        cpu_s=time.process_time() - cpu_began,
        memory_mb=psutil.Process().memory_info().rss / 2.0**20,
    )


def _plan_answer(run: runs.Run, lung: Lung, checker: Checker, atlas: Atlas) -> runs.Answer:
    """Search for plans and let the best be checked."""
    problem, best = run.problem, None
    improvements: list[runs.Improvement] = []
    target = point_target(lung, np.array(problem.target_lps), origin=problem.origin)
    began, first_s = time.process_time(), 0.0
    planner = run.planner
    request = Request.of(
        lung, problem.system, target, goal=planner.goal or problem.objective, errors=problem.errors,
        procedure=problem.procedure, method=planner.method, needle_planner=planner.needle_planner,
        seed=run.seed, iterations=run.iterations, time_s=problem.time_s,
    )  # fmt: skip
    for best in plan(request, atlas=atlas, counterfactuals=not planner.without_counterfactuals):
        loss = request.goal.loss(best)
        # The last plan has the cost of the best, and a simpler motion of the scope.
        if np.isfinite(loss) and (not improvements or loss < improvements[-1].cost):
            improvements.append(
                runs.Improvement(time_s=best.timing["planning_s"], iteration=best.iterations, cost=loss)
            )
        first_s = first_s or time.process_time() - began
        if problem.first_plan:
            break
    if best is None:
        raise NoPlan("The search ended without a plan", reasons={})
    spent = {FIRST_CPU: first_s, SEARCH_CPU: time.process_time() - began}
    best = replace(best, chance=_chance(run, best, lung), timing={**best.timing, **spent})
    report = checker.check(best, problem.system, target_lps=target.lps_mm)
    return runs.Answer(
        key=run.key,
        outcome=runs.PLAN,
        status=runs.EXACT,
        iterations=best.iterations,
        accepted=report.accepted,
        costs=dict(best.costs),
        improvements=tuple(improvements),
        findings=tuple(each.to_mapping() for each in report.findings),
        plan=best.to_json(),
        digest=best.digest,
    )


def _chance(run: runs.Run, found: Plan, lung: Lung) -> Chance | None:
    """Return the chance of success of a plan on draws that no search saw, the same for all planners."""
    errors, procedure = run.problem.errors, run.problem.procedure
    if errors is None:
        return None
    samples = (OPEN_LOOP if procedure.is_open_loop else MEASURED).fresh
    if found.chance is not None and found.chance.samples == samples:
        return found.chance
    seed = run.seed + FRESH_SEED
    return chance_of(
        estimate_success(found, lung, errors=errors, procedure=procedure, samples=samples, seed=seed)
    )


@lru_cache(maxsize=KEPT_PATIENTS)
def _opened(patient: runs.Patient, cache: Path | None) -> tuple[Lung, Checker]:
    lung = runs.open_patient(patient, cache)
    return lung, Checker(lung)


def _atlas_of(problem: runs.Problem, cache: Path | None) -> Atlas:
    grid = {name: getattr(problem, name) for name in AtlasGrid.__annotations__}
    return _atlas(problem.patient, problem.system, cache, **grid)


@lru_cache(maxsize=KEPT_PATIENTS)
def _atlas(patient: runs.Patient, system: System, cache: Path | None, **grid: Unpack[AtlasGrid]) -> Atlas:
    return open_atlas(_opened(patient, cache)[0], system, cache=cache, **grid)


def _in_own_process(run: runs.Run, cache: Path | None) -> runs.Answer:
    """Make a run in a fresh process, as a library with one seed a process needs."""
    words = [sys.executable, "-m", "lungaccess.running.study.one_run", *([str(cache)] if cache else [])]
    done = subprocess.run(words, input=pickle.dumps(run), capture_output=True)
    if done.returncode != 0:
        raise StudyError(
            f"The process of a run ended with code {done.returncode}: "
            f"{done.stderr.decode(errors='replace').strip()[-500:]}",
            expected="a process that ends with 0",
            remedy="Start the study again; it goes on from what is stored",
        )
    made: runs.Answer = pickle.loads(done.stdout)
    return made


def main(words: list[str]) -> int:
    """Make the run on standard input; an error goes to standard error."""
    end_with_parent()
    try:
        made = _here(pickle.load(sys.stdin.buffer), Path(words[0]) if words else None)
    except LungaccessError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.buffer.write(pickle.dumps(made))
    return 0


def needle_answer(run: runs.Run, lung: Lung) -> runs.Answer:
    """Search for a needle path and let `stages.needle.path.violation` look at it.

    Raises:
        SettingsError: If the patient came with no such start pose.
        TargetError: If the target is not in free lung tissue.
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
        return runs.Answer(key=run.key, outcome=runs.NO_PLAN, status=runs.TIMEOUT, message=found.outcome)
    record = found.record()
    first_s = record["path"].pop("first_path_s")
    costs = record["path"]["costs"]
    text = json.dumps(record, sort_keys=True)
    query = Query(lps_from_start=pose, target=target.lps_mm, branch=found.branch)
    tolerance_mm = OMPL_TOLERANCE_MM if run.planner.is_of_ompl else found.environment.goal_tolerance_mm
    why = violation(found.environment, query, found.path, goal_tolerance_mm=tolerance_mm)
    return runs.Answer(
        key=run.key,
        outcome=runs.PATH,
        status=runs.EXACT,
        message=why,
        accepted=not why,
        costs=costs,
        improvements=(runs.Improvement(time_s=first_s, iteration=0, cost=costs[problem.objective]),),
        plan=text,
        digest=hashlib.sha256(text.encode()).hexdigest(),
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
