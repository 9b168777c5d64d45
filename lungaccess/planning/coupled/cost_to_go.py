"""Lower bounds of the cost that paths of a needle still have to a target; docs/theory/cost_bound.md."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from anatomy.base.typed import Float, UInt16
from anatomy.kernels.field import UNITS_PER_MM
from lungaccess.planning.coupled.kernels.cost_to_go import (
    LEVELS,
    MOST_UNITS,
    N_NUMBERS,
    CostToGo,
    end_shell,
    fill_shell,
)
from stages.needle.kernels import Limits

SHELL_MM = 1.5
"""From shell to shell."""
HALF_WIDTH = 0.8
"""Of the window in the plane of directions: up to 77 degrees from the middle."""
THREADS = 2
"""Threads that fill a shell; their number changes nothing."""
SPREAD = 1.1
"""Cells are by this wider than the directions of paths change from a shell to the next near the target."""


def cost_to_go(
    field: UInt16,
    geometry: Float,
    limits: Limits,
    weights: tuple[float, float],
    target_lps: tuple[float, float, float],
    places: Float,
    limit: float,
) -> CostToGo:
    """Return lower bounds of what paths to a target still cost.

    Args:
        field, geometry: Corner field of the distance to all obstacles.
        limits: Of a needle no longer than half a circle of its greatest curvature.
        weights (tuple of 2 float): Of the integral of 1 / clearance, and of the length in mm.
        target_lps (tuple of 3 float): LPS mm.
        places ((N, 3) float64): Where needles start, about; LPS mm.  The window looks at those that are near.
        limit: Costs above are not told apart.
    """
    kappa = limits.kappa
    cell = 0.25 * kappa * SHELL_MM * SPREAD
    cells = 2 * int(HALF_WIDTH / cell) + 1
    shells = int(min(limits.max_length_mm, 1.9 / kappa) / SHELL_MM)
    away = places - np.asarray(target_lps)
    axis = (away / np.maximum((away**2).sum(axis=1, keepdims=True), 1.0) ** 1.5).sum(axis=0)
    axis /= max(float(np.linalg.norm(axis)), 1e-300)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    levels = []
    side = cells
    for _ in range(LEVELS):
        levels.append(np.zeros((shells + 1, side, side), dtype=np.uint16))
        side = (side + 1) // 2
    clearest = float(field.max()) / UNITS_PER_MM + math.sqrt(geometry[:, 4].sum()) + limits.goal_tolerance_mm
    numbers = np.zeros(N_NUMBERS)
    rate = weights[0] / clearest + weights[1]
    numbers[:6] = cell, SHELL_MM, kappa, limit / MOST_UNITS, rate, limits.required_mm
    togo = CostToGo(
        frame=np.stack([across, np.cross(axis, across), axis, np.asarray(target_lps)]),
        numbers=numbers,
        levels=tuple(levels),
    )
    if math.isfinite(limit) and limit > 0.0:
        _fill(togo, partial(fill_shell, field, geometry, weights, limits.goal_tolerance_mm, limit, togo))
    return togo


def _fill(togo: CostToGo, fill_rows: Callable[..., bool]) -> None:
    """Fill the shells from the target outwards, until no path costs less than the limit."""
    levels = togo.levels[0]
    # The cost from half a shell beyond the last one, and the same for the one that is being filled.
    behind, beyond = np.zeros(levels.shape[1:]), np.zeros(levels.shape[1:])
    with ThreadPoolExecutor(THREADS) as workers:
        for k in range(len(levels)):
            fill = partial(fill_rows, k, behind, beyond)
            some = list(workers.map(fill, range(THREADS), [THREADS] * THREADS))
            end_shell(togo, k)
            if not any(some):
                return
            behind, beyond = beyond, behind
