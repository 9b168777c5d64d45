"""Write the expectations of the scenarios anew: `python -m tests.scenarios.record [--data FOLDER]`.

Run it after a change that is meant to alter plans, look at what it prints, and say why in the commit.
Targets and queries stay as they are unless --draw is given.  Without --data the expectations for real
patients stay as they are.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lungaccess.problem.peripheral import peripheral_targets
from stages.needle.environment import direct_arcs, needle_environment, workspace_lengths
from tests.scenarios import expected as expectations
from tests.scenarios.cases import (
    ANATOMIES,
    CASES,
    COST_TOLERANCE,
    NEEDLE_DEVICE,
    NEEDLE_ITERATIONS,
    NEEDLE_PLANNERS,
    PLANNERS,
    SHARED_QUERIES,
    Anatomy,
    Case,
)
from tests.scenarios.runs import Answer, answer_for, costlier, lost, needle_answers
from tests.scenarios.scenes import Scenes
from tests.scenarios.shared_queries import SharedQueries

DRAWN_A_LUNG = 40
WITHIN_REACH, OTHERS = 4, 2
"""Targets that a direct arc of `NEEDLE_DEVICE` reaches, and targets that none reaches."""
FREE_QUERIES, BLOCKED_QUERIES = 3, 4
QUERY_MM = (25.0, 60.0)
QUERY_CLEAR_MM = 2.5
AIM_SPREAD = 0.25


def draw_targets(scenes: Scenes, anatomy: Anatomy) -> list[list[float]]:
    """Draw peripheral targets: `WITHIN_REACH` that a direct arc reaches, then `OTHERS`."""
    lung, system = scenes.lung(anatomy), scenes.system(anatomy, NEEDLE_DEVICE)
    atlas = scenes.atlas(Case(anatomy=anatomy, device=NEEDLE_DEVICE, planner="atlas"))
    environment = needle_environment(lung, system.needle, system.margins, with_fissures=atlas.with_fissures)
    entries = atlas.deployments
    points = peripheral_targets(lung, DRAWN_A_LUNG, 0).round(3)
    reached = []
    for point in points:
        near, _lengths = atlas.index.holding(environment, point)
        blockers, _lengths, _costs = direct_arcs(
            environment, entries.positions[near], entries.tangents[near], entries.branch[near], point
        )
        reached.append(bool((blockers == 0).any()))
    # Left and right in turns.
    mixed = np.arange(len(points)).reshape(2, -1).T.ravel()
    chosen = [n for n in mixed if reached[n]][:WITHIN_REACH] + [n for n in mixed if not reached[n]][:OTHERS]
    return points[chosen].tolist()


def draw_queries(scenes: Scenes, anatomy: Anatomy) -> list[dict[str, Any]]:
    """Draw queries: first those with a clear direct arc, then blocked ones that `decide` solves."""
    lung, system = scenes.lung(anatomy), scenes.system(anatomy, NEEDLE_DEVICE)
    environment = needle_environment(
        lung, system.needle, system.margins, with_fissures=not anatomy.fissures_allowed
    )
    rng, targets = np.random.default_rng(0), peripheral_targets(lung, DRAWN_A_LUNG, 1).round(3)
    free: list[dict[str, Any]] = []
    blocked: list[dict[str, Any]] = []
    while len(free) < FREE_QUERIES or len(blocked) < BLOCKED_QUERIES:
        target, ahead = targets[rng.integers(len(targets))], rng.standard_normal(3)
        ahead /= np.linalg.norm(ahead)
        start = (target - rng.uniform(*QUERY_MM) * ahead).round(3)
        direction = ahead + AIM_SPREAD * rng.standard_normal(3)
        direction = (direction / np.linalg.norm(direction)).round(6)
        one = direction[None] / np.linalg.norm(direction)
        if not lung.grid.contains(start[None]).all() or not _clear(lung, start):
            continue
        if not np.isfinite(workspace_lengths(environment, start[None], one, target)).all():
            continue
        blockers, _lengths, _costs = direct_arcs(environment, start[None], one, np.array([-1]), target)
        kind, most = (free, FREE_QUERIES) if blockers[0] == 0 else (blocked, BLOCKED_QUERIES)
        query = {"start": start.tolist(), "direction": direction.tolist(), "target": target.tolist()}
        if len(kind) < most and needle_answers(scenes, anatomy, [query], "decide")[0].cost is not None:
            kind.append(query)
    return free + blocked


def _clear(lung: Any, point: Any) -> bool:
    return bool(lung.fields["obstacle"].lower_bound_mm(point)[0] >= QUERY_CLEAR_MM)


def keep(stored: dict[str, Any], name: str, iterations: int, answers: list[Answer]) -> None:
    """Store the costs of a case; print what changed, and stop at a plan that is not valid."""
    faults = [fault for answer in answers for fault in answer.faults]
    if faults:
        raise SystemExit(f"{name}: {faults}; nothing was written")
    costs = [None if answer.cost is None else float(f"{answer.cost:.7g}") for answer in answers]
    before = stored.get(name, {}).get("costs", [])
    if len(before) == len(costs):
        for said in (lost(before, costs), costlier(before, costs, 0.0)):
            if said:
                sys.stdout.write(f"{name}: worse than before: {said}\n")
    planned = sum(cost is not None for cost in costs)
    sys.stdout.write(f"{name}: {planned} of {len(costs)}\n")
    stored[name] = {"iterations": iterations, "costs": costs}


def main() -> None:
    """Run all scenarios and store what they find."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="folder of real anatomy")
    parser.add_argument("--draw", action="store_true", help="draw targets and queries anew")
    names = [anatomy.name for anatomy in ANATOMIES]
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="these anatomies alone")
    options = parser.parse_args()
    content, scenes = expectations.load(), Scenes(data=options.data)
    for anatomy in ANATOMIES:
        if (anatomy.is_real and options.data is None) or anatomy.name not in options.only:
            continue
        if options.draw or anatomy.name not in content["targets"]:
            content["targets"][anatomy.name] = draw_targets(scenes, anatomy)
            if not anatomy.is_real:
                content["queries"][anatomy.name] = draw_queries(scenes, anatomy)
        for case in (case for case in CASES if case.anatomy == anatomy):
            targets = content["targets"][anatomy.name]
            answers = [answer_for(scenes, case, target) for target in targets]
            keep(content["plans"], case.name, PLANNERS[case.planner].iterations, answers)
        for planner in () if anatomy.is_real else NEEDLE_PLANNERS:
            answers = needle_answers(scenes, anatomy, content["queries"][anatomy.name], planner)
            keep(content["needles"], f"{anatomy.name}/{planner}", NEEDLE_ITERATIONS, answers)
    if options.data is not None:
        shared = SharedQueries(options.data)
        for planner in NEEDLE_PLANNERS:
            keep(content["shared"], planner, NEEDLE_ITERATIONS, shared.answers(planner))
    cases = {case.name for case in CASES}
    content["plans"] = {name: kept for name, kept in content["plans"].items() if name in cases}
    expectations.save(content)
    sys.stdout.write(f"{len(SHARED_QUERIES)} shared queries; costs may rise by {COST_TOLERANCE:.0%}\n")


if __name__ == "__main__":
    main()
