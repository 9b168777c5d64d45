"""Routes of limited curvature in four groups of tubes, as in [Li2021], and an exact repair beside theirs.

    python -m experiments.li2021_route [--quick] [--seed 1] [--results FOLDER] [--groups G1 G2 G3 G4]

The groups: see `experiments.support.route.groups`.  Ends have Gaussian noise.  A trial succeeds if the final
curve is proved on its whole length: curvature, and inside the lumen; beside it is what the method's own test
at path points says, which for RRT and RRT* is that there is a path.  These go on sampling until a curve is
proved or 4048 samples are taken; "first" is their first path, whatever its curve.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import kruskal

from experiments.support.anatomies import default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.route.baselines import sampled_route
from experiments.support.route.groups import LIMITS_PER_MM, NOISE_MM, TRIALS, Trial, load_group, trials
from experiments.support.route.speed import replanning, side_by_side
from lungaccess.showing.report import style
from stages.scope.route.curve import Curve
from stages.scope.route.guide_path import NoRouteError
from stages.scope.route.planner import Repair, plan_route
from stages.scope.route.proof import RouteLimits, measure

METHODS = ("exact", "ga", "rrt", "rrt*", "rrt first", "rrt* first")
COMPARED = METHODS[:4]
PAPER_SUCCESS = {
    "exact": {"G1": 1.0, "G2": 1.0, "G3": 1.0, "G4": 1.0},
    "ga": {"G1": 1.0, "G2": 1.0, "G3": 1.0, "G4": 1.0},
    "rrt": {"G1": 0.980, "G2": 0.760, "G3": 0.890, "G4": 0.910},
    "rrt*": {"G1": 0.988, "G2": 0.740, "G3": 0.890, "G4": 0.950},
}
"""[Li2021, table 2]; BFS-GA is compared with both repairs."""
PAPER_SAVED_G4 = 0.41
OWN_TEST = {
    "exact": "tested at path points",
    "ga": "tested at path points",
    "rrt": "a path was found",
    "rrt*": "a path was found",
}
QUICK_TRIALS = 12
PARALLEL, QUICK_PARALLEL = 10, 3
"""Routes that are repaired in one process and in two."""
END_TOLERANCE_MM = 1.0
QUANTITIES = ("time_ms", "normalised_length", "mean_wall_mm", "mean_curvature_per_mm")
WORDS = ("CPU time, ms", "length over distance", "mean distance to wall, mm", "mean curvature, 1/mm")
NOT_REPRODUCED = [
    "The success rates of RRT and RRT*: the paper does not say whether their curves had to keep the "
    "curvature.  Here both are reported: that there is a path, and that its curve is proved.",
    "Success 1 of BFS-GA: its final curves break the curvature limit between path points 1 mm apart and "
    "where a refitted segment meets the rest.  `exact` repairs that.",
    "Times: the text that we have lost the paper's numbers.",
    "The paper's vessels (femoral, lower limb, coronary): the images cannot be had.",
]


def attempt(trial: Trial, method: str, limits: RouteLimits) -> dict[str, Any]:
    """Run one method on one trial."""
    line, links = trial.tubes.centreline, trial.tubes.links
    curve: Curve | None = None
    proved = claimed = False
    began = time.process_time()
    try:
        if method in ("exact", "ga"):
            repair: Repair = "exact" if method == "exact" else "ga"
            route = plan_route(
                line,
                trial.start,
                trial.goal,
                limits,
                repair=repair,
                links=links,
                seed=trial.seed,
                require_proof=False,
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
        "time_ms": 1e3 * (time.process_time() - began), "proved": proved, "claimed": claimed,
        "found": curve is not None,
    }  # fmt: skip
    if curve is not None:
        row |= asdict(measure(curve, line))
    return row


def run_group(name: str, count: int, parallel: int, seed: int) -> dict[str, Any]:
    """Run all methods on all trials of a group, and repair some routes in two processes."""
    group = load_group(name)
    limits = RouteLimits(max_curvature_per_mm=LIMITS_PER_MM[name], end_tolerance_mm=END_TOLERANCE_MM)
    chosen = list(trials(group, count, seed=seed))
    for method in METHODS:
        attempt(chosen[0], method, limits)
    rows = {method: [attempt(trial, method, limits) for trial in chosen] for method in METHODS}
    with ProcessPoolExecutor(2) as processes:
        two = side_by_side(group, limits, processes, parallel)
    return {"rows": rows, "replanning": replanning(group, limits), "two_processes": two}


def add_group(result: Result, name: str, found: dict[str, Any]) -> None:
    """Add the rows of a group: success and time of every method, tests, replanning, two processes."""
    count = len(found["rows"]["exact"])
    solved = {m: np.array([row["proved"] for row in rows]) for m, rows in found["rows"].items()}
    solvable = np.logical_or.reduce(list(solved.values()))
    for method in METHODS:
        times = [row["time_ms"] for row in found["rows"][method]]
        claimed = float(np.mean([row["claimed"] for row in found["rows"][method]]))
        of_solved = solved[method][solvable].mean() if solvable.any() else 0.0
        paper = PAPER_SUCCESS.get(method, {}).get(name)
        result.add(
            f"{name}, {method}: success, proved on the whole curve", float(solved[method].mean()), paper,
            note=f"{count} trials; {of_solved:.2f} of the {solvable.sum()} that any method solved; CPU time "
            f"median {np.median(times):.1f} ms, 95 % within {np.percentile(times, 95):.1f} ms",
        )  # fmt: skip
        if method in COMPARED:
            result.add(f"{name}, {method}: success, {OWN_TEST[method]}", claimed, paper)
    for quantity, words in zip(QUANTITIES, WORDS, strict=True):
        samples = [_values(found, method, quantity) for method in COMPARED]
        answer = kruskal(*samples)
        medians = [f"{m} {np.median(s):.3g}" for m, s in zip(COMPARED, samples, strict=True)]
        label = f"{name}, Kruskal-Wallis p, {words.partition(',')[0]}"
        result.add(label, float(answer.pvalue), note="medians: " + ", ".join(medians))
    _add_speed(result, name, found)


def _add_speed(result: Result, name: str, found: dict[str, Any]) -> None:
    replans, two = found["replanning"], found["two_processes"]
    result.add(
        f"{name}, replanning: CPU time, median", replans["median_ms"], unit="ms",
        note=f"{replans['states']} moved states; 95 % within {replans['p95_ms']:.1f} ms",
    )  # fmt: skip
    if two["routes"]:
        result.add(
            f"{name}, genetic repair in two processes: time saved", 100.0 * two["saved"],
            100.0 * PAPER_SAVED_G4 if name == "G4" else None, "%",
            f"{two['routes']} routes with several segments; {two['possible']:.0%} by CPU times, if both "
            "cores were free",
        )  # fmt: skip


def _values(found: dict[str, Any], method: str, quantity: str) -> list[float]:
    return [row[quantity] for row in found["rows"][method] if row.get(quantity) is not None]


def draw_fig5(record: dict[str, Any]) -> Figure:
    """Draw time, length, wall distance and curvature by group and method, as in fig. 5."""
    figure = style.new_figure(13.0, 8.4)
    colours = (style.SCOPE, style.TUBE, style.VESSEL, style.FISSURE)
    groups = list(record)
    for number, (quantity, words) in enumerate(zip(QUANTITIES, WORDS, strict=True)):
        axes = figure.add_subplot(2, 2, number + 1)
        for m, (method, colour) in enumerate(zip(COMPARED, colours, strict=True)):
            values = [_values(record[g], method, quantity) for g in groups]
            drawn = axes.boxplot(
                values, positions=np.arange(len(groups)) + 0.19 * (m - 1.5), widths=0.16, patch_artist=True,
                medianprops={"color": style.INK}, flierprops={"markersize": 2.5}, manage_ticks=False,
            )  # fmt: skip
            for box in drawn["boxes"]:
                box.set_facecolor(colour)
            drawn["boxes"][0].set_label(method)
        axes.set_xticks(range(len(groups)), [f"{g}\n{LIMITS_PER_MM[g]:g} per mm" for g in groups])
        axes.set_ylabel(words)
        if quantity == "mean_wall_mm":
            # A few splines of RRT* swing far out of the lumen.
            axes.set_ylim(bottom=max(axes.get_ylim()[0], -2.0))
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
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--groups", nargs="+", default=list(LIMITS_PER_MM), choices=list(LIMITS_PER_MM))
    options = parser.parse_args()
    counts = {name: QUICK_TRIALS if options.quick else TRIALS[name] for name in options.groups}
    result = Result(
        name="li2021_route", title="Route of limited curvature", setting=setting_of(options),
        source="Li et al. 2021, fig. 5 and table 2", not_reproduced=NOT_REPRODUCED, seeds=[options.seed],
        conditions={
            "tubes": "G1 and G2: drawings; G3: "
            + ("two phantoms" if default_anatomies() == ("phantom",) else "liver veins, two airway trees")
            + "; G4: a synthetic child",
            "trials": ", ".join(f"{name} {count}" for name, count in counts.items()),
            "ends": f"noise of {NOISE_MM:g} mm, tolerance {END_TOLERANCE_MM:g} mm, device radius 0",
            "success": "the final curve is proved on its whole length: curvature, and inside the lumen",
        },
    )  # fmt: skip
    record = {}
    for name, count in counts.items():
        record[name] = run_group(name, count, QUICK_PARALLEL if options.quick else PARALLEL, options.seed)
        add_group(result, name, record[name])
    result.figure = draw_fig5(record)
    write_result(result, options.results)


if __name__ == "__main__":
    main()
