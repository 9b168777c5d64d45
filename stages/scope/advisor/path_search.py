"""Algorithm 2 of [Rosell2012], paths to a goal, with retreats where it is stuck.

The paper stops where no candidate is valid.  Here the look-ahead is first halved, down to a voxel; then the
scope is pulled back along its path and tries again with other weights and another look-ahead.  The path that
comes nearest is kept.
"""

from typing import Annotated

import numpy as np
from pydantic import Field

from anatomy.base.settings import impossible, quantity, settings, switch
from anatomy.base.typed import Float
from stages.scope.advisor.best_motion import Weights
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kernels import motion as kernel
from stages.scope.advisor.kinematics import ScopeState, tool_frames
from stages.scope.advisor.nf1 import Goal
from stages.scope.advisor.path import ScopePath


@settings
class PathSettings:
    """How a path is computed: dz is `look_ahead_mm`, `weights` are those of eq. 9.

    Candidates are moved at random within their spacing.  With 0 retreats the search stops where it is stuck,
    as the paper does.
    """

    look_ahead_mm: Annotated[float, quantity("advance of the candidates", above=0.0, at_most=50.0)] = 5.0
    sub_step_mm: Annotated[float, quantity("advance between two choices", above=0.0, at_most=50.0)] = 1.0
    weights: Weights = Weights()
    random_offsets: Annotated[bool, switch("whether candidates are moved at random")] = True
    retreats: Annotated[int, Field(description="most retreats when stuck", strict=True, ge=0, le=10_000)] = (
        200
    )
    max_length_mm: Annotated[float, quantity("longest path", above=0.0, at_most=2000.0)] = 600.0

    def __post_init__(self) -> None:
        if self.sub_step_mm > self.look_ahead_mm:
            raise impossible(
                "sub_step_mm", self.sub_step_mm, f"at most look_ahead_mm = {self.look_ahead_mm:g}"
            )


RETREATS_MM = (3.0, 6.0, 12.0, 24.0, 48.0)
"""Lengths of retreat, taken in turn, each times 0.5 to 1.5: from a fork just missed to a lost lobe."""
LOOK_AHEADS = (0.5, 1.0, 1.5, 2.0)
"""For a retry one of these shares of the look-ahead is drawn: a shorter one fits into a tighter turn."""


class PathSearch:
    """Algorithm 2 from a state, repeated with retreats until the goal is reached.

    Args:
        goal: Of the environment's field.
        options: In reproduction the look-ahead is never shortened and nothing is retried.
    """

    def __init__(self, environment: ScopeEnvironment, goal: Goal, options: PathSettings, seed: int) -> None:
        self._environment = environment
        self._goal = goal
        self._options = options
        self._rng = np.random.default_rng(seed)
        # Collision is tested this often a mm of advance: the body moves by less than a voxel between two
        # poses.
        self._looks = 1 if environment.reproduction else max(1, round(4 * options.sub_step_mm))
        self._least = min(options.sub_step_mm, float(environment.lumen.grid.spacing_mm.min()))

    def run(self, start: ScopeState) -> ScopePath:
        """Return the path from a state that ends at the goal or comes nearest to it."""
        options = self._options
        begin = np.zeros((1, 4))
        # The potential at the tip of a state, infinity outside the lumen.
        tip = tool_frames(self._environment.model, start.array[None])[0, :3, 3]
        voxel = self._environment.lumen.voxel_at(tip)
        begin[0, 3] = float(self._environment.field.potential[voxel]) if voxel >= 0 else np.inf
        states, info, end = self._compute_path(
            start.array[None], begin, options.weights, options.look_ahead_mm
        )
        if self._environment.reproduction:
            return self._path(states, info, end == kernel.REACHED, 0)
        states, info = _cut(states, info)
        used = 0
        # Potentials nearer than this are equal: rounding of sums of steps.
        enough = self._lowest_that_fits(states[0]) + 1e-9
        while end != kernel.REACHED and info[-1, 3] > enough and used < options.retreats:
            # The number of the state to which the scope is pulled back.
            retreat_mm = RETREATS_MM[used % len(RETREATS_MM)] * self._rng.uniform(0.5, 1.5)
            behind = np.cumsum(info[::-1, 2])[::-1]
            kept = int(np.flatnonzero(behind >= retreat_mm).max(initial=0))
            ahead = max(options.look_ahead_mm * float(self._rng.choice(LOOK_AHEADS)), options.sub_step_mm)
            more, more_info, new_end = self._compute_path(
                states[: kept + 1], info[: kept + 1], self._random_weights(), ahead
            )
            more, more_info = _cut(more, more_info)
            used += 1
            if more_info[-1, 3] < info[-1, 3]:
                states, info, end = more, more_info, new_end
        return self._path(states, info, end == kernel.REACHED, used)

    def _random_weights(self) -> Weights:
        low, high = (float(value) for value in np.sort(self._rng.uniform(size=2)))
        return Weights(nf1=low, clearance=high - low, twist=1.0 - high)

    def _lowest_that_fits(self, state: Float) -> float:
        """Return the lowest potential of a voxel to which a ball of the scope's radius gets."""
        environment = self._environment
        start = environment.lumen.voxel_at(state[9:12])
        if start < 0:
            start, _away = environment.lumen.nearest_voxel(state[9:12])
        fits = environment.lumen.width_from(start) >= environment.model.radius_mm
        return float(environment.field.potential[fits].min(initial=np.inf)) if fits.any() else -np.inf

    def _compute_path(
        self, begin: Float, begin_info: Float, weights: Weights, look_ahead_mm: float
    ) -> tuple[Float, Float, int]:
        """Run Algorithm 2 from the last of some states; return all states, their numbers and the end."""
        options = self._options
        done = len(begin) - 1
        left_mm = max(options.max_length_mm - float(begin_info[:, 2].sum()), 0.0)
        most = len(begin) + 1 + int(left_mm / min(self._least, look_ahead_mm))
        states, info = np.zeros((most, 14)), np.zeros((most, 4))
        states[: done + 1], info[: done + 1] = begin, begin_info
        randomness = np.zeros(1, dtype=np.uint64)
        if options.random_offsets:
            randomness[0] = self._rng.integers(1, 2**62)
        least = look_ahead_mm if self._environment.reproduction else self._least
        count, end = kernel.compute_path(
            self._environment.arrays,
            self._environment.scope,
            weights.array,
            self._goal.voxel,
            np.array([look_ahead_mm, options.sub_step_mm, least, left_mm]),
            randomness,
            self._looks,
            states[done:],
            info[done:],
        )
        return states[: done + count], info[: done + count], int(end)

    def _path(self, states: Float, info: Float, reached: bool, used: int) -> ScopePath:
        return ScopePath(
            model=self._environment.model,
            goal=self._goal,
            states=states,
            steps_mm=info[:, 2],
            costs=info[:, 0],
            potentials=info[:, 3],
            reached=reached,
            nearest=int(np.argmin(info[:, 3])),
            retreats=used,
            reproduction=self._environment.reproduction,
        )


def _cut(states: Float, info: Float) -> tuple[Float, Float]:
    """Leave out what comes after the first state of least potential."""
    end = int(np.argmin(info[:, 3])) + 1
    return states[:end], info[:end]
