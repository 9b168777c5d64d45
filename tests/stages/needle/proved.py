"""What every path of every needle search must keep, looked at densely and without the searches' kernels."""

from __future__ import annotations

import numpy as np

from anatomy.structures import OBSTACLES
from stages.needle.environment import NeedleEnvironment
from stages.needle.path import ArcPath, blocker_on_path
from stages.needle.search.base import Search
from tests.stages.scenes import brute_clearance


def assert_proved(environment: NeedleEnvironment, path: ArcPath, target: np.ndarray) -> None:
    """Fail unless a path is clear by proof and by trying, bends as the needle can, and ends at its target."""
    assert blocker_on_path(environment, path, -1) == 0
    points, _ = path.sample(0.02)
    gap = brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 2.0)
    assert gap.min() >= environment.required_clearance_mm - 1e-9
    assert path.arcs[:, 2].max() <= environment.needle.max_curvature_per_mm * (1 + 1e-9)
    assert np.linalg.norm(points[-1] - target) < 1e-6


def assert_each_path_is_cheaper(
    environment: NeedleEnvironment, search: Search, rounds: int, target: np.ndarray
) -> None:
    """Fail unless each of at least two paths that a search finds is proved and cheaper than the last."""
    costs = []
    for _ in range(rounds):
        if search.advance(300):
            assert search.path is not None
            costs.append(search.cost)
            assert_proved(environment, search.path, target)
    assert len(costs) >= 2
    assert (np.diff(costs) < 0.0).all()
