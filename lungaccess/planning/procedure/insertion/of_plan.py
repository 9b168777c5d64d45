"""Insert the needle of a plan many times, watched by a tracker of given noise, rate and latency."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import quantity, settings, to_mapping
from anatomy.lung import Lung
from lungaccess.planning.procedure.insertion.repeated import Study, Summary, study
from lungaccess.planning.procedure.insertion.simulation import Outcome
from lungaccess.planning.procedure.insertion.tracking import gain_for
from lungaccess.planning.procedure.insertion.truth import Errors, assumed_errors
from lungaccess.plans.curves import needle_pieces
from lungaccess.plans.plan import Plan
from stages.needle import ArcPath, NeedleEnvironment, Objective, Query, needle_environment

RATE_HZ, SPEED_MM_PER_S = 20.0, 2.0
SAMPLES = 50
"""A share of one half is then known to 14 %."""
ITERATIONS = 300
"""Of a replan: more made no difference in simulated insertions."""
STEP_MM = 0.5
"""Piece of needle within which the errors are constant, where measurements are not nearer."""


@settings
class TrackerModel:
    """A tracker, and the speed of the insertion that it watches; what is given here are assumptions.

    Parameters
    ----------
    position_mm, direction_deg : float
        Standard deviations of the tip, along each axis and about each of two axes.
    target_mm : float
        That of the target, along each axis.
    rate_hz, latency_s, lost_share : float
        Measurements a second, how old they are when they are used, and how many of them are lost.
    insertion_mm_per_s : float
        Speed of the insertion.
    replan_every_mm : float
        Least insertion between two replans.
    """

    position_mm: Annotated[float, quantity("noise of the tip", at_least=0.0, at_most=20.0)] = 0.4
    direction_deg: Annotated[float, quantity("noise of its direction", at_least=0.0, at_most=45.0)] = 0.6
    target_mm: Annotated[float, quantity("noise of the target", at_least=0.0, at_most=20.0)] = 0.4
    rate_hz: Annotated[float, quantity("measurements a second", above=0.0, at_most=1000.0)] = RATE_HZ
    latency_s: Annotated[float, quantity("age of a measurement", at_least=0.0, at_most=10.0)] = 0.1
    lost_share: Annotated[float, quantity("share that is lost", at_least=0.0, at_most=1.0)] = 0.0
    insertion_mm_per_s: Annotated[float, quantity("speed", above=0.0, at_most=100.0)] = SPEED_MM_PER_S
    replan_every_mm: Annotated[
        float, quantity("least insertion between two replans", at_least=0.0, at_most=500.0)
    ] = 2.0

    @property
    def every_mm(self) -> float:
        """Insertion between two measurements."""
        return self.insertion_mm_per_s / self.rate_hz

    def errors(self, size: float) -> Errors:
        """Return the errors of needle and target of a size, seen by this tracker."""
        return assumed_errors(
            size,
            position_noise_mm=self.position_mm,
            direction_noise_deg=self.direction_deg,
            target_noise_mm=self.target_mm,
            measure_every_mm=min(self.every_mm, 500.0),
            replan_every_mm=self.replan_every_mm,
            latency_mm=min(self.latency_s * self.insertion_mm_per_s, 100.0),
            lost_share=self.lost_share,
        )


@frozen_record
class InsertionStudy:
    """What came of the same needles, inserted blindly and with the tracker.

    Parameters
    ----------
    tracker : TrackerModel
    errors : Errors
    seed : int
        Of the first needle; the others count on from it.
    tolerance_mm : float
        A tip that ends no farther from the target has reached it.
    environment, query, path
        What was inserted, and where.
    made : Study
    """

    tracker: TrackerModel
    errors: Errors
    seed: int
    tolerance_mm: float
    environment: NeedleEnvironment
    query: Query
    path: ArcPath
    made: Study

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "tracker": to_mapping(self.tracker),
            "errors": to_mapping(self.errors),
            "samples": len(self.made.open_loop.insertions),
            "seed": self.seed,
            "tolerance_mm": self.tolerance_mm,
            "open_loop": _record(self.made.open_loop),
            "closed_loop": _record(self.made.closed_loop),
        }


def _record(found: Summary) -> dict[str, Any]:
    hits: dict[str, int] = {}
    for run in found.insertions:
        if run.outcome is Outcome.HIT:
            hits[run.structure] = hits.get(run.structure, 0) + 1
    replans = [each for run in found.insertions for each in run.replans]
    return {
        "reached": {
            "probability": found.reached_share,
            "interval_95": [found.reached_low, found.reached_high],
        },
        "outcomes": {str(outcome): count for outcome, count in found.outcomes.items()},
        "hits": dict(sorted(hits.items())),
        "tip_error_median_mm": found.median_error_mm,
        "tip_error_95_mm": found.error_95_mm,
        "least_clearance_mm": found.clearance_mm,
        "replans": len(replans),
        "replans_without_path": sum(each.path is None for each in replans),
        "tip_errors_mm": [run.tip_error_mm for run in found.insertions],
    }


def insert_plan(
    plan: Plan,
    lung: Lung,
    tracker: TrackerModel | None = None,
    *,
    size: float = 1.0,
    samples: int = SAMPLES,
    seed: int = 0,
    tolerance_mm: float = 2.0,
) -> InsertionStudy:
    """Insert the needle of a plan many times, blindly and planned again by what a tracker sees.

    The same seed is the same needle and the same motion of the target in both.  The needle starts where the
    plan has it: errors of scope and tubes are those of `lungaccess.simulate_procedure`.

    Parameters
    ----------
    tracker : TrackerModel, optional
        The default one if None.
    size : float
        Size of the errors of needle and target, see `assumed_errors`.
    samples, seed : int

    Raises
    ------
    PlanFileError
        If the plan was made for another patient.
    SettingsError
        If the plan has no needle, or a number is out of its range.
    """
    plan.require_lung(lung)
    needle = plan.system.require_needle("A simulated insertion")
    if samples < 1 or not 0.0 <= size <= 5.0:
        raise SettingsError(
            f"There are {samples} insertions with errors of size {size}",
            expected="at least 1 insertion, and a size from 0 to 5",
        )
    chosen = tracker or TrackerModel()
    errors = chosen.errors(size)
    environment = needle_environment(
        lung, needle, plan.system.margins, with_fissures=plan.fissures_are_obstacles
    )
    start = np.asarray(plan.tube.lps_from_tip)
    query = Query(lps_from_start=start, target=np.asarray(plan.end_lps), branch=plan.exemption.branch)
    path = ArcPath(lps_from_start=start, arcs=needle_pieces(plan.needle))
    made = study(
        environment, query, path, errors, seeds=range(seed, seed + samples),
        step_mm=min(STEP_MM, errors.measure_every_mm), tolerance_mm=tolerance_mm,
        gain=gain_for(chosen.position_mm, chosen.every_mm), objective=Objective.of(plan.objective),
        iterations=ITERATIONS,
    )  # fmt: skip
    return InsertionStudy(
        tracker=chosen, errors=errors, seed=seed, tolerance_mm=tolerance_mm, environment=environment,
        query=query, path=path, made=made,
    )  # fmt: skip
