"""Go on with a search in several processes, repeatable from the seed."""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.errors import SettingsError
from lungaccess.searches import AtlasSearch, Step

ROUND_ITERATIONS = 50
"""Iterations of one process before the best of all is shared."""
JOINT_ROUND = 8
"""Every so many rounds the first process refines the best candidate by a nonlinear program instead."""

_forked: dict[str, AtlasSearch] = {}
"""The search that forked processes find: so lung and atlas are shared and not copied."""


def parallel_steps(search: AtlasSearch, processes: int) -> Iterator[Step]:
    """Search forever in several processes; the caller stops.

    Direct arcs come first.  Then rounds: each process varies the best candidate, with random numbers of its
    own that depend on the seed, the round and its number, and the best of all goes into the next round.  So
    the same seed, number of processes and iterations give the same plans, whatever the machine's load.

    Raises
    ------
    SettingsError
        If there are fewer than two processes, or this system cannot fork.
    """
    if processes < 2 or "fork" not in multiprocessing.get_all_start_methods():
        raise SettingsError(
            f"{processes} processes are asked for",
            expected="at least 2, on a system that can fork processes",
            remedy="Search in one process",
        )
    best: Step | None = None
    for step in search.direct_steps():
        if step.candidate is not None:
            best = step
        yield step
    _forked["search"] = search
    try:
        with multiprocessing.get_context("fork").Pool(processes) as pool:
            number = 0
            while True:
                tasks = [(number, process, best) for process in range(processes)]
                found = [step for step in pool.starmap(_varied, tasks) if step is not None]
                number += 1
                iteration = number * processes * ROUND_ITERATIONS
                better = min(found, key=lambda step: step.cost, default=None)
                if better is not None and (best is None or better.cost < best.cost):
                    best = replace(better, iteration=iteration)
                    yield best
                else:
                    yield Step(iteration=iteration, phase="refinement")
    finally:
        _forked.clear()


def _varied(number: int, process: int, best: Step | None) -> Step | None:
    """Vary the best candidate in one process; return a better step, if one is found."""
    search = _forked["search"]
    search.seed_with(np.random.Generator(np.random.PCG64([search.task.seed, number, process])))
    if best is not None and process == 0 and number % JOINT_ROUND == JOINT_ROUND - 1:
        refined = search.refined(number, best)
        return refined if refined.candidate is not None else None
    found: Step | None = None
    for iteration in range(1, ROUND_ITERATIONS + 1):
        step = search.vary(iteration, found or best)
        limit = math.inf if best is None else best.cost
        if step.candidate is not None and step.cost < (limit if found is None else found.cost):
            found = step
    return found
