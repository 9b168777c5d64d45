"""The work whose growth is measured, by what grows: voxels, targets, atlas entries, tubes, lesions.

Both asv (`bench_growth.py`) and the study `experiments/growth.py` take their work from here.
`python -m benchmarks.workloads NAME SIZE` runs one piece of work in this process and prints what it took.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from anatomy.base.records import frozen_value
from benchmarks import scenes

Work = Callable[[], object]
LEAST_S = 1.0
"""Work is repeated for so long: a hundred times the clock's resolution."""
MOST_REPEATS = 20
"""The least of so many times changes no more."""


@frozen_value
class Workload:
    """A piece of work of several sizes.

    Args:
        grows: What grows: "voxels", "targets", "atlas entries", "tubes" or "lesions".
        sizes: Each about a multiple of the one before.  For voxels, the edge of a cube.
        promised: Exponent of time over work, where the algorithm has one.
        prepare: Takes a size and returns what is timed; it may be called again and again.
        runs: How many equal pieces one call of the work does; times are divided by it.
        fitted_from: Least amount that an exponent is fitted to.
    """

    title: str
    grows: str
    sizes: tuple[int, ...]
    promised: float | None
    prepare: Callable[[int], Work]
    runs: int = 1
    fitted_from: int = 0

    @property
    def size_is(self) -> str:
        """What a size counts."""
        return "edge in voxels" if self.grows == "voxels" else self.grows

    def amount(self, size: int) -> int:
        """Return how much work a size is: the number of what grows."""
        return size**3 if self.grows == "voxels" else size


def _distance_field(edge: int) -> Work:
    from anatomy.fields import distance_field

    grid, mask = scenes.obstacles(edge)
    return lambda: distance_field("obstacle", mask, grid)


def _vesselness(edge: int) -> Work:
    from anatomy.segmentation.vessels import vesselness

    chest = scenes.chest(edge)
    return lambda: vesselness(chest.hu, chest.lung, chest.grid.spacing_mm)


def _cost_map(edge: int) -> Work:
    from anatomy.segmentation.airway import Airways
    from anatomy.segmentation.cost_map import cost_map
    from anatomy.segmentation.vessels import Vessels

    chest = scenes.chest(edge)
    vessels = Vessels(
        vesselness=np.where(chest.vessels, np.float32(1.0), np.float32(0.1)), large=chest.vessels,
        mask=chest.vessels, threshold=0.5,
    )  # fmt: skip
    airways = Airways(lumen=chest.lumen, wall=chest.wall)
    return lambda: cost_map(vessels, airways, chest.lung, chest.grid)


def _build_lung(edge: int) -> Work:
    from anatomy.build import build_lung

    images = scenes.images(edge)
    return lambda: build_lung(images)


def _direct_arcs(targets: int) -> Work:
    search_for, points = scenes.direct_search(targets)

    def answer() -> int:
        return sum(any(step.candidate for step in search_for(point).direct_steps()) for point in points)

    return answer


def _build_index(entries: int) -> Work:
    from stages.needle.reach import StartIndex

    positions, tangents = scenes.starts(entries)
    return lambda: StartIndex(positions, tangents)


def _query_index(entries: int) -> Work:
    from stages.needle.reach import StartIndex

    environment, targets = scenes.free_environment(), scenes.index_targets()
    index = StartIndex(*scenes.starts(entries))
    return lambda: [index.holding(environment, target) for target in targets]


def _tubes(tubes: int) -> Work:
    made = scenes.mechanics(tubes)
    angles, beta = scenes.configurations(made, scenes.SOLVES)
    return lambda: made.batch(angles, beta)


def _tour(lesions: int) -> Work:
    from stages.scope.tour.itinerary import shortest_tour

    models = scenes.tours(lesions)
    return lambda: [shortest_tour(subtree) for subtree in models]


EDGES = (64, 128, 192, 256, 384, 512)
WORKLOADS: dict[str, Workload] = {
    "distance-field": Workload(
        title="distance field", grows="voxels", sizes=EDGES, promised=1.0, prepare=_distance_field
    ),
    "vesselness": Workload(
        title="vesselness, 5 scales", grows="voxels", sizes=EDGES, promised=1.0, prepare=_vesselness
    ),
    "cost-map": Workload(title="cost map", grows="voxels", sizes=EDGES, promised=1.0, prepare=_cost_map),
    "build-lung": Workload(
        title="lung from masks", grows="voxels", sizes=EDGES[1:], promised=1.0,
        prepare=_build_lung,
    ),
    "direct-arcs": Workload(
        title="direct arcs", grows="targets", sizes=(1, 10, 100, 1000, 10_000), promised=1.0,
        prepare=_direct_arcs, fitted_from=100,  # of a few targets, which they are decides
    ),
    "build-index": Workload(
        title="index of an atlas", grows="atlas entries", sizes=(10**4, 10**5, 10**6, 10**7), promised=1.0,
        prepare=_build_index,
    ),
    "query-index": Workload(
        title="query of the index", grows="atlas entries", sizes=(10**4, 10**5, 10**6, 10**7), promised=1.0,
        prepare=_query_index, runs=scenes.INDEX_TARGETS,
    ),
    "tube-mechanics": Workload(
        title="solve of tubes", grows="tubes", sizes=(1, 2, 3, 4, 5), promised=None, prepare=_tubes,
        runs=scenes.SOLVES,
    ),
    "shortest-tour": Workload(
        title="shortest tour", grows="lesions", sizes=(2, 4, 8, 16, 30), promised=None, prepare=_tour,
        runs=scenes.TOUR_MODELS,
    ),
}  # fmt: skip


def measure(name: str, size: int) -> dict[str, float]:
    """Return CPU seconds of one piece of work, the least of several, and the peak memory in MB.

    CPU time counts all threads.  The work is done once before, to compile; the peak is that of this run,
    inputs included, and not a number where the system does not tell.
    """
    workload = WORKLOADS[name]
    # The least size compiles the kernels, so that a large one need not be done twice.
    workload.prepare(workload.sizes[0])()
    work = workload.prepare(size)
    _forget_peak()
    times: list[float] = []
    while not times or (sum(times) < LEAST_S and len(times) < MOST_REPEATS) or len(times) < 2:
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
        if times[0] > 60.0:
            break
    return {"cpu_s": min(times) / workload.runs, "peak_mb": _peak_mb(), "repeats": len(times)}


def _forget_peak() -> None:
    reset = Path("/proc/self/clear_refs")
    if reset.exists():
        reset.write_text("5")


def _peak_mb() -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    (line,) = (line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024.0


def main() -> None:
    """Measure one size and print it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=sorted(WORKLOADS))
    parser.add_argument("size", type=int)
    options = parser.parse_args()
    sys.stdout.write(json.dumps(measure(options.name, options.size)) + "\n")


if __name__ == "__main__":
    main()
