"""The needle RRT of [Kuntz2015, sec. IV-C] after [Patil2014], with FCL: plain, slow, without fields."""

import math
import time
from collections.abc import Callable
from functools import cached_property

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int, Int32, Labels
from anatomy.lung import Lung
from anatomy.meshes import MeshDistance, box_surface
from anatomy.poses import roll_towards
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL
from stages.needle import RRT_STEP_MM, ArcPath, Needle, arc_transform
from stages.needle.kernels import least_cosine

SAGITTA_MM = 0.01
LONGEST_CHORD_MM = 2.0
"""Curves are tested as chords of at most this length, padded by at most this sagitta, well below a voxel."""


def chord_mm(curvature_per_mm: float) -> float:
    """Return a length of chord that stays within SAGITTA_MM of an arc."""
    if curvature_per_mm * LONGEST_CHORD_MM**2 <= 8.0 * SAGITTA_MM:
        return LONGEST_CHORD_MM
    return math.sqrt(8.0 * SAGITTA_MM / curvature_per_mm)


class Solid:
    """The voxels of a lung whose labels `holds` accepts, as solid boxes.

    It is known in a window of voxels from `low` to `high` alone; by default in the whole grid, and OUTSIDE
    beyond.
    """

    def __init__(
        self, lung: Lung, holds: Callable[[Labels], Bool], low: Int | None = None, high: Int | None = None
    ) -> None:
        self._lung = lung
        self._holds = holds
        grid, labels, beyond = lung.grid, lung.labels, bool(holds(np.array([OUTSIDE], np.uint16))[0])
        if low is not None and high is not None:
            grid = grid.crop(low, high)
            labels = labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
        self._surface = MeshDistance(box_surface(holds(labels), grid, beyond=beyond))

    def is_near(self, line_lps: Float, distance_mm: float) -> bool:
        """Tell whether a polyline `(N, 3)`, LPS mm, comes within `distance_mm` of the solid, or into it.

        A line that does not touch the surface lies on one side of it.
        """
        return self._holds_any(line_lps) or self._surface.polyline_distance_mm(line_lps) <= distance_mm

    def distance_mm(self, point_lps: Float) -> float:
        """Return the distance of a point `(3,)` from the solid, 0 inside it."""
        return 0.0 if self._holds_any(point_lps) else self._surface.polyline_distance_mm(point_lps)

    def depth_mm(self, point_lps: Float) -> float:
        """Return how far inside the solid a point `(3,)` lies, 0 outside it."""
        return self._surface.polyline_distance_mm(point_lps) if self._holds_any(point_lps) else 0.0

    def _holds_any(self, points_lps: Float) -> bool:
        return bool(self._holds(self._lung.grid.values_at(self._lung.labels, points_lps, OUTSIDE)).any())


class Obstacles:
    """The solids of one lung, each made when it is first asked for.

    Args:
        reach_mm: `other_airways` is exact within this distance of the pierced branch.
    """

    def __init__(self, lung: Lung, *, with_fissures: bool, reach_mm: float) -> None:
        self.lung = lung
        self.forbidden = VESSEL | OUTSIDE | (FISSURE if with_fissures else 0)
        self._reach_mm = reach_mm
        self._other_airways: dict[int, Solid] = {}

    def prepare(self) -> None:
        """Make the meshes of the whole lung; those of single branches are made when they are pierced."""
        for solid in (self.tissue, self.airways, self.lumen):
            solid.is_near(self.lung.tree.points_lps[:1], 0.0)

    @cached_property
    def tissue(self) -> Solid:
        """Vessels, all that is outside the lung, and fissures if they are obstacles."""
        return Solid(self.lung, lambda labels: (labels & self.forbidden) != 0)

    @cached_property
    def airways(self) -> Solid:
        """All airways with their walls."""
        return Solid(self.lung, lambda labels: (labels & AIRWAY) != 0)

    @cached_property
    def lumen(self) -> Solid:
        """The open space of all airways."""
        return Solid(self.lung, lambda labels: (labels & LUMEN) != 0)

    @cached_property
    def _boxes(self) -> list[tuple[slice, ...]]:
        from scipy.ndimage import find_objects

        return list(find_objects(branch_of(self.lung.labels) + 1))

    def other_airways(self, branch: int) -> Solid:
        """Return the airways but for one branch, known within the reach of that branch."""
        if branch not in self._other_airways:
            box = self._boxes[branch]
            reach = np.ceil(self._reach_mm / self.lung.grid.spacing_mm).astype(np.int64) + 1
            low = np.maximum(np.array([along.start for along in box]) - reach, 0)
            high = np.minimum(np.array([along.stop for along in box]) + reach, self.lung.labels.shape)
            self._other_airways[branch] = Solid(
                self.lung, lambda labels: ((labels & AIRWAY) != 0) & (branch_of(labels) != branch), low, high
            )
        return self._other_airways[branch]


def branch_of(labels: Labels) -> Int32:
    """Return the airway branch of labels, -1 where they are not airway."""
    return np.asarray(labels >> BRANCH_SHIFT, dtype=np.int32) - np.int32(1)


SPREAD = 1.2
"""Samples lie up to so many times the distance of the goal ahead of the start."""


@frozen_record
class Controls:
    """The controls [Kuntz2015, `steer`] that lead from N states to one point: length, bend and its direction.

    Lengths `(N,)` are infinite where the needle cannot bend so tightly; it bends towards the unit vectors
    `normal`, `(N, 3)`.
    """

    length_mm: Float
    curvature_per_mm: Float
    normal: Float


class Tree:
    """The states that are reached, as growing arrays; row 0 is the start."""

    def __init__(self, lps_from_start: Float) -> None:
        self.count = 1
        self.position, self.tangent, self.normal = (np.zeros((64, 3)) for _ in range(3))
        self.path_mm, self.turn_rad, self.length_mm, self.curvature = (np.zeros(64) for _ in range(4))
        self.parent = np.zeros(64, dtype=np.int64)
        self.goal_blocked = np.zeros(64, dtype=bool)
        self.position[0], self.tangent[0] = lps_from_start[:3, 3], lps_from_start[:3, 2]

    def add(self, parent: int, length_mm: float, curvature: float, normal: Float) -> None:
        """Append the state at the end of an arc from another."""
        if self.count == len(self.parent):
            for name, array in vars(self).items():
                if isinstance(array, np.ndarray):
                    setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        n, angle = self.count, curvature * length_mm
        self.position[n] = self.arc(parent, np.array([length_mm]), curvature, normal)[0]
        tangent = math.cos(angle) * self.tangent[parent] + math.sin(angle) * normal
        self.tangent[n] = tangent / np.linalg.norm(tangent)
        self.path_mm[n] = self.path_mm[parent] + length_mm
        self.turn_rad[n] = self.turn_rad[parent] + angle
        self.parent[n], self.length_mm[n], self.curvature[n] = parent, length_mm, curvature
        self.normal[n] = normal
        self.count += 1

    def arc(self, node: int, at_mm: Float, curvature: float, normal: Float) -> Float:
        """Return the points `(M, 3)` at arc lengths `(M,)` of an arc from a state."""
        half = 0.5 * curvature * at_mm
        ahead, aside = at_mm * np.sinc(2.0 * half / np.pi), at_mm * np.sin(half) * np.sinc(half / np.pi)
        return np.asarray(self.position[node] + ahead[:, None] * self.tangent[node] + aside[:, None] * normal)

    def controls_to(self, point_lps: Float, max_curvature: float) -> Controls:
        """Return the one arc from each state to a point."""
        away = point_lps - self.position[: self.count]
        ahead = np.einsum("ni,ni->n", away, self.tangent[: self.count])
        across = away - ahead[:, None] * self.tangent[: self.count]
        aside = np.linalg.norm(across, axis=1)
        straight = aside < 1e-9
        squared = np.where(straight, 1.0, aside**2 + ahead**2)
        curvature = np.where(straight, 0.0, 2.0 * aside / squared)
        bend = np.where(straight, 1.0, curvature)
        length = np.where(straight, ahead, 2.0 * np.arctan2(aside, ahead) / bend)
        # A shorter arc leads to the state itself.
        impossible = (curvature > max_curvature) | (length < 1e-6)
        return Controls(
            length_mm=np.where(impossible, np.inf, length),
            curvature_per_mm=curvature,
            normal=np.asarray(across / np.where(straight, 1.0, aside)[:, None]),
        )

    def path_to(self, node: int, lps_from_start: Float) -> ArcPath:
        """Return the path from the start to a state."""
        chain = []
        while node != 0:
            chain.append(node)
            node = int(self.parent[node])
        frame, arcs = np.asarray(lps_from_start), []
        for n in reversed(chain):
            roll = roll_towards(frame, self.normal[n]) if self.curvature[n] > 0.0 else 0.0
            arcs.append((self.length_mm[n], roll, self.curvature[n]))
            frame = frame @ arc_transform(*arcs[-1])
        return ArcPath(lps_from_start=lps_from_start, arcs=np.array(arcs))


class NeedleRRT:
    """Grows one tree per start pose until it meets the goal or its budget is spent.

    Args:
        required_mm: Distance that the needle's axis keeps from obstacles.
    """

    def __init__(self, needle: Needle, required_mm: float, obstacles: Obstacles) -> None:
        self._needle = needle
        self._required_mm = required_mm
        self._obstacles = obstacles
        self._least_cosine = math.cos(math.radians(needle.max_angle_from_start_deg))
        self._max_turn_rad = math.radians(needle.max_accumulated_turn_deg)
        self._chord_mm = chord_mm(needle.max_curvature_per_mm)

    def plan(
        self,
        lps_from_start: Float,
        goal_lps: Float,
        branch: int,
        rng: np.random.Generator,
        *,
        iterations: int | None = None,
        time_s: float | None = None,
    ) -> ArcPath | None:
        """Return a path from a start pose `(4, 4)` to the goal, or None when the budget is spent.

        Each of the `iterations` is a sample and one step towards the goal; `time_s` is processor time of this
        thread.
        """
        tree = Tree(lps_from_start)
        deadline = math.inf if time_s is None else time.thread_time() + time_s
        done = 0
        while done < (math.inf if iterations is None else iterations) and time.thread_time() < deadline:
            done += 1
            # Extend the nearest state towards a sampled point, by at most RRT_STEP_MM.
            point_lps = sample_ahead(lps_from_start, goal_lps, self._needle, rng)
            controls = tree.controls_to(point_lps, self._needle.max_curvature_per_mm)
            self._step(tree, int(np.argmin(controls.length_mm)), controls, branch)
            if self._towards_goal(tree, goal_lps, branch):
                return tree.path_to(tree.count - 1, lps_from_start)
        return None

    def _towards_goal(self, tree: Tree, goal_lps: Float, branch: int) -> bool:
        """Extend the state nearest to the goal towards it; tell whether it got there.

        A state whose step to the goal is blocked is not tried again.
        """
        controls = tree.controls_to(goal_lps, self._needle.max_curvature_per_mm)
        lengths = np.where(tree.goal_blocked[: tree.count], np.inf, controls.length_mm)
        nearest = int(np.argmin(lengths))
        if not math.isfinite(lengths[nearest]):
            return False
        if not self._step(tree, nearest, controls, branch):
            tree.goal_blocked[nearest] = True
            return False
        return bool(lengths[nearest] <= RRT_STEP_MM)

    def _step(self, tree: Tree, node: int, controls: Controls, branch: int) -> bool:
        """Add the end of an arc from a state if it is within the limits and free."""
        length = min(float(controls.length_mm[node]), RRT_STEP_MM)
        curvature, normal = float(controls.curvature_per_mm[node]), controls.normal[node]
        if not math.isfinite(controls.length_mm[node]) or not self._allowed(
            tree, node, length, curvature, normal
        ):
            return False
        if self._collides(tree, node, length, curvature, normal, branch):
            return False
        tree.add(node, length, curvature, normal)
        return True

    def _allowed(self, tree: Tree, node: int, length: float, curvature: float, normal: Float) -> bool:
        """Tell whether an arc keeps length, turn, and angle from the start all along."""
        turn = curvature * length
        if tree.path_mm[node] + length > self._needle.max_length_mm:
            return False
        if tree.turn_rad[node] + turn > self._max_turn_rad:
            return False
        forward, aside = float(tree.tangent[0] @ tree.tangent[node]), float(tree.tangent[0] @ normal)
        return bool(least_cosine(forward, aside, turn) >= self._least_cosine)

    def _collides(
        self, tree: Tree, node: int, length: float, curvature: float, normal: Float, branch: int
    ) -> bool:
        """Tell whether an arc comes too near an obstacle; its first mm may lie in the pierced wall."""
        exempt = min(max(self._needle.exit_exemption_mm - float(tree.path_mm[node]), 0.0), length)
        required, obstacles = self._required_mm + SAGITTA_MM, self._obstacles
        wall = self._line(tree, node, 0.0, exempt, curvature, normal)
        open_tissue = self._line(tree, node, exempt, length, curvature, normal)
        if exempt < length and obstacles.airways.is_near(open_tissue, required):
            return True
        if exempt > 0.0 and (
            obstacles.lumen.is_near(wall, self._needle.radius_mm + SAGITTA_MM)
            or obstacles.other_airways(branch).is_near(wall, required)
        ):
            return True
        return obstacles.tissue.is_near(np.concatenate([wall, open_tissue]), required)

    def _line(
        self, tree: Tree, node: int, begin: float, end: float, curvature: float, normal: Float
    ) -> Float:
        """Return points `(M, 3)` of an arc between two arc lengths, within SAGITTA_MM of it."""
        count = max(1, math.ceil((end - begin) / self._chord_mm)) + 1
        return tree.arc(node, np.linspace(begin, end, count), curvature, normal)


def sample_ahead(lps_from_start: Float, goal_lps: Float, needle: Needle, rng: np.random.Generator) -> Float:
    """Draw a point `(3,)` uniformly from the needle's workspace [Kuntz2015, fig. 4].

    The workspace is that of a single arc.  A circle of the least radius R bounds it aside; no point lies more
    than 45 degrees aside, which turns the needle by 90.  The farthest lies SPREAD times as far ahead as the
    goal is away.
    """
    radius = needle.min_radius_of_curvature_mm
    farthest = SPREAD * float(np.linalg.norm(goal_lps - lps_from_start[:3, 3]))
    while True:
        ahead = farthest * float(rng.random())
        width = _half_width(ahead, radius)
        if rng.random() * _half_width(farthest, radius) ** 2 <= width**2:
            break
    aside, azimuth = width * math.sqrt(rng.random()), 2.0 * math.pi * float(rng.random())
    local = np.array([aside * math.cos(azimuth), aside * math.sin(azimuth), ahead])
    return np.asarray(lps_from_start[:3, 3] + lps_from_start[:3, :3] @ local)


def _half_width(ahead: float, radius: float) -> float:
    """Return how far aside an arc leads at a distance ahead."""
    return radius - math.sqrt(radius**2 - ahead**2) if ahead < radius else ahead
