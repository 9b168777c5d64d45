"""A proof that there is no needle path: over-estimates of all states that a path can pass.

First, cubes that lie between start and target and are not certainly blocked are filled from the start on.  If
that does not part start and target, planes perpendicular to the line between them cut every path.  On each
plane the states, position times direction, lie in cells.  From one plane to the next the cells spread as far
as curvature allows and more by what a cell is wide; cells vanish from which obstacles, or the places of start
and target, leave no path.  If none is left on a plane, no path exists: none is missed, since every step
over-estimates.  If some are left, those that lie on a chain of cells from start to target are cut into
smaller ones and the same is done again.  docs/theory/no_path.md has the inequalities.
"""

import math
from collections.abc import Generator, Iterator

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Int
from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.kernels import bitmaps, blocked, bounds
from stages.needle.infeasibility.kernels import reachable_sets as sets
from stages.needle.infeasibility.passage import ROUNDING, Passage, PathBounds, Plane, tightest
from stages.needle.obstruction import blocked_end
from stages.needle.path import Query

# None of these numbers can make the proof wrong: they trade time and memory for how much is proved.
FIRST_CELL_MM, LARGEST_SLOPE_CELL = 0.5, 0.17
"""Largest sides of the first cells: of the size of a voxel, and of about 10 degrees."""
ALL_CUBES = 1 << 31
"""There are fewer cubes than this."""
SLOPE_CHANGE_EDGES = np.array([0.5, 0.75, 0.92, 1.0])
"""Classes of slope change, see `step_sets`: finer where the bound on the position falls fast."""
PROBES_PER_DEPTH = 8
"""Depths of a slab at which clearance is looked at."""
SLACKS = 48
LEAST_DISTANCE_MM = 1e-3
"""Nearer targets are left undecided; targets outside the workspace by less are not ruled out at once."""
MAX_BYTES = 1 << 30
"""A gigabyte, which any computer that segments a CT has."""


class _TooMuchError(Exception):
    """The states do not fit the memory allowed."""


class NoPathProof:
    """Tries to prove that no path leads from a start to within the goal tolerance of a target.

    Args:
        max_bytes: Most memory for states and tables.

    Attributes:
        outcome: "running", "no path" (proved) or "undecided" (paths may exist).
        reason: What proves it, or why the end is undecided.
        cell_mm, slope_cell: Sides of the cells of the present level: of position in mm, and of direction as a
            slope (1 is 45 degrees).
        passage: What the last finished level left; None before the first, and where the proof succeeds.

    Raises:
        SettingsError: If `max_bytes` is not positive.

    Notes:
        Among the limits, those of curvature and of the angle from the reference count; those of length and of
        accumulated turn count only in so far as together they forbid turning by more than 180 degrees in all.
        Without that, nothing is proved.
    """

    def __init__(self, environment: NeedleEnvironment, query: Query, *, max_bytes: int = MAX_BYTES) -> None:
        if max_bytes <= 0:
            raise SettingsError(f"The memory for a proof is {max_bytes} bytes", expected="more than 0")
        self.outcome = "running"
        self.reason = ""
        self.cell_mm = math.inf
        self.slope_cell = math.inf
        self.passage: Passage | None = None
        self.states = 0
        """Largest number of states on a plane so far."""
        self._environment = environment
        self._query = query
        self._max_bytes = max_bytes
        # In 1/mm; what bends less is taken to bend so much, for the sake of rounding.
        self._kappa = max(environment.limits.kappa * (1.0 + ROUNDING), 1e-5)
        self._tolerance = environment.goal_tolerance_mm + bounds.SPARE
        self._chord = query.target - query.lps_from_start[:3, 3]
        self._length = environment.limits.max_length_mm - query.inserted_mm + bounds.SPARE
        self._planes: list[Plane] = []
        self._coarse: list[Plane] = []
        self._too_steep = False
        self._steps = self._run()

    def advance(self, most_cubes: int = ALL_CUBES) -> bool:
        """Do a step: some cubes, a plane forward or all backward; return whether the proof has ended."""
        self._most_cubes = most_cubes
        if self.outcome == "running":
            try:
                next(self._steps, None)
            except _TooMuchError:
                self._end("undecided", "more states than fit the memory allowed")
            if self.outcome != "running":
                self._planes, self._coarse = [], []
        return self.outcome != "running"

    def run(self) -> str:
        """Go on to the end; return the outcome."""
        while not self.advance():
            pass
        return self.outcome

    def _end(self, outcome: str, reason: str) -> None:
        self.outcome, self.reason = outcome, reason
        if outcome == "no path":
            self.passage = None

    def _run(self) -> Iterator[None]:
        """Try one kind of proof after the other."""
        self._rule_out()
        if self.outcome != "running":
            return
        yield
        self._measure()
        # Sides of the cubes, the faster ones first.
        for side in (0.5, 0.25):
            if (yield from self._parted(side)):
                self._end("no path", f"blocked, whatever the curvature, by cubes of {side:g} mm")
                return
            yield
        self._aim_planes()
        if self.outcome == "running":
            yield from self._refine()

    def _rule_out(self) -> None:
        """Look whether the proof can hold or is already done."""
        environment, query, length = self._environment, self._query, self._length
        total = float(np.linalg.norm(self._chord))
        turn = min(environment.limits.max_turn_rad - query.turned_rad, self._kappa * length)
        if environment.limits.lookup_step_mm > 0.0:
            self._end("undecided", "paths of this environment need not be clear")
        elif turn > math.pi * (1.0 + ROUNDING):
            self._end("undecided", "the needle may turn by more than 180 degrees in all")
        elif total <= self._tolerance + LEAST_DISTANCE_MM:
            self._end("undecided", "the target lies at the start")
        elif total - self._tolerance > length:
            self._end("no path", "the target is farther than the needle is long")
        elif found := blocked_end(environment, query):
            self._end("no path", f"the {found.place} is too near to obstacles")
        else:
            ahead = float(self._chord @ query.lps_from_start[:3, 2])
            aside = math.sqrt(max(total**2 - ahead**2, 0.0))
            if bounds.escape_depth(aside, ahead, 1.0 / self._kappa) < -self._tolerance - LEAST_DISTANCE_MM:
                self._end("no path", "the target lies outside the workspace of the start")

    def _measure(self) -> None:
        """Set up the line from start to target."""
        start = self._query.lps_from_start
        total = float(np.linalg.norm(self._chord))
        normal = self._chord / total
        first = int(np.argmin(np.abs(normal)))
        second, third = (first + 1) % 3, (first + 2) % 3
        row, column = normal[first] * normal, np.zeros(3)
        row[first] -= 1.0
        column[second], column[third] = normal[third], -normal[second]
        across = math.hypot(normal[second], normal[third])
        self._frame = np.stack([start[:3, 3], normal, row / across, column / across])
        self._paths = PathBounds.of(total, self._tolerance, self._kappa, self._length)
        local = self._frame[1:] @ start[:3, 2]
        self._along = float(local[0])
        self._scale = np.zeros(bounds.SCALE_SIZE)
        self._scale[bounds.KAPPA] = self._kappa
        if self._along > 0.0:
            self._scale[bounds.FIRST_V : bounds.FIRST_U + 1] = local[1:] / local[0]
        self._tangent = self._scale[bounds.FIRST_V : bounds.FIRST_U + 1] @ self._frame[2:]

    def _parted(self, side: float) -> Generator[None, None, bool]:
        """Tell whether cubes that no path can pass part the target from the start."""
        if self._along <= 0.0:
            return False
        beside = math.ceil(self._paths.aside_mm / side) + 1
        before = math.ceil(self._paths.before_mm / side) + 1
        between = math.ceil(self._paths.ends[bounds.TOTAL] / side)
        shape = np.array([before + between + before, 2 * beside, 2 * beside]) + 1
        size = math.prod(int(n) for n in shape)
        if 5 * size > self._max_bytes or size >= ALL_CUBES:
            return False
        seen, queue, span = np.zeros(shape, dtype=np.bool_), np.zeros(1, np.int32), np.zeros(2, np.int64)
        while True:
            room = min(int(span[blocked.END]) + blocked.NEIGHBOURS * self._most_cubes + 1, size)
            if room > len(queue):
                queue = np.concatenate([queue, np.zeros(min(room, size - len(queue)), np.int32)])
            if blocked.flood(
                self._environment.obstacles, self._environment.limits, self._query.branch,
                self._query.inserted_mm, self._scale, self._paths.ends, self._frame, side,
                np.array([-before, -beside, -beside]), seen, queue, span, self._most_cubes,
            ):  # fmt: skip
                return False
            if span[blocked.BEGIN] == span[blocked.END]:
                return True
            yield

    def _aim_planes(self) -> None:
        """Choose the planes and the direction from which the limit of the angle counts."""
        last = float(self._paths.ends[bounds.TOTAL]) - self._tolerance
        # Distance of the planes as a share of the radius of curvature.
        # Greatest distance of the planes, however little the needle bends.
        self._count = math.ceil(last / min(0.1 / self._kappa, 12.5))
        self._depth = last / self._count
        # Largest sine of the angle between paths and the planes' normal for which planes are tried.
        self._proved_steepest = self._paths.steepest <= 0.995
        sine = self._paths.steepest if self._proved_steepest else 1.0 - self._kappa * self._depth
        self._scale[bounds.TOP_SINE] = sine
        if self._along <= 0.0 or math.sqrt(max(1.0 - self._along**2, 0.0)) >= sine:
            self._end("undecided", "the start looks away from the target")
        reference = self._query.reference
        if reference is None:
            reference = self._query.lps_from_start[:3, 2]
        self._reference = self._frame[1:] @ reference

    def _refine(self) -> Iterator[None]:
        """Go through all planes forward and backward, again and again with smaller cells."""
        self.cell_mm = min(FIRST_CELL_MM, 0.5 * LARGEST_SLOPE_CELL * self._depth)
        # How often cells are halved at most: then positions are known to 2 um.
        for level in range(9):
            self._split = False
            if level > 0:
                # Halving positions and depth leaves the cells of directions as they are.
                # Planes are moved nearer to each other where curvature times their distance squared is more.
                self._split = self._kappa * self._depth**2 > 16.0 * self.cell_mm
                self.cell_mm *= 0.5
                self._depth *= 0.5 if self._split else 1.0
                self._count *= 2 if self._split else 1
            self.slope_cell = 2.0 * self.cell_mm / self._depth
            self._scale[bounds.CELL], self._scale[bounds.SLOPE_CELL] = self.cell_mm, self.slope_cell
            if not self._proved_steepest:
                self._scale[bounds.TOP_SINE] = 1.0 - self._kappa * self._depth
            self._planes = []
            for number in range(self._count + 1):
                self._forward(number)
                if self.outcome != "running":
                    return
                yield
            for number in range(self._count - 1, -1, -1):
                self._backward(number)
                if self.outcome != "running":
                    return
            yield
            self._coarse = self._planes
            line = self._frame[0], self._frame[1] + self._tangent, self._frame[2:]
            self.passage = tightest(self._planes, self._depth, self.cell_mm, self._paths, self._kappa, line)
        self._end("undecided", "states are left at the finest level")

    def _forward(self, number: int) -> None:
        """Add a plane: the states reached from the plane before, or the start."""
        plane = self._allowed(number)
        bounds.prune_unreachable(
            plane.bits, plane.window, self._scale, self._paths.ends, number * self._depth, self._reference,
            self._environment.limits.max_angle_rad,
        )  # fmt: skip
        if number > 0 and plane.bits.any():
            plane = plane.trimmed()
            self._step(self._planes[-1], 1, plane, 2.0 if number > 1 else 1.0)
        if plane.bits.any():
            plane = plane.trimmed()
            self._keep_clear(plane, number)
        if not plane.bits.any():
            self._end("no path", f"no state is left {number * self._depth:.1f} mm from the start")
            return
        plane = plane.trimmed()
        self.states = max(self.states, int(np.bitwise_count(plane.bits).sum()))
        if not self._proved_steepest and not self._coarse and number < self._count:
            sine = bounds.steepest_of(plane.bits, plane.window, self._scale)
            self._too_steep = self._too_steep or sine > 1.0 - 2.0 * self._kappa * self._depth
        if self._too_steep:
            self._end("undecided", "paths may be too steep for the planes")
            return
        self._planes.append(plane)

    def _backward(self, number: int) -> None:
        """Remove from a plane what does not lead to the next one."""
        plane = self._planes[number]
        self._step(self._planes[number + 1], -1, plane, 2.0)
        if not plane.bits.any():
            self._end("no path", f"no state {number * self._depth:.1f} mm from the start leads to the target")
            return
        self._planes[number] = plane.trimmed()

    def _allowed(self, number: int) -> Plane:
        """Return all states of a plane that are to be looked at."""
        if number == 0:
            return Plane(np.ones((1, 1, 1, 1), dtype=np.uint64), np.zeros(4, dtype=np.int64))
        if self._coarse and not (self._split and number % 2):
            coarse = self._coarse[number // 2 if self._split else number]
            return coarse.refined(directions=not self._split, require=self._require)
        low, high = self._reached(self._planes[-1].window, self._planes[-1].ends, 1, number)
        if self._coarse:
            after = self._coarse[number // 2 + 1]
            # Cells of position, halved, overlap one more to either side.
            twice, more = np.array([1, 1, 2, 2]), np.array([0, 0, 1, 1])
            back = self._reached(after.window * twice - more, after.ends * twice + more, -1, number)
            low = np.maximum(low, back[0])
            high = np.maximum(np.minimum(high, back[1]), low)
        shape = high - low + 1
        shape[3] = -(-int(shape[3]) // 64)
        self._require(8 * math.prod(int(n) for n in shape))
        return Plane(np.full(tuple(shape), bitmaps.ALL, dtype=np.uint64), low)

    def _reached(self, low: Int, high: Int, direction: int, number: int) -> tuple[Int, Int]:
        """Return the first and last cells on a plane that states of that before (direction 1) or after (-1)
        reach."""
        scale = self._scale
        reach = bounds.largest_reach(scale, self._depth, 2.0, low, *(high - low + 1)[:2])
        top = scale[bounds.TOP_SINE]
        steep = top / math.sqrt(1.0 - top * top)
        aside = math.ceil(bounds.largest_aside(top, scale, self._depth, 0.0, 1e9) / self.cell_mm + 4.0)
        least, most = low.copy(), high.copy()
        for axis in (0, 1):
            first = scale[bounds.FIRST_V + axis]
            least[axis] = max(low[axis] - reach, math.floor((-steep - first) / self.slope_cell) - 1)
            most[axis] = max(
                min(high[axis] + reach, math.ceil((steep - first) / self.slope_cell) + 1), least[axis]
            )
            moves = direction * (low[axis] + least[axis]), direction * (high[axis] + most[axis])
            least[axis + 2] += min(moves) - aside
            most[axis + 2] += max(moves) + aside
            middle = number * self._depth * first
            farthest = self._paths.aside_mm
            least[axis + 2] = max(least[axis + 2], math.floor((-farthest - middle) / self.cell_mm) - 1)
            most[axis + 2] = min(most[axis + 2], math.ceil((farthest - middle) / self.cell_mm) + 1)
            most[axis + 2] = max(most[axis + 2], least[axis + 2])
        return least, most

    def _require(self, size: int) -> None:
        used = sum(plane.bits.nbytes for plane in self._planes + self._coarse)
        if used + size > self._max_bytes:
            raise _TooMuchError

    def _step(self, plane: Plane, direction: int, other: Plane, blur: float) -> None:
        """Keep of another plane what a plane's states reach, as many rows of directions at once as fit."""
        nv, nu, rows, words = other.bits.shape
        reach = bounds.largest_reach(self._scale, self._depth, blur, other.window, nv, nu)
        chunk = nv
        while True:
            part = plane.bits[: chunk + 2 * reach]
            try:
                self._require(8 * math.prod(sets.table_shape(part, reach)) + 2 * other.bits.nbytes)
                break
            except _TooMuchError:
                if chunk == 1:
                    raise
                chunk = (chunk + 1) // 2
        for first in range(0, nv, chunk):
            target = other.bits[first : first + chunk]
            offset = int(other.window[0] - plane.window[0]) + first
            low, high = max(offset - reach, 0), max(offset + chunk + reach, 0)
            source = plane.bits[low:high]
            if source.shape[0] == 0:
                target[:] = 0
                continue
            sets.step_sets(
                source, plane.window + np.array([low, 0, 0, 0]), self._scale, self._depth, direction, blur,
                SLOPE_CHANGE_EDGES, target, other.window + np.array([first, 0, 0, 0]),
            )  # fmt: skip

    def _keep_clear(self, plane: Plane, number: int) -> None:
        """Test half a slab to either side of a plane."""
        here = number * self._depth
        last = self._count * self._depth
        probes = self._depth / PROBES_PER_DEPTH * np.arange(-PROBES_PER_DEPTH // 2, PROBES_PER_DEPTH // 2 + 1)
        probes = probes[(here + probes > -1e-9) & (here + probes < last + 1e-9)]
        corners, shape = plane.probed_cells(np.asarray(probes * self.slope_cell / self.cell_mm))
        rows, words = int(shape[:, 0].max()), -(-int(shape[:, 1].max()) // 64)
        # Amounts of missing clearance that are told apart differ by this factor.
        slacks = bounds.HALF_DIAGONAL * self.cell_mm * 1.08 ** np.arange(SLACKS)
        self._require(len(probes) * rows * words * (8 + 64 + 8 * SLACKS))
        probed = np.zeros((len(probes), rows, words), dtype=np.uint64)
        blocked.mark_probed(plane.bits, plane.window, self._scale, probes, probed, corners)
        grades = np.zeros((len(probes), rows, 64 * words), dtype=np.uint8)
        across = self._frame[2:] * self.cell_mm
        limits = self._environment.limits
        for n, probe in enumerate(probes):
            depth = here + float(probe)
            # A path at this depth is at least as long, so beyond the exempt length nothing is spared.
            inserted = self._query.inserted_mm + max(depth, 0.0)
            exempt = self._query.branch if inserted < limits.exempt_mm else -1
            origin = self._frame[0] + depth * (self._frame[1] + self._tangent) + corners[n] @ across
            blocked.grade_clearance(
                self._environment.obstacles, limits, exempt, inserted, origin, across, probed[n], slacks,
                grades[n],
            )  # fmt: skip
        blocked.keep_clear(plane.bits, plane.window, self._scale, probes, corners, grades, slacks)
