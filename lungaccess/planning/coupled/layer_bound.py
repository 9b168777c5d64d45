"""A lower bound of the cost of every plan of any devices, from the layers of tissue that they go through.

A function that changes by no more than one moves, such as the distance from the lumen, takes every value
between those at both ends of a path somewhere on it.  So its cost is no less than the integral, over these
values, of the least cost of a mm on each layer of one value.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.structures import LUMEN, obstacle_bits
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.cost_bound import CostBound
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import Step, evaluated_step
from lungaccess.plans.evaluator import TIP_OFF_MM, CandidateEvaluator
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import TOLERANCE_MM, require_motion
from stages.needle.kernels import CLEARANCE_FLOOR_MM
from stages.tube import deployed, design_arrays, shape_of_arrays

STEADY_STEPS, MOST_TIMES = 16, 8
"""After each so many steps without a cheaper plan they are so many more, up to so many times as many."""
LAYER_MM = 0.1
"""Thickness of the layers: a small part of a wall, which costs most."""
SHIFTED_MM = 5.0
"""How far beside the tips of an atlas those of plans may be: searches move one along its motion by 4 mm."""


class LayerBound:
    """Bounds from below what plans to a target cost, whatever their tubes, once and for all.

    Without a needle the costs begin where the tubes leave the lumen, and the layers are those of one distance
    from it: this holds for every place of the scope.  With a needle they begin at the tip of the tubes, and
    the layers are spheres about the target from as far as the tubes come; it holds for scope tips up to
    SHIFTED_MM beside those of the atlas, and is 0 where the tubes are long enough to reach the target.  The
    devices may end up to `beside_mm` beside the target.
    """

    lowest: tuple[tuple[int, float, float, float], ...] = ()
    """No deployments are known to be promising."""

    def __init__(self, task: Task, atlas: Atlas, beside_mm: float = 0.0) -> None:
        self._task, self._tips, self._beside_mm = task, atlas.motions.tips[:, :3], beside_mm
        self._evaluator = CandidateEvaluator(task)
        self.known, self.settled = 0.0, False

    @property
    def value(self) -> float:
        """The bound: 0 before it has begun."""
        return self.known

    def start(self, cost: float, boxes: int) -> None:
        """Find the bound, if it is not known; neither the cost of a plan nor how many boxes matters."""
        if not self.settled:
            self.known = self._through_tissue() if self._task.system.needle is None else self._to_target()
            self.settled = True

    def _through_tissue(self) -> float:
        """Return the bound of tubes that end at the target, on layers about the lumen."""
        from scipy import ndimage

        lung, grid, target = self._task.lung, self._task.lung.grid, self._task.target.lps_mm
        off_mm = self._beside_mm + TIP_OFF_MM
        window = grid.window(target, self._task.system.tubes.max_extension_mm + off_mm)
        lumen = (lung.labels[window] & LUMEN) > 0
        if not lumen.any():
            return 0.0
        # The distance between two voxels as boxes is that of the one from the other with its neighbours.
        grown = ndimage.binary_dilation(lumen, np.ones((3, 3, 3)))
        nearest = ndimage.distance_transform_edt(~grown, sampling=grid.spacing_mm)
        farthest = np.where(lumen, 0.0, nearest + np.linalg.norm(grid.spacing_mm))
        voxels = np.argwhere(lumen) + [each.start for each in window]
        end = float(grid.box_distance_mm(voxels, target).min()) - off_mm
        return self._over(window, nearest, farthest, 0.0, end)

    def _to_target(self) -> float:
        """Return the bound of a needle from where tubes come nearest, on spheres about the target."""
        grid, target = self._task.lung.grid, self._task.target.lps_mm
        away_mm = float(np.linalg.norm(self._tips - target, axis=1).min(initial=math.inf))
        begin = self._evaluator.environment.limits.goal_tolerance_mm + self._beside_mm
        end = away_mm - self._task.system.tubes.max_extension_mm - SHIFTED_MM
        if not begin < end < math.inf:
            return 0.0
        window = grid.window(target, end)
        offsets = [
            (np.arange(each.start, each.stop) - at) * size
            for each, at, size in zip(window, grid.ijk(target), grid.spacing_mm, strict=True)
        ]
        i, j, k = np.meshgrid(*offsets, indexing="ij", sparse=True)
        middle, half = np.sqrt(i * i + j * j + k * k), 0.5 * np.linalg.norm(grid.spacing_mm)
        return self._over(window, middle - half, middle + half, begin, end)

    def _over(self, window: tuple[slice, ...], low: Float, high: Float, begin: float, end: float) -> float:
        """Return the integral of the least cost of a mm on layers from one value to another.

        Args:
            low, high ((ni, nj, nk) float64): The least and greatest value in each voxel of a window.
        """
        count = math.ceil((end - begin) / LAYER_MM)
        if count < 1:
            return 0.0
        first = np.floor((low - begin) / LAYER_MM).astype(np.int64)
        last = np.floor((high - begin) / LAYER_MM).astype(np.int64)
        counts = (first < count) & (last >= 0)
        first, last, most = np.maximum(first[counts], 0), last[counts], self._most_mm(window)[counts]
        clearest = np.zeros(count)
        for n in range(int((last - first).max(initial=-1)) + 1):
            on = first + n <= np.minimum(last, count - 1)
            np.maximum.at(clearest, first[on] + n, most[on])
        objective, edges = self._evaluator.objective, np.minimum(np.arange(count + 1) * LAYER_MM, end - begin)
        rates = objective.inverse_clearance / np.maximum(clearest, CLEARANCE_FLOOR_MM) + objective.length
        return float((rates * np.diff(edges)).sum())

    def _most_mm(self, window: tuple[slice, ...]) -> Float:
        """Return the most that clearance is in each voxel: it changes by no more than one moves."""
        lung, fissures = self._task.lung, self._task.with_fissures
        corners = lung.obstacle_field(with_fissures=fissures).corners
        diagonal, shape = (
            float(np.linalg.norm(lung.grid.spacing_mm)),
            [each.stop - each.start for each in window],
        )
        low, high = np.full(shape, np.inf), np.zeros(shape)
        for moves in itertools.product((0, 1), repeat=3):
            moved = zip(window, moves, strict=True)
            at = tuple(slice(each.start + move, each.stop + move) for each, move in moved)
            here = (corners[at] + 2.0) / UNITS_PER_MM
            low, high = np.minimum(low, here), np.maximum(high, here)
        blocked = (lung.labels[window] & obstacle_bits(fissures)) > 0
        return np.where(blocked, 0.0, np.minimum(low + diagonal, high + 0.5 * diagonal))


LowerBound = CostBound | LayerBound


def cost_bound(task: Task, atlas: Atlas, beside_mm: float = 0.0) -> LowerBound:
    """Return the best bound that is known for the system of a task; see `CostBound` and `LayerBound`."""
    boxed = task.system.needle is not None and task.system.tubes.planar
    return CostBound(task, atlas, beside_mm=beside_mm) if boxed else LayerBound(task, atlas, beside_mm)


def beside_in_window_mm(task: Task, phases: tuple[float, float]) -> float:
    """Return how far beside the target devices may end that are near it in phases of the breath.

    Raises:
        AnatomyError: If the patient has no motion.
        SettingsError: If the masks do not show one of these phases.
    """
    shown = require_motion(task.lung).masks_phase
    if not phases[0] <= shown <= phases[1]:
        raise SettingsError(
            f"A gap is asked for in the phases {phases[0]:g} to {phases[1]:g}; the masks show {shown:g}",
            expected="phases with that of the masks: nothing bounds where a plan for others ends in it",
            remedy="Leave out the gap, or ask for phases that hold that of the masks",
        )
    return TOLERANCE_MM


def guided(search: AtlasSearch, steps: Iterator[Step], bound: LowerBound) -> Iterator[Step]:
    """Yield the steps of a search, and cheaper plans from the boxes with the lowest bound.

    Each of those becomes the search's best candidate, which it then improves.  Who takes the steps improves
    the bound, which may go on while the search takes its next step.
    """
    design = design_arrays(search.atlas.system.tubes)
    for step in steps:
        yield step
        if bound.settled or search.incumbent.step is None:
            continue
        for tip, rotation, outer, inner in bound.lowest:
            made = deployed(design, [inner, outer][: len(design.radii)], np.zeros(len(design.radii)))
            if made is None:
                continue
            scope_tip = search.atlas.motions.tip(tip)
            candidate = search.evaluator.direct(scope_tip, rotation, shape_of_arrays(made))
            found = evaluated_step(search.evaluator, "lower bound", candidate, step.iteration)
            if found.cost < search.incumbent.cost:
                yield search.incumbent.improved(found)


class GapGoal:
    """The goal that a plan costs at most a share `gap` more than the best possible, proved.

    SettingsError is raised if the gap is negative or not finite.
    """

    def __init__(self, bound: LowerBound, gap: float) -> None:
        if not 0.0 <= gap < math.inf:
            raise SettingsError(
                f"The gap is {gap}", expected="a share of 0 or more", remedy="State 0.05 for five per cent"
            )
        self.bound, self._gap = bound, gap
        self._cost, self._steady, self._ahead = math.inf, 0, 0

    def is_met(self, cost: float) -> bool:
        """Tell whether a plan of this cost is so near to the best possible.

        If it is not, the bound is improved in other threads: the more, the longer the cost has stayed the
        same.  Then some of the next calls do not wait for them.
        """
        self._steady = self._steady + 1 if cost == self._cost else 0
        self._cost = cost
        self._ahead -= 1
        if self._ahead > 0:
            return cost <= (1.0 + self._gap) * self.bound.known
        met = cost <= (1.0 + self._gap) * self.bound.value
        if not met:
            times = min(1 + self._steady // STEADY_STEPS, MOST_TIMES)
            # Steps of a search, at most, before both threads are waited for: more boxes take both more
            # equally long.
            self._ahead = min(times, 4)
            # Boxes that are divided beside one step of a search: in two threads they take as long, or twice
            # as long.
            self.bound.start(cost, times * 500)
        return met
