"""Needle problems of rising difficulty beside the airways of a segmented CT, as for [Fu2018, fig. 7]."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

import edt
import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.structures import OUTSIDE
from experiments.support.cost_map.case import Case
from experiments.support.cost_map.inflation import refuting_labels
from stages.needle.costs import voxel_sum
from stages.needle.environment import NeedleEnvironment, direct_arcs, workspace_lengths
from stages.needle.objective import SHORTEST
from stages.needle.path import ArcPath, Query
from stages.needle.search.base import RestartingRRT

EXIT_MM = (5.0, 9.0)
"""Needles start this far outside of the airway's wall."""
MAX_EXIT_ANGLE_DEG = 60.0
"""A goal farther to the side needs more curvature than the needle has."""
TARGET_MM = (50.0, 90.0)
"""Distances of goals: through most of a lobe."""
PLEURA_MM = 5.0
"""Goals keep this far from the pleura."""
TRIES, TRY_ITERATIONS = 40, 300
"""Enough short searches to tell easy problems from hard ones."""
MOST_CANDIDATES = 3000
"""Of so many problems some are hard in every CT."""
SCENARIOS = {"easy": (0.9, 1.0), "medium": (0.4, 0.6), "hard": (0.02, 0.12)}
"""Share of `TRIES` short searches that find a path: what makes a scenario easy or hard."""
LEAST_COST = 1.0
"""Where the shortest path costs less there is nothing to be saved."""


@frozen_record
class Scenario:
    """A start pose and a goal of `SCENARIOS`, with the share of `TRIES` short searches that find a path."""

    name: str
    query: Query
    solved_share: float

    def describe(self) -> str:
        """Say where it is and how hard."""
        start, goal = self.query.lps_from_start[:3, 3], self.query.target
        return (
            f"start LPS {np.round(start, 1).tolist()}, goal {np.round(goal, 1).tolist()}, "
            f"{np.linalg.norm(goal - start):.0f} mm apart; {100 * self.solved_share:.0f} % of "
            f"{TRIES} searches of {TRY_ITERATIONS} iterations succeed"
        )


def candidates(case: Case, rng: np.random.Generator) -> Iterator[Query]:
    """Draw start poses beside airways, as a tube would hold the needle there, and goals ahead of them.

    Both are as clear of obstacles as the needle must be, the goal lies in the needle's workspace and
    5 mm or more below the pleura, and no single arc leads to it.
    """
    environment, inner = case.environment, case.inner_lps
    lung = np.asfortranarray((environment.obstacles.labels & OUTSIDE) == 0)
    depth = edt.edt(lung, anisotropy=tuple(environment.grid.spacing_mm), order="F")
    tissue = np.argwhere(depth > PLEURA_MM)
    while True:
        outward = unit(rng.normal(size=3))
        start = inner[rng.integers(len(inner))] + rng.uniform(*EXIT_MM) * outward
        goal = environment.grid.lps(tissue[rng.integers(len(tissue))] + rng.uniform(-0.5, 0.5, 3))
        ahead = goal - start
        distance = float(np.linalg.norm(ahead))
        tangent = unit(outward + rng.normal(scale=0.3, size=3))
        if (
            not TARGET_MM[0] <= distance <= TARGET_MM[1]
            or ahead @ outward < math.cos(math.radians(MAX_EXIT_ANGLE_DEG)) * distance
        ):
            continue
        query = Query(lps_from_start=_pose(start, tangent), target=goal)
        if _is_problem(environment, query):
            yield query


def unit(vector: Float) -> Float:
    """Return the vector over its length."""
    return np.asarray(vector / np.linalg.norm(vector))


def _pose(position: Float, tangent: Float) -> Float:
    """Return a pose (4, 4) whose +z is the tangent."""
    x = unit(np.cross(np.eye(3)[int(np.argmin(np.abs(tangent)))], tangent))
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, np.cross(tangent, x), tangent, position
    return pose


def _is_problem(environment: NeedleEnvironment, query: Query) -> bool:
    """Tell whether both ends are clear, the goal is in the workspace and no single arc leads there."""
    place, tangent = query.lps_from_start[None, :3, 3], query.lps_from_start[None, :3, 2]
    if not np.isfinite(workspace_lengths(environment, place, tangent, query.target)[0]):
        return False
    here = [
        ArcPath(lps_from_start=_pose(p, tangent[0]), arcs=np.zeros((1, 3))) for p in (place[0], query.target)
    ]
    if refuting_labels(environment, here).any():
        return False
    return bool(direct_arcs(environment, place, tangent, np.array([-1]), query.target)[0][0] != 0)


def choose_scenarios(case: Case, seed: int) -> list[Scenario]:
    """Return the first candidate of each difficulty, in the order of `SCENARIOS`; those that were found.

    Difficulty is the share of short searches for any path that succeed: it counts iterations, so that
    the choice is the same on every machine.  Left out is where the shortest path of these searches costs
    less than `LEAST_COST` [Fu2018, eq. 1].
    """
    found: dict[str, Scenario] = {}
    for query in islice(candidates(case, np.random.default_rng(seed)), MOST_CANDIDATES):
        paths = []
        for n in range(TRIES):
            search = RestartingRRT(case.environment, query, seed=n + 1, objective=SHORTEST)
            if search.advance(TRY_ITERATIONS) and search.path is not None:
                paths.append(search.path)
        share = len(paths) / TRIES
        if not paths or voxel_sum(case.costs, min(paths, key=_length)) < LEAST_COST:
            continue
        for name, (low, high) in SCENARIOS.items():
            if name not in found and low <= share <= high:
                found[name] = Scenario(name=name, query=query, solved_share=share)
        if len(found) == len(SCENARIOS):
            break
    return [found[name] for name in SCENARIOS if name in found]


def _length(path: ArcPath) -> float:
    return path.length_mm
