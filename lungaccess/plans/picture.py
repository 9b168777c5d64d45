"""The picture of a bronchoscope: its camera, the openings of the airway in it, and their hours on a clock."""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from anatomy.grid import read_only
from anatomy.kernels.sight import follow_rays
from anatomy.lung import Lung
from anatomy.structures import BRANCH_SHIFT, LUMEN
from lungaccess.problem.system import System

HALF_ANGLE_RAD = math.radians(48.0)
"""Half the angle of the round picture: common bronchoscopes see 90 to 120 degrees."""
ASIDE_SHARE, MOST_ASIDE_SHARE, CHANNEL_ROOM_MM = 0.7, 0.9, 0.35
"""The camera is aside of the axis by shares of the scope's radius, and clear of the tubes in its channel."""
HALF_BRIGHT_MM = math.sqrt(520.0)
"""At this distance the light has half its brightness, as the pages draw it."""
STRAIGHT_RAD = math.radians(4.0)
"""What lies nearer to the middle of the picture is straight ahead."""
ROUND_MIDDLE_RAD = math.radians(12.0)
"""An opening that holds the middle of the picture is straight ahead if its own middle is as near: its hour
would be that of a small part of it."""
STRAIGHT_AHEAD = "straight ahead"


def camera_aside_mm(system: System) -> float:
    """Return how far the camera is from the axis of the tip, in mm, on the side to which the tip bends up."""
    radius = system.scope.radius_mm
    clear = max(ASIDE_SHARE * radius, system.tubes.outermost.radius_mm + CHANNEL_ROOM_MM)
    return min(clear, MOST_ASIDE_SHARE * radius)


def lps_from_camera(system: System, lps_from_tip: Float) -> Float:
    """Return frames `(..., 4, 4)` of the camera beside tips: +z forward, +x up, +y right in the picture."""
    aside = np.eye(4)
    aside[0, 3] = camera_aside_mm(system)
    return np.asarray(lps_from_tip @ aside)


def clock_words(hour: int) -> str:
    """Say where in the picture an hour of `Hole.hour` is."""
    return f"at {hour} o'clock" if hour else STRAIGHT_AHEAD


@frozen_record
class Hole:
    """The dark region of a picture through which the airway goes on.

    `place_lps` (3,) is behind its rim and seen in its middle, LPS mm, or on the centreline if it is not seen;
    `share` is how much of the picture it darkens, less at the border, 0 if it is not seen; `rim_mm` is the
    distance of its nearest part from the camera; `holds_middle` tells whether the middle of the picture is in
    it.
    """

    place_lps: Float
    share: float = 0.0
    rim_mm: float = math.inf
    holds_middle: bool = False

    def hour(self, lps_from_eye: Float) -> int:
        """Return where it is in the picture of its camera on a clock, 1 to 12; 0 if it is straight ahead."""
        turn = self._turn_deg(lps_from_eye)
        return 0 if turn is None else round(turn / 30.0) % 12 or 12

    def side(self, lps_from_eye: Float) -> str:
        """Return in words on which side of the picture it is."""
        turn = self._turn_deg(lps_from_eye)
        if turn is None:
            return STRAIGHT_AHEAD
        # Left and right of what is nearly above or below the middle would depend on a few pixels.
        if not 30.0 <= abs(turn) <= 150.0:
            return "at the top" if abs(turn) < 30.0 else "at the bottom"
        return "on the right" if turn > 0.0 else "on the left"

    def _turn_deg(self, lps_from_eye: Float) -> float | None:
        """Return its angle clockwise from the top, +x of the camera; None for straight ahead."""
        up, right, ahead = lps_from_eye[:3, :3].T @ (self.place_lps - lps_from_eye[:3, 3])
        near = ROUND_MIDDLE_RAD if self.holds_middle else STRAIGHT_RAD
        if math.atan2(math.hypot(up, right), ahead) < near:
            return None
        return math.degrees(math.atan2(right, up))


class Picture:
    """What a camera at a frame of `lps_from_camera` sees: the wall of the lumen, as dark as it is far.

    It has so many `pixels` along an edge of the square around it.
    """

    def __init__(self, lung: Lung, lps_from_eye: Float, pixels: int) -> None:
        self._tree, self._eye = lung.tree, np.ascontiguousarray(lps_from_eye[:3, 3])
        self._inside, rays = _rays(pixels)
        self._across, self._rays = rays[:, :2] / rays[:, 2:], rays @ lps_from_eye[:3, :3].T
        self._away_mm, ends = np.zeros(len(rays)), np.zeros(len(rays), dtype=np.int64)
        eyes = np.broadcast_to(self._eye, rays.shape)
        # The light of a scope does not reach farther.
        follow_rays(lung.labels, lung.geometry, LUMEN, eyes, self._rays, 150.0, self._away_mm, ends)
        self._branch = (ends >> BRANCH_SHIFT) - 1

    def _beyond(self, point: int) -> Bool:
        """Tell which rays end in the airway from a point of the tree on."""
        tree, own = self._tree, int(self._tree.branch_of_point[point])
        found: Bool = np.append(branches_beyond(tree, point), False)[self._branch]
        here = np.flatnonzero(self._branch == own)
        points = tree.branch_points(own)
        ends = self._eye + self._away_mm[here, None] * self._rays[here]
        if point > points[0]:
            apart = np.linalg.norm(ends[:, None] - tree.points_lps[points], axis=2)
            found[here] = points[np.argmin(apart, axis=1)] >= point
        return found

    def holes(self, points: Sequence[int]) -> tuple[Hole, ...]:
        """Return where the airway goes on from points of the tree; what lies beyond others is theirs."""
        rays = [self._beyond(point) for point in points]
        rays[-1] = rays[-1] & ~np.any(rays[:-1], axis=0)
        return tuple(self._hole(each, point) for each, point in zip(rays, points, strict=True))

    def _hole(self, rays: Bool, point: int) -> Hole:
        from scipy import ndimage

        tree, fork = self._tree, max(int(self._tree.parent_point[point]), 0)
        dark = self._away_mm**2 / (self._away_mm**2 + HALF_BRIGHT_MM**2) * rays
        if not rays.any():
            points = np.arange(point, tree.branch_start[tree.branch_of_point[point] + 1])
            along = tree.distance_from_root_mm[points] - tree.distance_from_root_mm[fork]
            return Hole(place_lps=tree.points_lps[points[np.sum(along[1:] <= 2.0 * tree.radius_mm[fork])]])
        square = np.zeros(self._inside.shape, dtype=np.bool_)
        # An opening is as dark as this share of its darkest place, or darker.
        square[self._inside] = dark >= 0.75 * dark.max()
        region = ndimage.label(square, np.ones((3, 3)))[0][self._inside]
        own = np.flatnonzero(region == np.bincount(region, dark * (region > 0)).argmax())
        dark, across = dark[own], self._across[own]
        shown = own[np.linalg.norm(across - dark @ across / dark.sum(), axis=1).argmin()]
        whole = (1.0 - (across**2).sum(axis=1) / math.tan(HALF_ANGLE_RAD) ** 2) ** 2
        # A place in an opening is so far behind its rim, where it stays in the opening as the scope comes
        # nearer.
        away = float(np.linalg.norm(tree.points_lps[fork] - self._eye)) + 2.0
        return Hole(
            place_lps=self._eye + min(away, self._away_mm[shown]) * self._rays[shown],
            share=float(dark @ whole / len(rays)),
            rim_mm=float(self._away_mm[own].min()),
            holds_middle=bool(np.hypot(*across.T).min() < 2.0 * math.tan(HALF_ANGLE_RAD) / len(square)),
        )


def branches_beyond(tree: AirwayTree, point: int) -> Bool:
    """Return which branches `(B,)` go on from a point of the tree, that of the point among them."""
    own, parents = int(tree.branch_of_point[point]), tree.branch_parent.tolist()
    forks = tree.parent_point[tree.branch_start[:-1]].tolist()
    beyond = [branch == own for branch in range(tree.n_branches)]
    for branch in range(own + 1, tree.n_branches):
        parent = parents[branch]
        beyond[branch] = beyond[parent] and (parent != own or forks[branch] >= point)
    return np.array(beyond)


@cache
def _rays(pixels: int) -> tuple[Bool, Float]:
    """Return which pixels `(pixels, pixels)` are in the round picture, and their unit rays in the camera."""
    middle = math.tan(HALF_ANGLE_RAD) * ((2.0 * np.arange(pixels) + 1.0) / pixels - 1.0)
    up, right = np.meshgrid(-middle, middle, indexing="ij")
    inside = np.hypot(up, right) <= math.tan(HALF_ANGLE_RAD)
    rays = np.stack([up[inside], right[inside], np.ones(np.count_nonzero(inside))], axis=1)
    return read_only(inside), read_only(rays / np.linalg.norm(rays, axis=1, keepdims=True))
