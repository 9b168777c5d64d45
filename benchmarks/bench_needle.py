"""The needle stage in a made-up environment, and what compiling it costs."""

from __future__ import annotations

import numpy as np

from anatomy.grid import Grid
from anatomy.structures import VESSEL
from benchmarks.fresh import FreshProcess
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.path import Query, blocker_on_path, direct_path
from stages.needle.search.base import RestartingRRT
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.resolution import ResolutionSearch
from stages.needle.start_region import prove_starts
from stages.needle.start_region_trial import try_starts

RADIUS_MM = 60.0
SIDE = 96
BALLS = 160
COLD_RUN = """
from benchmarks.bench_needle import made_environment, query
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.resolution import ResolutionSearch
from stages.needle.search.base import RestartingRRT
environment = made_environment(0)
for kind in (RestartingRRT, OptimalSearch, ResolutionSearch):
    kind(environment, query()).advance(500)
proof = NoPathProof(environment, query())
for _ in range(4):
    proof.advance()
"""


def made_environment(seed: int, balls: int = BALLS) -> NeedleEnvironment:
    """Return a cube of tissue with balls of vessel, none at start and target."""
    rng = np.random.default_rng(seed)
    labels = np.zeros((SIDE, SIDE, SIDE), dtype=np.uint16, order="F")
    index = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1)
    for centre, radius in zip(rng.uniform(0, SIDE, (balls, 3)), rng.uniform(2, 6, balls), strict=True):
        labels[((index - centre) ** 2).sum(axis=-1) < radius**2] = VESSEL
    for end in (8, SIDE - 8):
        labels[((index - (SIDE / 2, SIDE / 2, end)) ** 2).sum(axis=-1) < 8**2] = 0
    grid = Grid.from_spacing(labels.shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1.0 / RADIUS_MM)
    return environment_of_labels(labels, grid, needle, required_clearance_mm=0.5)


def query() -> Query:
    """Return the query along the middle of the cube."""
    frame = np.eye(4)
    frame[:3, 3] = SIDE / 2, SIDE / 2, 8.0
    return Query(lps_from_start=frame, target=np.array([SIDE / 2, SIDE / 2, SIDE - 8.0]))


class Searches:
    """From one pose to one target."""

    def setup(self) -> None:
        """Make environments, and compile."""
        self.environments = [made_environment(seed) for seed in range(8)]
        self.query = query()
        self.time_first_paths()
        self.time_refine()
        self.time_resolution()
        self.time_proof()

    def time_first_paths(self) -> None:
        """The RRT's first path in eight environments, at most 20,000 iterations each."""
        for environment in self.environments:
            RestartingRRT(environment, self.query).advance(20_000)

    def time_refine(self) -> None:
        """20,000 iterations of the optimal search."""
        search = OptimalSearch(self.environments[0], self.query)
        while search.iterations < 20_000:
            search.advance(1000)

    def track_length_after_20000_iterations(self) -> float:
        """Length in mm that the optimal search has reached."""
        search = OptimalSearch(self.environments[0], self.query)
        while search.iterations < 20_000:
            search.advance(1000)
        return float("nan") if search.path is None else search.path.length_mm

    def time_resolution(self) -> None:
        """20,000 iterations of the resolution search."""
        ResolutionSearch(self.environments[0], self.query).advance(20_000)

    def time_proof(self) -> None:
        """Eight planes of the proof that no path exists."""
        proof = NoPathProof(self.environments[0], self.query)
        for _ in range(8):
            proof.advance()


class StartRegions:
    """From which poses the target is reached, around a start with obstacles beside the way."""

    def setup(self) -> None:
        """Make an environment whose direct path is clear, and compile."""
        self.query = query()
        self.path = direct_path(self.query.lps_from_start, self.query.target)
        found = (made_environment(seed, balls=40) for seed in range(100))
        self.environment = next(
            each for each in found if blocker_on_path(each, self.path, self.query.branch) == 0
        )
        self.time_prove()
        self.time_try_ten_thousand()

    def time_prove(self) -> None:
        """The proved part."""
        prove_starts(self.environment, self.query, self.path)

    def time_try_ten_thousand(self) -> None:
        """10,000 poses, with a search of 100 iterations where nothing simpler leads to the target."""
        try_starts(
            self.environment, self.query, self.path,
            offset_mm=5.0, tilt_rad=0.26, poses=10_000, iterations=100, seed=0,
        )  # fmt: skip


class Compile(FreshProcess):
    """All kernels of the stage in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_all_searches(self, cold: bool) -> None:
        """A few steps of every search."""
        self.run()
