"""Mechanics of concentric tubes: full solves, shapes, and what compiling costs."""

from __future__ import annotations

import numpy as np

from benchmarks.fresh import FreshProcess
from benchmarks.scenes import configurations, mechanics, random_mechanics
from stages.tube.mechanics import TubeMechanics

CONFIGURATIONS = 4000
COLD_RUN = """
from benchmarks.scenes import configurations, mechanics
made = mechanics(3)
made.batch(*configurations(made, 10))
made.given_base_angles(*(values[0] for values in configurations(made, 1)))
"""


class Solves:
    """Base angles given, with stability and tip frame."""

    params = (1, 2, 3, 4, 5)
    param_names = ("tubes",)

    def setup(self, tubes: int) -> None:
        """Make configurations, and compile."""
        self.made = mechanics(tubes)
        self.angles, self.beta = configurations(self.made, CONFIGURATIONS)
        self.made.batch(self.angles[:10], self.beta[:10])
        self.one = self.made.given_base_angles(self.angles[0], self.beta[0])

    def time_4000_solves(self, tubes: int) -> None:
        """4000 configurations in one call."""
        self.made.batch(self.angles, self.beta)

    def time_one_solve(self, tubes: int) -> None:
        """One configuration, with all that an `Equilibrium` holds."""
        self.made.given_base_angles(self.angles[0], self.beta[0])

    def track_error_um(self, tubes: int) -> float:
        """Largest error of a tip in micrometres, against steps a tenth as long."""
        fine = TubeMechanics(self.made.tubes, step_rad=0.1 * self.made.step_rad)
        some = slice(0, 400)
        one, two = (m.batch(self.angles[some], self.beta[some]).base_from_tip for m in (self.made, fine))
        return float(1e3 * np.abs(one[:, :3, 3] - two[:, :3, 3]).max())


class RandomDesigns:
    """Designs drawn at random, where some configurations are near snapping."""

    params = (2, 3)
    param_names = ("tubes",)

    def setup(self, tubes: int) -> None:
        """Make 40 designs with 100 configurations each, and compile."""
        self.made = random_mechanics(tubes, 40)
        self.joints = [configurations(made, 100, seed) for seed, made in enumerate(self.made)]
        self.time_4000_solves(tubes)

    def time_4000_solves(self, tubes: int) -> None:
        """4000 configurations, in one call a design."""
        for made, joints in zip(self.made, self.joints, strict=True):
            made.batch(*joints)


class Compile(FreshProcess):
    """All kernels of the mechanics in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_all_kernels(self, cold: bool) -> None:
        """A few solves."""
        self.run()
