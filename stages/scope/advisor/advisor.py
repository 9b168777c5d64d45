"""The advisor: which motion leads on from wherever the scope is, and the path to the goal [Rosell2012]."""

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from stages.scope.advisor.best_motion import Candidates, Motion, MotionEvaluation, evaluate_motions
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, ScopeState, straight_state, tip_frames
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import Goal, NavigationField, navigation_field
from stages.scope.advisor.path import ScopePath
from stages.scope.advisor.path_search import PathSearch, PathSettings

Action = Literal["advance", "pull back", "arrived"]

THINNER_STEP_MM = 0.25
THINNEST_MM = 0.5
"""Radii of thinner scopes that are tried."""


@frozen_record
class Advice:
    """What the user is advised to do.

    Args:
        action: "advance"; "pull back" where no motion leads on; "arrived" in the goal voxel.
        motion: The best motion; None if the tip has arrived.
        cost: Eq. 9 of the best motion; 0 if there is none.
        candidates: All that were evaluated.
        own: The evaluation of the user's own motion.
        distance_mm: From the tip to the centre of the goal voxel, straight.
    """

    action: Action
    motion: Motion | None
    cost: float
    candidates: Candidates
    own: MotionEvaluation | None
    distance_mm: float


@frozen_value
class ThinnerScope:
    """What a thinner scope of the same bends would reach.

    Args:
        distance_mm: Left to the centre of the goal voxel.
    """

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
        """Return the best motion from any state whose tip is in the lumen, and evaluate the user's own one.

        Where no candidate is valid the look-ahead is halved, down to the smallest voxel side (not in
        reproduction); where none is valid even then, the advice is to pull back as the scope came.

        Args:
            own: A motion that the user is about to make, evaluated at its own advance, at most the
                look-ahead.

        Raises:
            AnatomyError: If the tip is not in the lumen.
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
        least = (
            look_ahead
            if self.environment.reproduction
            else float(self.environment.lumen.grid.spacing_mm.min())
        )
        while True:
            found, _ = evaluate_motions(self.environment, state, look_ahead, self.options.weights)
            if found.best >= 0 or look_ahead <= least:
                return found
            look_ahead = max(0.5 * look_ahead, least)

    def _choose(self, found: Candidates, state: ScopeState) -> tuple[Action, Motion, float]:
        if found.best >= 0:
            return "advance", found.motion(found.best), float(found.cost[found.best])
        back = Motion(
            advance_mm=-self.options.look_ahead_mm, twist_rad=state.twist_rad, bend_rad=state.bend_rad
        )
        return "pull back", back, 0.0

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
        results: list[ThinnerScope] = []
        model = self.environment.model
        count = math.ceil((model.radius_mm - THINNEST_MM) / THINNER_STEP_MM)
        for n in range(1, count + 1):
            radius = max(model.radius_mm - n * THINNER_STEP_MM, THINNEST_MM)
            environment = ScopeEnvironment(model=replace(model, radius_mm=radius), field=self.field)
            found = PathSearch(environment, self.goal, self.options, seed).run(start)
            results.append(
                ThinnerScope(radius_mm=radius, reached=found.reached, distance_mm=found.distance_mm)
            )
            if found.reached:
                break
        return tuple(results)


def start_state(lumen: Lumen, tree: AirwayTree, model: ScopeModel) -> ScopeState:
    """Return the first state, from the root on, at which the straight scope fits in the trachea.

    Twist 0 and a positive bend turn the tip anteriorly, or superiorly where the trachea is parallel to that
    axis.

    Raises:
        AnatomyError: If the scope fits nowhere in the trachea.
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
    """Say in one sentence where and why a path ended; "" if it reached the goal.

    Args:
        field: Of the path's goal.
        tree: Tells generations and distances from the carina.
    """
    if path.reached:
        return ""
    lumen, tip = field.lumen, path.lps_from_tip[:3, 3]
    route = field.route(lumen.nearest_voxel(tip)[0])
    numbers = [lumen.voxel_at(point) for point in route]
    narrow = np.flatnonzero(lumen.depth_mm[numbers] < path.model.radius_mm)
    width = float(lumen.width_from(numbers[0])[path.goal.voxel])
    if width < path.model.radius_mm and len(narrow):
        return (
            f"too narrow {place_words(tree, route[narrow[0]])}: no ball thicker than {2.0 * width:.1f} mm "
            f"gets from there to the goal, the scope with its gap is {2.0 * path.model.radius_mm:.1f} mm "
            "thick"
        )
    return f"no motion found that leads on {place_words(tree, tip)}, though the lumen is wide enough"


def place_words(tree: AirwayTree, point_lps: Float) -> str:
    """Say in which generation and how far from the carina a point lies."""
    point = tree.nearest_point(point_lps)
    generation = int(tree.generation[tree.branch_of_point[point]])
    beyond = float(tree.distance_from_root_mm[point] - tree.distance_from_root_mm[tree.carina_point])
    side = "beyond" if beyond >= 0.0 else "above"
    return f"in generation {generation}, {abs(beyond):.0f} mm {side} the carina"
