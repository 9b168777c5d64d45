"""How time and memory grow with voxels, targets, atlas entries, tubes and lesions; and cost with iterations.

What is run: `workloads.py`; the exponents: `python -m experiments.growth`.
"""

from __future__ import annotations

import time
from typing import Any

import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from benchmarks.workloads import WORKLOADS
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target


class _Growth:
    """A workload at all its sizes; CPU time of all threads, and peak memory."""

    timeout = 600
    number = 1
    repeat = (2, 5, 20.0)
    rounds = 1
    warmup_time = 0.0
    timer = time.process_time
    name = ""
    params: tuple[int, ...]
    param_names: tuple[str, ...]

    def __init_subclass__(cls) -> None:
        workload = WORKLOADS[cls.name]
        cls.params, cls.param_names = workload.sizes, (workload.size_is,)

    def setup(self, size: int) -> None:
        """Prepare the work; the least size compiles the kernels."""
        workload = WORKLOADS[self.name]
        workload.prepare(workload.sizes[0])()
        self.work = workload.prepare(size)

    def time_cpu(self, size: int) -> None:
        """Time the work."""
        self.work()

    def peakmem_work(self, size: int) -> None:
        """Peak memory, inputs included."""
        self.work()


class DistanceField(_Growth):
    """Clearance field of cubes of 64^3 to 512^3 voxels."""

    name = "distance-field"


class Vesselness(_Growth):
    """Vesselness of a chest of 64^3 to 512^3 voxels."""

    name = "vesselness"


class CostMap(_Growth):
    """Cost map of a chest of 64^3 to 512^3 voxels."""

    name = "cost-map"


class BuildLung(_Growth):
    """Tree, labels and fields of a synthetic patient in finer and finer voxels."""

    name = "build-lung"


class DirectArcs(_Growth):
    """Direct arcs to 1 to 10^4 targets."""

    name = "direct-arcs"


class BuildIndex(_Growth):
    """Index of an atlas of 10^4 to 10^7 entries."""

    name = "build-index"


class QueryIndex(_Growth):
    """Queries of that index."""

    name = "query-index"


class TubeMechanicsGrowth(_Growth):
    """Solves of 1 to 5 tubes."""

    name = "tube-mechanics"


class ShortestTour(_Growth):
    """The exact tour to 2 to 30 lesions."""

    name = "shortest-tour"


class CostByIterations:
    """Cost of the best plan as the search is given more work, and how many targets have one."""

    params = (0, 50, 200, 800)
    param_names = ("iterations",)
    timeout = 600

    def setup_cache(self) -> Any:
        """Draw targets."""
        return peripheral_targets(self._lung(), 6, 0).tolist()

    def setup(self, targets: list[list[float]], iterations: int) -> None:
        """Plan to all targets once; the results are tracked."""
        lung, system = self._lung(), la.load_system("flexure-needle")
        atlas = la.build_atlas(lung, system)
        self.costs = []
        for point in targets:
            try:
                *_, best = la.plan(
                    lung,
                    system,
                    point_target(lung, point),
                    atlas=atlas,
                    iterations=iterations,
                    goal="default",
                )
            except la.NoPlan:
                continue
            self.costs.append(best.costs["inverse_clearance"])

    def track_mean_cost(self, targets: list[list[float]], iterations: int) -> float:
        """Mean integral of 1 / clearance of the best plans."""
        return sum(self.costs) / len(self.costs) if self.costs else float("nan")

    def track_planned(self, targets: list[list[float]], iterations: int) -> int:
        """Targets with a plan."""
        return len(self.costs)

    @staticmethod
    def _lung() -> la.Lung:
        return build_lung(make_phantom(seed=1, size="small").images)
