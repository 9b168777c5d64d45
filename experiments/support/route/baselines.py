"""RRT and RRT* on centreline samples, the baselines of [Li2021]."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int
from experiments.support.route.sampling import grow
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import Curve, interpolate
from stages.scope.route.guide_path import NoRouteError
from stages.scope.route.proof import RouteLimits, prove


@settings
class SamplingSettings:
    """How the baselines are set up; the first three numbers are those of the paper, which states no step."""

    samples: Annotated[int, quantity("most samples", at_least=1, at_most=10_000_000)] = 4048
    goal_probability: Annotated[float, quantity("chance to try the goal", at_least=0.0, at_most=1.0)] = 0.1
    neighbours: Annotated[int, quantity("near vertices to rewire", at_least=1, at_most=10_000)] = 32
    step_mm: Annotated[float, quantity("longest edge", above=0.0, at_most=1000.0)] = 3.0
    look_mm: Annotated[float, quantity("spacing of the tests of an edge", above=0.0, at_most=10.0)] = 0.25


def sampled_route(
    centreline: Centreline,
    start_mm: Float,
    goal_mm: Float,
    limits: RouteLimits,
    *,
    star: bool,
    seed: int,
    settings: SamplingSettings | None = None,
    any_curve: bool = False,
) -> tuple[Curve, bool]:
    """Return the first curve found by RRT, or by RRT* if `star`, that is proved to keep the limits.

    The trees know nothing of curvature: each path to the goal becomes a cubic spline through its vertices,
    which keeps the limits more often than one through points every 3 mm; if it breaks one, sampling goes on.

    Points are `(3,)` LPS mm.  With `any_curve`, the first path is taken, whatever limits its curve breaks.

    Returns:
        (Curve, bool): The curve and whether it is proved; the last one found if none is.

    Raises:
        NoRouteError: If the goal was never connected within the samples.
    """
    chosen = settings or SamplingSettings()
    points, parent = np.zeros((chosen.samples + 1, 3)), np.full(chosen.samples + 1, -1, dtype=np.int64)
    cost, counts = np.zeros(chosen.samples + 1), np.array((1, 0, -1))
    points[0] = start_mm
    goal = np.ascontiguousarray(goal_mm, dtype=np.float64)
    numbers = (limits.needed_mm, chosen.step_mm, chosen.look_mm, chosen.goal_probability)
    state = np.array([seed], dtype=np.uint64)
    found: Curve | None = None
    proved = False
    while not proved and grow(
        centreline.nodes_mm, goal, centreline.cones, *centreline.cells, np.array(numbers),
        chosen.neighbours if star else 0, points, parent, cost, counts, state,
    ):  # fmt: skip
        found = interpolate(_path_to_root(points, parent, int(counts[2]), goal))
        proved = prove(
            found, centreline, max_curvature_per_mm=limits.max_curvature_per_mm, needed_mm=limits.needed_mm
        ).holds
        if any_curve:
            break
    if found is None:
        raise NoRouteError(
            f"The goal was not connected within {chosen.samples} samples", remedy="Allow more samples"
        )
    return found, proved


def _path_to_root(points: Float, parent: Int, vertex: int, goal: Float) -> Float:
    """Return the vertices from the root to the goal, `(V, 3)`."""
    path = [goal]
    while vertex >= 0:
        path.append(points[vertex])
        vertex = int(parent[vertex])
    return np.array(path[::-1])
