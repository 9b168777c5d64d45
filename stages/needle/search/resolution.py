"""The search that ends: with the best path at its resolution, or with the statement that it has none."""

import math
from collections.abc import Iterable
from enum import StrEnum
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Array, Float, Int, Int32, UInt8
from anatomy.kernels import arcs as arc_kernels
from anatomy.kernels.field import UNITS_PER_MM
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import tree
from stages.needle.kernels.cost import CLEARANCE_FLOOR_MM, ObjectiveArrays
from stages.needle.objective import MAX_CLEARANCE_MM, SHORTEST, Objective
from stages.needle.path import ArcPath, Query, path_from_tree
from stages.needle.search.base import root_of
from stages.needle.search.kernels import resolution as kernel
from stages.needle.search.kernels import resolution_nodes as node_kernel

T = TypeVar("T", bound=np.generic)
Words = tuple[float, Float, Float, Int, Int]
Store = tuple[Float, Int32, UInt8, Int32]

FIRST_NODES = 1024
FIRST_ENTRIES = 4096
"""Sizes of the arrays at first; they are doubled when they are full."""
MOST_ROLLS = 64
"""The directions of a larger number would differ by less than 6 degrees."""
EQUAL_CELL_MM = 1e-3
"""Where only equal poses are duplicates, poses are looked for in cells of this size."""


class Outcome(StrEnum):
    """What a search can say."""

    RUNNING = "running"
    BEST = "best at resolution"
    NONE = "none at resolution"
    OUT_OF_MEMORY = "out of memory"


@frozen_value
class Resolution:
    """The words of a search: pieces of whole steps, in equally spaced directions of bending.

    Args:
        coarse_mm, fine_mm: Length of the longest piece, which is tried first, and of the step it is cut to.
        coarse_rolls, fine_rolls: Number of directions of bending that are tried first, and of all.

    Raises:
        SettingsError: If a number is out of range, or coarse and fine do not differ by a power of two.
    """

    coarse_mm: float = 16.0
    fine_mm: float = 1.0
    coarse_rolls: int = 4
    fine_rolls: int = 16

    def __post_init__(self) -> None:
        if not (0.0 < self.fine_mm <= self.coarse_mm < math.inf and 0 < self.coarse_rolls <= self.fine_rolls):
            raise SettingsError(f"{self} is no resolution", expected="0 < fine <= coarse")
        # The greatest power of two of which the kernel's bytes can hold the number of steps.
        for name, ratio, most in (
            ("lengths", self.coarse_mm / self.fine_mm, 128),
            ("rolls", self.fine_rolls / self.coarse_rolls, MOST_ROLLS),
        ):
            if ratio != 2.0 ** round(math.log2(ratio)) or ratio > most:
                raise SettingsError(
                    f"The {name} of {self} differ by a factor of {ratio:g}",
                    expected=f"a power of two, at most {most}",
                )
        if self.fine_rolls > MOST_ROLLS:
            raise SettingsError(f"{self} has too many rolls", expected=f"at most {MOST_ROLLS}")

    @property
    def steps(self) -> int:
        """Steps of the longest piece."""
        return round(self.coarse_mm / self.fine_mm)

    def primitives(self) -> tuple[Int, Int]:
        """Return all primitives by level, `(P, 2)` direction and steps, and the first of each level.

        The level counts how often length and roll are halved; the direction `fine_rolls` is straight.
        """
        halvings = [_halvings(self.steps, k) for k in range(1, self.steps + 1)]
        between = self.fine_rolls // self.coarse_rolls
        by_level: dict[int, list[tuple[int, int]]] = {}
        for direction in (self.fine_rolls, *range(self.fine_rolls)):
            rolled = 0 if direction == self.fine_rolls else _halvings(between, direction % between or between)
            for k, halved in enumerate(halvings, start=1):
                by_level.setdefault(rolled + halved, []).append((direction, k))
        levels = [by_level[level] for level in sorted(by_level)]
        first = np.cumsum([0, *map(len, levels)])
        return np.array([p for level in levels for p in level], dtype=np.int64), first.astype(np.int64)


def _halvings(whole: int, part: int) -> int:
    """Return how often a power of two must be halved until a number of such parts makes `part`."""
    return (whole // (part & -part)).bit_length() - 1


@frozen_value
class Cells:
    """Cells of poses: of all that fall into one cell, only the cheapest so far is followed.

    What a search with cells says holds up to them: a path that was not looked for leaves a cell in which
    a pose that costs no more was followed, in place of its own.  Raises SettingsError if a size is not
    positive and finite.

    Args:
        position_mm: Side of a cell, mm.
        angle_deg: Side in each component of the tip's direction, as the angle at its centre, degrees.
    """

    position_mm: float = 0.5
    angle_deg: float = 2.0

    def __post_init__(self) -> None:
        if not (0.0 < self.position_mm < math.inf and 0.0 < self.angle_deg < math.inf):
            raise SettingsError(f"{self} has no size", expected="finite sizes of more than 0")


@frozen_value
class Counts:
    """What a search has done: entries taken off the queue, and poses reached by words that are proved clear.

    Words are dropped as duplicates because another one ends there at no greater cost, as pruned because no
    path within the limits leads on to the goal for less than the best, and as refused because their last
    piece is not proved clear.
    """

    pops: int
    nodes: int
    duplicates: int
    pruned: int
    refused: int


class ResolutionSearch:
    """The search over words of arcs and straight pieces, from coarse to fine [Fu2021, Fu2022].

    It is a `stages.needle.search.base.Search`, and nothing in it is random;
    docs/explanation/needle.md says how it works.

    Args:
        query: The directions of bending count from +x of the start pose.
        duplicates: Poses that count as one; by default only those equal up to rounding: nothing is lost.
        max_memory_mb: The search ends before its arrays take more.

    Raises:
        SettingsError: If the environment is one in which arcs are looked up instead of proved.

    Attributes:
        path, cost, finished: See `Search`.
    """

    def __init__(
        self,
        environment: NeedleEnvironment,
        query: Query,
        *,
        resolution: Resolution | None = None,
        objective: Objective = SHORTEST,
        duplicates: Cells | None = None,
        max_memory_mb: float = 1000.0,
    ) -> None:
        if environment.limits.lookup_step_mm > 0.0:
            raise SettingsError(
                "The resolution search is asked for an environment whose arcs are looked up, not proved",
                expected="an environment with a clearance field: the search goes on from what is proved",
            )
        self.environment, self.query = environment, query
        self.path: ArcPath | None = None
        self.cost = math.inf
        self.finished = False
        self.outcome = Outcome.RUNNING
        self.resolution = resolution or Resolution()
        self.duplicates = duplicates
        self.max_memory_mb = max_memory_mb
        self.objective = environment.objective_arrays(objective)
        self._rates = _rates(self.objective, environment)
        self._merge = (EQUAL_CELL_MM, EQUAL_CELL_MM, False)
        if duplicates is not None:
            self._merge = (duplicates.position_mm, math.radians(duplicates.angle_deg), True)
        self._words = _words(self.resolution, environment.limits.kappa)
        self._reference = tree.reference_of(root_of(query))
        self._store = self._first_store()
        left = environment.limits.max_length_mm - query.inserted_mm
        pieces = max(int(left / self.resolution.fine_mm), 0) + 2
        lists = np.zeros((pieces * len(self._words[4]) + node_kernel.LOOK_AHEAD + 1, 2), dtype=np.int32)
        lists[:, node_kernel.HEAD] = -1
        entries = np.zeros((FIRST_ENTRIES, node_kernel.ENTRY_COLUMNS), dtype=np.int32)
        heap = np.zeros(FIRST_ENTRIES, dtype=np.int32)
        self._queue = np.zeros(FIRST_ENTRIES), entries, np.zeros(FIRST_ENTRIES), heap, lists
        self._state = np.zeros(node_kernel.STATE_SIZE, dtype=np.int64)
        self._state[node_kernel.FREE] = -1
        self._counts = np.zeros(kernel.COUNTS, dtype=np.int64)
        self._counts[kernel.NODES] = 1
        self._best = np.zeros(kernel.BEST_SIZE)

    def _first_store(self) -> Store:
        nodes = np.zeros((FIRST_NODES, node_kernel.NODE_COLUMNS))
        links = np.zeros((FIRST_NODES, node_kernel.LINK_COLUMNS), dtype=np.int32)
        proved = np.zeros((FIRST_NODES, self.resolution.fine_rolls + 1, 2), dtype=np.uint8)
        query, start, root = self.query, self.query.lps_from_start, nodes[0]
        root[:6] = *start[:3, 3], *start[:3, 2]
        root[node_kernel.NORMAL : node_kernel.NORMAL + 3] = start[:3, 0]
        root[node_kernel.PATH_LENGTH], root[node_kernel.PATH_TURN] = query.inserted_mm, query.turned_rad
        links[0] = -1, -1, 0, 0
        proved[0, :, node_kernel.USELESS] = self.resolution.steps + 1
        return nodes, links, proved, np.zeros(4 * FIRST_NODES, dtype=np.int32)

    @property
    def counts(self) -> Counts:
        """What the search has done so far."""
        nodes, pops, duplicates, pruned, refused = self._counts.tolist()
        return Counts(pops=pops, nodes=nodes, duplicates=duplicates, pruned=pruned, refused=refused)

    @property
    def memory_mb(self) -> float:
        """Size of the search's arrays."""
        return _megabytes((*self._store, *self._queue))

    def advance(self, iterations: int) -> bool:
        """Take up to `iterations` entries off the queue; see `Search`."""
        stop = int(self._counts[kernel.POPS]) + iterations
        while not self.finished and self._counts[kernel.POPS] < stop:
            reason, self.cost = kernel.search_words(
                self.environment.obstacles, self.environment.limits, self.objective, self._rates,
                self.query.branch, self.query.goal, self._reference, self._words, self._merge, self._store,
                self._queue, self._state, self._counts, self._best, self.cost, stop -
                int(self._counts[kernel.POPS]),
            )  # fmt: skip
            if reason == kernel.BETTER:
                self.path = self._best_path()
                if self._state[node_kernel.WAITING] == 0:
                    self._end(Outcome.BEST)
                return True
            if reason == kernel.EXHAUSTED:
                self._end(Outcome.NONE if self.path is None else Outcome.BEST)
            elif reason == kernel.FULL_OF_NODES:
                if self._may_double(self._store):
                    nodes, links, proved, seen = self._store
                    larger = np.zeros(2 * len(seen), dtype=np.int32)
                    node_kernel.rehash(nodes, self._merge, seen, larger)
                    self._store = _doubled(nodes), _doubled(links), _doubled(proved), larger
            elif reason == kernel.FULL_OF_ENTRIES:
                f, entries, heap_f, heap, ranks = self._queue
                if self._may_double((f, entries, heap_f, heap)):
                    self._queue = _doubled(f), _doubled(entries), _doubled(heap_f), _doubled(heap), ranks
        return False

    def _end(self, outcome: Outcome) -> None:
        self.outcome, self.finished = outcome, True

    def _may_double(self, arrays: tuple[Array, ...]) -> bool:
        """Tell whether arrays may take twice their memory; end if not."""
        fits = self.memory_mb + _megabytes(arrays) <= self.max_memory_mb
        if not fits:
            self._end(Outcome.OUT_OF_MEMORY)
        return fits

    def _best_path(self) -> ArcPath:
        """Return the path to the best node and on to the goal."""
        nodes, links = self._store[:2]
        fine_mm, rolls = self._words[:2]
        chain = []
        at = int(self._best[kernel.BEST_NODE])
        while at != 0:
            chain.append(at)
            at = int(links[at, node_kernel.PARENT])
        rows = [np.zeros(tree.NODE_COLUMNS)]
        for at in reversed(chain):
            parent, direction, steps = (int(v) for v in links[at, : node_kernel.NODE_RANK])
            bend = node_kernel.bend_of(nodes, rolls, self.environment.limits.kappa, parent, direction)
            rows.append(_row(fine_mm * steps, bend))
        for leg in range(2):
            length, *bend = self._best[kernel.BEST_LEGS + kernel.LEG_SIZE * leg :][: kernel.LEG_SIZE]
            if length > 0.0:
                rows.append(_row(length, bend))
        parents = np.arange(-1, len(rows) - 1)
        return path_from_tree(self.query.lps_from_start, np.stack(rows), parents, len(rows) - 1)


def _megabytes(arrays: Iterable[Array]) -> float:
    return sum(array.nbytes for array in arrays) / 1e6


def _row(length_mm: float, bend: ArrayLike) -> Float:
    """Return a row of a tree as far as `path_from_tree` reads it."""
    row = np.zeros(tree.NODE_COLUMNS)
    row[tree.ARC_LENGTH] = length_mm
    row[tree.BEND : tree.BEND + 4] = bend
    return row


def _doubled(array: NDArray[T]) -> NDArray[T]:
    larger = np.zeros((2 * len(array), *array.shape[1:]), dtype=array.dtype)
    larger[: len(array)] = array
    return larger


@lru_cache(maxsize=8)
def _words(resolution: Resolution, kappa: float) -> Words:
    """Return what the kernel has to know of a resolution, see `search_words`; it only reads the arrays."""
    lengths = resolution.fine_mm * np.arange(resolution.steps + 1)
    moves = [(arc_kernels.sine_length(kappa, s), arc_kernels.versine_length(kappa, s)) for s in lengths]
    turns = [(math.cos(kappa * s), math.sin(kappa * s)) for s in lengths]
    rolls = 2.0 * math.pi * np.arange(resolution.fine_rolls) / resolution.fine_rolls
    primitives, first = resolution.primitives()
    directions = np.stack([np.cos(rolls), np.sin(rolls)], axis=1)
    return resolution.fine_mm, directions, np.hstack([moves, turns]), primitives, first


def _rates(objective: ObjectiveArrays, environment: NeedleEnvironment) -> tuple[float, float]:
    """Return the least cost of a mm, at the largest clearance there is, and that of a mm of ending short."""
    least = objective.least_rate
    if objective.inverse_clearance == 0.0:
        return least, least
    largest = max(float(environment.obstacles.clearance.max()) / UNITS_PER_MM, CLEARANCE_FLOOR_MM)
    gain = objective.inverse_clearance * (1.0 / largest - 1.0 / MAX_CLEARANCE_MM)
    return least + max(gain, 0.0), least
