"""The picture of a bronchoscope, and the bifurcations on its way: which openings are seen, which is taken."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cache
from itertools import combinations

import numpy as np
from numpy.linalg import norm

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float, Int
from anatomy.grid import read_only
from anatomy.kernels.sight import follow_rays
from anatomy.lobes import LOBES
from anatomy.lung import Lung
from anatomy.poses import poses_on_arc
from anatomy.structures import BRANCH_SHIFT, LUMEN
from lungaccess.problem.system import System
from stages.scope import ScopeMotion, prover_of

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
        found: Bool = np.append(_branches_beyond(tree, point), False)[self._branch]
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


def _branches_beyond(tree: AirwayTree, point: int) -> Bool:
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


SEEN_FROM_MM, VIEWS = 25.0, 8
"""A bifurcation is looked at from at most so far before it, in so many states at most."""
LOOKED_PIXELS, SHOWN_PIXELS = 24, 80
"""Pictures among which one is chosen have as many pixels along an edge, and the chosen one."""
LEAST_CLARITY = 0.0005
"""Openings are in view if each fills 0.2 % of the picture where they are 15 degrees apart, or the like."""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth")


@frozen_value
class Opening:
    """One way on at a bifurcation: the dark region of the picture through which the airway goes on.

    Args:
        branch: Of the airway tree; that of the parent where it goes on itself.
        name: Number and generation, and what the tree and the lobes of the patient support beyond them.
        place_lps: A place in the opening that is seen in the middle of its dark region, LPS mm; in the lumen
            of the branch where the picture does not show it.
        hour: Where it is in the picture on a clock, 1 to 12; 0 is straight ahead.
        side: "on the left", "on the right", "at the top" or "at the bottom" of the picture, or "straight
            ahead".
        order: Place among the openings of its side, the nearest to the camera first; 0 if it is alone there.
    """

    branch: int
    label: str
    name: str
    place_lps: tuple[float, float, float]
    hour: int
    side: str
    order: int
    in_view: bool
    taken: bool

    @property
    def words(self) -> str:
        """Where it is, and what it is."""
        which = f"the {ORDINALS[min(self.order, len(ORDINALS)) - 1]} " if self.order else "the one "
        at = "" if self.side == STRAIGHT_AHEAD else f", at {self.hour} o'clock"
        hidden = "" if self.in_view else ", out of view"
        return f"{which}{self.side}{at}{hidden}: {self.name}"


@frozen_value
class Bifurcation:
    """A bifurcation of the route, and the state of the scope before it.

    Args:
        number, count: Of how many on the route it is which, from 1.
        from_carina_mm: Where it is along the tree; 0 is the carina itself.
        state: State of the motion in which the tip stands before it, and the picture shows all openings best.
        entered_state: First state in which the tip is past it; the last one if it never is.
        inserted_mm: Advance of the scope there.
        held_bend_deg, bend_deg: Bend of the tip in that state, and in the picture of the openings: the tip is
            bent where only that, by a proved motion, brings all of them into view.
        openings: The one that is taken first.
    """

    number: int
    count: int
    from_carina_mm: float
    state: int
    entered_state: int
    inserted_mm: float
    held_bend_deg: float
    bend_deg: float
    openings: tuple[Opening, ...]

    @property
    def text(self) -> str:
        """Say in a sentence which opening to take."""
        taken, *others = self.openings
        where = (
            f"{self.from_carina_mm:.0f} mm beyond the carina" if round(self.from_carina_mm) else "the carina"
        )
        rest = f" Not {'; not '.join(one.words for one in others)}." if others else ""
        up = "up" if self.bend_deg > 0.0 else "down"
        look = f"bend the tip to {abs(self.bend_deg):.0f}° {up} to see all openings, and "
        look = "" if self.bend_deg == self.held_bend_deg else look
        return (
            f"Bifurcation {self.number} of {self.count}, {where}, {self.inserted_mm:.0f} mm inserted: "
            f"{look}take {taken.words}.{rest}"
        )

    def as_json(self) -> dict[str, object]:
        """Return the bifurcation as plain values, with its sentence."""
        return {**asdict(self), "text": self.text}


def route_bifurcations(
    motion: ScopeMotion, branches: Int, lung: Lung, system: System
) -> tuple[Bifurcation, ...]:
    """Return the bifurcations on a route, from the trachea on.

    Each is told in the picture that shows the smallest of its openings largest, from where the one before is
    told to where the tip is past it.  Where not even that one shows all of them, the tip is bent for a look.

    Args:
        motion: With so many states that the tip moves little between them.
        branches ((B,) int64): Of the airway tree, from the trachea to where the tip ends.
        system: The scope of the motion, and the tubes in its channel, beside which the camera is.
    """
    tree, tips, state = lung.tree, motion.tips, 0
    depth = tree.distance_from_root_mm
    # The nearest point on the route to each tip, never going back.
    route = tree.route(int(tree.branch_start[branches[-1] + 1]) - 1)
    away = norm(tips[:, None, :3, 3] - tree.points_lps[route][None], axis=2)
    passed = depth[route[np.maximum.accumulate(np.argmin(away, axis=1))]]
    found = []
    for number, (parent, child) in enumerate(zip(branches[:-1].tolist(), branches[1:].tolist(), strict=True)):
        points, fork = _first_points(tree, parent, child), _fork(tree, child)
        entered = max(_first(passed >= depth[fork]), state)
        from_state = max(_first(passed >= depth[fork] - SEEN_FROM_MM), state)
        views = np.unique(np.linspace(from_state, entered, VIEWS).round().astype(int)).tolist()
        clear = [_clarity(lung, system, tips[n], points) for n in views]
        state = views[int(np.argmax(clear))]
        tip, bend_rad = tips[state], float(motion.states[state, 2])
        if max(clear) < LEAST_CLARITY:
            held = replace(motion, states=motion.states[: state + 1])
            tip, bend_rad = _look(held, tip, lung, system, points)
        found.append(
            Bifurcation(
                number=number + 1,
                count=len(branches) - 1,
                from_carina_mm=float(depth[fork] - depth[tree.carina_point]),
                state=state,
                entered_state=entered,
                inserted_mm=float(motion.states[state, 0]),
                held_bend_deg=math.degrees(motion.states[state, 2]),
                bend_deg=math.degrees(bend_rad),
                openings=_openings(lung, lps_from_camera(system, tip), points),
            )
        )
    return tuple(found)


def _first_points(tree: AirwayTree, parent: int, child: int) -> list[int]:
    """Return the first point of each way on at a bifurcation, that to a child first, the parent's last."""
    depth, fork, last = tree.distance_from_root_mm, _fork(tree, child), int(tree.branch_start[parent + 1]) - 1
    # Branches of the same parent that part within so many mm are openings of one bifurcation.
    others = [
        each
        for each in tree.children(parent).tolist()
        if each != child and abs(depth[_fork(tree, each)] - depth[fork]) <= 10.0
    ]
    goes_on = fork < last and all(_fork(tree, each) < last for each in others)
    return [*(int(tree.branch_start[each]) for each in (child, *others)), *([fork + 1] if goes_on else [])]


def _clarity(lung: Lung, system: System, lps_from_tip: Float, points: list[int]) -> float:
    """Return how well a picture tells openings apart: share of the smallest times least angle between any."""
    eye = lps_from_camera(system, lps_from_tip)
    holes = Picture(lung, eye, LOOKED_PIXELS).holes(points)
    rays = [(hole.place_lps - eye[:3, 3]) / norm(hole.place_lps - eye[:3, 3]) for hole in holes]
    angles = [math.acos(min(float(a @ b), 1.0)) for a, b in combinations(rays, 2)]
    return min(hole.share for hole in holes) * min(angles, default=1.0)


def _look(
    held: ScopeMotion, lps_from_tip: Float, lung: Lung, system: System, points: list[int]
) -> tuple[Float, float]:
    """Return tip and bend in rad of the clearest picture by a proved change of bend, or those held."""
    length, held_rad = held.bending_length_mm, float(held.states[-1, 2])
    base = poses_on_arc(lps_from_tip, 0.0, held_rad / length, [-length])[0]
    looks = [(_clarity(lung, system, lps_from_tip, points), held_rad, lps_from_tip)]
    # Bends of the tip that are tried in order to see all openings are so far apart.
    for bend_rad in np.arange(*system.scope.bends_rad, math.radians(15.0)).tolist():
        tip = poses_on_arc(base, 0.0, bend_rad / length, [length])[0]
        looks.append((_clarity(lung, system, tip, points), bend_rad, tip))
    for _clear, bend_rad, tip in sorted(looks, key=lambda each: -each[0]):
        states = np.append(held.states, [[*held.states[-1, :2], bend_rad]], axis=0)
        proved = prover_of(lung, system.scope).prove(replace(held, states=states))
        if not isinstance(proved, str):
            return tip, bend_rad
    return lps_from_tip, held_rad


def _first(true: Bool) -> int:
    """Return the first true state, the last one if none is."""
    return int(np.argmax(true)) if true.any() else len(true) - 1


def _branch_label(tree: AirwayTree, branch: int) -> str:
    """Return the short name of a branch."""
    if branch == 0:
        return "trachea"
    if tree.mediastinal[branch]:
        return f"{_side(tree, branch)} main"
    return tree.bronchi.names[branch] or f"branch {branch}"


def _branch_name(lung: Lung, branch: int) -> str:
    """Return what is known of a branch: number and generation, a main bronchus by its side, else its lobe.

    A lobe is named only where the bronchus has no name, and all ends at or beyond the branch lie in it.
    """
    tree = lung.tree
    known = f"branch {branch}, generation {int(tree.generation[branch])}"
    if branch == 0:
        return f"the trachea ({known})"
    if tree.mediastinal[branch]:
        return f"the {_side(tree, branch)} main bronchus ({known})"
    if words := tree.bronchi.words(branch):
        return f"{words} ({known})"
    # The last points of the branches without children at or beyond the branch.
    leaves = tree.leaf_branches[_branches_beyond(tree, int(tree.branch_start[branch]))[tree.leaf_branches]]
    lobes = {_lobe(lung, end) for end in tree.points_lps[tree.branch_start[leaves + 1] - 1]}
    return f"{known}, to the {lobes.pop()}" if len(lobes) == 1 and "" not in lobes else known


def _side(tree: AirwayTree, branch: int) -> str:
    return "left" if tree.points_lps[tree.branch_points(branch)[-1]][0] > tree.carina_lps[0] else "right"


def _lobe(lung: Lung, point_lps: Float) -> str:
    if lung.lobes is None:
        return ""
    number = int(lung.lobes.at(point_lps, 0))
    return LOBES[number] if number else lung.lobe_at(point_lps)


def _fork(tree: AirwayTree, branch: int) -> int:
    return int(tree.parent_point[tree.branch_start[branch]])


def _openings(lung: Lung, lps_from_eye: Float, points: list[int]) -> tuple[Opening, ...]:
    holes = Picture(lung, lps_from_eye, SHOWN_PIXELS).holes(points)
    sides = [hole.side(lps_from_eye) for hole in holes]
    made = []
    for n, (point, hole, side) in enumerate(zip(points, holes, sides, strict=True)):
        branch, (x, y, z) = int(lung.tree.branch_of_point[point]), hole.place_lps.tolist()
        same = sorted((holes[k].rim_mm, k) for k, other in enumerate(sides) if other == side)
        made.append(
            Opening(
                branch=branch,
                label=_branch_label(lung.tree, branch),
                name=_branch_name(lung, branch),
                place_lps=(x, y, z),
                hour=hole.hour(lps_from_eye),
                side=side,
                order=same.index((hole.rim_mm, n)) + 1 if len(same) > 1 else 0,
                in_view=hole.share > 0.0,
                taken=n == 0,
            )
        )
    return tuple(made)
