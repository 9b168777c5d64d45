"""The states that paths can have on planes between start and target, and the tightest place that is left.

The backward reachable set of a target tells where every path to it may come from, whatever its start;
docs/theory/unreachable.md derives it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float, Int, UInt64
from stages.needle.environment import NeedleEnvironment
from stages.needle.infeasibility.kernels import bitmaps, bounds
from stages.needle.infeasibility.kernels.backward_reach import SHELL_MM, BackwardReach, fill_backward_reach

ROUNDING = 1e-8
"""Share by which curvature and angles are taken too large, so that rounding rules out no path."""


@dataclass(frozen=True)
class Plane:
    """States on one plane: bits (V, U, Y, W) and the cell numbers (v, u, y, x) of their first cell."""

    bits: UInt64
    window: Int

    def trimmed(self) -> "Plane":
        """Return the same without empty rows and columns at the edges."""
        box = np.zeros(8, dtype=np.int64)
        bitmaps.extent(self.bits, box)
        v0, v1, u0, u1, y0, y1, w0, w1 = (int(n) for n in box)
        bits = self.bits[v0 : v1 + 1, u0 : u1 + 1, y0 : y1 + 1, w0 : w1 + 1]
        return Plane(np.ascontiguousarray(bits), self.window + np.array([v0, u0, y0, 64 * w0]))

    @property
    def ends(self) -> Int:
        """Cell numbers of the last cell."""
        nv, nu, rows, words = self.bits.shape
        last: Int = self.window + np.array([nv, nu, rows, 64 * words]) - 1
        return last

    def refined(self, *, directions: bool, require: Callable[[int], None]) -> "Plane":
        """Return the states in cells half as wide, directions too if asked; `require` gets the bytes."""
        halved = np.array([directions, directions, True, True])
        shape = np.where(halved, 2 * np.array(self.bits.shape) + 1, self.bits.shape)
        require(8 * math.prod(int(n) for n in shape))
        bits = np.zeros(tuple(shape), dtype=np.uint64)
        bitmaps.refine(self.bits, directions, bits)
        return Plane(bits, np.where(halved, 2 * self.window - 1, self.window))

    @property
    def places(self) -> Int:
        """Cells (N, 2) of position, numbers (y, x), in which the plane has a state of any direction."""
        words = np.ascontiguousarray(np.bitwise_or.reduce(self.bits, axis=(0, 1))).astype("<u8")
        cells = np.unpackbits(words.view(np.uint8), axis=1, bitorder="little")
        return np.asarray(np.argwhere(cells) + self.window[2:], dtype=np.int64)

    def probed_cells(self, moves: Float) -> tuple[Int, Int]:
        """Return the first cells (y, x) that the tangents meet at D depths, and how many: `(D, 2)` each.

        `moves` `(D,)` are the cells of position by which a tangent moves up to each depth, for each cell of
        direction.
        """
        low, high = self.window, self.ends
        corners = np.zeros((len(moves), 2), dtype=np.int64)
        shape = np.zeros((len(moves), 2), dtype=np.int64)
        for axis in (0, 1):
            ends = np.stack([moves * low[axis], moves * high[axis]])
            corners[:, axis] = low[axis + 2] + np.floor(ends.min(axis=0)) - 1
            shape[:, axis] = high[axis + 2] + np.ceil(ends.max(axis=0)) + 2 - corners[:, axis]
        return corners, shape


@frozen_record
class PathBounds:
    """Bounds of the places and directions of all paths.

    Args:
        ends ((ENDS_SIZE,) float64): See `stages.needle.infeasibility.kernels.bounds`.
        steepest: Largest sine of the angle between a path and the line from start to target.
        aside_mm, before_mm: How far aside of that line, and how far before the start or behind the target, a
            path can go.
    """

    ends: Float
    steepest: float
    aside_mm: float
    before_mm: float

    @classmethod
    def of(cls, total_mm: float, tolerance_mm: float, kappa: float, length_mm: float) -> "PathBounds":
        """Return the bounds for a target `total_mm` away, of which paths may end `tolerance_mm` off.

        `kappa` is the greatest curvature in 1/mm, `length_mm` the greatest length of a path.
        """
        radius, widest = 1.0 / kappa, total_mm + tolerance_mm
        ends = np.zeros(bounds.ENDS_SIZE)
        ends[: bounds.LONGEST] = total_mm, tolerance_mm
        ends[bounds.SPINDLE_RADIUS] = math.inf
        steepest, longest, highest = 1.0, length_mm, math.inf
        if widest < 2.0 * radius:
            half = math.asin(0.5 * widest / radius)
            tilt = math.asin(tolerance_mm / total_mm)
            offset = radius * math.cos(half)
            ends[bounds.SPINDLE_MIDDLE :] = 0.5 * widest, offset, radius + widest * tilt
            steepest = math.sin(min(half + tilt + ROUNDING, 0.5 * math.pi))
            longest = min(longest, 2.0 * half * radius)
            highest = radius + widest * tilt - offset
        longest += tolerance_mm
        ends[bounds.LONGEST] = longest
        return cls(
            ends=ends,
            steepest=steepest,
            aside_mm=min(0.5 * math.sqrt(longest**2 - total_mm**2) + bounds.SPARE, highest),
            before_mm=0.5 * (longest - total_mm) + bounds.SPARE,
        )

    def width_mm(self, depth_mm: float, kappa: float) -> float:
        """Return about how wide paths spread at a depth without obstacles, by their start and the spindle."""
        of_start = kappa * depth_mm**2
        radius, total = float(self.ends[bounds.SPINDLE_RADIUS]), float(self.ends[bounds.TOTAL])
        if not math.isfinite(radius):
            return of_start
        aside = math.sqrt(max(radius**2 - (depth_mm - 0.5 * total) ** 2, 0.0))
        return min(of_start, 2.0 * max(aside - float(self.ends[bounds.SPINDLE_OFFSET]), 0.0))


CELL = 0.008
"""Side of a cell of the plane of directions: 0.016 rad in the middle, 0.8 mm at 50 mm."""

NOT_BOUNDED = BackwardReach(
    frame=np.zeros((4, 3)), cell=CELL, kappa=0.0, angles=np.zeros((0, 1, 1), dtype=np.uint8)
)
"""The backward reach of a needle that may come from everywhere."""


@frozen_value
class Passage:
    """Where every path leads through, if there is one.

    It is the plane whose states are the narrowest beside what is wide enough for all paths without obstacles.

    Args:
        point_lps ((3,) tuple of float): Its middle, LPS mm.
        width_mm: Diameter of a disc of its area; the area is taken too large, by the cells along its edge.
        from_start_mm: Distance of its plane from the start.
        cell_mm, slope_cell: Resolution at which the query is open: sides of the cells of position in mm, and
            of direction as a slope (1 is 45 degrees).
    """

    point_lps: tuple[float, float, float]
    width_mm: float
    from_start_mm: float
    cell_mm: float
    slope_cell: float


def tightest(
    planes: Sequence[Plane],
    depth_mm: float,
    cell_mm: float,
    paths: PathBounds,
    kappa: float,
    line: tuple[Float, Float, Float],
) -> Passage | None:
    """Return the plane on which the states are narrowest for where it lies; None if all are near an end.

    The planes are `depth_mm` apart; `paths` tells where paths can be without obstacles; `line` holds the
    start (3,), what a mm of depth moves the first cell (3,), and the axes of cells (2, 3), LPS mm.
    """
    least, found = math.inf, None
    for number, plane in enumerate(planes):
        free_mm = paths.width_mm(number * depth_mm, kappa)
        # Cells; where paths are no wider without obstacles, the states say little.
        if free_mm < 4.0 * cell_mm:
            continue
        cells = plane.places
        width_mm = 2.0 * cell_mm * math.sqrt(len(cells) / math.pi)
        if width_mm < least * free_mm:
            least, found = width_mm / free_mm, (cells, number * depth_mm, width_mm)
    if found is None:
        return None
    cells, from_start_mm, width_mm = found
    start, ahead, across = line
    x, y, z = (start + from_start_mm * ahead + cells.mean(axis=0) * cell_mm @ across).tolist()
    return Passage(
        point_lps=(x, y, z),
        width_mm=width_mm,
        from_start_mm=from_start_mm,
        cell_mm=cell_mm,
        slope_cell=2.0 * cell_mm / depth_mm,
    )


def backward_reach(
    environment: NeedleEnvironment, target_lps: Float, middle: Float, *, cell: float = CELL
) -> BackwardReach:
    """Return from which directions paths of a needle may come to a target, at every distance from it.

    What is left out holds no point of a path that keeps its clearance from there to the target.  A needle
    that is longer than half a circle of its least radius may come from everywhere.  Directions far from
    `middle`, which leads from the target to where needles start, are not looked at; `cell` is the side of a
    cell of the plane of directions, half an angle in rad.
    """
    limits = environment.limits
    if limits.max_length_mm * limits.kappa > math.pi:
        return NOT_BOUNDED
    shells = int(min(limits.max_length_mm + SHELL_MM, 2.0 / limits.kappa) / SHELL_MM)
    # The window in this plane holds directions up to 100 degrees from the middle.
    count = 2 * int(1.2 / cell) + 1
    axis = np.asarray(middle, dtype=np.float64) / max(float(np.linalg.norm(middle)), 1e-300)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    reach = BackwardReach(
        frame=np.stack([across, np.cross(axis, across), axis, np.asarray(target_lps, dtype=np.float64)]),
        cell=cell,
        kappa=limits.kappa,
        angles=np.zeros((shells, count, count), dtype=np.uint8),
    )
    # A path that ends beside the target, moved onto it, keeps less.
    required = limits.required_mm - environment.goal_tolerance_mm
    fill_backward_reach(environment.obstacles, required, reach)
    return reach
