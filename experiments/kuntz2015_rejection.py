"""What workspace rejection saves in reference mode, beside the 7.6 of [Kuntz2015, sec. V].

    python experiments/kuntz2015_rejection.py PATIENT [--system lung-default] [--goals 3] [--repeats 2]

The paper took 5.63 s to find 15 paths to one goal, and 42.62 s without its line 8: a factor of 7.6.  Here
the same is measured: processor time until so many paths are found, on the same placements with and without
line 8, each RRT limited to 0.05 s.  The goal is one that is easily reached, as the paper's fig. 6 shows one:
of random peripheral targets, those that the most deployments have in their needle's workspace.

Two factors are stated.  Of all time, as the paper's; and of the RRTs alone, because the printed
algorithm tests no tubes for collisions and here they are tested in either case.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from kuntz2015_reachability import peripheral_targets

import lungaccess as la
from anatomy.grid import Float
from anatomy.lung import Lung
from lungaccess.assemble import Task
from lungaccess.atlas import Atlas
from lungaccess.reference import ReferenceSearch, ReferenceSearchWithoutRejection
from lungaccess.reference.obstacles import Obstacles
from lungaccess.reference.search import FOUND, obstacles_for
from lungaccess.target import point_target
from stages.needle.space import needle_space, workspace_lengths

RRT_TIME_S = 0.05
PAPER_PATHS, PAPER_S = 15, (5.63, 42.62)


@dataclass(frozen=True, kw_only=True)
class Run:
    """One search: paths found, placements, and processor time by part."""

    paths: int
    placements: int
    spent_s: Mapping[str, float]

    @property
    def total_s(self) -> float:
        """Processor time of all parts."""
        return float(sum(self.spent_s.values()))


def run_until(search: ReferenceSearch, paths: int, limit_s: float) -> Run:
    """Search until so many paths are found, or so much processor time is spent."""
    began, iteration = time.process_time(), 0
    for step in search.steps():
        iteration = step.iteration
        if search.counts[FOUND] >= paths or time.process_time() - began > limit_s:
            break
    return Run(paths=search.counts[FOUND], placements=iteration, spent_s=search.spent_s)


def prepared_obstacles(task: Task, atlas: Atlas) -> Obstacles:
    """Return the solids with the meshes that are needed, so that no run is charged for making them."""
    obstacles = obstacles_for(task)
    obstacles.prepare()
    for branch in np.unique(atlas.deployments.branch):
        obstacles.other_airways(int(branch))
    return obstacles


def goals_by_ease(lung: Lung, atlas: Atlas, points: Float) -> Float:
    """Return the points, that in the workspace of the most deployments first."""
    system, entries = atlas.system, atlas.deployments
    space = needle_space(lung, system.needle, system.margins, with_fissures=atlas.with_fissures)
    held = [
        int(np.isfinite(workspace_lengths(space, entries.positions, entries.tangents, point)).sum())
        for point in points
    ]
    return np.asarray(points[np.argsort(held)[::-1]])


def compare(
    task: Task, atlas: Atlas, obstacles: Obstacles, paths: int, limit_s: float
) -> tuple[Run, Run] | None:
    """Return a run with line 8 and one without; None if the first finds too few paths."""
    kinds = (ReferenceSearch, ReferenceSearchWithoutRejection)
    first, second = (kind(task, atlas, rrt_time_s=RRT_TIME_S, obstacles=obstacles) for kind in kinds)
    with_it = run_until(first, paths, limit_s)
    if with_it.paths < paths:
        return None
    return with_it, run_until(second, paths, 20.0 * limit_s)


def report(pairs: list[tuple[Run, Run]], paths: int) -> str:
    """Return the table."""
    total = np.array([(a.total_s, b.total_s) for a, b in pairs])
    rrt = np.array([(a.spent_s["needle"], b.spent_s["needle"]) for a, b in pairs])
    lines = [f"{'':36}{'paper':>10}{'ours, median':>14}{'least':>9}{'greatest':>10}"]
    rows = (
        (f"with line 8, s to {paths} paths", f"{PAPER_S[0]:.2f}", total[:, 0]),
        (f"without line 8, s to {paths} paths", f"{PAPER_S[1]:.2f}", total[:, 1]),
        ("factor, all time", f"{PAPER_S[1] / PAPER_S[0]:.1f}", total[:, 1] / total[:, 0]),
        ("factor, RRTs alone", "", rrt[:, 1] / rrt[:, 0]),
    )
    for name, paper, values in rows:
        numbers = f"{np.median(values):14.2f}{values.min():9.2f}{values.max():10.2f}"
        lines.append(f"{name:36}{paper:>10}{numbers}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the comparison and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("--system", default="lung-default")
    parser.add_argument("--goals", type=int, default=3)
    parser.add_argument("--paths", type=int, default=PAPER_PATHS)
    parser.add_argument("--repeats", type=int, default=2, help="seeds for each goal")
    parser.add_argument("--limit", type=float, default=60.0, help="processor time to find the paths, s")
    parser.add_argument("--allow-fissures", action="store_true")
    parser.add_argument("--cache", default=None)
    options = parser.parse_args()
    lung = la.load_patient(options.patient, cache=options.cache)
    system = replace(la.load_system(options.system), fissures_allowed=options.allow_fissures)
    atlas = la.build_atlas(lung, system)
    pairs: list[tuple[Run, Run]] = []
    obstacles, reached = None, 0
    for point in goals_by_ease(lung, atlas, peripheral_targets(lung, 50, 0)):
        for seed in range(options.repeats):
            task = Task(
                lung=lung,
                system=system,
                target=point_target(lung, point),
                objective="inverse_clearance",
                with_fissures=atlas.with_fissures,
                method="reference",
                seed=seed,
            )
            obstacles = obstacles or prepared_obstacles(task, atlas)
            pair = compare(task, atlas, obstacles, options.paths, options.limit)
            if pair is None:
                sys.stdout.write(f"goal {point.round(1).tolist()}: too few paths in {options.limit:g} s\n")
                break
            pairs.append(pair)
            words = ", ".join(
                f"{run.paths} paths of {run.placements} placements in {run.total_s:.2f} s "
                f"(RRTs {run.spent_s['needle']:.2f} s)"
                for run in pair
            )
            sys.stdout.write(f"goal {point.round(1).tolist()}, seed {seed}: {words}\n")
            sys.stdout.flush()
        else:
            reached += 1
        if reached == options.goals:
            break
    sys.stdout.write(f"{lung.name}, {system.name}, {reached} goals, {len(pairs)} pairs of runs\n")
    if pairs:
        sys.stdout.write(report(pairs, options.paths))


if __name__ == "__main__":
    main()
