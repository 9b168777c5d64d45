"""Cost of the best plan over planning time, and what joint refinement saves of the best sampled plan.

    python -m experiments.anytime_quality PATIENT [--system flexure-needle] [--goals 6] [--seeds 3]

Goals are peripheral targets as in `kuntz2015_reachability.py` that a direct arc reaches, evenly taken from
100; fissures may be crossed.  Each run is a line of the results file; runs that it holds are not repeated.
Time is processor time of this process without the atlas.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.grid import Float
from experiments.kuntz2015_reachability import peripheral_targets
from lungaccess.assemble import Task
from lungaccess.atlas import Atlas
from lungaccess.refinement import refine
from lungaccess.searches import AtlasSearch, Step
from lungaccess.target import point_target

TIMES_S = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
SAMPLED_ITERATIONS = 300
"""Iterations, without joint refinement, that sample the plan which joint refinement is to improve."""
JOINT = "joint refinement"


def search_for(atlas: Atlas, point: Float, seed: int) -> AtlasSearch:
    """Return a search for a plan to a point."""
    task = Task(
        lung=atlas.lung, system=atlas.system, target=point_target(atlas.lung, point),
        objective="inverse_clearance", with_fissures=atlas.with_fissures, method="atlas", seed=seed,
    )  # fmt: skip
    return AtlasSearch(task, atlas)


def goals(atlas: Atlas, count: int) -> list[int]:
    """Return the numbers of `count` targets that a direct arc reaches."""
    points = peripheral_targets(atlas.lung, 50, 0)
    reached = [
        number
        for number, point in enumerate(points)
        if any(step.candidate for step in search_for(atlas, point, 0).direct_steps())
    ]
    return [reached[place] for place in np.linspace(0, len(reached) - 1, count).astype(int)]


def trace(search: AtlasSearch, time_s: float) -> list[tuple[float, float, str]]:
    """Return time, cost and phase of each plan that is better than all before."""
    began, found = time.process_time(), []
    for step in search.steps():
        elapsed = time.process_time() - began
        if elapsed > time_s:
            break
        if step.candidate is not None:
            found.append((elapsed, step.cost, step.phase))
    return found


def joint_gain(search: AtlasSearch) -> dict[str, float]:
    """Return the cost of the best direct arc, of the best sampled plan, and of both after refinement."""
    costs: dict[str, float] = {}
    direct = _last(search, 0)
    sampled = _last(search_for(search.atlas, search.task.target.lps_mm, search.task.seed), SAMPLED_ITERATIONS)
    for name, step in (("direct", direct), ("sampled", sampled)):
        if step is None or step.candidate is None:
            continue
        better = refine(search.task, search.atlas.sites, step.candidate)
        costs[name] = step.cost
        costs[f"{name}, refined"] = step.cost if better is None else search.desk.cost(better.path)
    return costs


def _last(search: AtlasSearch, iterations: int) -> Step | None:
    """Return the best step within so many iterations, none of them joint refinement."""
    best = None
    for step in search.steps():
        if step.iteration > iterations:
            break
        if step.candidate is not None and step.phase != JOINT:
            best = step
    return best


def cost_at(run: dict[str, Any], time_s: float) -> float:
    """Return the cost of a run's best plan after so many seconds."""
    return min((cost for at, cost, _phase in run["trace"] if at <= time_s), default=float("inf"))


def table(runs: list[dict[str, Any]]) -> str:
    """Return the median excess over the last cost by time, and the gains of joint refinement."""
    lines = []
    last = max(run["time_s"] for run in runs)
    for time_s in (t for t in TIMES_S if t <= last):
        excess = [100.0 * (cost_at(run, time_s) / cost_at(run, last) - 1.0) for run in runs]
        lines.append(
            f"after {time_s:g} s: {np.median(excess):.2f} % above the cost after {last:g} s in the median, "
            f"{np.max(excess):.2f} % at most"
        )
    for name in ("direct", "sampled"):
        pairs = [(r["gain"][name], r["gain"][f"{name}, refined"]) for r in runs if name in r["gain"]]
        gains = [100.0 * (1.0 - after / before) for before, after in pairs]
        before, after = np.median(np.array(pairs), axis=0)
        lines.append(
            f"joint refinement of the best {name} plan: median cost {before:.3f} -> {after:.3f} "
            f"({100.0 * (1.0 - after / before):.1f} %), median saving {np.median(gains):.1f} %, "
            f"cheaper in {sum(gain > 0.0 for gain in gains)} of {len(gains)}"
        )
    return "\n".join(lines)


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Draw the cost of each run over time, as a share of its last."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    for run in runs:
        times = [at for at, _cost, _phase in run["trace"]] + [run["time_s"]]
        costs = [cost for _at, cost, _phase in run["trace"]]
        axes.step(times, [*(c / costs[-1] for c in costs), 1.0], where="post", linewidth=0.8)
    axes.set(xscale="log", xlabel="planning time, s", ylabel="cost / last cost", ylim=(0.98, 1.5))
    axes.axhline(1.05, color="black", linewidth=0.5)
    figure.savefig(path)


def main() -> None:
    """Run the study, print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("--system", default="flexure-needle")
    parser.add_argument("--goals", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--time", type=float, default=300.0, help="planning time per run, s")
    parser.add_argument("--quick", action="store_true", help="2 goals, 1 seed, 3 s")
    parser.add_argument("--out", type=Path, default=Path("anytime_quality.jsonl"))
    options = parser.parse_args()
    if options.quick:
        options.goals, options.seeds, options.time = 2, 1, 3.0
    lung = la.load_patient(options.patient)
    system = replace(la.load_system(options.system), fissures_allowed=True)
    atlas = la.build_atlas(lung, system)
    points = peripheral_targets(lung, 50, 0)
    done = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    runs = []
    chosen = goals(atlas, options.goals)
    # What is compiled or built once in a process does not count.
    joint_gain(search_for(atlas, points[chosen[0]], 0))
    for seed in range(options.seeds):
        for goal in chosen:
            name = [lung.name, system.name, goal, seed, options.time]
            run = next((each for each in done if each["name"] == name), None)
            if run is None:
                found = trace(search_for(atlas, points[goal], seed), options.time)
                gain = joint_gain(search_for(atlas, points[goal], seed))
                run = {"name": name, "time_s": options.time, "trace": found, "gain": gain}
                with options.out.open("a") as file:
                    file.write(json.dumps(run) + "\n")
                costs = " ".join(f"{cost_at(run, t):.3f}" for t in TIMES_S if t <= options.time)
                sys.stdout.write(f"{name}: {costs} {gain}\n")
                sys.stdout.flush()
            runs.append(run)
    sys.stdout.write(table(runs) + "\n")
    draw(runs, options.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
