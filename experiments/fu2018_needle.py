"""Needle RRT on a cost map, by length and by raw voxel intensity, as in [Fu2018, fig. 7], on a synthetic CT.

    python experiments/fu2018_needle.py [--quick] [--patient 1] [--runs 10] [--time 10] [--out FILE.png]

Three searches that differ in their objective alone, in three scenarios of rising difficulty: success and
cost over time.  Cost is judged by the cost map for all three: its sum over the set of voxels crossed [Fu2018,
eq. 1], and its line integral, which does not depend on the voxel size.

The cost map is a stand-in for the paper's: vesselness of eqs. 3-5 computed from the CT, but airways, the
space outside the lung and vessels of more than 2 sqrt(2) mm radius, which are obstacles, are taken from the
masks of the synthetic patient.  The paper's CT is of a pig's lung that cannot be had, so the numbers compare
objectives with each other, not with the paper.
"""

from __future__ import annotations

import argparse
import math
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import edt
import matplotlib as mpl
import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import ndimage

from anatomy.grid import Float, Volume
from anatomy.phantom import Phantom, phantom
from anatomy.structures import AIRWAY, OUTSIDE, VESSEL
from stages.needle.costs import map_integral, obstacle_clearance_mm, voxel_sum
from stages.needle.device import Needle
from stages.needle.inflation import inflated_space, largest_step_mm, refuting_labels
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import ArcPath
from stages.needle.searches import Query, RestartingRRT
from stages.needle.space import NeedleSpace, direct_arcs, space_of_labels, workspace_lengths

NEEDLE = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 121)
SAFETY_MM = 0.4
ALPHA, BETA, C = 0.5, 0.5, 70.0
SIGMAS_MM = (1.0, math.sqrt(2.0), 2.0, 2.0 * math.sqrt(2.0), 4.0)
DEEPER_THAN_MM = (0.0, 1.0, 1.0, 2.0, 2.0 * math.sqrt(2.0))
"""From which depth below the lung's surface each sigma is used [Fu2018, eq. 4]."""
LARGE_VESSEL_MM = 2.0 * math.sqrt(2.0)
RIGHT_LOBES = 3
BORDER_VOXELS = 14

GENERATIONS = (4, 9)
EXIT_MM = (5.0, 9.0)
MAX_EXIT_ANGLE_DEG = 60.0
TARGET_MM = (50.0, 90.0)
PLEURA_MM = 5.0
TRIES, TRY_ITERATIONS = 40, 300
SCENARIOS = {"easy": (0.9, 1.0), "medium": (0.4, 0.6), "hard": (0.02, 0.12)}
"""Share of `TRIES` short searches that find a path: what makes a scenario easy or hard."""

VARIANTS: dict[str, dict[str, Any]] = {
    "cost map": {"color": "#0072B2", "lw": 3.0},
    "shortest path": {"color": "#D55E00", "lw": 1.8},
    "voxel intensity": {"color": "#009E73", "lw": 1.8, "ls": (0, (4, 2))},
}
SLICE_ITERATIONS = 100
TABLE_SHARES = (0.01, 0.1, 1.0)
PAPER_MODE_ITERATIONS = 30_000
LEAST_COST = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenario:
    """A start pose and a goal, and the share of short searches that solve it."""

    name: str
    query: Query
    solved_share: float

    def describe(self) -> str:
        """Say where it is and how hard."""
        start, goal = self.query.lps_from_start[:3, 3], self.query.target
        return (
            f"  {self.name:7} start LPS {np.round(start, 1).tolist()}, goal {np.round(goal, 1).tolist()}, "
            f"{np.linalg.norm(goal - start):.0f} mm apart; obstructedness {1 - self.solved_share:.2f}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """The paths of one search, each better than the last by its own objective, and what they cost.

    `times` are seconds of processor time; `sums` are those of eq. 1, `integrals` in mm, `lengths` in mm.
    """

    times: Float
    sums: Float
    integrals: Float
    lengths: Float
    paths: list[ArcPath]

    def at(self, values: Float, seconds: Float) -> Float:
        """Return the value of the best path at each time, NaN before the first."""
        n = np.searchsorted(self.times, seconds, side="right")
        return np.asarray(np.concatenate([[math.nan], values])[n])


def vesselness(ct: NDArray[np.int16], spacing_mm: Float, lung: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the response of [Fu2018, eqs. 3-5] in [0, 1] at the voxels of `lung`, 0 elsewhere."""
    depth = edt.edt(np.asfortranarray(lung), anisotropy=tuple(spacing_mm), order="F")
    image = ct.astype(np.float32)
    best = np.zeros(ct.shape, dtype=np.float32, order="F")
    for sigma, deeper_than in zip(SIGMAS_MM, DEEPER_THAN_MM, strict=True):
        where = lung & (depth > deeper_than)
        hessian = np.zeros((int(where.sum()), 3, 3), dtype=np.float32)
        for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            order = [int(axis == a) + int(axis == b) for axis in range(3)]
            second = ndimage.gaussian_filter(image, sigma / spacing_mm, order=order, mode="nearest")
            hessian[:, a, b] = hessian[:, b, a] = second[where] * (sigma**2 / (spacing_mm[a] * spacing_mm[b]))
        best[where] = np.maximum(best[where], _response(hessian))
    return best


def _response(hessian: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the vesselness of Hessians `(N, 3, 3)`."""
    values = np.linalg.eigvalsh(hessian)
    values = np.take_along_axis(values, np.argsort(np.abs(values), axis=1), axis=1).T
    low, middle, high = np.abs(values) + np.float32(1e-12)
    flat, blob = middle / high, low / np.sqrt(middle * high)
    strength = low**2 + middle**2 + high**2
    response = (
        (1.0 - np.exp(-(flat**2) / (2.0 * ALPHA**2)))
        * np.exp(-(blob**2) / (2.0 * BETA**2))
        * (1.0 - np.exp(-strength / (2.0 * C**2)))
    )
    return np.where((values[1] < 0.0) & (values[2] < 0.0), response, 0.0).astype(np.float32)


def right_lung(patient: Phantom) -> tuple[NeedleSpace, Volume]:
    """Return the right lung with its cost map, and the CT as a map: both infinite at obstacles."""
    lobes = patient.lobes.array
    inside = np.argwhere((lobes > 0) & (lobes <= RIGHT_LOBES))
    low = np.maximum(inside.min(axis=0) - BORDER_VOXELS, 0)
    high = np.minimum(inside.max(axis=0) + 1 + BORDER_VOXELS, patient.grid.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    grid = patient.grid.crop(low, high)
    right = (lobes[box] > 0) & (lobes[box] <= RIGHT_LOBES)
    images = patient.images
    labels = np.zeros(grid.shape, dtype=np.uint16, order="F")
    labels[~(images.lung.array[box] & right)] |= OUTSIDE
    labels[patient.mask("lumen", "wall")[box]] |= AIRWAY
    labels[_opened(images.vessels.array[box], grid.spacing_mm)] |= VESSEL
    ct = patient.ct.array[box]
    obstacle = labels != 0
    costs = np.where(obstacle, np.float32(math.inf), vesselness(ct, grid.spacing_mm, right))
    intensity = np.where(
        obstacle, np.float32(math.inf), ct.astype(np.float32) - float(patient.ct.array.min())
    )
    space = space_of_labels(
        labels,
        grid,
        NEEDLE,
        required_clearance_mm=NEEDLE.radius_mm + SAFETY_MM,
        cost_map=Volume(grid=grid, array=costs),
    )
    return space, Volume(grid=grid, array=intensity)


def _opened(mask: NDArray[np.bool_], spacing_mm: Float) -> NDArray[np.bool_]:
    """Return the part of a mask that balls of `LARGE_VESSEL_MM` fit in."""
    sides = tuple(spacing_mm)
    core = edt.edt(np.asfortranarray(mask), anisotropy=sides, order="F") >= LARGE_VESSEL_MM
    if not core.any():
        return core
    return np.asarray(edt.edt(np.asfortranarray(~core), anisotropy=sides, order="F") < LARGE_VESSEL_MM)


def candidates(patient: Phantom, space: NeedleSpace, rng: np.random.Generator) -> Iterator[Query]:
    """Draw start poses beside airways, as a tube would hold the needle there, and goals ahead of them.

    Both are as clear of obstacles as the needle must be, the goal lies in the needle's workspace and
    5 mm or more below the pleura, and no single arc leads to it.
    """
    airways = patient.centerlines["airway"]
    generation = np.repeat(airways.generation, np.diff(airways.branch_start))
    inner = airways.points_lps[(generation >= GENERATIONS[0]) & (generation <= GENERATIONS[1])]
    inner = inner[space.grid.contains(inner)]
    depth = edt.edt(
        np.asfortranarray((space.arrays[1] & OUTSIDE) == 0),
        anisotropy=tuple(space.grid.spacing_mm),
        order="F",
    )
    tissue = space.grid.lps(np.argwhere(depth > PLEURA_MM))
    while True:
        way = _unit(rng.normal(size=3))
        start = inner[rng.integers(len(inner))] + rng.uniform(*EXIT_MM) * way
        goal = tissue[rng.integers(len(tissue))] + rng.uniform(-0.5, 0.5, 3) * space.grid.spacing_mm
        ahead = goal - start
        distance = float(np.linalg.norm(ahead))
        tangent = _unit(way + rng.normal(scale=0.3, size=3))
        if (
            not TARGET_MM[0] <= distance <= TARGET_MM[1]
            or ahead @ way < math.cos(math.radians(MAX_EXIT_ANGLE_DEG)) * distance
        ):
            continue
        query = Query(lps_from_start=_pose(start, tangent), target=goal)
        if _is_problem(space, query):
            yield query


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))


def _pose(position: Float, tangent: Float) -> Float:
    """Return a pose (4, 4) whose +z is the tangent."""
    x = _unit(np.cross(np.eye(3)[int(np.argmin(np.abs(tangent)))], tangent))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, np.cross(tangent, x), tangent, position
    return pose


def _is_problem(space: NeedleSpace, query: Query) -> bool:
    """Tell whether both ends are clear, the goal is in the workspace and no single arc leads there."""
    place, tangent = query.lps_from_start[None, :3, 3], query.lps_from_start[None, :3, 2]
    if not np.isfinite(workspace_lengths(space, place, tangent, query.target)[0]):
        return False
    here = [
        ArcPath(lps_from_start=_pose(p, tangent[0]), arcs=np.zeros((1, 3))) for p in (place[0], query.target)
    ]
    if refuting_labels(space, here).any():
        return False
    return bool(direct_arcs(space, place, tangent, np.array([-1]), query.target)[0][0] != 0)


def choose_scenarios(patient: Phantom, space: NeedleSpace, seed: int) -> list[Scenario]:
    """Return the first candidate of each difficulty, in the order of `SCENARIOS`.

    Difficulty is the share of short searches for any path that succeed: it counts iterations, so that
    the choice is the same on every machine.  Left out is where the shortest path of these searches costs
    less than `LEAST_COST` [Fu2018, eq. 1]: there is nothing to be saved.
    """
    found: dict[str, Scenario] = {}
    for query in candidates(patient, space, np.random.default_rng(seed)):
        paths = []
        for n in range(TRIES):
            search = RestartingRRT(space, query, seed=n + 1, objective=SHORTEST)
            if search.advance(TRY_ITERATIONS) and search.path is not None:
                paths.append(search.path)
        share = len(paths) / TRIES
        if not paths or voxel_sum(_map_of(space), min(paths, key=_length)) < LEAST_COST:
            continue
        for name, (low, high) in SCENARIOS.items():
            if name not in found and low <= share <= high:
                found[name] = Scenario(name=name, query=query, solved_share=share)
        if len(found) == len(SCENARIOS):
            break
    return [found[name] for name in SCENARIOS]


def _length(path: ArcPath) -> float:
    return path.length_mm


def run(
    space: NeedleSpace, costs: Volume, query: Query, objective: Objective, seed: int, limit_s: float
) -> Run:
    """Search for `limit_s` seconds of processor time; judge the paths afterwards by `costs`."""
    search = RestartingRRT(space, query, seed=seed, objective=objective)
    times, paths = [], []
    began = time.process_time()
    while time.process_time() - began < limit_s:
        if search.advance(SLICE_ITERATIONS) and search.path is not None:
            times.append(time.process_time() - began)
            paths.append(search.path)
    return Run(
        times=np.array(times),
        sums=np.array([voxel_sum(costs, path) for path in paths]),
        integrals=np.array([map_integral(costs, path) for path in paths]),
        lengths=np.array([path.length_mm for path in paths]),
        paths=paths,
    )


def run_all(
    space: NeedleSpace, intensity: Volume, scenarios: list[Scenario], runs: int, limit_s: float
) -> dict[tuple[str, str], list[Run]]:
    """Return the runs of every scenario and variant; seeds are 1 to `runs`."""
    searched = {
        "cost map": (space, Objective(voxel_sum=1.0)),
        "shortest path": (space, SHORTEST),
        "voxel intensity": (replace(space, cost_map=intensity), Objective(voxel_sum=1.0)),
    }
    costs = _map_of(space)
    for where, objective in searched.values():
        RestartingRRT(where, scenarios[0].query, objective=objective).advance(SLICE_ITERATIONS)
    return {
        (scenario.name, variant): [
            run(where, costs, scenario.query, objective, seed, limit_s) for seed in range(1, runs + 1)
        ]
        for scenario, (variant, (where, objective)) in product(scenarios, searched.items())
    }


def survey(patient: Phantom, space: NeedleSpace, seed: int, count: int, limit_s: float) -> str:
    """Say how the cost changes by planning on the map, in `count` more problems, one run of each variant.

    Problems are taken as they come; left out are those without a path, and where the shortest path costs
    less than `LEAST_COST`.
    """
    costs, changes = _map_of(space), []
    for query in candidates(patient, space, np.random.default_rng([seed, 1])):
        if len(changes) == count:
            break
        if not RestartingRRT(space, query).advance(TRIES * TRY_ITERATIONS):
            continue
        shortest, mapped = (
            run(space, costs, query, objective, 1, limit_s)
            for objective in (SHORTEST, Objective(voxel_sum=1.0))
        )
        if shortest.paths and mapped.paths and shortest.sums[-1] >= LEAST_COST:
            changes.append(100.0 * (mapped.sums[-1] / shortest.sums[-1] - 1.0))
    quartiles = ", ".join(f"{change:+.0f} %" for change in np.quantile(changes, (0.25, 0.5, 0.75)))
    half = 100.0 * np.mean(np.array(changes) <= -50.0)
    return (
        f"{count} further problems, {limit_s:g} s a run: sum of eq. 1 on the map against shortest, quartiles "
        f"{quartiles}; at least 50 % less in {half:.0f} % of them"
    )


def _map_of(space: NeedleSpace) -> Volume:
    if space.cost_map is None:
        raise TypeError("The experiment's space always has a cost map")
    return space.cost_map


def success_and_means(runs: list[Run], seconds: Float) -> tuple[Float, Float, Float]:
    """Return the share of runs with a path at each time, and the means over these of both costs."""
    sums = np.array([run.at(run.sums, seconds) for run in runs])
    integrals = np.array([run.at(run.integrals, seconds) for run in runs])
    found = np.isfinite(sums).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return found / len(runs), np.nansum(sums, axis=0) / found, np.nansum(integrals, axis=0) / found


def table(results: dict[tuple[str, str], list[Run]], limit_s: float) -> str:
    """Return success, cost at the end, and cost against that of the shortest path."""
    times = limit_s * np.array(TABLE_SHARES)
    head = "  ".join(f"{t:>6.3g} s" for t in times)
    lines = [
        f"{'scenario':9}{'variant':17}{head}   first ms   eq. 1 sum   integral mm   length mm   eq. 1 change"
    ]
    for (scenario, variant), runs in results.items():
        success, sums, integrals = success_and_means(runs, times)
        shortest = success_and_means(results[scenario, "shortest path"], times)[1][-1]
        first = np.median([run.times[0] if len(run.times) else math.inf for run in runs])
        length = np.mean([run.lengths[-1] for run in runs if len(run.times)])
        lines.append(
            f"{scenario:9}{variant:17}"
            + "  ".join(f"{100 * share:6.0f} %" for share in success)
            + f"{1e3 * first:11.1f}{sums[-1]:12.2f}{integrals[-1]:14.2f}{length:12.1f}"
            + f"{100 * (sums[-1] / shortest - 1):+17.0f} %"
        )
    return "\n".join(lines)


def paper_mode(space: NeedleSpace, scenarios: list[Scenario], runs: int) -> str:
    """Plan with inflated obstacles and lookups, put every path to the proof, and say how many fail."""
    inflated = inflated_space(space)
    lines = []
    for scenario in scenarios:
        paths: dict[str, list[ArcPath]] = {"inflation": [], "proof": []}
        for (name, where), seed in product((("inflation", inflated), ("proof", space)), range(1, runs + 1)):
            search = RestartingRRT(where, scenario.query, seed=seed, objective=SHORTEST)
            while (left := PAPER_MODE_ITERATIONS - search.iterations) > 0:
                if search.advance(left) and search.path is not None:
                    paths[name].append(search.path)
        counts = [
            f"{name} {len(found)} paths, {np.count_nonzero(refuting_labels(space, found))} refuted"
            + (f", least distance {_least_distance_mm(space, found):.2f} mm" if found else "")
            for name, found in paths.items()
        ]
        lines.append(f"  {scenario.name:7} {'; '.join(counts)}")
    return "\n".join(lines)


def _least_distance_mm(space: NeedleSpace, paths: list[ArcPath]) -> float:
    """Return the least distance of the needle's axis from an obstacle, at samples of 0.05 mm."""
    return min(float(obstacle_clearance_mm(space.arrays, path.sample(0.05)[0]).min()) for path in paths)


def draw(
    space: NeedleSpace,
    scenarios: list[Scenario],
    results: dict[tuple[str, str], list[Run]],
    limit_s: float,
    out: Path,
) -> None:
    """Draw each scenario, and below it cost and success over time, as in the paper's figure."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        4, len(scenarios), figsize=(12, 10.5), height_ratios=(1.1, 1, 1, 1), layout="constrained"
    )
    seconds = np.geomspace(1e-4, limit_s, 500)
    for column, scenario in zip(axes.T, scenarios, strict=True):
        best = {variant: _best(results[scenario.name, variant]) for variant in VARIANTS}
        _draw_scenario(column[0], space, scenario, best)
        for variant, style in VARIANTS.items():
            success, sums, integrals = success_and_means(results[scenario.name, variant], seconds)
            for axis, values in zip(column[1:], (sums, integrals, 100 * success), strict=True):
                axis.plot(seconds, values, label=variant, **style)
                axis.set_xscale("log")
                axis.set_xlim(seconds[0], limit_s)
                axis.grid(alpha=0.25)
        for axis in column[1:3]:
            axis.set_ylim(0, 1.1 * axis.dataLim.y1)
        column[3].set_ylim(-3, 103)
        column[3].set_xlabel("processor time, s")
    for axis, label in zip(
        axes[1:, 0], ("mean cost, eq. 1", "mean integral of the map, mm", "success, %"), strict=True
    ):
        axis.set_ylabel(label)
    axes[3, 0].legend(frameon=False, fontsize=9, loc="lower right")
    figure.savefig(out, dpi=130)
    plt.close(figure)


def _best(runs: list[Run]) -> ArcPath | None:
    """Return the last path of the first run that has one."""
    return next((run.paths[-1] for run in runs if run.paths), None)


def _draw_scenario(
    axis: mpl.axes.Axes, space: NeedleSpace, scenario: Scenario, best: dict[str, ArcPath | None]
) -> None:
    """Draw the plane through start and goal in which the paths spread most, over 6 mm of the map."""
    start, goal = scenario.query.lps_from_start[:3, 3], scenario.query.target
    along = _unit(goal - start)
    curves = {name: path.sample(0.2)[0] for name, path in best.items() if path is not None}
    offsets = np.concatenate([curve - start for curve in curves.values()])
    offsets -= (offsets @ along)[:, None] * along
    across = np.linalg.svd(offsets, full_matrices=False)[2][0]
    across = _unit(across - (across @ along) * along)
    length = float(np.linalg.norm(goal - start))
    s, t = np.meshgrid(np.arange(-8, length + 8, 0.5), np.arange(-22, 22.1, 0.5), indexing="ij")
    plane = start + s[..., None] * along + t[..., None] * across
    layers = [_look_up(space, plane + d * np.cross(along, across)) for d in np.arange(-3, 3.1, 1.0)]
    barred = np.isinf(layers).mean(axis=0)
    soft = np.where(np.isinf(layers), 0.0, layers).max(axis=0)
    image = np.stack([1 - 0.55 * soft, 1 - 0.8 * soft, 1 - 0.8 * soft], axis=-1)
    image *= (1 - 0.7 * barred)[..., None]
    axis.imshow(image.transpose(1, 0, 2), origin="lower", extent=(s.min(), s.max(), t.min(), t.max()))
    for name, curve in curves.items():
        axis.plot((curve - start) @ along, (curve - start) @ across, **VARIANTS[name])
    axis.plot(0, 0, "o", color="#2ca02c", ms=7, mec="white")
    axis.plot(length, 0, "o", color="#d62728", ms=7, mec="white")
    axis.set_title(
        f"{scenario.name}: {100 * scenario.solved_share:.0f} % of short searches succeed", fontsize=10
    )
    axis.set_xlabel("mm")


def _look_up(space: NeedleSpace, points: Float) -> Float:
    """Return the map's value at points, infinite beyond the grid."""
    costs = _map_of(space)
    ijk = np.floor(space.grid.ijk(points) + 0.5).astype(int)
    inside = ((ijk >= 0) & (ijk < space.grid.shape)).all(axis=-1)
    values = np.full(points.shape[:-1], math.inf)
    values[inside] = costs.array[tuple(ijk[inside].T)]
    return values


def machine() -> str:
    """Name processor and versions."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return (
        f"{model or platform.machine()}, one core; Python {platform.python_version()}, "
        f"numpy {np.__version__}, numba {numba.__version__}, scipy {scipy.__version__}"
    )


def main() -> None:
    """Run the study, print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small patient, 3 runs of 0.5 s: about a minute")
    parser.add_argument("--patient", type=int, default=1, help="seed of the synthetic patient")
    parser.add_argument("--runs", type=int, default=None, help="seeds per variant and scenario (10)")
    parser.add_argument("--time", type=float, default=None, help="processor time per run, s (10)")
    parser.add_argument("--out", type=Path, default=Path("fu2018_needle.png"))
    options = parser.parse_args()
    runs = options.runs or (3 if options.quick else 10)
    limit_s = options.time or (0.5 if options.quick else 10.0)
    size = "small" if options.quick else "adult"
    patient = phantom(seed=options.patient, size=size)
    space, intensity = right_lung(patient)
    write = sys.stdout.write
    write(f"{machine()}\n")
    write(f"synthetic patient: {size}, seed {options.patient}; right lung, {space.grid.describe()}\n")
    write(
        f"needle {NEEDLE.diameter_mm:g} mm, margin {SAFETY_MM:g} mm, curvature 1/121 mm; "
        f"{runs} runs (seeds 1 to {runs}) of {limit_s:g} s of processor time\n"
    )
    scenarios = choose_scenarios(patient, space, options.patient)
    write("\n".join(scenario.describe() for scenario in scenarios) + "\n")
    results = run_all(space, intensity, scenarios, runs, limit_s)
    write(f"\n{table(results, limit_s)}\n")
    write(f"{survey(patient, space, options.patient, 10 if options.quick else 50, 0.1 * limit_s)}\n")
    write("the paper, on a pig's lung: about 50 % less in most cases, 500 s a run\n\n")
    found = [path for group in results.values() for run in group for path in run.paths]
    refuted = np.count_nonzero(refuting_labels(space, found))
    write(f"paths of all runs: {len(found)}, refuted by the proof: {refuted}\n")
    step = largest_step_mm(space.grid.spacing_mm, space.required_clearance_mm)
    write(
        f"the paper's inflation and lookup at steps of {step:.3f} mm, shortest paths, "
        f"{PAPER_MODE_ITERATIONS} iterations a run, put to the proof "
        f"that the axis keeps {space.required_clearance_mm:g} mm:\n"
    )
    write(f"{paper_mode(space, scenarios, runs)}\n")
    draw(space, scenarios, results, limit_s, options.out)
    write(f"figure: {options.out}\n")


if __name__ == "__main__":
    main()
