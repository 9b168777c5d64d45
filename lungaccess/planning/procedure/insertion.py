"""Insert the needle of a plan many times: blindly, and planned again by what a tracker sees."""

import math
from collections.abc import Iterable
from enum import StrEnum
from typing import Any

import numpy as np

from anatomy import poses
from anatomy.base.records import frozen_record
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.procedure import truth
from lungaccess.plans import curves
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import NeedleSteering
from lungaccess.uncertainty.risk import RiskAssessor, Share
from lungaccess.uncertainty.risk.deviations import deviated_pieces
from lungaccess.uncertainty.risk.patient_errors import model_for
from stages.needle import (
    ArcPath,
    Failure,
    NeedleEnvironment,
    Objective,
    Query,
    Replan,
    Replanner,
    ReplanSettings,
    needle_environment,
)

RATE_HZ, SPEED_MM_PER_S, LATENCY_S = 20.0, 2.0, 0.1
WATCHED = NeedleSteering(
    closed_loop=True, measure_every_mm=SPEED_MM_PER_S / RATE_HZ, replan_every_mm=2.0, position_mm=0.5,
    direction_deg=0.6, target_mm=0.5, latency_mm=LATENCY_S * SPEED_MM_PER_S,
)  # fmt: skip
"""An electromagnetic tracker and a slow insertion [assumption]."""
SAMPLES = 50
"""A share of one half is then known to 14 %."""
ITERATIONS = 300
"""Of a replan: more made no difference in simulated insertions."""
TOLERANCE_MM = 2.0
SHOWN_STEP_MM = 0.5


class Outcome(StrEnum):
    """How an insertion ended."""

    REACHED = "reached"
    MISSED = "missed"
    HIT = "hit an obstacle"
    NO_PATH = "no path left"
    OUT_OF_LENGTH = "out of length"


@frozen_record
class Insertion:
    """What happened to one needle.

    Args:
        lps_from_tip ((N, 4, 4) float64): Where the tip really was, the start first.
        inserted_mm ((N,) float64): Length of needle at each of these poses.
        touched: Names of the forbidden structures that tubes or needle touch.
        target_lps, tip_error_mm: Where the target really is, LPS mm, and how far from it the tip ended.
        factor: True curvature over the commanded one.
        believed_factor: What is believed of it in the end; nan of a needle that nobody watched.
    """

    lps_from_tip: Float
    inserted_mm: Float
    outcome: Outcome
    touched: tuple[str, ...]
    target_lps: Float
    tip_error_mm: float
    factor: float
    believed_factor: float = math.nan
    replans: tuple[Replan, ...] = ()


@frozen_record
class Summary:
    """What became of many insertions, with the share that reached the target."""

    insertions: tuple[Insertion, ...]
    reached: Share

    @staticmethod
    def of(insertions: Iterable[Insertion]) -> "Summary":
        """Count what became of at least one insertion."""
        runs = tuple(insertions)
        reached = sum(run.outcome is Outcome.REACHED for run in runs)
        return Summary(insertions=runs, reached=Share(count=reached, samples=len(runs)))

    @property
    def tip_errors_mm(self) -> Float:
        """Of each insertion, wherever it ended."""
        return np.array([run.tip_error_mm for run in self.insertions])

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        runs, errors = self.insertions, self.tip_errors_mm
        hits = [name for run in runs for name in run.touched]
        replans = [each for run in runs for each in run.replans]
        return {
            "reached": self.reached.to_mapping(),
            "outcomes": {str(each): sum(run.outcome is each for run in runs) for each in Outcome},
            "hits": {name: hits.count(name) for name in sorted(set(hits))},
            "tip_error_median_mm": float(np.median(errors)),
            "tip_error_95_mm": float(np.quantile(errors, 0.95)),
            "replans": len(replans),
            "replans_without_path": sum(each.path is None for each in replans),
            "tip_errors_mm": errors.tolist(),
        }


@frozen_record
class InsertionStudy:
    """What came of the same needles, inserted blindly and with the tracker.

    The errors are of needle and target alone.  A tip that ends no farther than `tolerance_mm` from the target
    has reached it.
    """

    steering: NeedleSteering
    errors: ErrorModel
    seed: int
    tolerance_mm: float
    query: Query
    path: ArcPath
    open_loop: Summary
    closed_loop: Summary

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        watched = self.closed_loop.insertions
        return {
            "tracker": to_mapping(self.steering),
            "errors": to_mapping(self.errors),
            "samples": len(watched),
            "seed": self.seed,
            "tolerance_mm": self.tolerance_mm,
            "open_loop": self.open_loop.to_mapping(),
            "closed_loop": self.closed_loop.to_mapping(),
            "curvature_factors": [run.factor for run in watched],
            "believed_factors": [run.believed_factor for run in watched],
        }


def insert_plan(
    plan: Plan,
    lung: Lung,
    steering: NeedleSteering = WATCHED,
    *,
    errors: ErrorModel | None = None,
    believed: ErrorModel | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
    tolerance_mm: float = TOLERANCE_MM,
) -> InsertionStudy:
    """Insert the needle of a plan many times, blindly and planned again by what a tracker sees.

    The same needles go to the same targets in both ways, drawn as `lungaccess.uncertainty.risk.assess` draws
    them, and judged by its kernel.  Scope and tubes stand as planned: their errors belong to
    `lungaccess.simulate_procedure`.

    Args:
        errors: The preset `breath-hold` if None; only what concerns needle and target counts.
        believed: What the errors are taken to be when measurements are weighed, if that is something else.

    Raises:
        PlanFileError: If the plan was made for another patient.
        SettingsError: If the plan has no needle, or a number is out of its range.
    """
    plan.system.require_needle("A simulated insertion")
    model = model_for(errors or load_errors(), plan, lung)
    inserter = _Inserter(plan, lung, steering, model, believed or model, tolerance_mm)
    open_loop, closed_loop = inserter.open_and_closed_loop(samples, seed)
    return InsertionStudy(
        steering=steering, errors=inserter.errors, seed=seed, tolerance_mm=tolerance_mm, query=inserter.query,
        path=inserter.path, open_loop=open_loop, closed_loop=closed_loop,
    )  # fmt: skip


class _Inserter:
    """Inserts the needle of one plan, and looks at what came of it."""

    def __init__(
        self,
        plan: Plan,
        lung: Lung,
        steering: NeedleSteering,
        errors: ErrorModel,
        believed: ErrorModel,
        tolerance_mm: float,
    ) -> None:
        self.plan, self.steering = plan, steering
        self.errors = ErrorModel(
            name=errors.name, description=errors.description, needle_curvature=errors.needle_curvature,
            needle_roll=errors.needle_roll, needle_insertion=errors.needle_insertion,
            target_position=errors.target_position, breathing=errors.breathing,
            vessel_border=errors.vessel_border,
        )  # fmt: skip
        # The needle begins where the plan has it, which is known.
        self._unknown = truth.unknown_of(believed, steering, np.zeros((6, 6)))
        self._assessor = RiskAssessor(plan, lung, radius_mm=tolerance_mm)
        needle = plan.system.require_needle("A simulated insertion")
        self._environment: NeedleEnvironment = needle_environment(
            lung, needle, plan.system.margins, with_fissures=plan.fissures_are_obstacles
        )
        start = np.asarray(plan.tube.lps_from_tip)
        self.path = ArcPath(lps_from_start=start, arcs=curves.needle_pieces(plan.needle))
        self.query = Query(
            lps_from_start=start, target=np.asarray(plan.end_lps), branch=plan.exemption.branch
        )

    def open_and_closed_loop(self, samples: int, seed: int) -> tuple[Summary, Summary]:
        """Insert needles blindly, and the same ones with the tracker."""
        plan, n_arcs = self.plan, len(self.path.arcs)
        errors = self._assessor.draws(samples, seed, n_arcs=truth.ARCS).deviations(self.errors)
        pieces = deviated_pieces(plan, truth.fitted_to(n_arcs, errors))
        tubes, needles = pieces[:, :-n_arcs], pieces[:, -n_arcs:]
        # Tubes that are turned too far do not take the needle along, which is turned from outside.
        rolled = needles[:, 0, 1] - self.path.arcs[0, 1] - errors.roll_rad[:, 0]
        ends = truth.ends_of(np.tile(np.asarray(plan.scope.lps_from_scope_tip), (samples, 1, 1)), tubes)
        tips = truth.turned_about(ends, rolled)
        blind, watched = [], []
        for n in range(samples):
            own = truth.rows_of(errors, np.array([n]))
            attempt = truth.Attempt(errors=own, target_lps=self.query.target + errors.target_mm[n])
            blind.append(self._checked(attempt, tubes[n], needles[n], ends[n], None))
            found = self._watched(attempt, tips[n], (seed, n))
            arcs = np.array(found.arcs)
            arcs[:1, 1] += rolled[n]
            (needle,) = truth.as_pieces(arcs[None], plan.system.track_radius_mm)
            watched.append(self._checked(attempt, tubes[n], needle, ends[n], found))
        return Summary.of(blind), Summary.of(watched)

    def _watched(self, attempt: truth.Attempt, tip: Float, luck: tuple[int, int]) -> truth.Steered:
        """Insert the needle with the tracker; `luck` is the seed and the number of the needle."""
        replanner = Replanner(
            self._environment, self.query, self.path, objective=Objective.of(self.plan.objective),
            settings=ReplanSettings(largest_miss_mm=min(self._assessor.radius_mm, 10.0)),
            iterations=ITERATIONS, seed=luck[1],
        )  # fmt: skip
        # Stream of the tracker's noise, beyond those of the kinds of error.
        rng = np.random.default_rng(np.random.SeedSequence(luck[0], spawn_key=(1000, luck[1])))
        return truth.insert_needle(
            self._environment, self.query, self.path, replanner, attempt, tip, self.steering, self._unknown,
            rng,
        )  # fmt: skip

    def _checked(
        self, attempt: truth.Attempt, tubes: Float, needle: Float, end: Float, steered: truth.Steered | None
    ) -> Insertion:
        """Return what true arcs have come to; `end` is the frame behind those of the tubes."""
        frame = np.asarray(self.plan.scope.lps_from_scope_tip)
        start = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])
        chain = np.concatenate([tubes, needle])
        moved = (attempt.target_lps - self.query.target)[None]
        border_mm = attempt.errors.border_mm
        flags = int(self._assessor.follow(start[None], chain[None], len(tubes), moved, border_mm).touched[0])
        touched = tuple(name for name in self._assessor.forbidden if flags & self._assessor.structures[name])
        frames, lengths = poses.poses_on_pieces(end, needle[:, :3], SHOWN_STEP_MM)
        error = float(np.linalg.norm(frames[-1][:3, 3] - attempt.target_lps))
        stopped = None if steered is None else steered.stopped
        outcome = Outcome.MISSED if stopped is None else Outcome.NO_PATH
        outcome = Outcome.OUT_OF_LENGTH if stopped is Failure.OUT_OF_LENGTH else outcome
        if touched or error <= self._assessor.radius_mm:
            outcome = Outcome.HIT if touched else Outcome.REACHED
        return Insertion(
            lps_from_tip=frames, inserted_mm=lengths, outcome=outcome, touched=touched,
            target_lps=attempt.target_lps, tip_error_mm=error, factor=float(attempt.errors.factor[0]),
            believed_factor=math.nan if steered is None else steered.factor,
            replans=() if steered is None else steered.replans,
        )  # fmt: skip
