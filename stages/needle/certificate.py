"""A proof that there is no needle path: over-estimates of all states that a path can pass.

Planes perpendicular to the line from start to target cut every path.  On each plane the states, position
times direction, lie in cells.  From one plane to the next the cells spread as far as curvature allows and
more by what a cell is wide; cells vanish from which obstacles, the turning limit or the target's distance
leave no way.  If none is left on a plane, no path exists: none can slip through, since every step
over-estimates.  If some are left, those that lie on a chain of cells from start to target are cut into
smaller ones and the same is done again.  docs/proofs.md has the inequalities.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anatomy.errors import SettingsError
from anatomy.grid import Float
from stages.needle.kernels import limits as index
from stages.needle.kernels import sets
from stages.needle.searches import Query
from stages.needle.space import NeedleSpace

Bits = NDArray[np.uint64]
Window = NDArray[np.int64]

FIRST_CELL_MM = 0.5
FIRST_SLOPE_CELL = 0.04
LEVELS = 6
DEPTH_SHARE = 0.07
"""Distance of the planes as a share of the radius of curvature."""
LEAST_DEPTH_SHARE = 0.02
SLOPE_CHANGE_EDGES = np.array([0.75, 0.92, 1.0])
PROBES_PER_DEPTH = 8
LACK_STEP_MM = 0.05
DEEPEST_LACK_MM = 2.5
MAX_BYTES = 1 << 30


@dataclass(frozen=True)
class Plane:
    """States on one plane: bits (V, U, Y, W) and the cell numbers (v, u, y, x) of their first cell."""

    bits: Bits
    window: Window

    def trimmed(self) -> Plane:
        """Return the same without empty rows and columns at the edges."""
        box = np.zeros(8, dtype=np.int64)
        sets.extent(self.bits, box)
        v0, v1, u0, u1, y0, y1, x0, x1 = (int(n) for n in box)
        bits = self.bits[v0 : v1 + 1, u0 : u1 + 1, y0 : y1 + 1, x0 // 64 : x1 // 64 + 1]
        return Plane(np.ascontiguousarray(bits), self.window + np.array([v0, u0, y0, x0]))


class NoPathProof:
    """Tries to prove that no path leads from a start to within the goal tolerance of a target.

    Parameters
    ----------
    space : NeedleSpace
    query : Query
    max_bytes : int
        Most memory for one set of states.

    Attributes
    ----------
    outcome : str
        "running", "no path" (proved) or "undecided" (paths may exist).
    cell_mm, slope_cell : float
        Sides of the cells of the present level: of position in mm, and of direction as a slope (1 is 45
        degrees).
    reason : str
        Why the end is undecided.

    Raises
    ------
    SettingsError
        If the needle may turn by more than 90 degrees from its start: then the tests do not hold.

    Notes
    -----
    The limits on length and accumulated turning are not used, so a path that only they forbid counts as
    possible.  Where the exit may touch a pierced branch, that branch does not count as an obstacle.
    """

    def __init__(self, space: NeedleSpace, query: Query, *, max_bytes: int = MAX_BYTES) -> None:
        if space.limits[index.MAX_ANGLE] > 0.5 * math.pi + 1e-9:
            raise SettingsError(
                f"A needle that turns {math.degrees(space.limits[index.MAX_ANGLE]):.0f} degrees from its start",
                expected="at most 90 degrees, for a proof that there is no path",
            )
        self.outcome = "running"
        self.reason = ""
        self.cell_mm = FIRST_CELL_MM
        self.slope_cell = FIRST_SLOPE_CELL
        self.states = 0
        """Largest number of states on a plane so far."""
        self._space = space
        self._query = query
        self._max_bytes = max_bytes
        self._kappa = float(space.limits[index.KAPPA])
        self._tolerance = space.goal_tolerance_mm
        self._prepare()
        self._steps = self._run()

    def advance(self) -> bool:
        """Do the next step, a plane of one level; return whether the proof has ended."""
        if self.outcome == "running":
            next(self._steps, None)
        return self.outcome != "running"

    def run(self) -> str:
        """Go on to the end; return the outcome."""
        while not self.advance():
            pass
        return self.outcome

    def _prepare(self) -> None:
        start, forward = self._query.lps_from_start[:3, 3], self._query.lps_from_start[:3, 2]
        chord = self._query.target - start
        self._total = float(np.linalg.norm(chord))
        self._last = self._total - self._tolerance
        if self._last <= 0.0:
            self._end("undecided", "the target lies at the start")
            return
        self._normal = chord / self._total
        axis = np.eye(3)[int(np.argmin(np.abs(self._normal)))]
        column = np.cross(self._normal, axis)
        column /= np.linalg.norm(column)
        self._sides = np.stack([np.cross(self._normal, column), column])
        along = float(forward @ self._normal)
        if along <= 0.0:
            self._end("undecided", "the start looks away from the target")
            return
        self._first_slope: Float = self._sides @ forward / along

    def _end(self, outcome: str, reason: str = "") -> None:
        self.outcome, self.reason = outcome, reason

    def _run(self) -> Iterator[None]:
        """Refine level by level, with planes nearer to each other if paths may be too steep for them."""
        share = DEPTH_SHARE
        coarse: list[Plane] | None = None
        level = 0
        while level < LEVELS:
            self.cell_mm, self.slope_cell = FIRST_CELL_MM / 2**level, FIRST_SLOPE_CELL / 2**level
            self._count = max(1, math.ceil(self._last * self._kappa / share))
            self._depth = self._last / self._count
            self._too_steep = False
            planes: list[Plane] = []
            for plane in self._forward(coarse):
                if plane is not None:
                    planes.append(plane)
                yield
            if self.outcome != "running":
                return
            if self._too_steep:
                level += 1
                continue
            for _ in self._backward(planes):
                yield
            if self.outcome != "running":
                return
            coarse = planes
            level += 1
        self._end("undecided", "states are left at the finest level")

    def _forward(self, coarse: list[Plane] | None) -> Iterator[Plane | None]:
        """Propagate from the start; end the proof if a plane is empty."""
        plane = Plane(np.ones((1, 1, 1, 1), dtype=np.uint64), np.zeros(4, dtype=np.int64))
        for number in range(self._count + 1):
            if number > 0:
                spread = self._spread(plane, None if coarse is None else coarse[number])
                if spread is None:
                    self._end("undecided", "more states than fit the memory allowed")
                    yield None
                    return
                plane = spread
                if coarse is not None:
                    sets.keep_refined(plane.bits, plane.window, coarse[number].bits, coarse[number].window)
            kept, _steep = self._keep_hopeful(plane, number)
            steep = 0
            if kept:
                plane = plane.trimmed()
                self._keep_clear(plane, number)
                kept, steep = self._keep_hopeful(plane, number)
            self.states = max(self.states, kept)
            if kept == 0:
                self._end("no path")
                yield None
                return
            if steep and number < self._count:
                self._too_steep = True
                yield None
                return
            plane = plane.trimmed()
            yield plane

    def _backward(self, planes: list[Plane]) -> Iterator[None]:
        """Remove from all planes what does not lead to the last one."""
        for number in range(self._count - 1, -1, -1):
            after, here = planes[number + 1], planes[number]
            bits = np.zeros_like(here.bits)
            self._step(after, -1, bits, here.window)
            if sets.keep_both(here.bits, bits) == 0:
                self._end("no path")
                yield
                return
            planes[number] = here.trimmed()
            yield

    def _step(self, plane: Plane, way: int, bits: Bits, window: Window) -> None:
        sets.step_sets(
            plane.bits, plane.window, self._first_slope, self.cell_mm, self.slope_cell,
            self._kappa, self._depth, way, SLOPE_CHANGE_EDGES, bits, window,
        )  # fmt: skip

    def _spread(self, plane: Plane, coarse: Plane | None) -> Plane | None:
        """Return the states of the next plane; None if they do not fit the memory."""
        nv, nu, rows, words = plane.bits.shape
        low = plane.window.copy()
        high = low + np.array([nv - 1, nu - 1, rows - 1, 64 * words - 1])
        used = plane.bits.reshape(nv, nu, -1).any(axis=2)
        slopes = [
            self._first_slope[axis] + (low[axis] + np.arange(plane.bits.shape[axis])) * self.slope_cell
            for axis in (0, 1)
        ]
        steepest = float(np.hypot(slopes[0][:, None], slopes[1][None])[used].max())
        change = sets.largest_slope_change(steepest + self.slope_cell, self._kappa, self._depth)
        pad = math.ceil(change / self.slope_cell + 2.0)
        low[:2] -= pad
        high[:2] += pad
        for axis in (0, 1):
            ends = self._first_slope[axis] + np.array([low[axis], high[axis]]) * self.slope_cell
            shift = ends * self._depth / self.cell_mm
            # A state moves by the mean of two slopes, both between these ends, and by no more than cells.
            spare = math.ceil(0.25 * change * self._depth / self.cell_mm) + 4
            low[axis + 2] += math.floor(shift[0]) - spare
            high[axis + 2] += math.ceil(shift[1]) + spare
        if coarse is not None:
            cv, cu, crows, cwords = coarse.bits.shape
            low = np.maximum(low, 2 * coarse.window - 1)
            high = np.minimum(high, 2 * (coarse.window + np.array([cv, cu, crows, 64 * cwords]) - 1) + 1)
        shape = high - low + 1
        size = int(shape[0] * shape[1] * shape[2]) * (-(-int(shape[3]) // 64)) * 8
        table = nv * nu * int(shape[2]) * (-(-int(shape[3]) // 64)) * 8 * (nu.bit_length() + 1)
        if max(size, table) > self._max_bytes:
            return None
        bits = np.zeros((*shape[:3], -(-int(shape[3]) // 64)), dtype=np.uint64)
        self._step(plane, 1, bits, low)
        return Plane(bits, low)

    def _keep_hopeful(self, plane: Plane, number: int) -> tuple[int, int]:
        goal = np.array([0.0, 0.0, self._total - number * self._depth])
        largest_sine = 1.0 - 2.0 * self._kappa * self._depth - 1e-3
        kept, steep = sets.keep_hopeful(
            plane.bits, plane.window, self._first_slope, self.cell_mm, self.slope_cell,
            self._kappa, goal, self._tolerance, largest_sine,
        )  # fmt: skip
        return int(kept), int(steep)

    def _keep_clear(self, plane: Plane, number: int) -> None:
        """Test half a slab to either side of a plane."""
        here = number * self._depth
        probes = self._depth / PROBES_PER_DEPTH * np.arange(-PROBES_PER_DEPTH // 2, PROBES_PER_DEPTH // 2 + 1)
        probes = probes[(here + probes > -1e-9) & (here + probes < self._last + 1e-9)]
        boxes = [self._seen_at(plane, float(depth)) for depth in probes]
        rows = max(y1 - y0 for y0, y1, _x0, _x1 in boxes) + 1
        words = max((x1 - x0) // 64 for _y0, _y1, x0, x1 in boxes) + 1
        levels = round(DEEPEST_LACK_MM / LACK_STEP_MM)
        free = np.zeros((len(boxes), levels, rows, words), dtype=np.uint64)
        lack = np.zeros((rows, 64 * words))
        across = self._sides * self.cell_mm
        start = self._query.lps_from_start[:3, 3]
        for n, (depth, (y0, _y1, x0, _x1)) in enumerate(zip(probes, boxes, strict=True)):
            # A path at this depth is at least as long, so beyond the exempt length nothing is spared.
            exempt = self._query.branch if here + depth < self._space.limits[index.EXEMPT_LENGTH] else -1
            origin = start + (here + depth) * self._normal + y0 * across[0] + x0 * across[1]
            sets.lack_of_clearance(
                self._space.arrays, self._space.limits[index.REQUIRED], exempt, origin, across,
                DEEPEST_LACK_MM, lack,
            )  # fmt: skip
            for q in range(levels):
                sets.free_within(lack, q * LACK_STEP_MM, free[n, q])
        corners = np.array([(y0, x0) for y0, _y1, x0, _x1 in boxes], dtype=np.int64)
        sets.keep_clear(
            plane.bits, plane.window, self._first_slope, self.cell_mm, self.slope_cell, self._kappa,
            free, corners, probes, LACK_STEP_MM,
        )  # fmt: skip

    def _seen_at(self, plane: Plane, depth: float) -> tuple[int, int, int, int]:
        """Return the rows and columns, first and last, that the tangents of a plane's states meet."""
        out: list[int] = []
        for axis, count in ((0, plane.bits.shape[2]), (1, 64 * plane.bits.shape[3])):
            ends = np.array([0, plane.bits.shape[axis] - 1]) + plane.window[axis]
            shift = (self._first_slope[axis] + ends * self.slope_cell) * depth / self.cell_mm
            first = int(plane.window[axis + 2])
            out += [first + math.floor(shift.min()) - 1, first + count + math.ceil(shift.max())]
        return out[0], out[1], out[2], out[3]
