"""Searches that end, run to the end with every path on the way judged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.structures import OBSTACLES
from stages.needle.environment import NeedleEnvironment, workspace_lengths
from stages.needle.path import ArcPath, blocker_on_path
from stages.needle.search.resolution import Outcome, Resolution, ResolutionSearch
from tests.stages.needle.mazes import CLEARANCE_MM, Maze
from tests.stages.scenes import brute_clearance

COARSE = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=4)
MIDDLE = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=8)


def run(
    maze: Maze, resolution: Resolution, environment: NeedleEnvironment | None = None, **more: Any
) -> ResolutionSearch:
    """Search until the end, and judge every path on the way."""
    search = ResolutionSearch(environment or maze.environment(), maze.query, resolution=resolution, **more)
    best = math.inf
    while not search.finished:
        if search.advance(10**9):
            assert search.path is not None
            assert search.cost < best
            best = search.cost
            judge(search.environment, maze, search.path)
    assert search.outcome == (Outcome.NONE if search.path is None else Outcome.BEST)
    return search


def judge(environment: NeedleEnvironment, maze: Maze, path: ArcPath) -> None:
    """Walk a path in steps of 0.02 mm."""
    points, _ = path.sample(0.02)
    clearance = brute_clearance(
        environment.obstacles.labels, environment.grid, points, OBSTACLES, CLEARANCE_MM + 1.0
    )
    assert clearance.min() >= CLEARANCE_MM - 1e-9
    assert blocker_on_path(environment, path, -1) == 0
    assert np.array_equal(path.lps_from_start, maze.start)
    assert np.linalg.norm(points[-1] - maze.target) <= maze.goal_tolerance_mm + 1e-6
    needle = maze.needle
    assert path.arcs[:, 2].max(initial=0.0) <= needle.max_curvature_per_mm * (1.0 + 1e-9)
    assert path.length_mm <= needle.max_length_mm + 1e-6
    assert path.accumulated_turn_rad <= math.radians(needle.max_accumulated_turn_deg) + 1e-6
    assert path.max_angle_from_start_rad() <= math.radians(needle.max_angle_from_start_deg) + 1e-6


def shortest_mm(maze: Maze) -> float:
    """Length of the shortest path to the target itself without obstacles."""
    start, environment = maze.start, replace(maze, goal_tolerance_mm=0.0).environment()
    return float(workspace_lengths(environment, start[None, :3, 3], start[None, :3, 2], maze.target)[0])
