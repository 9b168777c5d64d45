"""Needle planners on recorded queries, with the recorded results of another planner beside them.

    python experiments/needle_planners.py DATA [--set hard|easy] [--time 1] [--seeds 3] [--decide 10]
                                          [--recheck 5000] [--out FILE.json] [--quick]

DATA holds `needle/` (queries and results) and `med-rad/PatientN` (masks).  Times are CPU seconds of this
process without loading.  A length includes the distance left to the target.  Every path is walked again in
steps of 0.02 mm and measured to every obstacle voxel's centre.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from needle_queries import Judge, Obstacles, Query, easy_queries, hard_queries, load_obstacles

from anatomy.io.files import atomic_write
from stages.needle import searches
from stages.needle.decision import Decision
from stages.needle.planners import PLANNERS, MakeSearch
from stages.needle.resolution import Resolution, ResolutionSearch
from stages.needle.searches import RestartingRRT
from stages.needle.space import NeedleSpace

MARKS_S = (0.01, 0.1, 1.0, 10.0)
SLICE = 200
UNIT = Resolution(fine_mm=1.0, fine_rolls=16)

NAMES = ("rrt", "optimal", "resolution", "decide")


def asked(query: Query) -> searches.Query:
    """Return a recorded query as the needle stage takes it."""
    return searches.Query(lps_from_start=query.lps_from_start, target=query.target_lps)


def run(
    make: MakeSearch, space: NeedleSpace, query: Query, seed: int, time_s: float, judge: Judge
) -> dict[str, Any]:
    """Run one planner for some CPU time; return when it had which length, and its paths' faults."""
    began = time.process_time()
    search = make(space, asked(query), seed)
    first: float | None = None
    history: list[tuple[float, float]] = []
    faults: list[str] = []
    paths = 0
    while not search.finished and (spent := time.process_time() - began) < time_s:
        if search.advance(SLICE) and search.path is not None:
            spent = time.process_time() - began
            first = spent if first is None else first
            history.append((spent, search.path.length_mm + judge.miss_mm(search.path)))
            aside = time.process_time()
            faults += judge.faults(search.path)
            paths += 1
            began += time.process_time() - aside
    return {
        "first_s": first,
        "length_mm": min((length for _, length in history), default=None),
        "at": {mark: min((v for t, v in history if t <= mark), default=None) for mark in MARKS_S},
        "paths": paths,
        "faults": faults,
    }


def decide(space: NeedleSpace, query: Query, seed: int, time_s: float, judge: Judge) -> dict[str, Any]:
    """Decide a query: a path, a proof that there is none, exhausted at a resolution, or undecided."""
    began = time.process_time()
    decision = Decision(space, asked(query), seed=seed)
    while decision.outcome == "running" and time.process_time() - began < time_s:
        decision.advance(SLICE)
    found = {"outcome": decision.outcome, "s": time.process_time() - began, "faults": []}
    if decision.path is not None:
        found["faults"] = judge.faults(decision.path)
    elif decision.outcome != "no path":
        began = time.process_time()
        search = ResolutionSearch(space, asked(query), resolution=UNIT)
        while not search.finished and time.process_time() - began < time_s:
            search.advance(SLICE)
        exhausted = search.finished and search.path is None
        found["outcome"] = "exhausted at resolution" if exhausted else "undecided"
    return found


def best_valid_mm(query: Query) -> float:
    """Return the length of the other planner's best path that passes a strict check, and its miss."""
    valid = [
        run["best_length_mm"] + run["check"]["goal_err_mm"]
        for run in query.runs
        if run.get("solved") and run.get("check", {}).get("clearance_valid_strict")
    ]
    return min(valid, default=math.inf)


def solved_by_other(query: Query) -> bool:
    """Tell whether any recorded run solved the query."""
    return any(run.get("solved") for run in query.runs)


def recheck(problems: list[tuple[Query, NeedleSpace, Judge]], wanted: int) -> tuple[int, Counter[str]]:
    """Plan many paths with many seeds; return how many, and the faults found."""
    count, faults, seed = 0, Counter[str](), 0
    while count < wanted and problems:
        seed += 1
        for query, space, judge in problems:
            search = RestartingRRT(space, asked(query), seed=seed)
            for _ in range(3):
                if search.advance(5000) and search.path is not None:
                    faults.update(judge.faults(search.path))
                    count += 1
            if count >= wanted:
                break
        if seed > 20 and count == 0:
            break
    return count, faults


def problems_of(queries: list[Query], patients: Path) -> Iterator[tuple[Query, NeedleSpace, Judge]]:
    """Make each query's space, one patient in memory at a time."""
    obstacles: Obstacles | None = None
    patient = -1
    for query in sorted(queries, key=lambda q: q.patient):
        if obstacles is None or query.patient != patient:
            patient, obstacles = query.patient, load_obstacles(patients / f"Patient{query.patient}")
        space = obstacles.space(query)
        yield query, space, Judge(space, query)


def warm_up(space: NeedleSpace, query: Query) -> None:
    """Compile or load the kernels."""
    for name in NAMES:
        PLANNERS[name](space, asked(query), 1).advance(SLICE)


def print_summary(results: list[dict[str, Any]], names: list[str], peers: Callable[[float], str]) -> None:
    """Print the share solved by time, lengths against the other planner's, and verdicts."""
    for radius in sorted({row["radius_mm"] for row in results}):
        rows = [row for row in results if row["radius_mm"] == radius]
        print(f"\nR = {radius:g} mm, {len(rows)} queries; other planner: {peers(radius)}")
        for name in names:
            runs = [run for row in rows for run in row["runs"][name]]
            shares = [
                100.0 * sum(r["first_s"] is not None and r["first_s"] <= mark for r in runs) / len(runs)
                for mark in MARKS_S
            ]
            first = [1000.0 * r["first_s"] for r in runs if r["first_s"] is not None]
            table = " / ".join(f"{share:.1f}" for share in shares)
            print(
                f"  {name:11s} solved {table} % at {' / '.join(f'{m:g}' for m in MARKS_S)} s; "
                f"median first path {np.median(first) if first else math.nan:.2f} ms; "
                f"faults {sum(len(r['faults']) for r in runs)} in {sum(r['paths'] for r in runs)} paths"
            )
            compared = [
                (
                    min((r["length_mm"] for r in row["runs"][name] if r["length_mm"]), default=math.inf),
                    row["other_mm"],
                )
                for row in rows
                if row["other_mm"] < math.inf
            ]
            if compared:
                shorter = sum(ours <= other + 1e-3 for ours, other in compared)
                ratio = [ours / other for ours, other in compared if ours < math.inf]
                print(
                    f"  {'':11s} not longer than its best valid path: {shorter} of {len(compared)}; "
                    f"length ratio median {np.median(ratio):.4f}, largest {max(ratio):.4f}"
                )
        verdicts = Counter(row["decision"]["outcome"] for row in rows if row.get("decision"))
        if verdicts:
            slowest = max(row["decision"]["s"] for row in rows)
            print(f"  decided: {dict(verdicts)}; slowest {slowest:.1f} s")
        missed = [r["query"] for r in rows if r["other_solved"] and not r["solved"]]
        print(f"  solved by the other planner and not here: {missed or 'none'}")


def main() -> int:
    """Run the study and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--set", choices=("hard", "easy"), default="hard")
    parser.add_argument("--planners", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--time", type=float, default=1.0, help="CPU seconds a run")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--decide", type=float, default=10.0, help="CPU seconds a decision, 0 for none")
    parser.add_argument("--recheck", type=int, default=5000, help="paths planned only to be checked")
    parser.add_argument("--patients", type=int, nargs="+", help="only these")
    parser.add_argument("--out", type=Path, help="write all results as JSON")
    parser.add_argument("--quick", action="store_true", help="one seed, 0.1 s, a few queries")
    options = parser.parse_args()
    if options.quick:
        options.time, options.seeds, options.decide, options.recheck = 0.1, 1, 2.0, 100
    folder, patients = options.data / "needle", options.data / "med-rad"
    queries = hard_queries(folder) if options.set == "hard" else easy_queries(folder, patients)
    queries = [q for q in queries if not options.patients or q.patient in options.patients]
    if options.quick:
        queries = queries[::8]
    print(
        f"lungaccess {version('lungaccess')}, Python {platform.python_version()}, {platform.machine()}, "
        f"{os.cpu_count()} cores, seeds 1 to {options.seeds}, {options.time:g} s a run"
    )
    results, solvable = [], []
    for number, (query, space, judge) in enumerate(problems_of(queries, patients)):
        if number == 0:
            warm_up(space, query)
        runs = {
            name: [
                run(PLANNERS[name], space, query, seed, options.time, judge)
                for seed in range(1, (1 if name == "resolution" else options.seeds) + 1)
            ]
            for name in options.planners
        }
        row: dict[str, Any] = {
            "query": query.name,
            "radius_mm": query.radius_mm,
            "other_mm": best_valid_mm(query),
            "other_solved": solved_by_other(query),
            "solved": any(r["first_s"] is not None for found in runs.values() for r in found),
            "runs": runs,
        }
        if options.decide:
            row["decision"] = decide(space, query, 1, options.decide, judge)
        results.append(row)
        if row["solved"]:
            solvable.append((query, space, judge))
        verdict = row.get("decision", {}).get("outcome", "")
        print(
            f"{query.name:18s} {'solved' if row['solved'] else '-':7s} {verdict}", file=sys.stderr, flush=True
        )
    print_summary(results, options.planners, lambda radius: other_shares(queries, radius))
    if options.recheck:
        count, faults = recheck(solvable, options.recheck)
        print(f"\n{count} more paths checked again: {dict(faults) or 'no fault'}")
    if options.out:
        with atomic_write(options.out) as temporary:
            Path(temporary).write_text(json.dumps(results, indent=1))
    return 0


def other_shares(queries: list[Query], radius: float) -> str:
    """Return the shares that the other planner's best kind of run solved by time."""
    mine = [q for q in queries if q.radius_mm == radius and q.runs]
    if not mine:
        return "no runs"
    kinds = {run["planner"] for q in mine for run in q.runs}
    out = []
    for mark in MARKS_S[:3]:
        share = {
            kind: sum(
                any(r["planner"] == kind and (r.get("first_cpu_s") or math.inf) <= mark for r in q.runs)
                for q in mine
            )
            / len(mine)
            for kind in kinds
        }
        out.append(f"{100.0 * max(share.values()):.1f}")
    return " / ".join(out) + " % at 0.01 / 0.1 / 1 s"


if __name__ == "__main__":
    sys.exit(main())
