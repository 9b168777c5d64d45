"""Needle planners on recorded queries, with the recorded results of another planner beside them.

    python -m experiments.needle_planners [--quick] [--seed 1] [--results FOLDER] [--set hard|easy]

Where LUNGACCESS_DATA is not set, queries are drawn in the phantom, and nothing is recorded for them.  Times
are CPU seconds of this process without loading.  A length includes the distance left to the target.  Every
path is walked again in steps of 0.02 mm and measured to every obstacle voxel's centre.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from experiments.support.anatomies import data_folder, require_data
from experiments.support.needle.queries import (
    Query,
    Validator,
    easy_queries,
    environment_of,
    generated_queries,
    hard_queries,
    load_obstacles,
)
from experiments.support.needle.runs import (
    MARKS_S,
    SLICE,
    Problem,
    asked,
    best_valid_mm,
    decide,
    recheck,
    run,
    solved_by_other,
)
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.running.benchmark.published import UncObstacles, unc_obstacles
from lungaccess.showing.report import style
from stages.needle.search.planners import searches

NAMES = ("rrt", "optimal", "resolution", "decide")
COLOURS = (style.SCOPE, style.TUBE, style.NODULE, style.FISSURE)
QUERY_SETS = {"hard": "96 queries whose direct arc is blocked", "easy": "the poses shipped with the patients"}
QUICK_EVERY = 8
GENERATED = 96
FULL = {"time_s": 1.0, "seeds": 3, "decide_s": 10.0, "recheck": 5000}
QUICK = {"time_s": 0.1, "seeds": 1, "decide_s": 2.0, "recheck": 100}
SAME_MM = 1e-3

Rows = list[dict[str, Any]]


def problems(query_set: str, every: int, seed: int) -> Iterator[Problem]:
    """Make the environment of each query, one patient in memory at a time."""
    if data_folder() is None:
        images = make_phantom(seed=3, size="small").images
        obstacles = unc_obstacles(images)
        for query in generated_queries(obstacles, build_lung(images).tree, GENERATED // every, seed):
            yield _problem(obstacles, query)
        return
    folder, patients = require_data("needle"), require_data("med-rad")
    queries = hard_queries(folder) if query_set == "hard" else easy_queries(folder, patients)
    loaded = -1
    for query in sorted(queries[::every], key=lambda q: q.patient):
        if query.patient != loaded:
            loaded, obstacles = query.patient, load_obstacles(patients / f"Patient{query.patient}")
        yield _problem(obstacles, query)


def _problem(obstacles: UncObstacles, query: Query) -> Problem:
    environment = environment_of(obstacles, query)
    return query, environment, Validator(environment, query)


def run_all_planners(found: Problem, numbers: dict[str, Any], seed: int) -> dict[str, Any]:
    """Run all planners on one query, and decide it."""
    query, environment, validator = found
    runs = {
        name: [
            run(searches()[name], environment, query, each, numbers["time_s"], validator)
            for each in range(seed, seed + (1 if name == "resolution" else numbers["seeds"]))
        ]
        for name in NAMES
    }
    return {
        "query": query,
        "solved": any(each["first_s"] is not None for of_name in runs.values() for each in of_name),
        "runs": runs,
        "decision": decide(environment, query, seed, numbers["decide_s"], validator),
    }


def run_queries(found: Iterable[Problem], numbers: dict[str, Any], seed: int) -> tuple[Rows, list[Problem]]:
    """Run all planners on all queries, after kernels are compiled; return the rows, and what was solved."""
    rows, solvable = [], []
    for number, problem in enumerate(found):
        if number == 0:
            for name in NAMES:
                searches()[name](problem[1], asked(problem[0]), 1).advance(SLICE)
        rows.append(run_all_planners(problem, numbers, seed))
        if rows[-1]["solved"]:
            solvable.append(problem)
        print(f"{problem[0].name}: {rows[-1]['decision']['outcome']}", file=sys.stderr, flush=True)
    return rows, solvable


def solved_share(rows: Rows, name: str, mark_s: float) -> float:
    """Return the share of a planner's runs that had a path after some CPU time, %."""
    first = [each["first_s"] for row in rows for each in row["runs"][name]]
    return 100.0 * sum(s is not None and s <= mark_s for s in first) / len(first)


def other_share(rows: Rows, mark_s: float) -> float | None:
    """Return the share that the recorded planner's best kind of run solved after some CPU time, %."""
    recorded = [row["query"] for row in rows if row["query"].runs]
    kinds = {each["planner"] for query in recorded for each in query.runs}
    shares = [
        sum(
            any(r["planner"] == kind and (r.get("first_cpu_s") or math.inf) <= mark_s for r in query.runs)
            for query in recorded
        )
        / len(recorded)
        for kind in kinds
    ]
    return 100.0 * max(shares) if shares else None


def add_radius(result: Result, radius: float, rows: Rows, marks_s: list[float]) -> None:
    """Add the rows of one needle: shares by time, first path, lengths, decisions."""
    label = f"R = {radius:g} mm"
    for mark in marks_s:
        share = other_share(rows, mark)
        if share is not None:
            result.add(
                f"{label}, recorded C++ planner: solved by {mark:g} s", share, unit="%",
                note=f"{len(rows)} queries, best kind of run at this time",
            )  # fmt: skip
    for name in NAMES:
        for mark in marks_s:
            result.add(f"{label}, {name}: solved by {mark:g} s", solved_share(rows, name, mark), unit="%")
        runs = [each for row in rows for each in row["runs"][name]]
        first = [1e3 * each["first_s"] for each in runs if each["first_s"] is not None]
        if first:
            result.add(
                f"{label}, {name}: first path, median", float(np.median(first)), unit="ms",
                note=f"{sum(len(r['faults']) for r in runs)} faults in {sum(r['paths'] for r in runs)} paths",
            )  # fmt: skip
        _add_lengths(result, f"{label}, {name}", rows, name)
    verdicts = Counter(row["decision"]["outcome"] for row in rows)
    result.add(
        f"{label}: queries decided", 100.0 * (verdicts["path"] + verdicts["no path"]) / len(rows), unit="%",
        note=", ".join(f"{outcome} {count}" for outcome, count in sorted(verdicts.items()))
        + f"; slowest {max(row['decision']['s'] for row in rows):.1f} s",
    )  # fmt: skip


def _add_lengths(result: Result, label: str, rows: Rows, name: str) -> None:
    pairs = []
    for row in rows:
        ours = min((r["length_mm"] for r in row["runs"][name] if r["length_mm"]), default=math.inf)
        pairs.append((ours, best_valid_mm(row["query"])))
    pairs = [(ours, other) for ours, other in pairs if max(ours, other) < math.inf]
    if not pairs:
        return
    longer = np.array([100.0 * (ours / other - 1.0) for ours, other in pairs])
    never = sum(ours <= other + SAME_MM for ours, other in pairs)
    result.add(
        f"{label}: longer than the recorded planner's best valid path, median", float(np.median(longer)),
        unit="%", note=f"largest {longer.max():.2f} %; not longer in {never} of {len(pairs)}",
    )  # fmt: skip


def draw(by_radius: dict[float, Rows], longest_s: float) -> Figure:
    """Draw the share of solved runs over CPU time for each needle."""
    figure = style.new_figure(10.0, 4.0)
    times = np.geomspace(1e-4, longest_s, 120)
    for panel, (axes, (radius, rows)) in enumerate(
        zip(figure.subplots(1, len(by_radius), sharey=True, squeeze=False)[0], by_radius.items(), strict=True)
    ):
        for name, colour in zip(NAMES, COLOURS, strict=True):
            axes.plot(times, [solved_share(rows, name, t) for t in times], color=colour, label=name)
        if other_share(rows, longest_s) is not None:
            axes.plot(
                times, [other_share(rows, t) for t in times], "--", color=style.INK, label="recorded C++"
            )
        axes.set(xscale="log", xlabel="CPU time, s", ylim=(0.0, 100.0))
        axes.set_title(f"R = {radius:g} mm, {len(rows)} queries", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        if panel == 0:
            axes.set_ylabel("solved, %")
            axes.legend(frameon=False, fontsize=9)
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--set", choices=tuple(QUERY_SETS), default="hard")
    options = parser.parse_args()
    numbers, every = (QUICK, QUICK_EVERY) if options.quick else (FULL, 1)
    drawn = data_folder() is None
    result = Result(
        name="needle_planners", title="Needle planners on shared queries", setting=setting_of(options),
        seeds=list(range(options.seed, options.seed + numbers["seeds"])),
        conditions={
            "queries": "drawn in the phantom" if drawn else f"{options.set}: {QUERY_SETS[options.set]}"
            + (f", every {every}th" if every > 1 else ""),
            "time": f"{numbers['time_s']:g} CPU s a run, {numbers['decide_s']:g} a decision, one core",
            "clearance": "1 mm and half a voxel diagonal to every obstacle voxel's centre",
        },
    )  # fmt: skip
    rows, solvable = run_queries(problems(options.set, every, options.seed), numbers, options.seed)
    by_radius = {
        radius: [row for row in rows if row["query"].radius_mm == radius]
        for radius in sorted({row["query"].radius_mm for row in rows})
    }
    marks_s = [mark for mark in MARKS_S if mark <= numbers["time_s"]]
    for radius, of_radius in by_radius.items():
        add_radius(result, radius, of_radius, marks_s)
    if not drawn:
        missed = [r["query"].name for r in rows if solved_by_other(r["query"]) and not r["solved"]]
        result.add("solved by the recorded planner and not here", float(len(missed)), note=", ".join(missed))
    count, faults = recheck(solvable, numbers["recheck"])
    result.add("more paths walked again: faults", float(sum(faults.values())), note=f"{count} paths")
    result.figure = draw(by_radius, marks_s[-1])
    write_result(result, options.results)


if __name__ == "__main__":
    main()
