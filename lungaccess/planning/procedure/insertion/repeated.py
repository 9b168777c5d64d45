"""Insertions of one needle many times, in open and in closed loop: how often they reach the target."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from lungaccess.planning.procedure.insertion.simulation import Insertion, Outcome, simulate
from lungaccess.planning.procedure.insertion.truth import Errors
from lungaccess.uncertainty.risk import Share
from stages.needle import ArcPath, NeedleEnvironment, Query


@frozen_record
class Summary:
    """What became of many insertions.

    Parameters
    ----------
    insertions : tuple of Insertion
    outcomes : dict
        How often each outcome came.
    reached_share, reached_low, reached_high : float
        Share that reached the target, and its 95 % interval [Wilson1927].
    median_error_mm, error_95_mm : float
        Median and 95 % quantile of the tip error, over all insertions wherever they ended.
    clearance_mm : float
        Smallest of all.
    """

    insertions: tuple[Insertion, ...]
    outcomes: dict[Outcome, int]
    reached_share: float
    reached_low: float
    reached_high: float
    median_error_mm: float
    error_95_mm: float
    clearance_mm: float


@frozen_record
class Study:
    """The same needles in open and in closed loop."""

    open_loop: Summary
    closed_loop: Summary


def study(
    environment: NeedleEnvironment,
    query: Query,
    plan: ArcPath,
    errors: Errors,
    *,
    seeds: Iterable[int],
    **settings: Any,
) -> Study:
    """Insert one needle for each seed, in open and in closed loop.

    Parameters are those of `simulate`, to which the settings go.

    Raises
    ------
    SettingsError
        If there is no seed, and as `simulate`.
    """
    chosen = tuple(seeds)

    def insertions(closed_loop: bool) -> Iterator[Insertion]:
        for seed in chosen:
            yield simulate(environment, query, plan, errors, closed_loop=closed_loop, seed=seed, **settings)

    return Study(open_loop=summary(insertions(False)), closed_loop=summary(insertions(True)))


def summary(insertions: Iterable[Insertion]) -> Summary:
    """Count outcomes and errors.

    Raises
    ------
    SettingsError
        If there is no insertion.
    """
    runs = tuple(insertions)
    if not runs:
        raise SettingsError("A study has no insertions", expected="at least one seed")
    outcomes = {outcome: sum(run.outcome is outcome for run in runs) for outcome in Outcome}
    errors = np.array([run.tip_error_mm for run in runs])
    low, high = Share(count=outcomes[Outcome.REACHED], samples=len(runs)).interval
    return Summary(
        insertions=runs,
        outcomes=outcomes,
        reached_share=outcomes[Outcome.REACHED] / len(runs),
        reached_low=low,
        reached_high=high,
        median_error_mm=float(np.median(errors)),
        error_95_mm=float(np.quantile(errors, 0.95)),
        clearance_mm=min(run.clearance_mm for run in runs),
    )
