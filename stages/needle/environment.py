"""The environment of a needle: obstacles as arrays, and the needle's limits, as the kernels take them."""

import math
from dataclasses import field, replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Labels
from anatomy.fields import CENTRES, SOLID, distance_field
from anatomy.grid import Grid, Volume, read_only
from anatomy.kernels.field import EXACT_REACH_MM
from anatomy.margins import Margins
from anatomy.organ import Organ
from anatomy.structures import AIRWAY, BRANCH_SHIFT, OBSTACLES, close_border, obstacle_bits
from stages.needle.device import Needle
from stages.needle.kernels import start_trial
from stages.needle.kernels.cost import ObjectiveArrays
from stages.needle.kernels.proof import Limits, Obstacles
from stages.needle.objective import Objective


@frozen_record
class NeedleEnvironment:
    """One needle among obstacles.

    Args:
        required_clearance_mm: Distance that the needle's axis keeps from obstacles.
        goal_tolerance_mm: How far from the target a path may end.
        cost_map: Cost of a mm of path at each voxel, on `grid`; infinite is an obstacle.
    """

    grid: Grid
    needle: Needle
    required_clearance_mm: float
    goal_tolerance_mm: float
    obstacles: Obstacles
    limits: Limits
    cost_map: Volume | None
    _objectives: dict[Objective, ObjectiveArrays] = field(default_factory=dict, init=False, repr=False)

    def objective_arrays(self, objective: Objective) -> ObjectiveArrays:
        """Return an objective for the kernels; made once, because the least cost of a map takes a while."""
        if objective not in self._objectives:
            costs = None if self.cost_map is None else self.cost_map.array
            self._objectives[objective] = objective.arrays(costs, self.needle.diameter_mm)
        return self._objectives[objective]


def needle_environment(
    lung: Organ, needle: Needle, margins: Margins, *, with_fissures: bool, goal_tolerance_mm: float = 0.0
) -> NeedleEnvironment:
    """Gather what the kernels need to steer `needle` through `lung`, whose fissures may be obstacles.

    The needle's axis keeps its radius and the margins from obstacles, whose voxels are solid boxes.  A path
    may end `goal_tolerance_mm` from the target.
    """
    clearance = lung.obstacle_field(with_fissures=with_fissures)
    required = needle.radius_mm + margins.total_mm
    obstacles = Obstacles(clearance.corners, lung.labels, clearance.geometry, obstacle_bits(with_fissures))
    return _environment(lung.grid, needle, required, obstacles, lung.cost, goal_tolerance_mm)


def environment_of_labels(
    labels: Labels,
    grid: Grid,
    needle: Needle,
    *,
    bits: int = OBSTACLES,
    required_clearance_mm: float,
    obstacles_as: float = SOLID,
    goal_tolerance_mm: float = 0.0,
    cost_map: Volume | None = None,
) -> NeedleEnvironment:
    """Gather the same from a label volume `(ni, nj, nk)` uint16 alone, see `anatomy.structures`.

    With `obstacles_as` SOLID the clearance is measured to voxels as solid boxes, and the outermost voxels
    count as OUTSIDE, since what lies beyond the grid is not known; with CENTRES it is measured to voxel
    centres, and the axis alone stays in the grid.  The cost map lies on `grid`.

    Raises:
        GridMismatchError: If labels or cost map do not fit the grid.
        SettingsError: If `obstacles_as` is neither, or a length is negative or not finite.
    """
    if labels.shape != grid.shape or (cost_map is not None and cost_map.array.shape != grid.shape):
        raise GridMismatchError(
            "Labels or cost map do not fit the grid", expected=f"arrays of the shape {grid.shape}"
        )
    if obstacles_as not in (SOLID, CENTRES):
        raise SettingsError(
            f"Obstacles cannot be taken as {obstacles_as}", expected=f"{SOLID} (boxes) or {CENTRES} (centres)"
        )
    labels = np.array(labels, dtype=np.uint16, order="F")
    if obstacles_as == SOLID:
        close_border(labels)
    clearance = distance_field("obstacle", (labels & bits) != 0, grid, obstacles_as)
    obstacles = Obstacles(clearance.corners, read_only(labels), clearance.geometry, bits)
    return _environment(grid, needle, required_clearance_mm, obstacles, cost_map, goal_tolerance_mm)


def begun_at_wall(
    environment: NeedleEnvironment, point: ArrayLike, branches: tuple[int, ...]
) -> NeedleEnvironment:
    """Return an environment for a needle that begins at a point `(3,)` LPS mm at a wall and pierces it.

    The rule of `stages.needle.kernels.proof.exact_gap` is that of all searches and proofs.  The airways of
    all `branches`, the pierced one first, count as that of the first, as far as the exemption reaches.
    """
    # A needle that pierces the wall itself leaves it at this angle at least: the least of the presets' tubes.
    limits = environment.limits._replace(leaving_sine=math.sin(math.radians(10.0)))
    obstacles = environment.obstacles
    if len(branches) > 1:
        far = limits.exempt_mm + limits.required_mm + EXACT_REACH_MM
        labels = obstacles.labels.copy(order="F")
        part = labels[environment.grid.window(point, far)]
        joined = ((part & AIRWAY) != 0) & np.isin((part >> BRANCH_SHIFT) - 1, branches[1:])
        names = np.uint16((1 << BRANCH_SHIFT) - 1)
        part[joined] = (part[joined] & names) | np.uint16((branches[0] + 1) << BRANCH_SHIFT)
        obstacles = obstacles._replace(labels=read_only(labels))
    return replace(environment, limits=limits, obstacles=obstacles)


RRT_STEP_MM = 20.0
"""Longest arc of a tree.  The value is a free choice: a path across a lobe takes several arcs."""
COST_STEP_MM = 0.5
"""Step of estimated integrals: about a voxel, since clearance changes by no more than one moves."""
ROUNDING_MM = 1e-6
"""The searches keep a goal tolerance that is smaller by this, so that rounding leads no path out of it."""


def _environment(
    grid: Grid, needle: Needle, required_mm: float, obstacles: Obstacles, cost: Volume | None, miss_mm: float
) -> NeedleEnvironment:
    for name, value in (("required clearance", required_mm), ("goal tolerance", miss_mm)):
        if not 0.0 <= value < math.inf:
            raise SettingsError(f"The {name} is {value} mm", expected="a finite length of 0 or more")
    limits = Limits(
        kappa=float(needle.max_curvature_per_mm),
        max_length_mm=float(needle.max_length_mm),
        max_angle_rad=math.radians(needle.max_angle_from_start_deg),
        max_turn_rad=math.radians(needle.max_accumulated_turn_deg),
        required_mm=float(required_mm),
        radius_mm=float(needle.radius_mm),
        exempt_mm=float(needle.exit_exemption_mm),
        max_step_mm=RRT_STEP_MM,
        cost_step_mm=COST_STEP_MM,
        goal_tolerance_mm=max(float(miss_mm) - ROUNDING_MM, 0.0),
    )
    return NeedleEnvironment(
        grid=grid,
        needle=needle,
        required_clearance_mm=required_mm,
        goal_tolerance_mm=miss_mm,
        obstacles=obstacles,
        limits=limits,
        cost_map=cost,
    )


def workspace_lengths(
    environment: NeedleEnvironment, positions: ArrayLike, tangents: ArrayLike, target: ArrayLike
) -> Float:
    """Return the shortest path length from start poses `(E, 3)` to a target, LPS mm, infinite where none is.

    A path may end anywhere within the goal tolerance.  Nothing that a needle reaches is left out [Kuntz2015,
    fig. 4; Dubins1957].  In free space what is left in can be reached if the angle from the start is limited
    to 90 degrees, or the turn to 180, see `stages.needle.kernels.goal_ball`.
    """
    places = _plain(positions)
    lengths = np.zeros(len(places))
    start_trial.workspace_scan(places, _plain(tangents), _plain(target), environment.limits, lengths)
    return lengths


def direct_arcs(
    environment: NeedleEnvironment,
    positions: ArrayLike,
    tangents: ArrayLike,
    branches: Int,
    target: ArrayLike,
) -> tuple[Int, Float, Float]:
    """Try the single arc to a target `(3,)` from each start pose: positions and tangents `(E, 3)`, LPS mm.

    `branches` `(E,)` are those whose walls the starts have pierced; -1 for none.

    Returns:
        - blockers ((E,) int64) - 0 where the arc is proved clear, -1 where no arc fits the limits, else the
            label of the voxel that is too near.
        - lengths, inverse_clearance ((E,) float64) - Length in mm, and the estimated integral of 1 /
            clearance where the arc is clear.
    """
    blockers = np.zeros(len(branches), dtype=np.int64)
    costs = np.zeros((len(branches), 2))
    start_trial.direct_arcs(
        environment.obstacles, environment.limits, _plain(positions), _plain(tangents),
        np.array(branches, dtype=np.int64), _plain(target), blockers, costs,
    )  # fmt: skip
    return blockers, costs[:, 0], costs[:, 1]


def _plain(array: ArrayLike) -> Float:
    """Copy to the one kind of array (writeable, contiguous) for which the kernels are compiled."""
    return np.array(array, dtype=np.float64, order="C")
