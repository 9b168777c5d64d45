"""Runs of needle planners on recorded queries: when each had which path, and what is wrong with it."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Any

from experiments.support.needle.queries import Query, Validator
from stages.needle import path as needle_query
from stages.needle.environment import NeedleEnvironment
from stages.needle.search.base import RestartingRRT
from stages.needle.search.decision import Decision
from stages.needle.search.planners import MakeSearch
from stages.needle.search.resolution import Resolution, ResolutionSearch

MARKS_S = (0.01, 0.1, 1.0)
SLICE = 200
UNIT = Resolution(fine_mm=1.0, fine_rolls=16)

Problem = tuple[Query, NeedleEnvironment, Validator]


def asked(query: Query) -> needle_query.Query:
    """Return a recorded query as the needle stage takes it."""
    return needle_query.Query(lps_from_start=query.lps_from_start, target=query.target_lps)


def run(
    make: MakeSearch,
    environment: NeedleEnvironment,
    query: Query,
    seed: int,
    time_s: float,
    validator: Validator,
) -> dict[str, Any]:
    """Run one planner for some CPU time; return when it had which length, and its paths' faults."""
    began = time.process_time()
    search = make(environment, asked(query), seed)
    first: float | None = None
    history: list[tuple[float, float]] = []
    faults: list[str] = []
    paths = 0
    while not search.finished and (spent := time.process_time() - began) < time_s:
        if search.advance(SLICE) and search.path is not None:
            spent = time.process_time() - began
            first = spent if first is None else first
            history.append((spent, search.path.length_mm + validator.miss_mm(search.path)))
            aside = time.process_time()
            faults += validator.faults(search.path)
            paths += 1
            began += time.process_time() - aside
    return {
        "first_s": first,
        "length_mm": min((length for _, length in history), default=None),
        "paths": paths,
        "faults": faults,
    }


def decide(
    environment: NeedleEnvironment, query: Query, seed: int, time_s: float, validator: Validator
) -> dict[str, Any]:
    """Decide a query: a path, a proof that there is none, exhausted at a resolution, or undecided."""
    began = time.process_time()
    decision = Decision(environment, asked(query), seed=seed)
    while decision.outcome == "running" and time.process_time() - began < time_s:
        decision.advance(SLICE)
    found = {"outcome": decision.outcome, "s": time.process_time() - began, "faults": []}
    if decision.path is not None:
        found["faults"] = validator.faults(decision.path)
    elif decision.outcome != "no path":
        began = time.process_time()
        search = ResolutionSearch(environment, asked(query), resolution=UNIT)
        while not search.finished and time.process_time() - began < time_s:
            search.advance(SLICE)
        exhausted = search.finished and search.path is None
        found["outcome"] = "exhausted at resolution" if exhausted else "undecided"
    return found


def best_valid_mm(query: Query) -> float:
    """Return the length of the other planner's best path that passes a strict check, and its miss."""
    valid = [
        run["best_length_mm"] + run["check"]["goal_err_mm"]
        for run in query.runs
        if run.get("solved") and run.get("check", {}).get("clearance_valid_strict")
    ]
    return min(valid, default=math.inf)


def solved_by_other(query: Query) -> bool:
    """Tell whether any recorded run solved the query."""
    return any(run.get("solved") for run in query.runs)


def recheck(problems: list[Problem], wanted: int) -> tuple[int, Counter[str]]:
    """Plan many paths with many seeds; return how many, and the faults found."""
    count, faults, seed = 0, Counter[str](), 0
    while count < wanted and problems:
        seed += 1
        for query, environment, validator in problems:
            search = RestartingRRT(environment, asked(query), seed=seed)
            for _ in range(3):
                if search.advance(5000) and search.path is not None:
                    faults.update(validator.faults(search.path))
                    count += 1
            if count >= wanted:
                break
        if seed > 20 and count == 0:
            break
    return count, faults
