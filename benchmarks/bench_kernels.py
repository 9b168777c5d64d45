"""The kernels that everything rests on, and what compiling them costs."""

from __future__ import annotations

import numpy as np

from anatomy.fields import distance_field
from anatomy.grid import Grid
from anatomy.kernels.field import exact_at
from benchmarks.fresh import FreshProcess

POINTS = 100_000
COLD_RUN = """
import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from lungaccess.problem.target import nodule_target
lung = build_lung(make_phantom(seed=3, size="small").images)
next(la.plan(lung, la.load_system("ultrathin"), nodule_target(lung, 1), goal="default"))
"""


class Field:
    """A clearance field of 128^3 voxels with scattered obstacles."""

    def setup(self) -> None:
        """Make field and points."""
        rng = np.random.default_rng(0)
        mask = np.asfortranarray(rng.random((128, 128, 128)) < 1e-4)
        self.mask = mask
        self.grid = Grid.from_spacing(mask.shape, (0.6, 0.6, 0.7), (0.0, 0.0, 0.0))
        self.field = distance_field("obstacle", mask, self.grid)
        self.labels = np.asfortranarray(mask.astype(np.uint16))
        self.points = self.grid.lps(rng.uniform(0, 127, (POINTS, 3)))
        self.out = np.zeros(POINTS)
        self.time_exact_distance()

    def time_distance_field(self) -> None:
        """Make the field."""
        distance_field("obstacle", self.mask, self.grid)

    def time_lower_bound(self) -> None:
        """100,000 proved lower bounds."""
        self.field.lower_bound_mm(self.points)

    def time_exact_distance(self) -> None:
        """100,000 exact distances up to 1.5 mm."""
        exact_at(self.labels, self.field.geometry, self.points, 1, -1, 1.5, self.out)


class Compile(FreshProcess):
    """A first plan in a new process, without and with cached kernels."""

    code = COLD_RUN

    def time_first_plan(self, cold: bool) -> None:
        """Phantom, lung, atlas, first plan."""
        self.run()
