"""What every path of every needle search must keep, looked at densely and without the searches' kernels."""

from __future__ import annotations

import numpy as np

from anatomy.structures import OBSTACLES
from stages.needle.environment import NeedleEnvironment
from stages.needle.path import ArcPath, blocker_on_path
from tests.stages.scenes import brute_clearance


def assert_proved(environment: NeedleEnvironment, path: ArcPath, target: np.ndarray) -> None:
    """Fail unless a path is clear by proof and by trying, bends as the needle can, and ends at its target."""
    assert blocker_on_path(environment, path, -1) == 0
    points, _ = path.sample(0.02)
    gap = brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 2.0)
    assert gap.min() >= environment.required_clearance_mm - 1e-9
    assert path.arcs[:, 2].max() <= environment.needle.max_curvature_per_mm * (1 + 1e-9)
    assert np.linalg.norm(points[-1] - target) < 1e-6
