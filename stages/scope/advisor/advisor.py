"""The advisor: which motion leads on from wherever the scope is, and the path to the goal [Rosell2012].

The path is that of Algorithm 2, with retreats where it is stuck.  The paper stops where no candidate is
valid.  Here the look-ahead is first halved, down to a voxel; then the scope is pulled back along its path and
tries again with other weights and another look-ahead.  The path that comes nearest is kept.
"""

import math
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import impossible, quantity, settings, switch
from anatomy.base.typed import Float
from stages.scope.advisor.best_motion import Candidates, Motion, MotionEvaluation, Weights, evaluate_motions
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kernels import motion as kernel
from stages.scope.advisor.kinematics import ScopeModel, ScopeState, straight_state, tip_frames, tool_frames
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import Goal, NavigationField, navigation_field
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
    retreats: Annotated[int, Field(description="most retreats if stuck", strict=True, ge=0, le=10_000)] = 200
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
    """Algorithm 2 from a state, with retreats until the goal is reached; reproduction retries nothing."""

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
        # The numbers of a first state: the potential at its tip is infinity outside the lumen.
        row = np.zeros((1, 4))
        tip = tool_frames(self._environment.model, start.array[None])[0, :3, 3]
        voxel = self._environment.lumen.voxel_at(tip)
        row[0, 3] = self._environment.field.potential[voxel] if voxel >= 0 else np.inf
        states, info, end = self._compute_path(start.array[None], row, options.weights, options.look_ahead_mm)
        if self._environment.reproduction:
            return self._path(states, info, end == kernel.REACHED, 0)
        states, info = _cut(states, info)
        used = 0
        # Potentials nearer than this are equal: rounding of sums of steps.
        enough = self._lowest_that_fits(states[0]) + 1e-9
        while end != kernel.REACHED and info[-1, 3] > enough and used < options.retreats:
            # The number of the state to which the scope is pulled back.
            retreat_mm = RETREATS_MM[used % len(RETREATS_MM)] * self._rng.uniform(0.5, 1.5)
            kept = int(np.flatnonzero(np.cumsum(info[::-1, 2])[::-1] >= retreat_mm).max(initial=0))
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
        randomness = np.array(
            [self._rng.integers(1, 2**62) if options.random_offsets else 0], dtype=np.uint64
        )
        least = look_ahead_mm if self._environment.reproduction else self._least
        count, end = kernel.compute_path(
            self._environment.arrays, self._environment.scope, weights.array, self._goal.voxel,
            np.array([look_ahead_mm, options.sub_step_mm, least, left_mm]), randomness, self._looks,
            states[done:], info[done:],
        )  # fmt: skip
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


Action = Literal["advance", "pull back", "arrived"]

THINNER_STEP_MM = 0.25
THINNEST_MM = 0.5
"""Radii of thinner scopes that are tried."""


@frozen_record
class Advice:
    """What the user is advised to do.

    The action is "advance", "pull back" where no motion leads on, or "arrived" in the goal voxel, with no
    `motion` and a `cost` (eq. 9) of 0.  `own` is the evaluation of the user's own motion; `distance_mm` leads
    straight from the tip to the centre of the goal voxel.
    """

    action: Action
    motion: Motion | None
    cost: float
    candidates: Candidates
    own: MotionEvaluation | None
    distance_mm: float


@frozen_value
class ThinnerScope:
    """What a thinner scope of the same bends would reach, and how far that is from the goal voxel."""

    radius_mm: float
    reached: bool
    distance_mm: float


class Advisor:
    """Guides a scope through a lumen to a goal.

    Args:
        reproduction: Eqs. 1 and 3 as printed, potential in steps of voxels, no halved look-ahead, no retreat
            [Rosell2012].  What comes of it may touch the wall and must not feed a plan.
    """

    def __init__(
        self,
        lumen: Lumen,
        model: ScopeModel,
        goal: Goal,
        options: PathSettings | None = None,
        *,
        reproduction: bool = False,
    ) -> None:
        self.goal = goal
        self.options = options or PathSettings()
        field = navigation_field(lumen, goal.voxel, metric="voxels" if reproduction else "mm")
        self.environment = ScopeEnvironment(model=model, field=field, reproduction=reproduction)

    @property
    def field(self) -> NavigationField:
        """The navigation field of the goal."""
        return self.environment.field

    def advise(self, state: ScopeState, *, own: Motion | None = None) -> Advice:
        """Return the best motion from any state whose tip is in the lumen, and evaluate the user's `own` one.

        Where no candidate is valid the look-ahead is halved, down to the smallest voxel side (not in
        reproduction); where none is valid even then, the advice is to pull back as the scope came.  The
        user's `own` motion is evaluated at its own advance, at most the look-ahead.  Raises AnatomyError if
        the tip is not in the lumen.
        """
        tip = tip_frames(self.environment.model, state.array)[0][:3, 3]
        voxel = self.environment.lumen.voxel_at(tip)
        if voxel < 0:
            raise AnatomyError(
                f"The tip of the scope is not in the lumen, at LPS {tip.round(1).tolist()}",
                expected="a tip in the airways that hang together with the trachea",
                remedy="Check the frame of the scope's position",
            )
        found = self._weigh(state)
        choice: tuple[Action, Motion | None, float] = self._choose(found, state)
        action, motion, cost = ("arrived", None, 0.0) if voxel == self.goal.voxel else choice
        return Advice(
            action=action,
            motion=motion,
            cost=cost,
            candidates=found,
            own=None if own is None else self._evaluate(state, own),
            distance_mm=float(np.linalg.norm(tip - self.goal.centre_lps)),
        )

    def _weigh(self, state: ScopeState) -> Candidates:
        """Return the candidates of the longest look-ahead at which one is valid, or of the least."""
        look_ahead = self.options.look_ahead_mm
        finest = float(self.environment.lumen.grid.spacing_mm.min())
        least = look_ahead if self.environment.reproduction else finest
        while True:
            found, _ = evaluate_motions(self.environment, state, look_ahead, self.options.weights)
            if found.best >= 0 or look_ahead <= least:
                return found
            look_ahead = max(0.5 * look_ahead, least)

    def _choose(self, found: Candidates, state: ScopeState) -> tuple[Action, Motion, float]:
        if found.best >= 0:
            return "advance", found.motion(found.best), float(found.cost[found.best])
        away_mm = -self.options.look_ahead_mm
        return (
            "pull back",
            Motion(advance_mm=away_mm, twist_rad=state.twist_rad, bend_rad=state.bend_rad),
            0.0,
        )

    def _evaluate(self, state: ScopeState, own: Motion) -> MotionEvaluation | None:
        most = self.options.look_ahead_mm
        ahead = min(own.advance_mm, most) if own.advance_mm > 0.0 else most
        return evaluate_motions(self.environment, state, ahead, self.options.weights, own=own)[1]

    def path(self, start: ScopeState, *, seed: int = 0) -> ScopePath:
        """Return the path from a state to the goal, or to the nearest point that was reached.

        The same seed and settings give the same path, bit for bit.
        """
        return PathSearch(self.environment, self.goal, self.options, seed).run(start)

    def thinner(self, start: ScopeState, *, seed: int = 0) -> tuple[ThinnerScope, ...]:
        """Return what thinner scopes reach from a state, thickest first, until one reaches the goal."""
        tried: list[ThinnerScope] = []
        model = self.environment.model
        for n in range(1, math.ceil((model.radius_mm - THINNEST_MM) / THINNER_STEP_MM) + 1):
            radius = max(model.radius_mm - n * THINNER_STEP_MM, THINNEST_MM)
            environment = ScopeEnvironment(model=replace(model, radius_mm=radius), field=self.field)
            found = PathSearch(environment, self.goal, self.options, seed).run(start)
            tried.append(ThinnerScope(radius_mm=radius, reached=found.reached, distance_mm=found.distance_mm))
            if found.reached:
                break
        return tuple(tried)


def start_state(lumen: Lumen, tree: AirwayTree, model: ScopeModel) -> ScopeState:
    """Return the first state, from the root on, at which the straight scope fits in the trachea.

    Twist 0 and a positive bend turn the tip anteriorly, or superiorly where the trachea is parallel to that
    axis.  Raises AnatomyError if the scope fits nowhere in the trachea.
    """
    field = navigation_field(lumen, lumen.nearest_voxel(tree.carina_lps)[0])
    environment = ScopeEnvironment(model=model, field=field)
    depth_mm = tree.distance_from_root_mm
    for point in tree.branch_points(0)[:-1]:
        ahead = int(np.searchsorted(depth_mm[: tree.carina_point + 1], depth_mm[point] + model.length_mm))
        ahead = min(ahead, tree.carina_point)
        state = straight_state(tree.points_lps[point], tree.points_lps[ahead] - tree.points_lps[point])
        if environment.fits(state.array)[0]:
            return state
    wide = 2.0 * float(lumen.depth_mm.max())
    raise AnatomyError(
        f"A scope {2.0 * model.radius_mm:g} mm thick, with its gap, fits nowhere in the trachea",
        expected=f"less than the {wide:.1f} mm of the widest place of the lumen, over {model.length_mm:g} mm",
        remedy="Choose a thinner scope, or check the airway mask",
    )


def why_stopped(path: ScopePath, field: NavigationField, tree: AirwayTree) -> str:
    """Say in one sentence where and why a path ended, by the field of its goal; "" if it reached the goal."""
    if path.reached:
        return ""
    lumen, tip = field.lumen, path.lps_from_tip[:3, 3]
    route = field.route(lumen.nearest_voxel(tip)[0])
    numbers = [lumen.voxel_at(point) for point in route]
    narrow = np.flatnonzero(lumen.depth_mm[numbers] < path.model.radius_mm)
    width = float(lumen.width_from(numbers[0])[path.goal.voxel])
    if width < path.model.radius_mm and len(narrow):
        return (
            f"too narrow {_place_words(tree, route[narrow[0]])}: no ball thicker than {2.0 * width:.1f} mm "
            f"gets from there to the goal, the scope with its gap is {2.0 * path.model.radius_mm:.1f} mm "
            "thick"
        )
    return f"no motion found that leads on {_place_words(tree, tip)}, though the lumen is wide enough"


def _place_words(tree: AirwayTree, point_lps: Float) -> str:
    """Say in which generation and how far from the carina a point lies."""
    point = tree.nearest_point(point_lps)
    generation = int(tree.generation[tree.branch_of_point[point]])
    beyond = float(tree.distance_from_root_mm[point] - tree.distance_from_root_mm[tree.carina_point])
    side = "beyond" if beyond >= 0.0 else "above"
    return f"in generation {generation}, {abs(beyond):.0f} mm {side} the carina"
