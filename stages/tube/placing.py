"""The shapes of a design, placed in a patient: which leave the airway safely, and from which scope tips."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from stages.tube import kernels
from stages.tube.environment import DEFAULT_ROTATIONS, THREADS, tube_environment
from stages.tube.kernels import placing
from stages.tube.shape_tree import ShapeTree, tree_of_shapes
from stages.tube.shapes import TubeShapes
from stages.tube.validation import REASONS


@frozen_record
class PlacedShapes:
    """Shapes that leave the airway safely, E of them, and counts of the refused.

    Parameters
    ----------
    site, shape : (E,) int64
        Index of the scope tip, and of the shape in `shapes`.
    rotation_rad : (E,) float64
        Rotation of all tubes together about +z of the scope tip.
    branch : (E,) int64
        Pierced branch.
    exit_mm, wall_angle_rad, wall_run_mm : (E,) float64
        Arc length at which the axis leaves the lumen, its angle to the wall there, and the run in the wall:
        those of the shape that shares the beginning, which is within the tolerance of the tree.
    positions, tangents : (E, 3) float64
        Tip of the innermost tube, LPS mm.
    candidates : int
        Deployments looked at.
    refused : dict of str to int
        Counts by reason.
    """

    shapes: TubeShapes
    site: Int
    shape: Int
    rotation_rad: Float
    branch: Int
    exit_mm: Float
    wall_angle_rad: Float
    wall_run_mm: Float
    positions: Float
    tangents: Float
    candidates: int
    refused: dict[str, int]

    @property
    def count(self) -> int:
        """Number of placed shapes, E."""
        return len(self.site)


def place_shapes(
    lung: Lung,
    shapes: TubeShapes,
    margins: Margins,
    scope_tips: ArrayLike,
    *,
    min_wall_angle_rad: float,
    max_wall_run_mm: float,
    with_fissures: bool,
    rotations: int = DEFAULT_ROTATIONS,
    tree: ShapeTree | None = None,
    progress: Callable[[float], None] | None = None,
) -> PlacedShapes:
    """Return the shapes of a design that leave the airway safely from many scope tips.

    A stretch that many shapes share is followed once; where it is refused, so are all of them.  What a shape
    sweeps, and what its arcs and the sharing are off by, is added to its clearance.

    Parameters
    ----------
    scope_tips : (S, 4, 4) float64
        `lps_from_scope_tip` of each scope tip.
    min_wall_angle_rad, max_wall_run_mm : float
        Limits at the wall, see `ConcentricTubes`.
    with_fissures : bool
        Whether fissures are obstacles.
    rotations : int
        Evenly spaced rotations of all tubes together.
    tree : ShapeTree, optional
        That of the shapes; `tree_of_shapes(shapes)` if None.
    progress : callable, optional
        Told the share of scope tips done.
    """
    tips = np.array(scope_tips, dtype=np.float64).reshape(-1, 4, 4)
    tree = tree or tree_of_shapes(shapes)
    nodes = tree.with_margin(margins.total_mm)
    environment = tube_environment(lung, with_fissures=with_fissures)
    limits = np.zeros(kernels.N_TUBES)
    limits[kernels.MIN_WALL_ANGLE], limits[kernels.MAX_WALL_RUN] = min_wall_angle_rad, max_wall_run_mm
    angles = 2.0 * math.pi / rotations * np.arange(rotations)
    done = 0

    def one_site(site: int) -> tuple[Float, Int, Int]:
        nonlocal done
        refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
        traces = np.zeros((int(tree.depth.max(initial=0)) + 1, kernels.N_TRACE))
        room = np.zeros((shapes.count, placing.PLACED_COLUMNS))
        rows, turns = [], []
        for turn, angle in enumerate(angles):
            turned = tips[site] @ _about_z(angle)
            count = placing.place_tree(environment, limits, turned, nodes, refused, traces, room)
            rows.append(room[:count].copy())
            turns.append(np.full(count, turn))
        done += 1
        if progress and done % 50 == 0:
            progress(done / len(tips))
        return np.concatenate(rows), np.concatenate(turns), refused

    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(one_site, range(len(tips))))
    rows = np.concatenate([np.zeros((0, placing.PLACED_COLUMNS)), *(part[0] for part in parts)])
    turns = np.concatenate([np.zeros(0, dtype=np.int64), *(part[1] for part in parts)])
    sites = np.repeat(np.arange(len(tips)), [len(part[0]) for part in parts])
    refused = sum((part[2] for part in parts), np.zeros(kernels.N_REASONS, dtype=np.int64))
    shape = rows[:, placing.PLACED_SHAPE].astype(np.int64)
    lps = tips[sites] @ _about_z(angles)[turns] @ shapes.scope_from_tip[shape]
    return PlacedShapes(
        shapes=shapes,
        site=read_only(sites),
        shape=read_only(shape),
        rotation_rad=read_only(angles[turns]),
        branch=read_only(rows[:, placing.PLACED_BRANCH].astype(np.int64)),
        exit_mm=read_only(rows[:, placing.PLACED_EXIT].copy()),
        wall_angle_rad=read_only(rows[:, placing.PLACED_ANGLE].copy()),
        wall_run_mm=read_only(rows[:, placing.PLACED_RUN].copy()),
        positions=read_only(lps[:, :3, 3].copy()),
        tangents=read_only(lps[:, :3, 2].copy()),
        candidates=len(tips) * rotations * shapes.count,
        refused={REASONS[code]: int(refused[code]) for code in REASONS if refused[code]},
    )


def _about_z(angles_rad: ArrayLike) -> Float:
    """Return rotations about +z `(..., 4, 4)`."""
    angles = np.asarray(angles_rad, dtype=np.float64)
    turned = np.zeros((*angles.shape, 4, 4))
    turned[..., 0, 0] = turned[..., 1, 1] = np.cos(angles)
    turned[..., 1, 0] = np.sin(angles)
    turned[..., 0, 1] = -turned[..., 1, 0]
    turned[..., 2, 2] = turned[..., 3, 3] = 1.0
    return turned
