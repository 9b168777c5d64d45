"""Motions of few changes: from a proved motion to one of fewer, longer legs that ends in the same pose."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Int
from stages.scope.device import SHORTEST_MM
from stages.scope.kernels import simplifying as kernel
from stages.scope.kernels.body import MOST_TWIST_RAD, Walls
from stages.scope.kernels.growth import Device
from stages.scope.motion import ADVANCE, BEND, TWIST, ScopeMotion, frame_columns

LADDER = ((3, 2), (4, 3), (6, 4), (8, 5), (11, 7), (15, 10), (20, 14))
"""Legs and twists that are tried at once, the simplest first."""
TURN_MM, STEP_MM = 0.2, 0.1
"""Longest parts of changes in place and longest steps along the body in which room is measured."""
STEPS, GAIN = 40, 0.005
"""A fit ends after so many steps, or where a step gains less than this share."""
MOST_TRIES = 60
"""Removals that are tried one by one."""


@dataclass(frozen=True)
class Legs:
    """A motion by its legs: K of them, with G twists.

    Args:
        group ((K + 1,) int64): Which twist each leg and the end have; they never fall.
        twists ((G,) float64): rad.
        bends ((K + 1,) or (K,) float64): rad; without the last one the end has that of the last leg.  Where
            the first is 0 it stays so: the scope enters with its tip straight.
        advances ((K,) float64): mm.
        orders ((K + 1,) int64): In which order twist and bend change before each leg and at the end, where
            that is proved.
    """

    group: Int
    twists: Float
    bends: Float
    advances: Float
    orders: Int = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def count(self) -> int:
        """Number of legs, K."""
        return len(self.advances)

    @property
    def rows(self) -> Float:
        """Twist, bend and advance of each leg and the end, `(K + 1, 3)`."""
        bends = self.bends[np.minimum(np.arange(self.count + 1), len(self.bends) - 1)]
        return np.column_stack([self.twists[self.group], bends, np.append(self.advances, 0.0)])

    @property
    def unknowns(self) -> Float:
        """What a fit changes."""
        return np.concatenate([self.twists, self.bends, self.advances])

    def changed(self, x: Float) -> "Legs":
        """Return the legs with other unknowns."""
        twists, bends, advances = np.split(x, [len(self.twists), len(self.twists) + len(self.bends)])
        return replace(self, twists=twists, bends=bends, advances=advances)


def legs_of(motion: ScopeMotion) -> Legs:
    """Return the legs of a motion, each with a twist of its own."""
    states = motion.states
    rows: list[list[float]] = []
    for before, after in zip(states[:-1], states[1:], strict=True):
        advance = float(after[ADVANCE] - before[ADVANCE])
        if advance <= SHORTEST_MM:
            continue
        if rows and rows[-1][:2] == before[1:].tolist():
            rows[-1][2] += advance
        else:
            rows.append([float(before[TWIST]), float(before[BEND]), advance])
    rows.append([float(states[-1, TWIST]), float(states[-1, BEND]), 0.0])
    twist, bend, advance_mm = np.array(rows).T
    return Legs(np.arange(len(rows)), twist, bend, advance_mm[:-1])


class Removal(NamedTuple):
    """A change less of legs: how much it changes before it is fitted, in rad, and how its legs are made.

    `joins` tells whether it takes a leg, `ties` whether it takes a twist.
    """

    damage: float
    made: Callable[[], Legs]
    joins: bool = False
    ties: bool = False


class Simplifier:
    """Looks for motions of fewer changes and twists to the end of a proved one, with room of `room_mm`.

    The device is the scope, and the largest curvature that what passes its channel can stand.
    `ends_rad` are the bends farthest down and up of the section at the tip, and `room_mm` is the room that a
    simpler motion keeps.
    """

    def __init__(
        self, walls: Walls, device: Device, motion: ScopeMotion, ends_rad: tuple[float, float], room_mm: float
    ) -> None:
        self._walls, self._device, self._motion, self._least_mm = walls, device, motion, room_mm
        # So much more depth than needed is wanted: it becomes the tolerance of the steps.
        self._section = kernel.Section(length=device.length, radius=device.radius, spare_mm=0.5)
        laying = device.laying * device.length
        self._laid = max(device.least_bend, -laying), min(device.most_bend, laying)
        self._end = ends_rad
        self._entry, self._target = frame_columns(motion.lps_from_entry), frame_columns(motion.lps_from_tip)

    def best(self) -> ScopeMotion:
        """Return the simplest motion found, the given one if none is; the same one gives the same result."""
        given = self._turned(legs_of(self._motion))
        found = None
        for legs, twists in LADDER:
            if legs < given.count:
                found = found or self._fitted(self._reduced(given, legs, twists))
        found = found or self._fitted(given)
        if found is None:
            return self._motion
        return replace(self._motion, states=self._states(self._rounded(self._without(found))))

    def _without(self, legs: Legs) -> Legs:
        """Remove what can be removed of legs, the least change first."""
        least, tries = 0.0, 0
        removed = False
        while tries < MOST_TRIES:
            for move in sorted(self._removals(legs), key=lambda each: each.damage):
                if move.damage < least or tries >= MOST_TRIES:
                    continue
                tries += 1
                found = self._fitted(move.made())
                if found is not None:
                    legs, least, removed = found, move.damage, True
                    break
            else:
                if not removed:
                    break
                least, removed = 0.0, False
        return legs

    def _rounded(self, legs: Legs) -> Legs:
        """Return legs with round twists, bends and advances but for the last ones, which make up for it."""
        # Twists, bends and advances become multiples of so many degrees and mm, of the first that is proved.
        for grid in (1.0, 0.1):
            bounds = self._bounds(legs)
            units = np.full(len(bounds), math.radians(grid))
            units[-legs.count :] = grid
            x = units * np.round(legs.unknowns / units)
            fixed = (bounds[:, 0] < x) & (x < bounds[:, 1])
            begin = 0
            # So many of the last twists, bends and advances are free: the six numbers of a pose need some.
            for count, free in zip((len(legs.twists), len(legs.bends), legs.count), (2, 4, 3), strict=True):
                fixed[begin + max(count - free, 0) : begin + count] = False
                begin += count
            bounds[fixed] = x[fixed, None]
            found = self._fitted(legs.changed(np.where(fixed, x, legs.unknowns)), bounds)
            if found is not None:
                return found
        return legs

    def _reduced(self, legs: Legs, count: int, twists: int) -> Legs:
        """Return legs of which the least important are removed until there are so few."""
        while legs.count > count or len(legs.twists) > twists:
            long, turned = legs.count > count, len(legs.twists) > twists
            moves = (each for each in self._removals(legs) if each.joins and long or each.ties and turned)
            legs = min(moves, key=lambda each: each.damage).made()
        return legs

    def _removals(self, legs: Legs) -> Iterator[Removal]:
        """Yield what could be removed of legs: a twist, a leg, or the bend at the begin or at the end."""
        rows = legs.rows
        lengths = np.append(legs.advances, self._device.length)
        ways = np.stack([np.cos(rows[:, 0]), np.sin(rows[:, 0])], axis=1)
        vectors = rows[:, 1:2] / self._device.length * ways
        turned = np.linalg.norm(vectors, axis=1) * lengths
        for group in range(len(legs.twists) - 1):
            yield self._tied(legs, group, vectors, lengths, turned)
        for leg in range(legs.count - 1):
            yield self._joined(legs, leg, vectors, lengths)
        if legs.bends[0] != 0.0 and legs.count > 1:
            bends = legs.bends.copy()
            bends[0] = 0.0
            damage = float(abs(rows[0, 1]) * lengths[0] / self._device.length)
            yield Removal(damage, partial(replace, legs, bends=bends))
        if len(legs.bends) > legs.count:
            bends = legs.bends[:-1].copy()
            change = abs(bends[-1] - legs.bends[-1])
            if self._end[0] <= bends[-1] <= self._end[1]:
                yield Removal(float(change), partial(replace, legs, bends=bends))

    def _tied(self, legs: Legs, group: int, vectors: Float, lengths: Float, turned: Float) -> Removal:
        """Return legs with one twist for two groups of them."""
        begin, middle, end = np.searchsorted(legs.group, (group, group + 1, group + 2)).tolist()
        one, other = float(legs.twists[group]), float(legs.twists[group + 1])
        weights = [float(turned[begin:middle].sum()) + 1e-12, float(turned[middle:end].sum()) + 1e-12]
        # A section bent the other way, half a turn on, is the same.
        near = one + math.pi * round((other - one) / math.pi)
        twist = (weights[0] * one + weights[1] * near) / sum(weights)
        if group + 2 == len(legs.twists):
            twist += other - near
        twist = min(max(twist, -MOST_TWIST_RAD), MOST_TWIST_RAD)
        way = np.array([math.cos(twist), math.sin(twist)])
        along = vectors @ way
        across = np.linalg.norm(vectors - along[:, None] * way, axis=1)

        def made() -> Legs:
            bends = legs.rows[:, 1]
            bends[begin:end] = along[begin:end] * self._device.length
            twists = np.delete(legs.twists, group + 1)
            twists[group] = twist
            groups = legs.group - (legs.group > group)
            return replace(legs, group=groups, twists=twists, bends=bends[: len(legs.bends)])

        return Removal(float((across * lengths)[begin:end].sum()), made, ties=True)

    def _joined(self, legs: Legs, leg: int, vectors: Float, lengths: Float) -> Removal:
        """Return legs of which two that follow each other are one."""
        whole = lengths[leg] + lengths[leg + 1]
        mean = (lengths[leg] * vectors[leg] + lengths[leg + 1] * vectors[leg + 1]) / whole
        change = np.linalg.norm(vectors[leg] - vectors[leg + 1]) * lengths[leg] * lengths[leg + 1] / whole
        twists = legs.twists[legs.group[leg : leg + 2]]
        along = mean @ np.stack([np.cos(twists), np.sin(twists)])
        kept = leg + int(abs(along[1]) > abs(along[0]))
        left = 2 * leg + 1 - kept

        def made() -> Legs:
            bends = np.delete(legs.bends, leg)
            bends[leg] = along[kept - leg] * self._device.length
            advances = np.delete(legs.advances, leg)
            advances[leg] = whole
            used, group = np.unique(np.delete(legs.group, left), return_inverse=True)
            return Legs(group.astype(np.int64), legs.twists[used], bends, advances)

        alone = np.count_nonzero(legs.group == legs.group[left]) == 1
        return Removal(float(change), made, joins=True, ties=alone)

    def _fitted(self, legs: Legs, bounds: Float | None = None) -> Legs | None:
        """Return proved legs near to some that end in the pose, within bounds `(n, 2)`; None if not found."""
        x = legs.unknowns
        # Spacing of the places of a leg that are looked at as it is fitted: less than a lumen is wide.
        counts = np.ceil((np.append(legs.advances, 0.0) + self._device.length) / 2.0).astype(np.int64)
        left = kernel.fit_legs(
            self._walls, self._section, self._entry, self._target, legs.group, counts, x,
            self._bounds(legs) if bounds is None else bounds, STEPS, GAIN,
        )  # fmt: skip
        found = legs.changed(x)
        orders = self._orders(found) if math.isfinite(left) else None
        return None if orders is None else replace(found, orders=orders)

    def _bounds(self, legs: Legs) -> Float:
        bends = [self._laid] * len(legs.bends)
        bends[-1] = self._end
        if len(legs.bends) == legs.count:
            bends[-1] = max(self._laid[0], self._end[0]), min(self._laid[1], self._end[1])
        if legs.bends[0] == 0.0:
            bends[0] = (0.0, 0.0)
        turns = [(-MOST_TWIST_RAD, MOST_TWIST_RAD)] * len(legs.twists)
        # Shorter advances are not asked of hands.
        return np.array(turns + bends + [(1.0, math.inf)] * legs.count)

    def _orders(self, legs: Legs) -> Int | None:
        """Return in which orders legs change twist and bend, None if they are not proved."""
        orders = np.zeros(legs.count + 1, dtype=np.int64)
        walls, device, rows = self._walls, self._device, legs.rows
        # Long steps tell soon what is blocked, short ones how much room there is.
        for turn_mm, step_mm, least_mm in ((math.inf, math.inf, 0.0), (TURN_MM, STEP_MM, self._least_mm)):
            room = kernel.prove_legs(
                walls, device.radius, device.length, self._entry, rows, turn_mm, step_mm, least_mm, orders
            )
            if room < least_mm:
                return None
        return orders

    def _turned(self, legs: Legs) -> Legs:
        """Return the same legs with twists by half a turn more or less, where less is twisted then."""
        last = len(legs.twists) - 1
        choices: list[list[tuple[float, int]]] = []
        for group, twist in enumerate(legs.twists.tolist()):
            of_group = legs.rows[legs.group == group, 1]
            choices.append([])
            for turns in (0,) if group == last else (0, -1, 1):
                at, bends = twist + math.pi * turns, of_group * (-1.0) ** turns
                laid = self._laid[0] <= bends.min() and bends.max() <= self._laid[1]
                if turns == 0 or (laid and abs(at) <= MOST_TWIST_RAD):
                    choices[-1].append((at, turns))
        # The least twist in all, from the end back.
        ways: list[tuple[float, list[tuple[float, int]]]] = [(0.0, [one]) for one in choices[-1]]
        for options in choices[-2::-1]:
            ways = [
                min(((cost + abs(way[0][0] - one[0]), [one, *way]) for cost, way in ways), key=itemgetter(0))
                for one in options
            ]
        _, way = min(ways, key=lambda each: each[0] + abs(each[1][0][0]))
        twists, signs = np.array([at for at, _ in way]), np.array([(-1.0) ** turns for _, turns in way])
        bends = legs.bends * signs[legs.group[: len(legs.bends)]]
        return replace(legs, twists=twists, bends=bends)

    def _states(self, legs: Legs) -> Float:
        """Return the states of legs `(M, 3)`, of which each changes one thing."""
        rows, advance = [(0.0, 0.0, 0.0)], 0.0
        for order, (twist, bend, step) in zip(legs.orders.tolist(), legs.rows.tolist(), strict=True):
            _, twist_before, bend_before = rows[-1]
            between = {
                kernel.TWIST_FIRST: [(twist, bend_before)],
                kernel.BEND_FIRST: [(twist_before, bend)],
                kernel.BY_STRAIGHT: [(twist_before, 0.0), (twist, 0.0)],
            }.get(order, [])
            rows += [(advance, *each) for each in between]
            if rows[-1][1:] != (twist, bend):
                rows.append((advance, twist, bend))
            if step > 0.0:
                advance += step
                rows.append((advance, twist, bend))
        return np.array(rows)
