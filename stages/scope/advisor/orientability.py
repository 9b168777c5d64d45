"""Orientability: the directions in which the tip can point at a site, within its bends and the lumen.

Scopes that reached a site and could not be turned to the planned exit were what failed in a first human study
of tunnelling through the airway wall; hence this question is asked for every site.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from anatomy.grid import read_only
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kernels.orientation import pointable
from stages.scope.advisor.kinematics import ScopeState, straight_state, tool_frames

TWIST_STEP_RAD = math.radians(15.0)
BEND_STEP_RAD = math.radians(7.5)
"""Steps of twist and bend that are tried: directions are then at most about 8 degrees from one tried."""
LEAN_RAD = math.radians(15.0)
"""How far the base of the bending tip may lean from the axis of the airway behind it."""
SHAFT_MM = 5.0
"""So much of the body behind the bending tip is straight and must fit, too."""
ASIDE = 6
"""Directions in which tip and base are moved and tilted."""


@frozen_record
class Orientability:
    """The directions in which a scope's tip can point at a site; D directions tried.

    Parameters
    ----------
    site_lps : (3,) float64, LPS mm
    forward : (3,) float64
        The airway's direction at the site.
    directions : (D, 3) float64
        Unit vectors, LPS.
    twist_rad, bend_rad : (D,) float64
        How the tip is turned to point there.
    possible : (D,) bool
        Whether it can, with the scope's radius clear of the wall along the tip and a piece of shaft.
    """

    site_lps: Float
    forward: Float
    directions: Float
    twist_rad: Float
    bend_rad: Float
    possible: Bool

    @property
    def largest_bend_rad(self) -> float:
        """Largest bend that is possible in some direction, 0 if none is."""
        return float(np.abs(self.bend_rad[self.possible]).max(initial=0.0))

    def angle_rad(self, direction: ArrayLike) -> float:
        """Return the least angle between the tip and a direction (3,), pi if the scope does not fit."""
        wanted = np.asarray(direction, dtype=np.float64)
        cosines = self.directions[self.possible] @ (wanted / np.linalg.norm(wanted))
        return float(np.arccos(np.clip(cosines.max(initial=-1.0), -1.0, 1.0)))

    def allows(self, direction: ArrayLike, tolerance_rad: float = BEND_STEP_RAD) -> bool:
        """Tell whether the tip can point in a direction (3,), within a tolerance."""
        return bool(self.possible.any()) and self.angle_rad(direction) <= tolerance_rad


def measure_orientability(environment: ScopeEnvironment, tree: AirwayTree, point: int) -> Orientability:
    """Return the directions in which a scope can point whose tip is at a tree point or beside it.

    The tip may lie aside from the medial axis as far as the clearance beside the scope allows.  The base
    of the bending tip lies in the direction of the airway one tip's length before, or leans 15 degrees from
    it; its roll is that of a scope that has come from the root without rolling.  Twists every
    15 degrees and bends every 7.5 degrees are tried.

    Parameters
    ----------
    environment : ScopeEnvironment
        Its model and lumen count, not its goal.
    point : int
        Index of a tree point.
    """
    model = environment.model
    base = _base_frame(tree, point, model.length_mm)
    tips = _beside(tree, point, environment)
    twists = _steps(math.radians(model.twist_low_deg), math.radians(model.twist_high_deg), TWIST_STEP_RAD)
    bends = _steps(math.radians(model.bend_low_deg), math.radians(model.bend_high_deg), BEND_STEP_RAD)
    fits = np.zeros((len(twists), len(bends)), dtype=bool)
    bases = np.array([turned.ravel() for turned in _leaning(base)])
    pointable(environment.arrays, environment.scope, bases, tips, SHAFT_MM, twists, bends, fits)
    twist, bend = (values.ravel() for values in np.meshgrid(twists, bends, indexing="ij"))
    frame = np.eye(4)
    frame[:3, :3] = base
    states = np.tile(ScopeState(lps_from_base=frame).array, (len(twist), 1))
    states[:, 12], states[:, 13] = twist, bend
    return Orientability(
        site_lps=tree.points_lps[point],
        forward=tree.tangents[point],
        directions=read_only(-tool_frames(model, states)[:, :3, 2]),
        twist_rad=read_only(twist),
        bend_rad=read_only(bend),
        possible=fits.ravel(),
    )


def _steps(low: float, high: float, step: float) -> Float:
    """Return evenly spaced angles from `low` to `high`, 0 among them."""
    below = np.linspace(low, 0.0, max(1, math.ceil(-low / step)) + 1)[:-1] if low < 0.0 else np.zeros(0)
    above = np.linspace(0.0, high, max(1, math.ceil(high / step)) + 1)[1:] if high > 0.0 else np.zeros(0)
    return np.concatenate([below, [0.0], above])


def _base_frame(tree: AirwayTree, point: int, length_mm: float) -> Float:
    """Return the rotation (3, 3) of a base one tip's length before, come from the root without rolling."""
    route = tree.route(point)
    depth_mm = tree.distance_from_root_mm
    before = route[depth_mm[route] <= max(depth_mm[point] - length_mm, 0.0)]
    first, *others = before if len(before) else route[:1]
    rotation = np.array(straight_state(np.zeros(3), tree.tangents[first]).lps_from_base[:3, :3])
    for number in others:
        rotation = _turn(-rotation[:, 2], tree.tangents[number]) @ rotation
    return rotation


def _turn(a: Float, b: Float) -> Float:
    """Return the smallest rotation (3, 3) that takes a unit vector to another one, not its opposite."""
    axis = np.cross(a, b)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + float(a @ b)))


def _leaning(base: Float) -> list[Float]:
    """Return the base's rotation and those that lean from it."""
    made = [base]
    forward = -base[:, 2]
    for angle in np.arange(ASIDE) * (2.0 * math.pi / ASIDE):
        aside = math.cos(angle) * base[:, 0] + math.sin(angle) * base[:, 1]
        made.append(_turn(forward, math.cos(LEAN_RAD) * forward + math.sin(LEAN_RAD) * aside) @ base)
    return made


def _beside(tree: AirwayTree, point: int, environment: ScopeEnvironment) -> Float:
    """Return places for the tip: the site, and rings about it as far as the clearance of the scope goes."""
    site, forward = tree.points_lps[point], tree.tangents[point]
    helper = np.eye(3)[int(np.argmin(np.abs(forward)))]
    first = np.cross(forward, helper)
    first /= np.linalg.norm(first)
    second = np.cross(forward, first)
    spare = max(float(tree.radius_mm[point]) - environment.model.radius_mm, 0.0)
    places = [site]
    for radius in (0.5 * spare, spare) if spare > 0.0 else ():
        for angle in np.arange(ASIDE) * (2.0 * math.pi / ASIDE):
            places.append(site + radius * (math.cos(angle) * first + math.sin(angle) * second))
    return np.array(places)
