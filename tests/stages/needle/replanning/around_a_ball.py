"""A ball in the way of a needle, and what a replanner finds around it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from anatomy.margins import Margins
from anatomy.poses import pose
from anatomy.structures import OBSTACLES, VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.path import ArcPath, Query
from stages.needle.replanning.replanner import Replan, Replanner
from stages.needle.search.base import RestartingRRT
from tests.stages.scenes import Canvas, brute_clearance

KAPPA = 1 / 40
BALL_MM = 4.0
CURVED_RAD = 0.6


def ball_environment(goal_tolerance_mm: float = 0.0, **changes: float) -> NeedleEnvironment:
    """Free lung with a vessel ball in the middle of the way from (0, 0, -28) to (0, 0, 28)."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], BALL_MM), VESSEL)
    values: dict[str, float] = {"diameter_mm": 1.0, "max_curvature_per_mm": KAPPA, **changes}
    return needle_environment(
        canvas.lung(), Needle(**values), Margins(), with_fissures=False, goal_tolerance_mm=goal_tolerance_mm
    )


def frame_at(place: Any, forward: Any = (0.0, 0.0, 1.0)) -> Float:
    return np.array(pose(place, forward))


START = frame_at([0.0, 0.0, -28.0])
BESIDE = frame_at([12.0, 0.0, -28.0])
"""From here the way ahead is free."""
TARGET = np.array([0.0, 0.0, 28.0])


def query(start: Float = START, target: Any = TARGET, **more: Any) -> Query:
    return Query(lps_from_start=start, target=np.asarray(target, dtype=float), **more)


@cache
def with_ball() -> NeedleEnvironment:
    """The environment of most tests, made once."""
    return ball_environment()


@cache
def around_the_ball() -> ArcPath:
    """A plan in `with_ball`, made once."""
    search = RestartingRRT(with_ball(), query(), seed=2)
    search.advance(20_000)
    assert search.path is not None
    return search.path


def straight(start: Float, length: float) -> ArcPath:
    return ArcPath(lps_from_start=start, arcs=np.array([[length, 0.0, 0.0]]))


def replanner(
    environment: NeedleEnvironment, asked: Query, plan: ArcPath | None = None, **more: Any
) -> Replanner:
    """Return a replanner whose plan, by default, goes straight on."""
    return Replanner(environment, asked, plan or straight(asked.lps_from_start, 10.0), **more)


def require(replan: Replan) -> ArcPath:
    assert replan.path is not None, replan.why
    return replan.path


def angle_from(direction: Float, path: ArcPath) -> float:
    """Return the largest angle, in radians, between a direction and samples of a path's directions."""
    points, _ = path.sample(0.01)
    ways = np.diff(points, axis=0)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    return float(np.arccos(np.clip(ways @ direction, -1.0, 1.0)).max())


def clearances(environment: NeedleEnvironment, path: ArcPath) -> tuple[Float, Float]:
    points, lengths = path.sample(0.05)
    return brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 6.0), lengths
