"""The tree of states of a bronchoscope over the whole airway, grown along its branches."""

import math

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from stages.scope.kernels import growth as kernel
from stages.scope.kernels.body import Walls
from stages.scope.kernels.growth import Device, Route

STEP_MM = 1.0
"""Advance from layer to layer: about a voxel and a half, far shorter than a bending section."""
TANGENT_MM = 3.0
"""The direction of a route is that of its chord so far each way: several voxels, less than a branch."""


@frozen_record
class StateTree:
    """States of a scope, each reached from an earlier one; N states.

    Args:
        states ((N, 26) float64): See `stages.scope.kernels.growth`.
        parent ((N,) int64): -1 for the first one.
        by_straight ((N,) bool): Whether the section is straightened before it twists on the way from the
            parent.
        advance_mm ((N,) float64): Advance of the base since the first state.
        turned_from ((T,) int64): States from which tips may be turned: some of each layer.
    """

    states: Float
    parent: Int
    by_straight: Bool
    advance_mm: Float
    turned_from: Int

    def only(self, needed: Int) -> "tuple[StateTree, Int]":
        """Return the states on the ways to some `(S,)` of them, and the new numbers of those."""
        keep = np.zeros(len(self.parent), dtype=np.bool_)
        keep[needed] = True
        keep[:1] = True
        for state in range(len(self.parent) - 1, 0, -1):
            if keep[state]:
                keep[self.parent[state]] = True
        number = np.cumsum(keep) - 1
        parent = self.parent[keep]
        return StateTree(
            states=self.states[keep],
            parent=np.where(parent >= 0, number[parent], -1),
            by_straight=self.by_straight[keep],
            advance_mm=self.advance_mm[keep],
            turned_from=number[self.turned_from[keep[self.turned_from]]],
        ), number[needed]


class Growth:
    """Grows the states of a scope along the routes of an airway.

    `tried` `(N,)` marks tree points that the scope might get to; routes end at the last of them.  `passable`
    `(N,)` marks those to which a ball as thick as the scope gets along the axis.
    """

    def __init__(self, walls: Walls, tree: AirwayTree, tried: Bool, passable: Bool, device: Device) -> None:
        self._walls, self._tree, self._device = walls, tree, device
        self._tried, self._passable = tried, passable
        # Curvatures beside that which leads to the route ahead: they move a tip of 15 mm by 0.3 to 3 mm.
        self._offsets = np.vstack([np.zeros((1, 2)), rings((0.003, 0.01, 0.03), 8)])
        # The first layer has no states, so that there is always one.
        self._rows = [np.zeros((0, kernel.COLUMNS))]
        self._parents = [np.zeros(0, dtype=np.int64)]
        self._straight = [np.zeros(0, dtype=np.bool_)]
        self._advance = [0.0]
        self._begins = [0, 0]
        self._layers: dict[int, list[tuple[int, float]]] = {}
        """Of each branch: number of a layer and how far from the root its tips are, in the median."""

    def grow(self) -> StateTree:
        """Grow along all branches, parents first."""
        for branch in range(self._tree.n_branches):
            points = self._tree.branch_points(branch)
            points = points[self._tried[points]]
            if len(points) and not self._ends_before(branch):
                self._grow_branch(branch, self._tree.route(int(points[-1])))
        return self._result()

    def _grow_branch(self, branch: int, points: Int) -> None:
        route = self._route(points)
        if branch == 0 and not self._begin(route):
            return
        # States kept in a layer, and those kept where fewer did not get as far as the scope passes the axis.
        # Motions into a branch part from those into others so many lengths of the section before the fork.
        for beam, lengths in zip((24, 96), (2.0, 4.0), strict=True):
            layers = self._follow(branch, points, route, beam, lengths * self._device.length)
            known = self._layers.get(branch, [])
            if not known or (layers and layers[-1][1] > known[-1][1]):
                self._layers[branch] = layers
            expected = points[self._passable[points]]
            if not len(expected) or self._farthest(branch) >= (
                self._tree.distance_from_root_mm[expected[-1]] - 2.0 * STEP_MM
            ):
                return

    def _farthest(self, branch: int) -> float:
        """Return how far from the root the states of a branch get, 0 if there are none."""
        return self._layers[branch][-1][1] if self._layers.get(branch) else 0.0

    def _ends_before(self, branch: int) -> bool:
        """Tell whether the parent's states end before its fork: up to there both searches are the same."""
        if branch == 0:
            return False
        fork = int(self._tree.parent_point[self._tree.branch_start[branch]])
        parent = int(self._tree.branch_parent[branch])
        return bool(self._farthest(parent) < self._tree.distance_from_root_mm[fork] - TANGENT_MM)

    def _follow(
        self, branch: int, points: Int, route: Route, beam: int, before_mm: float
    ) -> list[tuple[int, float]]:
        """Follow a route from some way before its last fork; return the layers."""
        start = self._start(branch, before_mm)
        if start is None:
            return []
        layers = [start]
        from_root = self._tree.distance_from_root_mm[points]
        states = self._rows[start[0]].copy()
        numbers = self._number(start[0])
        shared = int(np.searchsorted(points, self._tree.branch_start[branch])) if branch else len(points)
        states[:, kernel.NEAR] = np.minimum(states[:, kernel.NEAR], max(shared - 1, 0))
        end = len(points) - 1
        while True:
            out = np.zeros((beam, kernel.COLUMNS))
            parents, straight = np.zeros(beam, dtype=np.int64), np.zeros(beam, dtype=np.bool_)
            kept = kernel.grow_layer(
                self._walls, self._device, route, states, self._offsets, STEP_MM, out, parents, straight
            )
            if not kept:
                return layers
            states = out[:kept].copy()
            layer = self._add(states, numbers[parents[:kept]], straight[:kept], self._advance[layers[-1][0]])
            numbers = self._number(layer)
            near = states[:, kernel.NEAR].astype(np.int64)
            layers.append((layer, float(np.median(from_root[near]))))
            if near.min() >= end or len(layers) > 4 * len(points) + 100:
                return layers

    def _start(self, branch: int, before_mm: float) -> tuple[int, float] | None:
        """Return the last layer of the branches before one that is at least so far before its fork."""
        if branch == 0:
            return self._layers[0][0]
        tree = self._tree
        hangs_on = int(tree.parent_point[tree.branch_start[branch]])
        limit = float(tree.distance_from_root_mm[hangs_on]) - before_mm
        above = int(tree.branch_parent[branch])
        while above >= 0:
            before = [layer for layer in self._layers.get(above, []) if layer[1] <= limit]
            if before:
                return before[-1]
            above = int(tree.branch_parent[above])
        return self._layers[0][0] if self._layers.get(0) else None

    def _begin(self, route: Route) -> bool:
        """Put a straight section into the trachea, where the first one fits."""
        from anatomy import poses

        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(route.points, axis=0), axis=1)))
        # The first straight section may begin so far down the trachea.
        for n in range(int(np.searchsorted(along, 30.0))):
            tip = int(np.searchsorted(along, along[n] + self._device.length))
            if tip >= len(along):
                return False
            frame = poses.pose(route.points[n], route.points[tip] - route.points[n])
            state = np.zeros((1, kernel.COLUMNS))
            state[0, : kernel.U] = frame[:3].T.ravel()
            state[0, kernel.NEAR] = tip
            if kernel.put_first(self._walls, self._device, route, state[0]):
                layer = self._add(state, np.array([-1]), np.array([False]), -STEP_MM)
                self._layers[0] = [(layer, float(along[tip]))]
                return True
        return False

    def _route(self, points: Int) -> Route:
        tree = self._tree
        places = np.ascontiguousarray(tree.points_lps[points])
        along = tree.distance_from_root_mm[points]
        ahead = np.minimum(np.searchsorted(along, along + TANGENT_MM), len(points) - 1)
        behind = np.maximum(np.searchsorted(along, along - TANGENT_MM, side="right") - 1, 0)
        chords = places[ahead] - places[behind]
        lengths = np.linalg.norm(chords, axis=1, keepdims=True)
        tangents = np.where(lengths > 0.0, chords / np.maximum(lengths, 1e-9), tree.tangents[points])
        # The room beside the axis counts at least so much, half a voxel: costs stay finite in narrow places.
        room = np.maximum(tree.radius_mm[points] - self._device.radius, 0.3)
        return Route(points=places, tangents=tangents, room=room)

    def _add(self, states: Float, parents: Int, straight: Bool, advance_mm: float) -> int:
        self._rows.append(states)
        self._parents.append(np.asarray(parents, dtype=np.int64))
        self._straight.append(straight)
        self._advance.append(advance_mm + STEP_MM)
        self._begins.append(self._begins[-1] + len(states))
        return len(self._rows) - 1

    def _number(self, layer: int) -> Int:
        """Return the numbers of the states of a layer."""
        return np.arange(self._begins[layer], self._begins[layer + 1])

    def _result(self) -> StateTree:
        used = sorted({layer for layers in self._layers.values() for layer, _ in layers})
        # States of a layer from which tips are turned, spread over those that it keeps, the best among them.
        numbers = [self._number(layer) for layer in used]
        some = [each[np.unique(np.linspace(0, len(each) - 1, 16).astype(np.int64))] for each in numbers]
        return StateTree(
            states=np.concatenate(self._rows),
            parent=np.concatenate(self._parents),
            by_straight=np.concatenate(self._straight),
            advance_mm=np.repeat(self._advance, np.diff(self._begins)),
            turned_from=np.concatenate([self._number(0), *some]),
        )


def rings(sizes: tuple[float, ...], spokes: int) -> Float:
    """Return offsets `(2 + R * spokes, 2)`: two of 0, and rings of growing size, every other one turned."""
    out = [(0.0, 0.0), (0.0, 0.0)]
    for number, size in enumerate(sizes):
        angles = (np.arange(spokes) + 0.5 * (number % 2)) * (2.0 * math.pi / spokes)
        out += [(size * math.cos(angle), size * math.sin(angle)) for angle in angles]
    return np.array(out)
