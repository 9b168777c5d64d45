"""A motion of few legs that ends in a given pose: Levenberg and Marquardt's method on its settings.

A leg holds one twist and bend over one advance.  The unknowns `x` are the twists of groups of the K legs and
the section at the end, the bends of the legs and, if it is not that of the last one, of the end, and the K
advances:

    minimise  sum of squares of the room that is missing at samples of all that the section sweeps
              + what unknowns beyond their bounds, twists and changes of the bend cost
    subject to  the frame of the tip is the given one (six equations).

Every step solves the linearised problem with its equations.  What comes out is a proposal: the motion proof
decides.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.field import distance_estimate
from anatomy.kernels.linear import solve_in_place
from stages.scope.kernels.body import BLOCKED, change_room, move_along, point_along, room_along

EQUATIONS = 6
"""A tip's frame has three coordinates of its place and three angles."""
NARROW_MM, STEEPER = 0.2, 4.0
"""Where there is less room than this, about what a proof loses, what is missing counts so much more."""
TURN_SAMPLES, SECTION_SAMPLES = 2, 6
"""A change in place is looked at in so many settings of its twist and of its bend, each in so many places."""
TWIST_WEIGHT, BEND_WEIGHT = 0.3, 0.03
"""A twist by 1 rad and a change of the bend by 1 rad cost as much as so many mm too near to the wall."""
DIFFERENCE = 1e-6
"""Step of the differences that stand for derivatives, in mm and rad: small beside a voxel."""
TWIST_SCALE_RAD, BEND_SCALE_RAD, ADVANCE_SCALE_MM = 0.3, 0.1, 3.0
"""Unknowns move by about so much before the linearised problem is wrong."""
FROZEN = 1e-12
"""The scale of an unknown that stays as it is."""
FIRST_DAMPING, RAISE, LOWER, MOST_DAMPING = 0.03, 8.0, 0.3, 1e4
"""Damping in units of the scales above, and its factors after a failure and a success."""
CLOSED = 1e-11
"""The tip is there where it is so near, mm and rad: far below what a check of poses tells apart."""
TOGETHER, TWIST_FIRST, BEND_FIRST, BY_STRAIGHT = 0, 1, 2, 3
"""Orders of a change of twist and bend: both at once, one after the other, or with the section straightened
for the twist."""


class Section(NamedTuple):
    """A bending section, for kernels: its length and radius, and how much room around it is wanted, mm."""

    length: float
    radius: float
    spare_mm: float


@inner_kernel
def _shortfall(walls, section, base, twist, bend, at):
    """Return by how much the place `at` mm along a section or its leg lies too near to the wall."""
    kappa = bend / section.length
    x, y, z = point_along(base, kappa * math.cos(twist), kappa * math.sin(twist), at)
    room = distance_estimate(walls.depth, walls.depth_geometry, x, y, z) - section.radius
    return max(0.0, section.spare_mm - room) + STEEPER * max(0.0, NARROW_MM - room)


@inner_kernel
def _look_at_section(walls, section, base, twist, bend, row, out):
    """Fill in the samples of a section in place; return the row after them."""
    for n in range(SECTION_SAMPLES):
        at = section.length * (n + 1) / SECTION_SAMPLES
        out[row + n] = _shortfall(walls, section, base, twist, bend, at)
    return row + SECTION_SAMPLES


@inner_kernel
def _look(walls, section, group, counts, x, bounds, target, first, bases, rows, moved, out):
    """Fill in the residuals (R + EQUATIONS,) of unknowns, those of the equations last.

    group (K + 1,) : group of each leg and of the end; counts (K + 1,) : samples of each; bases (K + 2, 12)
    and rows (K + 1,) : frame and residual with which each begins, which are filled in, the first frame is
    given.  With a `first` above -1 the legs before it are as in the last look at all; bases then stay.
    """
    legs = group.shape[0] - 1
    groups = group[legs] + 1
    advances = x.shape[0] - legs
    begin, base = max(first, 0), bases[legs + 1]
    base[:] = bases[begin]
    row = rows[begin]
    twist_before = bend_before = 0.0
    if begin > 0:
        twist_before, bend_before = x[group[begin - 1]], x[min(groups + begin - 1, advances - 1)]
    for k in range(begin, legs + 1):
        if first < 0:
            bases[k] = base
            rows[k] = row
        twist, bend = x[group[k]], x[min(groups + k, advances - 1)]
        advance = x[advances + k] if k < legs else 0.0
        # The twist is where the section is less bent: that moves it least.
        early = abs(bend_before) <= abs(bend)
        for n in range(TURN_SAMPLES):
            share = (n + 1) / TURN_SAMPLES
            between = twist_before + share * (twist - twist_before)
            row = _look_at_section(walls, section, base, between, bend_before if early else bend, row, out)
        for n in range(TURN_SAMPLES):
            share = n / TURN_SAMPLES
            between = bend_before + share * (bend - bend_before)
            row = _look_at_section(walls, section, base, twist if early else twist_before, between, row, out)
        far = max(advance, 0.0) + section.length
        for n in range(counts[k]):
            out[row] = _shortfall(walls, section, base, twist, bend, far * (n + 1) / counts[k])
            row += 1
        out[row] = TWIST_WEIGHT * (twist - twist_before)
        out[row + 1] = BEND_WEIGHT * (bend - bend_before)
        row += 2
        twist_before, bend_before = twist, bend
        if k < legs:
            kappa = bend / section.length
            move_along(base, kappa * math.cos(twist), kappa * math.sin(twist), advance, base)
    for i in range(x.shape[0]):
        # An unknown 1 rad or 1 mm beyond its bound costs as much as so many mm too near to the wall.
        out[row] = 20.0 * (max(0.0, bounds[i, 0] - x[i]) + max(0.0, x[i] - bounds[i, 1]))
        row += 1
    kappa = bend_before / section.length
    move_along(base, kappa * math.cos(twist_before), kappa * math.sin(twist_before), section.length, moved)
    cosine, sine = math.cos(twist_before), math.sin(twist_before)
    for k in range(3):
        x_k = cosine * moved[k] + sine * moved[3 + k]
        moved[3 + k] = cosine * moved[3 + k] - sine * moved[k]
        moved[k] = x_k
        out[row + k] = moved[9 + k] - target[9 + k]
    for k in range(3):
        # The rotation to the target: half the antisymmetric part, by the axes a and b.
        a, b = (k + 1) % 3, (k + 2) % 3
        turned = 0.0
        for m in range(3):
            turned += moved[3 * a + m] * target[3 * b + m] - moved[3 * b + m] * target[3 * a + m]
        # A tip turned by 1 rad counts as much as one so many mm away.
        out[row + 3 + k] = 0.5 * 10.0 * turned


@inner_kernel
def _step(slopes, begins, residuals, scale, damping, matrix, right):
    """Fill `right` with the step of the linearised problem and its multipliers; tell whether there is one.

    slopes (n, R + EQUATIONS) : of the residuals, by unknowns, 0 before `begins` (n,).  Without damping the
    step is the shortest that solves the equations.
    """
    n = slopes.shape[0]
    rows = slopes.shape[1] - EQUATIONS
    matrix[:] = 0.0
    for i in range(n):
        right[i] = 0.0
        if damping > 0.0:
            for r in range(begins[i], rows):
                right[i] -= slopes[i, r] * residuals[r]
            for j in range(i + 1):
                total = 0.0
                for r in range(max(begins[i], begins[j]), rows):
                    total += slopes[i, r] * slopes[j, r]
                matrix[i, j] = matrix[j, i] = total
        matrix[i, i] += (damping if damping > 0.0 else 1.0) / scale[i] ** 2
        for e in range(EQUATIONS):
            matrix[i, n + e] = matrix[n + e, i] = slopes[i, rows + e]
    for e in range(EQUATIONS):
        right[n + e] = -residuals[rows + e]
    return solve_in_place(matrix, right) != 0.0


@inner_kernel
def _merit(residuals):
    """Return what is wrong with a motion: squares of its residuals, and how far its tip is off."""
    rows = residuals.shape[0] - EQUATIONS
    total = 0.0
    for r in range(rows):
        total += residuals[r] ** 2
    for r in range(rows, rows + EQUATIONS):
        # A tip 1 mm or 0.1 rad off costs as much as so many mm too near to the wall.
        total += 20.0 * abs(residuals[r])
    return total


@inner_kernel
def _off(residuals):
    """Return how far the tip is off."""
    most = 0.0
    for r in range(residuals.shape[0] - EQUATIONS, residuals.shape[0]):
        most = max(most, abs(residuals[r]))
    return most


@kernel()
def fit_legs(walls, section, entry, target, group, counts, x, bounds, steps, gain):
    """Change unknowns `x` (n,) until the tip is at its target and the body far enough from the wall.

    Return the sum of squares left, infinite if the tip does not come there within the bounds.

    bounds : (n, 2) least and most of each unknown; where they are the same it stays.
    entry, target : (12,) frames of the base and of the tip at the end; steps : the most steps; gain : the
    share of the merit by which a step must lower it.
    """
    legs = group.shape[0] - 1
    groups, advances = group[legs] + 1, x.shape[0] - legs
    total = EQUATIONS + x.shape[0] + (legs + 1) * (2 * TURN_SAMPLES * SECTION_SAMPLES + 2)
    for k in range(legs + 1):
        total += counts[k]
    n = x.shape[0]
    scale = np.zeros(n)
    scale[:groups] = TWIST_SCALE_RAD
    scale[groups:advances] = BEND_SCALE_RAD
    scale[advances:] = ADVANCE_SCALE_MM
    for i in range(n):
        if bounds[i, 0] == bounds[i, 1]:
            scale[i] = FROZEN
    bases, moved, rows = np.zeros((legs + 2, 12)), np.zeros(12), np.zeros(legs + 1, dtype=np.int64)
    bases[0] = entry
    # The first leg that each unknown moves: what lies before it has no slope.
    firsts, begins = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    for k in range(legs, -1, -1):
        firsts[group[k]] = k
        firsts[min(groups + k, advances - 1)] = k
        if k < legs:
            firsts[advances + k] = k
    residuals, trial = np.zeros(total), np.zeros(total)
    slopes = np.zeros((n, total))
    matrix, right = np.zeros((n + EQUATIONS, n + EQUATIONS)), np.zeros(n + EQUATIONS)
    near = x.copy()
    _look(walls, section, group, counts, x, bounds, target, -1, bases, rows, moved, residuals)
    begins[:] = rows[firsts]
    merit = _merit(residuals)
    damping = FIRST_DAMPING
    # Newton's method on the equations alone converges in fewer steps from nearby.
    for step in range(steps + 8):
        closing = step >= steps or damping > MOST_DAMPING
        if closing:
            # What is at a bound stays there.
            for i in range(n):
                if not bounds[i, 0] < x[i] < bounds[i, 1]:
                    x[i] = min(max(x[i], bounds[i, 0]), bounds[i, 1])
                    scale[i] = FROZEN
            _look(walls, section, group, counts, x, bounds, target, -1, bases, rows, moved, residuals)
            if _off(residuals) < CLOSED:
                break
        for i in range(n):
            near[:] = x
            near[i] += DIFFERENCE
            _look(walls, section, group, counts, near, bounds, target, firsts[i], bases, rows, moved, trial)
            for r in range(begins[i], total):
                slopes[i, r] = (trial[r] - residuals[r]) / DIFFERENCE
        if closing:
            if not _step(slopes, begins, residuals, scale, 0.0, matrix, right):
                return math.inf
            for i in range(n):
                x[i] += right[i]
            continue
        before = merit
        while damping <= MOST_DAMPING:
            if _step(slopes, begins, residuals, scale, damping, matrix, right):
                for i in range(n):
                    near[i] = x[i] + right[i]
                _look(walls, section, group, counts, near, bounds, target, -1, bases, rows, moved, trial)
                if _merit(trial) < merit:
                    x[:] = near
                    residuals[:] = trial
                    merit = _merit(trial)
                    damping *= LOWER
                    break
            damping *= RAISE
        if before - merit < gain * before:
            damping = 2.0 * MOST_DAMPING
    upright = moved[0] * target[0] + moved[1] * target[1] + moved[2] * target[2]
    if not (_off(residuals) < CLOSED and upright > 0.0):
        return math.inf
    squares = 0.0
    for r in range(total - EQUATIONS):
        squares += residuals[r] ** 2
    return squares


@inner_kernel
def _order_room(walls, radius, length, base, before, after, order, finest, longest_step):
    """Return a room that is there all along a change in place in an order, BLOCKED if none is proved."""
    twist, bend = before[0], before[1]
    least = math.inf
    for part in range(3):
        to_twist, to_bend = after[0], after[1]
        if order == TWIST_FIRST and part == 0:
            to_bend = bend
        elif order == BEND_FIRST and part == 0:
            to_twist = twist
        elif order == BY_STRAIGHT and part < 2:
            to_bend = 0.0
            if part == 0:
                to_twist = twist
        room = change_room(walls, radius, length, base, twist, bend, to_twist, to_bend, finest, longest_step)
        least = min(least, room)
        if room < 0.0 or (to_twist == after[0] and to_bend == after[1]):
            break
        twist, bend = to_twist, to_bend
    return least


@kernel()
def prove_legs(walls, radius, length, entry, legs, finest, longest_step, least, orders):
    """Return a room that is there during a motion of legs, BLOCKED if none of at least `least` is proved.

    legs : (K + 1, 3) twist, bend and advance, the last one the end; finest, longest_step : see `motion_room`;
    orders : (K + 1,), filled in with the order of twist and bend in each change: the first that keeps the
    room.
    """
    base = entry.copy()
    before = np.zeros(2)
    room = room_along(walls, radius, base, 0.0, 0.0, 0.0, length, 0.0, longest_step)
    for k in range(legs.shape[0]):
        kappa = legs[k, 1] / length
        u, v = kappa * math.cos(legs[k, 0]), kappa * math.sin(legs[k, 0])
        room = min(room, room_along(walls, radius, base, u, v, 0.0, length + legs[k, 2], 0.0, longest_step))
        if room < least:
            return BLOCKED
        tried = (TOGETHER, TOGETHER, TOGETHER)
        if legs[k, 0] != before[0] and legs[k, 1] != before[1]:
            tried = (TWIST_FIRST, BEND_FIRST, BY_STRAIGHT)
            if abs(before[1]) > abs(legs[k, 1]):
                tried = (BEND_FIRST, TWIST_FIRST, BY_STRAIGHT)
        found = BLOCKED
        for order in tried:
            orders[k] = order
            found = _order_room(walls, radius, length, base, before, legs[k], order, finest, longest_step)
            if found >= least or order == TOGETHER:
                break
        room = min(room, found)
        if room < least:
            return BLOCKED
        before[0], before[1] = legs[k, 0], legs[k, 1]
        move_along(base, u, v, legs[k, 2], base)
    return room
