"""Mechanics of concentric tubes: full solves, shapes, and what compiling costs."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.fresh import FreshProcess
from stages.tube.device import Tube
from stages.tube.mechanics import TubeMechanics

SIZES = ((1.1, 0.9), (1.5, 1.3), (1.9, 1.65))
CONFIGURATIONS = 4000
COLD_RUN = """
from benchmarks.bench_tube import configurations, mechanics
made = mechanics(3)
made.batch(*configurations(made, 10))
made.given_base_angles(*(values[0] for values in configurations(made, 1))).jacobian
"""


def mechanics(count: int) -> TubeMechanics:
    """Return nested tubes, all of them curved, that never snap."""
    lengths = (200.0, 160.0, 120.0)[:count]
    return TubeMechanics(
        [
            Tube(
                outer_diameter_mm=outer, inner_diameter_mm=inner, length_mm=length, curved_length_mm=40.0,
                precurvature_per_mm=0.006,
            )
            for length, (outer, inner) in zip(lengths, SIZES[-count:], strict=True)
        ]
    )  # fmt: skip


def configurations(made: TubeMechanics, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return base angles and rear ends, drawn at random."""
    rng = np.random.default_rng(0)
    ahead = np.sort(rng.uniform(10.0, 60.0, (count, made.count)), axis=1)[:, ::-1]
    beta = np.minimum(ahead - made.lengths_mm, 0.0)
    beta = np.minimum.accumulate(beta[:, ::-1], axis=1)[:, ::-1]
    return rng.uniform(-math.pi, math.pi, beta.shape), beta


class Solves:
    """Base angles given, with stability and tip frame."""

    params = (1, 2, 3)
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

    def time_jacobian(self, tubes: int) -> None:
        """The tip's motion by all joints."""
        _ = self.made.given_tip_angles(self.one.tip_angles_rad, self.beta[0]).jacobian

    def track_error_um(self, tubes: int) -> float:
        """Largest error of a tip in micrometres, against steps a tenth as long."""
        fine = TubeMechanics(self.made.tubes, step_rad=0.1 * self.made.step_rad)
        some = slice(0, 400)
        one, two = (m.batch(self.angles[some], self.beta[some]).base_from_tip for m in (self.made, fine))
        return float(1e3 * np.abs(one[:, :3, 3] - two[:, :3, 3]).max())


class Compile(FreshProcess):
    """All kernels of the mechanics in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_all_kernels(self, cold: bool) -> None:
        """A few solves."""
        self.run()
