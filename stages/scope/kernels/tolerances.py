"""How far advance, twist and bend of a step may err before the body has no room left."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.scope.kernels.body import along_setting, move_along, room_along

HALVINGS = 12
"""A tolerance is found to this power of a half of the most that is looked for."""
MOST_RAD = math.pi / 2.0
"""Larger errors of twist and bend are not looked for."""
MOST_MM = 10.0
"""Larger errors of an advance are not looked for."""
LONGEST_MM = 0.1
"""Longest step of the walk along a body; half of it is lost."""


@inner_kernel
def _spare(walls, radius, length, base, setting, far, growth, more):
    """Return the largest change `D` of curvature for which the places of an arc have room, 0 if none has.

    A place `s` mm from the base has to have (D / 2 + growth) s^2 mm.
    """
    u = setting[1] / length * math.cos(setting[0])
    v = setting[1] / length * math.sin(setting[0])
    if room_along(walls, radius, base, u, v, 0.0, far, 0.5 * more + growth, LONGEST_MM) >= 0.0:
        return more
    low, high = 0.0, more
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if room_along(walls, radius, base, u, v, 0.0, far, 0.5 * middle + growth, LONGEST_MM) >= 0.0:
            low = middle
        else:
            high = middle
    return low


@inner_kernel
def _beyond(walls, radius, base, u, v, far):
    """Return how much farther than `far` mm a section may go on along its arc."""
    if room_along(walls, radius, base, u, v, far, far + MOST_MM, 0.0, LONGEST_MM) >= 0.0:
        return MOST_MM
    low, high = 0.0, MOST_MM
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if room_along(walls, radius, base, u, v, far, far + middle, 0.0, LONGEST_MM) >= 0.0:
            low = middle
        else:
            high = middle
    return low


@kernel()
def step_tolerances(walls, radius, length, entry, states, finest, out):
    """Fill in by how much advance (mm), twist and bend (rad) may err in each step, `out` (M - 1, 3).

    Each holds for the whole step if all else is as stated.  A curvature vector that errs by D moves a place
    `s` mm from the base by no more than D s^2 / 2, where the section is and where it has laid the shaft
    in this step; a bend that errs by b has D = b / length, a twist that errs by t at the curvature kappa no
    more than kappa t.  A base that stands x mm before or behind its place, on an arc of curvature kappa,
    moves the place by no more than x (1 + kappa s).

    states : (M, 3) advance, twist and bend; finest : a change in place is looked at in pieces that move the
    tip by no more than this.
    """
    base, moved = entry.copy(), entry.copy()
    setting = np.zeros(2)
    laid = 0.0
    for n in range(states.shape[0] - 1):
        advance = states[n + 1, 0] - states[n, 0]
        kappa = max(abs(states[n, 2]), abs(states[n + 1, 2])) / length
        if advance > 0.0:
            setting[:] = states[n, 1:]
            u = setting[1] / length * math.cos(setting[0])
            v = setting[1] / length * math.sin(setting[0])
            spare = _spare(walls, radius, length, base, setting, length + advance, 0.0, MOST_RAD / length)
            out[n, 0] = _beyond(walls, radius, base, u, v, length + advance)
            move_along(base, u, v, advance, moved)
            base[:] = moved
            laid = abs(setting[1]) / length
        else:
            change = math.hypot(
                states[n + 1, 2] - states[n, 2], kappa * length * (states[n + 1, 1] - states[n, 1])
            )
            change /= length
            pieces = max(1, int(math.ceil(0.5 * change * length * length / finest)))
            spare, room = MOST_RAD / length, math.inf
            for m in range(pieces + 1):
                share = m / pieces
                setting[0] = states[n, 1] + share * (states[n + 1, 1] - states[n, 1])
                setting[1] = states[n, 2] + share * (states[n + 1, 2] - states[n, 2])
                # Between two pieces each place is within a quarter of their change of one of them.
                growth = 0.25 * change / pieces
                spare = _spare(walls, radius, length, base, setting, length, growth, spare)
                room = min(
                    room,
                    along_setting(walls, radius, length, base, setting[0], setting[1], growth, LONGEST_MM),
                )
            out[n, 0] = min(MOST_MM, max(room, 0.0) / (1.0 + max(kappa, laid) * length))
        out[n, 1] = min(MOST_RAD, spare / max(kappa, 1e-12))
        out[n, 2] = spare * length
