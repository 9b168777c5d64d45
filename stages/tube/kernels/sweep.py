"""How far a body was from its final place during its deployment: sideways sweep, and error of following.

`bodies` (S, K, 3) are points of S deployments at K stops, mm; see `shapes.follow_all` for the others.
"""

import math

from anatomy.kernels.compiling import borrowing_kernel, merged_kernel


@borrowing_kernel
def _distance(bodies, one, other, j):
    x = bodies[one, j, 0] - bodies[other, j, 0]
    y = bodies[one, j, 1] - bodies[other, j, 1]
    z = bodies[one, j, 2] - bodies[other, j, 2]
    return math.sqrt(x * x + y * y + z * z)


@merged_kernel
def _bow(bodies, a, i, b, j, c, k):
    """Return the size of the second difference of three points."""
    total = 0.0
    for m in range(3):
        bow = bodies[a, i, m] - 2.0 * bodies[b, j, m] + bodies[c, k, m]
        total += bow * bow
    return math.sqrt(total)


@merged_kernel
def _off_track(bodies, other, j, final, last):
    """Return the distance of a point of a body to the final one, a polyline, near the same arc length."""
    best = math.inf
    for e in range(max(j - 3, 0), min(j + 3, last)):
        along, off, long2, gap2 = 0.0, 0.0, 0.0, 0.0
        for m in range(3):
            a = bodies[final, e + 1, m] - bodies[final, e, m]
            d = bodies[other, j, m] - bodies[final, e, m]
            along += a * d
            long2 += a * a
            gap2 += d * d
        share = min(max(along / long2, 0.0), 1.0)
        off = gap2 - 2.0 * share * along + share * share * long2
        best = min(best, off)
    return math.sqrt(max(best, 0.0))


@merged_kernel
def _diagonal_bow(bodies, states, parents, state):
    """Return the largest second difference, along the body, of how far points stray when the tip is there."""
    worst = 0.0
    ahead, at = state, parents[state]
    while at >= 0 and parents[at] >= 0:
        behind, j = parents[at], states[at, 0]
        total = 0.0
        for m in range(3):
            bow = bodies[ahead, j + 1, m] - 2.0 * bodies[at, j, m] + bodies[behind, j - 1, m]
            bow -= bodies[state, j + 1, m] - 2.0 * bodies[state, j, m] + bodies[state, j - 1, m]
            total += bow * bow
        worst = max(worst, math.sqrt(total))
        ahead, at = at, behind
    return worst


@borrowing_kernel
def sweep_of(bodies, states, parents, state, sagitta):
    """Return how far the body was from its final place, and from its final track, at any step.

    Points and steps are stops apart; what lies between is bounded by second differences: between three
    places a smooth curve strays from their chords by an eighth of it, and a kink by a quarter.
    """
    sweep = leader = bow = 0.0
    at = parents[state]
    later, latest = state, -1
    while at >= 0:
        for j in range(1, states[at, 0] + 1):
            strayed = _distance(bodies, at, state, j)
            sweep = max(sweep, strayed)
            if strayed > leader:
                off = _off_track(bodies, at, j, state, states[state, 0]) + sagitta
                leader = max(leader, min(strayed, off))
            if latest >= 0:
                bow = max(bow, _bow(bodies, at, j, later, j, latest, j))
        later, latest, at = at, later, parents[at]
    bow = 0.25 * max(bow, _diagonal_bow(bodies, states, parents, state))
    return sweep + bow, leader + bow
