"""The bronchoscope stage on a made-up airway, and what compiling it costs."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.grid import Grid, Volume
from benchmarks.fresh import FreshProcess
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state
from stages.scope.advisor.best_motion import Weights, evaluate_motions
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import Lumen, lumen_of_mask
from stages.scope.advisor.nf1 import goal_at, navigation_field

SPACING_MM = (0.7, 0.7, 0.6)
LINES = (
    ((0, 0, 80), (0, 0, 0), 8.0),
    ((0, 0, 0), (45, 8, -48), 6.0),
    ((0, 0, 0), (-40, 4, -40), 6.0),
    ((45, 8, -48), (80, 8, -80), 4.0),
    ((45, 8, -48), (42, 30, -95), 4.0),
    ((-40, 4, -40), (-76, 0, -70), 4.0),
)
GOAL = (79.0, 8.0, -79.0)
COLD_RUN = "from benchmarks.bench_scope import Stage; stage = Stage(); stage.setup()"


def airway() -> tuple[Lumen, AirwayTree]:
    """Return a lumen of about 100,000 voxels with four branches, and the trachea's line as its tree."""
    low, high = np.array([-86.0, -14.0, -104.0]), np.array([90.0, 40.0, 88.0])
    grid = Grid.from_spacing(np.ceil((high - low) / SPACING_MM), SPACING_MM, low)
    points = grid.lps(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1))
    mask = np.zeros(grid.shape, dtype=bool)
    for a, b, radius in LINES:
        begin, along = np.array(a, dtype=float), np.subtract(b, a).astype(float)
        t = np.clip((points - begin) @ along / (along @ along), 0.0, 1.0)
        mask |= np.linalg.norm(points - begin - t[..., None] * along, axis=-1) <= radius
    z = np.arange(80.0, -0.25, -0.5)
    line = np.column_stack([np.zeros_like(z), np.zeros_like(z), z])
    tree = AirwayTree(
        points_lps=line,
        radius_mm=np.full(len(z), 8.0),
        parent_point=np.arange(-1, len(z) - 1),
        branch_of_point=np.zeros(len(z)),
        branch_start=np.array([0, len(z)]),
        branch_parent=np.array([-1]),
        generation=np.array([0]),
        distance_from_root_mm=80.0 - z,
        tangents=np.tile([0.0, 0.0, -1.0], (len(z), 1)),
    )
    return lumen_of_mask(Volume(grid=grid, array=mask), [0.0, 0.0, 80.0]), tree


class Stage:
    """Field, motion and path of a scope of 3 mm."""

    def setup(self) -> None:
        """Make the airway, and compile."""
        self.lumen, self.tree = airway()
        self.model = ScopeModel(radius_mm=1.5, twist_low_deg=-90.0, bend_low_deg=-120.0)
        self.goal = goal_at(self.lumen, GOAL)
        self.start = start_state(self.lumen, self.tree, self.model)
        self.advisor = Advisor(self.lumen, self.model, self.goal)
        self.once = Advisor(self.lumen, self.model, self.goal, PathSettings(retreats=0))
        self.printed = Advisor(self.lumen, self.model, self.goal, reproduction=True)
        for work in (self.time_field, self.time_best_motion, self.time_path):
            work()

    def time_field(self) -> None:
        """The clearance-based navigation function."""
        navigation_field(self.lumen, self.goal.voxel)

    def time_best_motion(self) -> None:
        """121 candidates with the true radius."""
        evaluate_motions(self.advisor.environment, self.start, 5.0, Weights())

    def time_best_motion_printed_rules(self) -> None:
        """121 candidates with eq. 1."""
        evaluate_motions(self.printed.environment, self.start, 5.0, Weights())

    def time_path(self) -> None:
        """A path with retreats, if it needs any."""
        self.advisor.path(self.start, seed=1)

    def time_path_without_retreats(self) -> None:
        """A path that ends where it is stuck."""
        self.once.path(self.start, seed=1)

    def track_voxels(self) -> float:
        """Interior voxels."""
        return float(self.lumen.count)


class Compile(FreshProcess):
    """All kernels of the stage in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_stage(self, cold: bool) -> None:
        """Each piece of work once."""
        self.run()
