"""The search that ends, on problems with known answers and against an enumeration of all words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from anatomy.structures import OBSTACLES
from stages.needle.path import ArcPath, blocker_on_path
from stages.needle.resolution import Resolution, ResolutionSearch
from stages.needle.space import NeedleSpace
from tests.stages.needle.mazes import CLEARANCE_MM, Maze
from tests.stages.scenes import brute_clearance

COARSE = Resolution(coarse_mm=8.0, fine_mm=4.0, coarse_rolls=4, fine_rolls=4)


def run(maze: Maze, resolution: Resolution, pops: int = 10**7, **more: Any) -> ResolutionSearch:
    """Search until the end, and judge every path on the way."""
    search = ResolutionSearch(maze.space(), maze.query, resolution=resolution, **more)
    best = math.inf
    while not search.finished and search.counts.pops < pops:
        if search.advance(pops - search.counts.pops):
            assert search.path is not None
            assert search.cost < best
            best = search.cost
            judge(search.space, maze, search.path)
    return search


def judge(space: NeedleSpace, maze: Maze, path: ArcPath) -> None:
    """Walk a path in steps of 0.02 mm."""
    points, _ = path.sample(0.02)
    clearance = brute_clearance(space.arrays[1], space.grid, points, OBSTACLES, CLEARANCE_MM + 1.0)
    assert clearance.min() >= CLEARANCE_MM - 1e-9
    assert blocker_on_path(space, path, -1) == 0
    assert np.array_equal(path.lps_from_start, maze.start)
    assert np.linalg.norm(points[-1] - maze.target) <= maze.goal_tolerance_mm + 1e-6
    needle = maze.needle
    assert path.arcs[:, 2].max(initial=0.0) <= needle.max_curvature_per_mm * (1.0 + 1e-9)
    assert path.length_mm <= needle.max_length_mm + 1e-6
    assert path.accumulated_turn_rad <= math.radians(needle.max_accumulated_turn_deg) + 1e-6
    assert path.max_angle_from_start_rad() <= math.radians(needle.max_angle_from_start_deg) + 1e-6
