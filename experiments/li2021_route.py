"""Routes of limited curvature in four groups of tubes, as in [Li2021], and an exact repair beside theirs.

    python experiments/li2021_route.py DATA [--trials 50] [--groups G1 G2 G3 G4] [--out FOLDER] [--cache DIR]

DATA holds `med-rad/Patient1`, `med-rad-liver/Patient1` and `airway-tree`.  The paper's images cannot be had;
the groups keep its limits and number of dimensions:

    G1  drawings of winding vessels, 0.68 mm a pixel                 0.08 per mm
    G2  drawings of straighter vessels, 0.37 mm a pixel              0.10 per mm
    G3  hepatic and portal veins, two airway trees                   0.08 per mm
    G4  the airways of a synthetic child                             0.20 per mm

Ends have Gaussian noise.  A trial succeeds if the final curve is proved on its whole length: curvature, and
inside the lumen; "claimed" is what the method's own test at path points says.  RRT and RRT* go on sampling
until a curve is proved or 4048 samples are taken; "first" is their first way, whatever its curve.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kruskal

import lungaccess as la
from anatomy.grid import Float
from anatomy.io import read_mask
from anatomy.io.centerlines import read_centerlines
from anatomy.io.files import atomic_write
from anatomy.phantom import phantom
from lungaccess.report import style
from stages.scope.route.baselines import sampled_route
from stages.scope.route.centreline import Centreline, from_image, from_lung, from_mask, from_tree
from stages.scope.route.curve import Curve
from stages.scope.route.genetic import (
    GeneticSettings,
    cut_segments,
    repair_genetic,
    search_segment,
)
from stages.scope.route.metrics import measure
from stages.scope.route.planner import Repair, Replanner, try_route
from stages.scope.route.search import Links, NoRouteError, fewest_hops, nearest_links
from stages.scope.route.settings import RouteLimits

METHODS = ("exact", "ga", "rrt", "rrt*", "rrt first", "rrt* first")
COMPARED = METHODS[:4]
LIMITS_PER_MM = {"G1": 0.08, "G2": 0.10, "G3": 0.08, "G4": 0.20}
PAPER_SUCCESS = {
    "rrt": {"G1": 0.980, "G2": 0.760, "G3": 0.890, "G4": 0.910},
    "rrt*": {"G1": 0.988, "G2": 0.740, "G3": 0.890, "G4": 0.950},
    "ga": {"G1": 1.0, "G2": 1.0, "G3": 1.0, "G4": 1.0},
}
NOISE_MM = 0.5
END_TOLERANCE_MM = 1.0
NARROWEST_MM = 0.45
NEAREST_ENDS_MM = 20.0
MOST_PARALLEL = 10
REPEATS = 7
"""Of so many runs with one process and with two, the quickest counts: others use the machine too."""
QUANTITIES = ("time_ms", "normalised_length", "mean_wall_mm", "mean_curvature_per_mm")
WORDS = ("time, ms", "length over distance", "mean distance to wall, mm", "mean curvature, 1/mm")


@dataclass(frozen=True, kw_only=True, eq=False)
class Tubes:
    """Tubes to plan in, with what is known of them beforehand."""

    name: str
    centreline: Centreline
    links: Links
    root: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """Start and goal."""

    tubes: Tubes
    start: Float
    goal: Float
    seed: int


def tubes(name: str, centreline: Centreline) -> Tubes:
    """Prepare tubes; the root is the end with the widest tube behind it."""
    ends = np.flatnonzero(np.bincount(centreline.edges.ravel(), minlength=centreline.n_nodes) == 1)

    def width(node: int) -> float:
        near = np.linalg.norm(centreline.nodes_mm - centreline.nodes_mm[node], axis=1) < 15.0
        return float(np.median(centreline.radius_mm[near]))

    centreline.depth_mm(centreline.nodes_mm[:1])
    return Tubes(
        name=name, centreline=centreline, links=nearest_links(centreline), root=int(max(ends, key=width))
    )


def draw_vessels(seed: int, *, pixel_mm: float, wave_mm: float, height_mm: float) -> Float:
    """Draw a winding vessel with two side branches, `(rows, columns)` bool."""
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 170.0, 0.2)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    y = 60.0 + height_mm * np.sin(2.0 * np.pi * x / wave_mm + phase)
    lines = [(np.stack((x + 10.0, y), axis=1), np.linspace(6.5, 4.5, len(x)))]
    for at in rng.choice(np.arange(250, 650), 2, replace=False):
        run = np.arange(0.0, 45.0, 0.2)
        slope = np.arctan2(y[at + 1] - y[at], 0.2) + rng.choice((-1.0, 1.0)) * rng.uniform(0.5, 0.8)
        branch = lines[0][0][at] + run[:, None] * (np.cos(slope), np.sin(slope))
        lines.append((branch, np.linspace(4.0, 2.5, len(run))))
    shape = (round(120.0 / pixel_mm), round(190.0 / pixel_mm))
    picture = np.zeros(shape, dtype=bool)
    for points, radius in lines:
        for (px, py), r in zip(points / pixel_mm, radius / pixel_mm, strict=True):
            i0, j0 = max(int(py - r) - 1, 0), max(int(px - r) - 1, 0)
            ii, jj = np.mgrid[i0 : int(py + r) + 2, j0 : int(px + r) + 2]
            inside = ((ii - py) ** 2 + (jj - px) ** 2 <= r * r) & (ii < shape[0]) & (jj < shape[1])
            picture[ii[inside], jj[inside]] = True
    return picture


def load_group(name: str, data: Path, cache: str | None) -> list[Tubes]:
    """Return the tubes of a group."""
    if name == "G1":
        made = [draw_vessels(s, pixel_mm=0.68, wave_mm=70.0, height_mm=14.0) for s in range(5)]
        return [tubes(f"drawing {s}", from_image(d, pixel_mm=0.68)) for s, d in enumerate(made)]
    if name == "G2":
        made = [draw_vessels(100 + s, pixel_mm=0.37, wave_mm=90.0, height_mm=9.0) for s in range(3)]
        return [tubes(f"drawing {s}", from_image(d, pixel_mm=0.37)) for s, d in enumerate(made)]
    if name == "G4":
        return [tubes("synthetic child", from_mask(phantom(seed=2, size="small").images.lumen, rounded=True))]
    liver = data / "med-rad-liver" / "Patient1"
    found = [
        tubes(vein, from_mask(read_mask(liver / f"{vein}.nii.gz"), rounded=True))
        for vein in ("hepaticVein", "portalVein")
    ]
    lung = la.load_patient(data / "med-rad" / "Patient1", cache=cache)
    found.append(tubes(f"airway of {lung.name}", from_lung(lung)))
    (file,) = (data / "airway-tree").glob("*.vtu")
    return [*found, tubes("airway tree", from_tree(read_centerlines(file, frame="lps")))]


def trials(group: list[Tubes], count: int, seed: int) -> Iterator[Trial]:
    """Draw starts near the root and goals anywhere, in turn in all tubes of the group."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        yield _trial(group[number % len(group)], rng, number)


def _trial(each: Tubes, rng: np.random.Generator, number: int) -> Trial:
    line = each.centreline
    wide = np.flatnonzero(line.radius_mm > NARROWEST_MM)
    while True:
        try:
            path = fewest_hops(each.links, each.root, int(rng.choice(wide)))
        except NoRouteError:
            continue
        path = path[rng.integers(max(len(path) // 3, 1)) :]
        noise = rng.normal(0.0, NOISE_MM, (2, 3))
        if np.ptp(line.nodes_mm[:, 2]) == 0.0:
            noise[:, 2] = 0.0
        start, goal = line.nodes_mm[path[[0, -1]]] + noise
        far = np.linalg.norm(goal - start) >= NEAREST_ENDS_MM
        inside = (line.depth_mm(np.stack((start, goal))) > 0.2).all()
        if far and inside and line.radius_mm[path].min() > NARROWEST_MM:
            return Trial(tubes=each, start=start, goal=goal, seed=number)


def attempt(trial: Trial, method: str, limits: RouteLimits) -> dict[str, Any]:
    """Run one method on one trial."""
    line, links = trial.tubes.centreline, trial.tubes.links
    curve: Curve | None = None
    proved = claimed = False
    began = time.perf_counter()
    try:
        if method in ("exact", "ga"):
            repair: Repair = "exact" if method == "exact" else "ga"
            route = try_route(
                line, trial.start, trial.goal, limits, repair=repair, links=links, seed=trial.seed
            )
            curve, proved, claimed = route.curve, route.proved, route.claimed
        else:
            curve, proved = sampled_route(
                line,
                trial.start,
                trial.goal,
                limits,
                star="*" in method,
                seed=trial.seed,
                any_curve="first" in method,
            )
            claimed = True
    except NoRouteError:
        pass
    row: dict[str, Any] = {
        "time_ms": 1e3 * (time.perf_counter() - began), "proved": proved, "claimed": claimed,
        "found": curve is not None,
    }  # fmt: skip
    if curve is not None:
        row |= asdict(measure(curve, line))
    return row


def run_group(name: str, group: list[Tubes], count: int) -> dict[str, Any]:
    """Run all methods on all trials of a group and print its tables."""
    limits = RouteLimits(max_curvature_per_mm=LIMITS_PER_MM[name], end_tolerance_mm=END_TOLERANCE_MM)
    chosen = list(trials(group, count, seed=1))
    for method in METHODS:
        attempt(chosen[0], method, limits)
    rows = {method: [attempt(trial, method, limits) for trial in chosen] for method in METHODS}
    solvable = np.array([any(rows[m][i]["proved"] for m in METHODS) for i in range(count)])
    sys.stdout.write(
        f"\n{name}, at most {LIMITS_PER_MM[name]:g} per mm, {count} trials, {solvable.sum()} solved by some "
        f"method\n{'':11s}success  of solved  claimed  paper   median ms (solved)   p95    "
        "length  wall mm  curvature  largest\n"
    )
    for method in METHODS:
        sys.stdout.write(_line(method, rows[method], solvable, PAPER_SUCCESS.get(method, {}).get(name)))
    for quantity, words in zip(QUANTITIES, WORDS, strict=True):
        samples = [[row[quantity] for row in rows[m] if row.get(quantity) is not None] for m in COMPARED]
        answer = kruskal(*samples)
        sys.stdout.write(f"  Kruskal-Wallis, {words}: H = {answer.statistic:.1f}, p = {answer.pvalue:.1e}\n")
    return {"limit_per_mm": LIMITS_PER_MM[name], "rows": rows, "solvable": solvable.tolist()}


def _line(method: str, rows: list[dict[str, Any]], solvable: Any, paper: float | None) -> str:
    proved = np.array([row["proved"] for row in rows])
    times = np.array([row["time_ms"] for row in rows])
    found = [row for row in rows if row["found"]]

    def median(quantity: str) -> float:
        return float(np.median([row[quantity] for row in found])) if found else float("nan")

    of_solved = proved[solvable].mean() if solvable.any() else float("nan")
    at_solved = float(np.median(times[solvable])) if solvable.any() else float("nan")
    claimed = np.mean([row["claimed"] for row in rows])
    return (
        f"{method:11s}{proved.mean():7.2f}  {of_solved:9.2f}  {claimed:7.2f}  "
        f"{'' if paper is None else f'{paper:.2f}':>5s}  {np.median(times):9.1f}  ({at_solved:6.1f})  "
        f"{np.percentile(times, 95):7.1f}  {median('normalised_length'):6.3f}  "
        f"{median('mean_wall_mm'):7.2f}  "
        f"{median('mean_curvature_per_mm'):9.4f}  {median('largest_curvature_per_mm'):7.3f}\n"
    )


def replanning(group: list[Tubes], limits: RouteLimits, frames: int = 200) -> dict[str, float]:
    """Breathe with the tubes of the first solvable trials and count replans a second."""
    times = []
    for trial in trials(group, 4 * len(group), seed=7):
        line = trial.tubes.centreline
        route = try_route(line, trial.start, trial.goal, limits, links=trial.tubes.links)
        if not route.proved:
            continue
        replanner = Replanner(line, route)
        for frame in range(frames // (4 * len(group))):
            phase = 2.0 * np.pi * frame / 40.0
            nodes = np.array(line.nodes_mm)
            nodes[:, 0] += 4.0 * np.sin(phase + nodes[:, 1] / 60.0)
            nodes[:, 1] += 3.0 * np.sin(phase + nodes[:, 0] / 80.0)
            began = time.perf_counter()
            try:
                replanner.replan(nodes)
            except la.LungaccessError:
                continue
            times.append(time.perf_counter() - began)
    spent = np.array(times)
    found = {"median_ms": 1e3 * float(np.median(spent)), "p95_ms": 1e3 * float(np.percentile(spent, 95))}
    sys.stdout.write(
        f"  replanning, {len(spent)} moved states: median {found['median_ms']:.1f} ms "
        f"({1e3 / found['median_ms']:.0f} Hz), 95 % within {found['p95_ms']:.1f} ms\n"
    )
    return found


def side_by_side(group: list[Tubes], limits: RouteLimits, processes: Executor) -> dict[str, float]:
    """Measure what two processes save the genetic repair on routes with several segments.

    The share that two free cores would save follows from the CPU times of the segments: at best the longer
    half is left.
    """
    settings = GeneticSettings()
    alone = together = cpu = longest = 0.0
    taken = 0
    for trial in trials(group, 60, seed=3):
        line, links = trial.tubes.centreline, trial.tubes.links
        tentative = try_route(line, trial.start, trial.goal, limits, repair="none", links=links).tentative
        parts = cut_segments(tentative, line, limits, settings.margin_share)[1]
        if len(parts) < 2:
            continue
        spent = []
        for part in parts:
            began = time.process_time()
            search_segment(part, limits=limits, settings=settings, seed=1)
            spent.append(time.process_time() - began)
        cpu += sum(spent)
        longest += min(max(sum(half), sum(spent) - sum(half)) for half in _halves(spent))
        repair_genetic(tentative, line, limits, seed=1, executor=processes)
        best = [math.inf, math.inf]
        for _ in range(REPEATS):
            for n, workers in enumerate((None, processes)):
                began = time.perf_counter()
                repair_genetic(tentative, line, limits, seed=1, executor=workers)
                best[n] = min(best[n], time.perf_counter() - began)
        alone, together = alone + best[0], together + best[1]
        taken += 1
        if taken == MOST_PARALLEL:
            break
    if not taken:
        return {"routes": 0}
    saved, possible = 1.0 - together / alone, 1.0 - longest / cpu
    sys.stdout.write(
        f"  two processes against one, genetic repair, {taken} routes with several segments: "
        f"{saved:.0%} of the time saved, {possible:.0%} with two free cores (paper: 41 % in G4)\n"
    )
    return {"routes": taken, "saved": saved, "possible": possible}


def _halves(times: list[float]) -> list[tuple[float, ...]]:
    """Return the ways to give some of the segments to the first of two processes."""
    return [half for n in range(len(times) + 1) for half in itertools.combinations(times, n)]


def box_plots(record: dict[str, Any], path: Path) -> None:
    """Draw time, length, wall distance and curvature by group and method."""
    figure = style.new_figure(13.0, 8.4)
    colours = (style.SCOPE, style.TUBE, style.VESSEL, style.FISSURE)
    groups = list(record)
    for number, (quantity, words) in enumerate(zip(QUANTITIES, WORDS, strict=True)):
        axes = figure.add_subplot(2, 2, number + 1)
        for m, (method, colour) in enumerate(zip(COMPARED, colours, strict=True)):
            values = [
                [row[quantity] for row in record[g]["rows"][method] if row.get(quantity) is not None]
                for g in groups
            ]
            drawn = axes.boxplot(
                values, positions=np.arange(len(groups)) + 0.19 * (m - 1.5), widths=0.16, patch_artist=True,
                medianprops={"color": style.INK}, flierprops={"markersize": 2.5}, manage_ticks=False,
            )  # fmt: skip
            for box in drawn["boxes"]:
                box.set_facecolor(colour)
            drawn["boxes"][0].set_label(method)
        axes.set_xticks(range(len(groups)), [f"{g}\n{record[g]['limit_per_mm']:g} per mm" for g in groups])
        axes.set_ylabel(words)
        if quantity == "mean_wall_mm":
            # A few splines of RRT* swing far out of the lumen.
            axes.set_ylim(bottom=-2.0)
        if quantity == "mean_curvature_per_mm":
            axes.set_yscale("log")
        if quantity == "time_ms":
            axes.set_yscale("log")
            axes.legend(frameon=False, ncol=4, fontsize=9, loc="upper left")
            low, high = axes.get_ylim()
            axes.set_ylim(low, 6.0 * high)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.tight_layout()
    style.save_png(figure, path)


def main() -> None:
    """Run the study, print the tables, store the rows and draw them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--groups", nargs="+", default=list(LIMITS_PER_MM), choices=list(LIMITS_PER_MM))
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--cache", default=None)
    options = parser.parse_args()
    record: dict[str, Any] = {}
    with ProcessPoolExecutor(2) as processes:
        for name in options.groups:
            group = load_group(name, options.data, options.cache)
            limits = RouteLimits(max_curvature_per_mm=LIMITS_PER_MM[name], end_tolerance_mm=END_TOLERANCE_MM)
            record[name] = run_group(name, group, options.trials)
            record[name]["replanning"] = replanning(group, limits)
            record[name]["two_processes"] = side_by_side(group, limits, processes)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        with atomic_write(options.out / "li2021_route.json") as temporary:
            temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")
        box_plots(record, options.out / "li2021_route.png")


if __name__ == "__main__":
    main()
