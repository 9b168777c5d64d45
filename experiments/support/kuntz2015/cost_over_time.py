"""Cost of the best plan over planning time, and what joint refinement saves [Kuntz2015, fig. 9].

Goals are peripheral targets that a direct arc reaches, evenly taken from 100.  Time is processor time of this
process without the atlas.  Each run is a line of a file; runs that it holds are not repeated.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import Step
from lungaccess.planning.refinement import refine
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIMES_S = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
SAMPLED_ITERATIONS = 300
"""Iterations, without joint refinement, that sample the plan which joint refinement is to improve."""
JOINT = "joint refinement"


def search_for(atlas: Atlas, point: Float, seed: int) -> AtlasSearch:
    """Return a search for a plan to a point."""
    task = Task(lung=atlas.lung, system=atlas.system, target=point_target(atlas.lung, point), seed=seed)
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
        better = refine(search.task, step.candidate)
        costs[name] = step.cost
        costs[f"{name}, refined"] = step.cost if better is None else search.evaluator.cost(better)
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


def recorded(atlas: Atlas, name: list[Any], point: Float, time_s: float, file: Path) -> dict[str, Any]:
    """Return the run of that name from the file, or search and append it.

    Args:
        name: Lung, system, goal, seed and seconds, as in the file; the seed is the fourth.
    """
    done = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    run = next((each for each in done if each["name"] == name), None)
    if run is None:
        found = trace(search_for(atlas, point, name[3]), time_s)
        run = {"name": name, "time_s": time_s, "trace": found}
        run["gain"] = joint_gain(search_for(atlas, point, name[3]))
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a") as lines:
            lines.write(json.dumps(run) + "\n")
    return run


def all_runs(atlas: Atlas, count: int, seeds: list[int], time_s: float, file: Path) -> list[dict[str, Any]]:
    """Return a run for every goal and seed."""
    points, chosen = peripheral_targets(atlas.lung, 50, 0), goals(atlas, count)
    # What is compiled or built once in a process does not count.
    joint_gain(search_for(atlas, points[chosen[0]], 0))
    return [
        recorded(atlas, [atlas.lung.name, atlas.system.name, goal, seed, time_s], points[goal], time_s, file)
        for seed in seeds
        for goal in chosen
    ]


def excess_percent(runs: list[dict[str, Any]], time_s: float) -> Float:
    """Return by how much the cost of each run at a time is above its last, in percent."""
    return np.array([100.0 * (cost_at(r, time_s) / cost_at(r, r["time_s"]) - 1.0) for r in runs])


def gain_percent(runs: list[dict[str, Any]], name: str) -> Float:
    """Return what joint refinement saves of the best "direct" or "sampled" plan, in percent."""
    gains = [run["gain"] for run in runs if name in run["gain"]]
    return np.array([100.0 * (1.0 - gain[f"{name}, refined"] / gain[name]) for gain in gains])


def draw(axes: Axes, runs: list[dict[str, Any]]) -> None:
    """Draw the cost over time of each goal, the mean of its seeds, as in fig. 9."""
    for number, goal in enumerate(sorted({run["name"][2] for run in runs})):
        mine = [run for run in runs if run["name"][2] == goal]
        times = np.geomspace(0.1, mine[0]["time_s"], 200)
        costs = np.mean([[cost_at(run, at) for at in times] for run in mine], axis=0)
        axes.plot(times, costs, label=f"goal {number + 1}", linewidth=1.2)
    axes.set(xscale="log", xlabel="planning time (s)", ylabel="cost of the best plan", title="fig. 9")
    axes.legend(frameon=False, fontsize=7)
