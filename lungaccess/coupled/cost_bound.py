"""A proved lower bound of the cost of every plan to a target; docs/explanation/cost_bound.md derives it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from anatomy.errors import SettingsError
from anatomy.structures import AIRWAY
from anatomy.typed import Float
from lungaccess.coupled.atlas import Atlas
from lungaccess.coupled.cost_to_go import cost_to_go
from lungaccess.coupled.kernels.box_queue import ENDED, MOST_BOXES, WAITING, begin_queue, divide
from lungaccess.coupled.kernels.cost_bound import BoundEnvironment
from lungaccess.coupled.kernels.deployment_box import (
    BOUND,
    BOX_COLUMNS,
    INNER,
    OUTER,
    ROTATION,
    TIP,
    TubeSurroundings,
)
from lungaccess.coupled.search.atlas_search import AtlasSearch
from lungaccess.coupled.search.base import Step, evaluated_step
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.tube import tube_constants, tube_environment
from stages.tube.kernels import INSERTION_STEP_MM, MAX_EXTENSION, greatest_insertions

BOXES_A_STEP = 250
"""Boxes that are divided in one step of a search, which takes some ten milliseconds."""
BOXES_A_TIP = 2
"""A scope tip is begun with instead of dividing so many boxes."""
TRIED_A_STEP = 4
"""Deployments that are tried in one step, in the middle of boxes: less than a millisecond."""
INSERTION_SPACING_MM = 0.01
"""Spacing of the insertions that are tried for the greatest one."""


class CostBound:
    """Bounds from below what plans to a target cost, better and better.

    The bound holds for every deployment from a scope tip of the atlas, with any rotation and any insertions
    of the tubes, and for every path of the needle from there to the target.  Of other scope tips, which the
    planner tries along the motions between those of the atlas, it says nothing.

    Parameters
    ----------
    task : Task
    atlas : Atlas
    most_boxes : int
        Boxes that may wait.

    Raises
    ------
    SettingsError
        If the tubes are not planar, there is no needle, or it is longer than half a circle of its greatest
        curvature.
    """

    def __init__(self, task: Task, atlas: Atlas, *, most_boxes: int = MOST_BOXES) -> None:
        system = task.system
        needle = system.require_needle("A lower bound of the cost")
        system.tubes.require_planar("A lower bound of the cost")
        if needle.max_length_mm * needle.max_curvature_per_mm > math.pi:
            raise SettingsError(
                f"The needle is {needle.max_length_mm:g} mm long and bends to a radius of "
                f"{1.0 / needle.max_curvature_per_mm:g} mm",
                expected="a needle no longer than half a circle, so that its paths lie near a straight line",
                remedy="Leave out the gap",
            )
        self._most_boxes = most_boxes
        self._task = task
        self._environment: BoundEnvironment | None = None
        self._tubes = tube_constants(system.tubes, system.margins)
        self._longest = float(self._tubes[MAX_EXTENSION])
        self._insertions = np.zeros(0)
        self._tips = np.ascontiguousarray(atlas.motions.tips[:, None, :])
        self._rates = np.zeros((len(self._tips), 2))
        x, y, z = task.target.lps_mm.tolist()
        self._target = (x, y, z)
        self._state: tuple[np.ndarray, ...] | None = None
        self._begun = 0
        self._left_out = math.inf
        self.settled = False
        """Whether it rises no more."""

    @property
    def value(self) -> float:
        """The bound: 0 before it has begun."""
        if self._state is None or self._begun < len(self._tips):
            return 0.0
        boxes, heap, _unused, numbers = self._state
        lowest = float(boxes[heap[0], BOUND]) if numbers[WAITING] else math.inf
        return min(lowest, self._left_out)

    def improve(self, cost: float, boxes: int) -> float:
        """Divide so many boxes, and return the bound.

        Parameters
        ----------
        cost : float
            That of a plan: deployments that cost as much need not be told apart.  The first calls only begin
            with the boxes of some scope tips each.
        """
        if self.settled:
            return self.value
        self._left_out = min(self._left_out, cost)
        if self._begun < len(self._tips):
            self._begin(cost, max(boxes // BOXES_A_TIP, 1))
            return self.value
        outcome, _divided = divide(
            self._environment, self._tubes, self._insertions, self._tips, self._rates, self._target,
            boxes, cost, self._state,
        )  # fmt: skip
        self.settled = outcome != ENDED
        return self.value

    def lowest(self, count: int) -> list[tuple[int, float, float, float]]:
        """Return scope tip, rotation (rad) and insertions (mm) in the middle of some of the lowest boxes."""
        if self._state is None:
            return []
        boxes, heap, _unused, numbers = self._state
        rows = boxes[heap[: min(count, int(numbers[WAITING]))]]
        inner = rows[:, INNER]
        columns = rows[:, TIP], rows[:, ROTATION], np.clip(rows[:, OUTER], 0.0, inner), inner
        return [(int(tip), *rest) for tip, *rest in zip(*(each.tolist() for each in columns), strict=True)]

    def _begin(self, cost: float, tips: int) -> None:
        if self._state is None:
            self._environment = _environment(self._task, self._tips[:, 0], cost)
            self._insertions = np.zeros(int(self._longest / INSERTION_STEP_MM) + 1)
            greatest_insertions(self._tubes, self._longest, INSERTION_SPACING_MM, self._insertions)
            most = self._most_boxes
            places = np.zeros(most, dtype=np.int64)
            numbers = np.zeros(2, dtype=np.int64)
            self._state = (np.zeros((most, BOX_COLUMNS)), places, np.zeros_like(places), numbers)
        first, last = self._begun, min(self._begun + tips, len(self._tips))
        room = begin_queue(
            self._environment, self._tubes, self._insertions, self._tips, self._rates, self._target,
            float(self._insertions.max()), cost, first, last, self._state,
        )  # fmt: skip
        self._begun = last
        if not room:
            self._left_out, self.settled = 0.0, True


def guided(search: AtlasSearch, steps: Iterator[Step], bound: CostBound) -> Iterator[Step]:
    """Yield the steps of a search, and cheaper plans from the boxes with the lowest bound.

    Each of those becomes the search's best candidate, which it then improves.  Who takes the steps improves
    the bound.
    """
    for step in steps:
        yield step
        if bound.settled or search.incumbent.step is None:
            continue
        for tip, rotation, outer, inner in bound.lowest(TRIED_A_STEP):
            candidate = search.evaluator.direct(search.atlas.motions.tip(tip), rotation, outer, inner)
            found = evaluated_step(search.evaluator, "lower bound", candidate, step.iteration)
            if found.cost < search.incumbent.cost:
                yield search.incumbent.improved(found)


class GapGoal:
    """The goal that a plan costs at most so much more than the best possible, proved.

    Parameters
    ----------
    bound : CostBound
    gap : float
        Share of the best possible cost.

    Raises
    ------
    SettingsError
        If the gap is negative or not finite.
    """

    def __init__(self, bound: CostBound, gap: float) -> None:
        if not 0.0 <= gap < math.inf:
            raise SettingsError(
                f"The gap is {gap}", expected="a share of 0 or more", remedy="State 0.05 for five per cent"
            )
        self.bound, self._gap = bound, gap

    def is_met(self, cost: float) -> bool:
        """Improve the bound, and tell whether a plan of this cost is so near to the best possible."""
        return cost <= (1.0 + self._gap) * self.bound.improve(cost, BOXES_A_STEP)


def _environment(task: Task, tips: Float, limit: float) -> BoundEnvironment:
    lung = task.lung
    evaluator = CandidateEvaluator(task)
    limits, objective = evaluator.environment.limits, evaluator.needle_arrays.objective
    tubes = tube_environment(lung, with_fissures=task.with_fissures)
    weights = objective.inverse_clearance, objective.length
    x, y, z = task.target.lps_mm.tolist()
    togo = cost_to_go(tubes.field, tubes.geometry, limits, weights, (x, y, z), tips[:, :3], limit)
    return BoundEnvironment(
        obstacles=tubes.field,
        geometry=tubes.geometry,
        surroundings=TubeSurroundings(
            clearance=tubes.field,
            labels=tubes.labels,
            geometry=tubes.geometry,
            depth=tubes.lumen,
            depth_geometry=tubes.lumen_geometry,
            bits=tubes.bits,
            hazard_bits=tubes.bits & ~AIRWAY,
            mediastinal=tubes.mediastinal,
        ),
        kappa=limits.kappa,
        max_length_mm=limits.max_length_mm,
        goal_tolerance_mm=limits.goal_tolerance_mm,
        per_clearance=objective.inverse_clearance,
        per_mm=objective.length,
        required_mm=limits.required_mm,
        exempt_mm=limits.exempt_mm,
        togo=togo,
    )
