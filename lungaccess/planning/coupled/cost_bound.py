"""A proved lower bound of the cost of every plan to a target; docs/theory/cost_bound.md derives it."""

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float, UInt16
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.structures import AIRWAY
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.box_of_tubes import INNER, OUTER, ROTATION
from lungaccess.planning.coupled.kernels.box_queue import ENDED, MOST_BOXES, WAITING, begin_queue, divide
from lungaccess.planning.coupled.kernels.cost_bound import BoundEnvironment
from lungaccess.planning.coupled.kernels.cost_to_go import (
    LEVELS,
    MOST_UNITS,
    N_NUMBERS,
    CostToGo,
    end_shell,
    fill_shell,
)
from lungaccess.planning.coupled.kernels.deployment_box import BOUND, BOX_COLUMNS, TIP, TubeSurroundings
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle.kernels import Limits
from stages.tube import tube_constants, tube_environment
from stages.tube.kernels import INSERTION_STEP_MM, MAX_EXTENSION, TubeEnvironment, greatest_insertions

QUEUES = 2
"""Queues of boxes, each in a thread of its own: of every second scope tip.  More would be other plans."""


class CostBound:
    """Bounds from below what plans to a target cost, better and better.

    The bound holds for every deployment from a scope tip of the atlas, with any rotation and any insertions
    of the tubes, and for every path of the needle from there to the target.  Of other scope tips, which the
    planner tries along the motions between those of the atlas, it says nothing.  SettingsError is raised if
    the tubes are not planar, there is no needle, or it is longer than half a circle of its greatest
    curvature.

    Args:
        beside_mm: How far beside the target the needle may end.
    """

    def __init__(self, task: Task, atlas: Atlas, *, beside_mm: float = 0.0) -> None:
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
        self._beside_mm = beside_mm
        self._task = task
        self._tubes = tube_constants(system.tubes, system.margins)
        self._tips = atlas.motions.tips
        self.queues: list[_BoxQueue] = []
        """Once it has begun."""
        self._workers = ThreadPoolExecutor(QUEUES)
        self._running: list[Future[None]] = []
        self.known, self._left_out = 0.0, math.inf
        """The bound when the boxes were last divided to the end, while others may be divided now."""
        self.lowest: list[tuple[int, float, float, float]] = []
        """Scope tip, rotation (rad) and insertions (mm) in the middle of some of the lowest boxes then."""
        self.settled = False
        """Whether it rises no more."""

    @property
    def value(self) -> float:
        """The bound: 0 before it has begun."""
        self.finish()
        return self.known

    def start(self, cost: float, boxes: int) -> None:
        """Begin to divide so many boxes in other threads; `finish` waits for them.

        Deployments that cost as much as a plan, `cost`, need not be told apart.  The first calls only begin
        with the boxes of some scope tips each.
        """
        self.finish()
        if self.settled:
            return
        self._left_out = min(self._left_out, cost)
        if not self.queues:
            evaluator = CandidateEvaluator(self._task)
            limits, objective = evaluator.environment.limits, evaluator.needle_arrays.objective
            limits = limits._replace(goal_tolerance_mm=limits.goal_tolerance_mm + self._beside_mm)
            tubes = tube_environment(self._task.lung, with_fissures=self._task.with_fissures)
            weights, target = (objective.inverse_clearance, objective.length), self._task.target.lps_mm
            environment = bound_environment(tubes, limits, weights, target, self._tips, cost)
            insertions = np.zeros(int(self._tubes[MAX_EXTENSION] / INSERTION_STEP_MM) + 1)
            # Spacing of the insertions that are tried for the greatest one.
            greatest_insertions(self._tubes, self._tubes[MAX_EXTENSION], 0.01, insertions)
            x, y, z = target.tolist()
            for n in range(QUEUES):
                tips = np.ascontiguousarray(self._tips[n::QUEUES])
                about = (environment, self._tubes, insertions, tips, (x, y, z))
                self.queues.append(_BoxQueue(about, MOST_BOXES // QUEUES))
        self._running = [self._workers.submit(each.go_on, cost, boxes // QUEUES) for each in self.queues]

    def finish(self) -> None:
        """Wait until the boxes are divided that `start` has begun with."""
        if not self._running:
            return
        for each in self._running:
            each.result()
        self._running = []
        if any(not each.begun for each in self.queues):
            return
        least = min(self.queues, key=lambda each: each.value)
        self.known, self.settled = min(least.value, self._left_out), least.settled
        # Deployments that are tried in one step, in the middle of the lowest boxes: less than a millisecond.
        self.lowest = [
            (tip * QUEUES + n, rotation, outer, inner)
            for n, each in enumerate(self.queues)
            for tip, rotation, outer, inner in each.lowest(2)
        ]


class _BoxQueue:
    """The boxes of some scope tips, the lowest first.

    Args:
        about: What `begin_queue` and `divide` take first: environment, tubes, insertions, tips and target.
    """

    def __init__(self, about: tuple[Any, ...], most_boxes: int) -> None:
        self.about = about
        self._longest, self._tips = float(about[2].max()), len(about[3])
        places, numbers = np.zeros(most_boxes, dtype=np.int64), np.zeros(2, dtype=np.int64)
        self._state = (np.zeros((most_boxes, BOX_COLUMNS)), places, np.zeros_like(places), numbers)
        self._next_tip = 0
        self._room = True
        self.settled = False
        """Whether its bound rises no more."""

    @property
    def begun(self) -> bool:
        """Whether boxes of all scope tips wait."""
        return self.settled or self._next_tip == self._tips

    @property
    def value(self) -> float:
        """The least bound of the boxes that wait; inf if none does."""
        boxes, heap, _unused, numbers = self._state
        if not self._room:
            return 0.0
        return float(boxes[heap[0], BOUND]) if numbers[WAITING] else math.inf

    def go_on(self, cost: float, boxes: int) -> None:
        """Divide so many boxes, or let those of some scope tips wait."""
        if self.settled:
            return
        if self.begun:
            outcome, _divided = divide(*self.about, boxes, cost, self._state)
            self.settled = outcome != ENDED
            return
        first = self._next_tip
        # A scope tip is begun with instead of dividing so many boxes.
        self._next_tip = min(first + max(boxes // 2, 1), self._tips)
        self._room = begin_queue(*self.about, self._longest, cost, first, self._next_tip, self._state)
        self.settled = not self._room

    def lowest(self, count: int) -> list[tuple[int, float, float, float]]:
        """Return scope tip, rotation (rad) and insertions (mm) in the middle of some of the lowest boxes."""
        boxes, heap, _unused, numbers = self._state
        rows = boxes[heap[: min(count, int(numbers[WAITING]))]]
        inner = rows[:, INNER]
        columns = rows[:, TIP], rows[:, ROTATION], np.clip(rows[:, OUTER], 0.0, inner), inner
        return [(int(tip), *rest) for tip, *rest in zip(*(each.tolist() for each in columns), strict=True)]


def bound_environment(
    tubes: TubeEnvironment,
    limits: Limits,
    weights: tuple[float, float],
    target_lps: Float,
    tips: Float,
    limit: float,
) -> BoundEnvironment:
    """Return what the bounds look at from scope tips (S, 9), LPS mm.

    The weights are those of a path's integral of 1 / clearance and of its length; `limit` is a cost that no
    path need be told to exceed.
    """
    x, y, z = target_lps.tolist()
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
        per_clearance=weights[0],
        per_mm=weights[1],
        required_mm=limits.required_mm,
        exempt_mm=limits.exempt_mm,
        togo=cost_to_go(tubes.field, tubes.geometry, limits, weights, (x, y, z), tips[:, :3], limit),
    )


SHELL_MM = 1.5
"""From shell to shell."""
HALF_WIDTH = 0.8
"""The window in the plane of directions reaches so far: 77 degrees from the middle."""
THREADS = 2
"""Threads that fill a shell; their number changes nothing."""


def cost_to_go(
    field: UInt16,
    geometry: Float,
    limits: Limits,
    weights: tuple[float, float],
    target_lps: tuple[float, float, float],
    places: Float,
    limit: float,
) -> CostToGo:
    """Return lower bounds of what paths to a target (LPS mm) still cost, in a corner field of all obstacles.

    Args:
        limits: Of a needle no longer than half a circle of its greatest curvature.
        weights (tuple of 2 float): Of the integral of 1 / clearance, and of the length in mm.
        places ((N, 3) float64): Where needles start, about; LPS mm.  The window looks at those that are near.
        limit: Costs above are not told apart.
    """
    kappa = limits.kappa
    # Cells are by this wider than the directions of paths change from a shell to the next near the target.
    cell = 0.25 * kappa * SHELL_MM * 1.1
    cells = 2 * int(HALF_WIDTH / cell) + 1
    shells = int(min(limits.max_length_mm, 1.9 / kappa) / SHELL_MM)
    away = places - np.asarray(target_lps)
    axis = (away / np.maximum((away**2).sum(axis=1, keepdims=True), 1.0) ** 1.5).sum(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-300)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    levels = []
    side = cells
    for _ in range(LEVELS):
        levels.append(np.zeros((shells + 1, side, side), dtype=np.uint16))
        side = (side + 1) // 2
    clearest = float(field.max()) / UNITS_PER_MM + math.sqrt(geometry[:, 4].sum()) + limits.goal_tolerance_mm
    numbers = np.zeros(N_NUMBERS)
    rate = weights[0] / clearest + weights[1]
    numbers[:6] = cell, SHELL_MM, kappa, limit / MOST_UNITS, rate, limits.required_mm
    togo = CostToGo(
        frame=np.stack([across, np.cross(axis, across), axis, np.asarray(target_lps)]),
        numbers=numbers,
        levels=tuple(levels),
    )
    if math.isfinite(limit) and limit > 0.0:
        _fill(togo, partial(fill_shell, field, geometry, weights, limits.goal_tolerance_mm, limit, togo))
    return togo


def _fill(togo: CostToGo, fill_rows: Callable[..., bool]) -> None:
    """Fill the shells from the target outwards, until no path costs less than the limit."""
    levels = togo.levels[0]
    # The cost from half a shell beyond the last one, and the same for the one that is being filled.
    behind, beyond = np.zeros(levels.shape[1:]), np.zeros(levels.shape[1:])
    with ThreadPoolExecutor(THREADS) as workers:
        for k in range(len(levels)):
            fill = partial(fill_rows, k, behind, beyond)
            some = list(workers.map(fill, range(THREADS), [THREADS] * THREADS))
            end_shell(togo, k)
            if not any(some):
                return
            behind, beyond = beyond, behind
