"""How the needle moves in OMPL: bounds, and steps that are proved clear one by one."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from ompl import base

from anatomy.kernels.field import MIN_GAP_MM
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import states
from stages.needle.kernels.limits import Limits
from stages.needle.ompl.planner import Question
from stages.needle.ompl.states import numbers_of, put_numbers

ARC_STEPS = 20
"""A control of duration 1 is an arc; OMPL propagates it in so many steps."""
LONGEST_STEP_MM = 1.0
"""Longest step of a propagation."""


def position_bounds(environment: NeedleEnvironment) -> Any:
    """Bound positions by the box of the grid."""
    grid = environment.grid
    corners = grid.lps(list(itertools.product(*[(-0.5, n - 0.5) for n in grid.shape])))
    bounds = base.RealVectorBounds(3)
    for axis in range(3):
        bounds.setLow(axis, float(corners[:, axis].min()))
        bounds.setHigh(axis, float(corners[:, axis].max()))
    return bounds


def control_bounds(environment: NeedleEnvironment) -> Any:
    """Bound length, roll and curvature of an arc, so that a step is at most 1 mm long."""
    bounds = base.RealVectorBounds(3)
    highs = (ARC_STEPS * LONGEST_STEP_MM, math.pi, environment.needle.max_curvature_per_mm)
    for n, (low, high) in enumerate(zip((0.0, -math.pi, 0.0), highs, strict=True)):
        bounds.setLow(n, low)
        bounds.setHigh(n, high)
    return bounds


def _limits_of_steps(environment: NeedleEnvironment) -> Limits:
    """Return the limits by which steps are proved, so that whatever is proved as an arc passes.

    The proof refuses points that have less than MIN_GAP_MM to spare.  Between its points half of that is
    left at least; so arcs that passed, cut anywhere, pass again with so much less required clearance, and
    what passes this way still has all of it.
    """
    limits = environment.limits
    return limits._replace(required_mm=max(limits.required_mm - 0.5 * MIN_GAP_MM, 0.0))


def propagator(environment: NeedleEnvironment, question: Question) -> Callable[[Any, Any, float, Any], None]:
    """Return how OMPL moves a state by a control."""
    limits = _limits_of_steps(environment)
    costs = environment.cost_map
    forbidden = None if costs is None or np.isfinite(costs.array).all() else costs.array

    def propagate(state: Any, u: Any, duration: float, result: Any) -> None:
        """Advance along a share `duration` of an arc that bends towards `u[1]`, if that is proved clear."""
        begin, arc = numbers_of(state), (u[1], u[2], duration * u[0])
        moved = states.proved_step(
            environment.obstacles, limits, begin, *arc, question.origin, question.branch
        )
        if forbidden is not None and states.is_forbidden(
            forbidden, environment.obstacles.geometry, begin, *arc
        ):
            moved = (math.nan, math.nan, math.nan, *begin[3:])
        put_numbers(result, moved)

    return propagate


def validity(environment: NeedleEnvironment, question: Question) -> Callable[[Any], bool]:
    """Return how OMPL tells whether a state is allowed."""
    limits = _limits_of_steps(environment)

    def is_valid(state: Any) -> bool:
        # A numpy.bool_ would raise std::bad_cast.
        return bool(
            states.is_allowed(
                environment.obstacles, limits, numbers_of(state), question.origin, question.branch
            )
        )

    return is_valid
