"""Start poses near a planned one, tried one by one."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float, UInt8
from anatomy.grid import read_only
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import start_trial as kernel
from stages.needle.kernels import tree
from stages.needle.objective import SHORTEST
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import MAX_NODES, RANDOM_SHARE
from stages.needle.start_region import TriedStarts

DIRECTIONS = 25
"""Directions tried at each place: enough for shares in steps of 4 %, and for rings of 3 degrees in 15."""
GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))
"""Directions that follow each other are turned by this angle: then they cover the cone evenly."""
TURNS = (0.6180339887498949, 0.7548776662466927)
"""From place to place the directions are shifted by these shares of a step and of a turn: together the
places try many more: multiples of these numbers fall evenly between 0 and 1."""
RING_SHARES = (0.25, 0.5, 0.75)
RING_POINTS = 6
FAR_MM, FAR_RAD = 20.0, math.radians(60.0)
"""Poses farther away are no deviations of this start."""


def try_starts(
    environment: NeedleEnvironment,
    query: Query,
    path: ArcPath,
    *,
    offset_mm: float,
    tilt_rad: float,
    poses: int,
    iterations: int,
    seed: int,
) -> TriedStarts:
    """Try start poses around a planned one; the same input and seed give the same answer.

    Paths of several arcs are looked for through points on the planned path and beside it.  About `poses` are
    tried, `DIRECTIONS` at each place; the RRT from each pose from which nothing simpler leads to the target
    has `iterations`, 0 for none.

    Raises:
        SettingsError: If a number is out of its range.
    """

    def tried(positions: Float, tangents: Float) -> UInt8:
        return try_poses(environment, query, path, positions, tangents, iterations=iterations, seed=seed)

    if iterations < 0:
        raise SettingsError(
            f"A search cannot have {iterations} iterations",
            expected="0 or more",
            remedy="Choose 0 for no search, or 100",
        )
    return try_around(query.lps_from_start, tried, offset_mm=offset_mm, tilt_rad=tilt_rad, poses=poses)


def try_around(
    frame: Float,
    tried: Callable[[Float, Float], UInt8],
    *,
    offset_mm: float,
    tilt_rad: float,
    poses: int,
    directions: int = DIRECTIONS,
) -> TriedStarts:
    """Try poses around a pose: places on a lattice in a ball, each with directions spread evenly in a cone.

    The cone's axis is +z of `frame` `(4, 4)`, `directions` are those at each place, and `tried` takes
    positions and tangents `(N, 3)` and returns `KINDS` `(N,)`.  Raises SettingsError if a number is out of
    its range.
    """
    _require_ranges(offset_mm, tilt_rad, poses, directions)
    places = max(poses // directions, 1)
    spacing = offset_mm * (4.0 / 3.0 * math.pi / places) ** (1.0 / 3.0)
    reach = math.ceil(offset_mm / spacing)
    steps = np.arange(-reach, reach + 1)
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = spacing * np.linalg.norm(lattice, axis=1)
    lattice, offsets = lattice[offsets <= offset_mm], offsets[offsets <= offset_mm]
    positions = frame[:3, 3] + spacing * lattice @ frame[:3, :3].T
    # Each place covers the cone evenly.
    place = np.arange(len(positions))[:, None]
    rank = np.arange(directions) + (TURNS[0] * (place + 0.5)) % 1.0
    tilts = np.arccos(1.0 - rank / directions * (1.0 - math.cos(tilt_rad)))
    around = GOLDEN_RAD * np.arange(directions) + 2.0 * math.pi * TURNS[1] * place
    local = np.stack([np.sin(tilts) * np.cos(around), np.sin(tilts) * np.sin(around), np.cos(tilts)], axis=-1)
    tangents = local @ frame[:3, :3].T
    kinds = tried(np.repeat(positions, directions, axis=0), tangents.reshape(-1, 3))
    return TriedStarts(
        offset_mm=offset_mm,
        tilt_rad=tilt_rad,
        positions=read_only(positions),
        tangents=read_only(tangents),
        offsets_mm=read_only(offsets),
        tilts_rad=read_only(tilts),
        kinds=read_only(kinds.reshape(len(positions), directions)),
        spacing_mm=spacing,
        lattice=read_only(lattice),
    )


def try_poses(
    environment: NeedleEnvironment,
    query: Query,
    path: ArcPath,
    positions: ArrayLike,
    tangents: ArrayLike,
    *,
    iterations: int,
    seed: int,
) -> UInt8:
    """Tell for each of N start poses how a clear path was found, or why none was: `KINDS`, `(N,)`.

    The target and the branch are those of `query`, from the planned start; `path`, `iterations` and `seed` as
    in `try_starts`; `positions` `(N, 3)` are LPS mm, `tangents` `(N, 3)` unit vectors.
    """
    places = np.array(positions, dtype=np.float64, order="C")
    kinds = np.zeros(len(places), dtype=np.uint8)
    rows = min(iterations * tree.ROWS_PER_STEP + kernel.ROWS, MAX_NODES)
    kernel.try_starts(
        environment.obstacles, environment.limits, environment.objective_arrays(SHORTEST), query.branch,
        places, np.array(tangents, dtype=np.float64, order="C"), _vias_around(path), query.goal, iterations,
        RANDOM_SHARE, seed, np.zeros((rows, tree.NODE_COLUMNS)), np.zeros(rows, dtype=np.int64), kinds,
    )  # fmt: skip
    return kinds


def _vias_around(path: ArcPath) -> Float:
    """Return the points `(V, 3)` that paths of several arcs are tried through: on the plan and beside it."""
    points, lengths = path.sample(0.5)
    places = [path.frames()[1:-1, :3, 3]]
    x, y = path.lps_from_start[:3, 0], path.lps_from_start[:3, 1]
    # How far beside the planned path via points lie: enough to pass a vessel of a few mm on its other side.
    for radius in (0.0, 3.0, 6.0):
        for share in RING_SHARES:
            centre = points[int(np.argmin(np.abs(lengths - share * lengths[-1])))]
            angles = 2.0 * math.pi * np.arange(RING_POINTS if radius else 1) / RING_POINTS
            places.append(centre + radius * (np.outer(np.cos(angles), x) + np.outer(np.sin(angles), y)))
    return np.ascontiguousarray(np.vstack(places))


def _require_ranges(offset_mm: float, tilt_rad: float, poses: int, directions: int) -> None:
    if not 0.0 < offset_mm <= FAR_MM:
        raise SettingsError(
            f"Start poses up to {offset_mm} mm away cannot be tried",
            expected=f"above 0, at most {FAR_MM:g} mm",
            remedy="Choose a distance by which the start may really be off, such as 5 mm",
        )
    if not 0.0 < tilt_rad <= FAR_RAD:
        raise SettingsError(
            f"Start poses tilted by up to {math.degrees(tilt_rad):g} degrees cannot be tried",
            expected=f"above 0, at most {math.degrees(FAR_RAD):g} degrees",
            remedy="Choose a tilt that may really occur, such as 15 degrees",
        )
    if poses < directions:
        raise SettingsError(
            f"{poses} start poses cannot be tried",
            expected=f"at least {directions}, the directions tried at one place",
            remedy="Ask for thousands: a share is known to 1 % from 10,000",
        )
