"""Needle problems with known answers, and the needle's words enumerated without any of the kernels.

Obstacles are blocks on the voxel lattice, so that the distance to them has a closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.path import Query
from tests.stages.scenes import Canvas

CLEARANCE_MM = 1.0
SAMPLE_MM = 0.1
SURE_MM = 0.5 * SAMPLE_MM + 0.01
"""Clearance to spare at samples that rules out a refusal: half their distance, and what a proof gives up."""


@frozen_value
class Maze:
    """Blocks in a box of free space, a start and a target.

    Args:
        low, high ((3,) float64, LPS mm): The box; beyond it all is an obstacle.
        blocks ((B, 2, 3) float64, LPS mm): Lowest and highest corner of each block, on the voxel lattice of
            the box.
        start: (4, 4) float64.
        target: (3,) float64, LPS mm.
    """

    low: Float
    high: Float
    blocks: Float
    needle: Needle
    start: Float
    target: Float
    goal_tolerance_mm: float = 0.0
    voxel_mm: float = 0.5

    @property
    def query(self) -> Query:
        """Start and target."""
        return Query(lps_from_start=self.start, target=self.target)

    def environment(self) -> NeedleEnvironment:
        """Draw the blocks."""
        canvas = Canvas.empty(self.low, self.high, self.voxel_mm)
        for block_low, block_high in self.blocks:
            canvas.add(((canvas.points > block_low) & (canvas.points < block_high)).all(axis=-1), VESSEL)
        return environment_of_labels(
            canvas.labels,
            canvas.grid,
            self.needle,
            required_clearance_mm=CLEARANCE_MM,
            goal_tolerance_mm=self.goal_tolerance_mm,
        )

    def clearance(self, points: Float) -> Float:
        """Return the distance of points `(..., 3)` to the nearest block or face of the box, mm."""
        out = np.minimum(points - self.low, self.high - points).min(axis=-1)
        for block_low, block_high in self.blocks:
            gap = np.maximum(np.maximum(block_low - points, points - block_high), 0.0)
            out = np.minimum(out, np.linalg.norm(gap, axis=-1))
        return np.asarray(out)


def pose_at(*position: float) -> Float:
    """Return a pose that looks along +z, its +x that of the world."""
    frame = np.eye(4)
    frame[:3, 3] = position
    return frame


def needle(radius_mm: float = 30.0, **changes: float) -> Needle:
    """Return a needle of 1 mm."""
    return Needle(diameter_mm=1.0, max_curvature_per_mm=1.0 / radius_mm, **changes)


BOX = np.array([[-12.0, -12.0, -30.0], [12.0, 12.0, 30.0]])


def in_box(blocks: list[list[list[float]]], **changes: float) -> Maze:
    """Return a maze from (0, 0, -25) to (0, 0, 25)."""
    return Maze(
        low=BOX[0],
        high=BOX[1],
        blocks=np.array(blocks).reshape(-1, 2, 3),
        needle=needle(**changes),
        start=pose_at(0.0, 0.0, -25.0),
        target=np.array([0.0, 0.0, 25.0]),
    )


def wall(z_mm: float, hole: tuple[float, float, float, float] | None = None) -> list[list[list[float]]]:
    """Return a wall of 2 mm across the box, with a hole from x0 to x1 and y0 to y1."""
    (x_low, y_low, _), (x_high, y_high, _) = BOX
    z0, z1 = z_mm - 1.0, z_mm + 1.0
    if hole is None:
        return [[[x_low, y_low, z0], [x_high, y_high, z1]]]
    x0, x1, y0, y1 = hole
    return [
        [[x_low, y_low, z0], [x0, y_high, z1]],
        [[x1, y_low, z0], [x_high, y_high, z1]],
        [[x0, y_low, z0], [x1, y0, z1]],
        [[x0, y1, z0], [x1, y_high, z1]],
    ]


WAY = ((0.0, 12.0), (math.pi, 24.0), (None, 4.0), (0.0, 8.0))
"""Roll in rad (None: straight) and length in mm of the pieces of the one way through the winding maze."""
HOLE_MM = 2.5
"""Half a hole of the winding maze."""


def winding_maze(closed: int | None = None) -> tuple[Maze, list[tuple[float, tuple[float, ...]]]]:
    """Return a maze whose only way leads through three holes aside of each other, and its walls with holes.

    The holes lie about the points where WAY is after 16, 28 and 44 mm; the target, 6 mm straight ahead of
    its end.  One of the walls may be `closed`.
    """
    maze = in_box([])
    frames = maze.start[None]
    points = []
    for roll, length in WAY:
        kappa = 0.0 if roll is None else maze.needle.max_curvature_per_mm
        part = arcs(frames, np.full(1, roll or 0.0), np.full(1, kappa), np.full(1, length))
        points.append(part.points[0, 1:])
        frames = part.frames
    way = np.concatenate(points)
    per_mm = len(way) / sum(length for _roll, length in WAY)
    blocks, walls = [], []
    for number, at in enumerate((16.0, 28.0, 44.0)):
        x, y, z = np.round(2.0 * way[round(at * per_mm)]) / 2.0
        hole = (x - HOLE_MM, x + HOLE_MM, y - HOLE_MM, y + HOLE_MM)
        walls.append((float(z), hole))
        blocks += wall(float(z), None if number == closed else hole)
    end = frames[0]
    return replace(in_box(blocks), target=end[:3, 3] + 6.0 * end[:3, 2]), walls


CostAt = Callable[[Float], Float]


@dataclass(frozen=True)
class Enumeration:
    """The least cost of all words, over those surely clear and over those that may be.

    Args:
        sure, possible: Infinite if there is none.
        words: Number of words from whose end the goal was tried.
    """

    sure: float
    possible: float
    words: int


@frozen_value
class Curves:
    """N curves, sampled at S points each, as they lie one after the other on N paths.

    Args:
        points, tangents: (N, S, 3) float64, LPS mm.
        lengths ((N, S) float64): Arc length from the start of the curve.
        turns ((N, S) float64): Sum of all turning so far, rad.
        frames ((N, 4, 4) float64): At the ends, carried along without twist.
    """

    points: Float
    tangents: Float
    lengths: Float
    turns: Float
    frames: Float

    def then(self, other: Curves) -> Curves:
        """Return these curves, each followed by another."""
        return Curves(
            points=np.concatenate([self.points, other.points], axis=1),
            tangents=np.concatenate([self.tangents, other.tangents], axis=1),
            lengths=np.concatenate([self.lengths, self.lengths[:, -1:] + other.lengths], axis=1),
            turns=np.concatenate([self.turns, self.turns[:, -1:] + other.turns], axis=1),
            frames=other.frames,
        )


def arcs(frames: Float, rolls: Float, kappas: Float, lengths: Float) -> Curves:
    """Sample arcs at most SAMPLE_MM apart; roll in rad, about +z of each frame."""
    samples = max(2, math.ceil(float(lengths.max(initial=0.0)) / SAMPLE_MM) + 1)
    s = lengths[:, None] * np.linspace(0.0, 1.0, samples)
    angle = kappas[:, None] * s
    ahead = s * np.sinc(angle / np.pi)
    aside = s * np.sinc(0.5 * angle / np.pi) * np.sin(0.5 * angle)
    normal = np.stack([np.cos(rolls), np.sin(rolls), np.zeros_like(rolls)], axis=-1)
    axis = np.stack([-np.sin(rolls), np.cos(rolls), np.zeros_like(rolls)], axis=-1)
    local = aside[..., None] * normal[:, None] + ahead[..., None] * np.array([0.0, 0.0, 1.0])
    direction = np.sin(angle)[..., None] * normal[:, None] + np.cos(angle)[..., None] * np.array(
        [0.0, 0.0, 1.0]
    )
    rotation = frames[:, :3, :3]
    points = frames[:, None, :3, 3] + np.einsum("nij,nsj->nsi", rotation, local)
    ends = np.zeros_like(frames)
    ends[:, 3, 3] = 1.0
    ends[:, :3, :3] = rotation @ Rotation.from_rotvec(axis * angle[:, -1:]).as_matrix().reshape(-1, 3, 3)
    ends[:, :3, 3] = points[:, -1]
    return Curves(
        points=points,
        tangents=np.einsum("nij,nsj->nsi", rotation, direction),
        lengths=s,
        turns=angle,
        frames=ends,
    )


def connections(frames: Float, goal: Float, kappa: float, longest_mm: float) -> list[Curves]:
    """Return, for each frame, the shortest path to the goal and the single arc, no longer than `longest_mm`.

    Where the tightest circle keeps the goal out of reach, both are half of that circle.
    """
    radius = 1.0 / kappa
    x, y, h = np.einsum("nij,ni->jn", frames[:, :3, :3], goal - frames[:, :3, 3])
    rho, roll = np.hypot(x, y), np.arctan2(y, x)
    away = np.hypot(rho - radius, h)
    reached = away >= radius * (1.0 - 1e-12)
    # Where the goal lies straight ahead of the tangent.
    turn = np.arctan2(h, radius - rho) - np.arccos(np.minimum(radius / away, 1.0))
    turn = np.where(turn < -1e-9, turn + 2.0 * np.pi, np.maximum(turn, 0.0))
    straight = np.sqrt(np.maximum(away**2 - radius**2, 0.0))
    short = reached & (turn * radius + straight <= longest_mm)
    bow = np.where(short, turn * radius, np.where(reached, 0.0, min(np.pi * radius, longest_mm)))
    first = arcs(frames, roll, np.full(len(frames), kappa), bow)
    flat = np.zeros(len(frames))
    shortest = first.then(arcs(first.frames, flat, flat, np.where(short, straight, 0.0)))
    assert np.abs((shortest.points[:, -1] - goal)[short]).max(initial=0.0) < 1e-6
    half_turn = np.arctan2(rho, h)
    curvature = np.where(reached, 2.0 * rho / (rho**2 + h**2), kappa)
    single = np.hypot(rho, h) / np.maximum(np.sinc(half_turn / np.pi), 1e-9)
    single = np.where(reached, single, np.pi * radius)
    return [shortest, arcs(frames, roll, curvature, np.minimum(single, longest_mm))]


def into_ball(curves: Curves, goal: Float, tolerance: float) -> tuple[Float, np.ndarray]:
    """Return the arc length `(N,)` at which each curve first is within the tolerance, and its last sample.

    Infinite where it never is.
    """
    away = np.linalg.norm(curves.points - goal, axis=-1)
    near = away <= tolerance + 1e-6
    last = near.argmax(axis=1)
    each = np.arange(len(last))
    before = np.maximum(last - 1, 0)
    fall = away[each, before] - away[each, last]
    share = np.where(fall > 0.0, (away[each, before] - tolerance) / np.maximum(fall, 1e-12), 1.0)
    length = curves.lengths[each, before] + np.clip(share, 0.0, 1.0) * (
        curves.lengths[each, last] - curves.lengths[each, before]
    )
    return np.where(near.any(axis=1), length, np.inf), last


@dataclass
class Paths:
    """The words so far: frames at their ends, length, turn, cost, and clearance to spare at samples."""

    frames: Float
    length: Float
    turn: Float
    cost: Float
    spare: Float

    def follow(
        self, maze: Maze, curves: Curves, lengths: Float, last: np.ndarray, cost_at: CostAt | None
    ) -> Paths:
        """Go on by curves as far as `lengths`, sample `last`; those that break a limit spare nothing."""
        on = np.arange(curves.points.shape[1]) <= last[:, None]
        gap = np.where(on, maze.clearance(curves.points), np.inf).min(axis=1) - CLEARANCE_MM
        ahead = np.where(on, curves.tangents @ maze.start[:3, 2], 1.0).min(axis=1)
        cost = lengths
        if cost_at is not None:
            steps = np.diff(curves.lengths, axis=1) * on[:, 1:]
            cost = (steps * cost_at(0.5 * (curves.points[:, 1:] + curves.points[:, :-1]))).sum(axis=1)
        limits = maze.needle
        length, turn = self.length + lengths, self.turn + curves.turns[np.arange(len(last)), last]
        kept = (
            (length <= limits.max_length_mm + 1e-9)
            & (turn <= math.radians(limits.max_accumulated_turn_deg) + 1e-9)
            & (ahead >= math.cos(math.radians(limits.max_angle_from_start_deg)) - 1e-9)
        )
        spare = np.where(kept, np.minimum(self.spare, gap), -np.inf)
        return Paths(curves.frames, length, turn, self.cost + cost, spare)

    def clear(self) -> Paths:
        """Return those that may be clear."""
        kept = self.spare >= 0.0
        return Paths(*(getattr(self, name)[kept] for name in ("frames", "length", "turn", "cost", "spare")))


def enumerate_words(
    maze: Maze, fine_mm: float, rolls: int, most_steps: int, cost_at: CostAt | None = None, least: float = 1.0
) -> Enumeration:
    """Try the goal from the end of every word of up to `most_steps` single steps.

    Args:
        fine_mm: Length of a step.
        rolls: Number of directions of bending.
        cost_at: Cost of a mm at points `(..., 3)`; by default 1.
        least: What a mm costs by which a path ends short of the target.
    """
    kappa = maze.needle.max_curvature_per_mm
    paths = Paths(maze.start[None], np.zeros(1), np.zeros(1), np.zeros(1), np.full(1, np.inf))
    sure = possible = math.inf
    words = 0
    for step in range(most_steps + 1):
        words += len(paths.frames)
        for curves in connections(paths.frames, maze.target, kappa, maze.needle.max_length_mm):
            lengths, last = into_ball(curves, maze.target, maze.goal_tolerance_mm)
            ends = paths.follow(maze, curves, lengths, last, cost_at)
            missing = np.linalg.norm(paths.frames[:, :3, 3] - maze.target, axis=-1)
            costs = ends.cost + least * np.minimum(missing, maze.goal_tolerance_mm)
            possible = min(possible, float(costs[ends.spare >= 0.0].min(initial=math.inf)))
            sure = min(sure, float(costs[ends.spare >= SURE_MM].min(initial=math.inf)))
        if step < most_steps:
            paths = _longer(paths, maze, fine_mm, rolls, cost_at)
    return Enumeration(sure, possible, words)


def _longer(paths: Paths, maze: Maze, fine_mm: float, rolls: int, cost_at: CostAt | None) -> Paths:
    """Return the words that are one step longer."""
    count = len(paths.frames)
    parts = []
    for direction in range(rolls + 1):
        kappa = maze.needle.max_curvature_per_mm if direction < rolls else 0.0
        roll = 2.0 * math.pi * direction / rolls
        lengths = np.full(count, fine_mm)
        curves = arcs(paths.frames, np.full(count, roll), np.full(count, kappa), lengths)
        last = np.full(count, curves.points.shape[1] - 1)
        parts.append(paths.follow(maze, curves, lengths, last, cost_at).clear())
    names = ("frames", "length", "turn", "cost", "spare")
    return Paths(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
