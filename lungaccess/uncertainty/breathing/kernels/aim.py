"""Where devices that are carried by a scope tip have to end, so that the moving target stays near their end.

A point e of the devices misses the target by norm(e - p(share)), p being the place where the target is in the
frame of the devices: p(share) = c + R'(x + share d(x) - c - share d(c)).
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel
from lungaccess.uncertainty.breathing.kernels.rigid import rate_bounds, turned


@kernel()
def _places(rigid, target, moves, begin, end, out):
    """Fill `out` (K, 3) with the places of the target in the frame of the devices, from share to share."""
    rotation, rate = np.zeros((3, 3)), np.zeros((3, 3))
    last = out.shape[0] - 1
    for n in range(last + 1):
        share = begin + (end - begin) * n / last
        turned(rigid.gradient, share, rotation, rate)
        for a in range(3):
            out[n, a] = rigid.centre[a]
            for b in range(3):
                lever = target[b] - rigid.centre[b] + share * (moves[b] - rigid.displacement[b])
                out[n, a] += rotation[b, a] * lever


@kernel()
def aim_between(rigid, target, moves, begin, end, samples, aim):
    """Fill `aim` (3,) with the middle of the two farthest places; return half their distance, and the miss.

    No end of the devices misses the target by less than the first at all of these shares; the aim misses it
    by the second at most, at the `samples` shares that are looked at.

    Args:
        rigid: Rigid.
        target, moves ((3,) float64): Place of the masks, LPS mm, and its displacement.
        begin, end (float): First and last share.
    """
    places = np.zeros((samples, 3))
    _places(rigid, target, moves, begin, end, places)
    most, first, second = -1.0, 0, 0
    for n in range(samples):
        for m in range(n + 1, samples):
            square = 0.0
            for a in range(3):
                square += (places[n, a] - places[m, a]) ** 2
            if square > most:
                most, first, second = square, n, m
    for a in range(3):
        aim[a] = 0.5 * (places[first, a] + places[second, a])
    miss = 0.0
    for n in range(samples):
        square = 0.0
        for a in range(3):
            square += (places[n, a] - aim[a]) ** 2
        miss = max(miss, square)
    return 0.5 * math.sqrt(max(most, 0.0)), math.sqrt(miss)


@kernel()
def most_shares(rigid, target, moves, begin, end, samples, tolerance):
    """Return a length of shares that no end of the devices exceeds with a miss within the tolerance.

    Along the line from the first to the last place the target goes by at least its least step less what its
    acceleration, at most norm(R'') lever + 2 norm(R') norm(d(x) - d(c)), makes of it between two samples.
    """
    places = np.zeros((samples, 3))
    _places(rigid, target, moves, begin, end, places)
    most = max(abs(begin), abs(end))
    rate, change = rate_bounds(rigid.gradient, most)
    lever, apart, chord = 0.0, 0.0, 0.0
    for a in range(3):
        lever += (target[a] - rigid.centre[a]) ** 2
        apart += (moves[a] - rigid.displacement[a]) ** 2
        chord += (places[samples - 1, a] - places[0, a]) ** 2
    apart, chord = math.sqrt(apart), math.sqrt(chord)
    step = (end - begin) / (samples - 1)
    if not chord > 0.0:
        return end - begin
    slowest = math.inf
    for n in range(samples - 1):
        ahead = 0.0
        for a in range(3):
            ahead += (places[n + 1, a] - places[n, a]) * (places[samples - 1, a] - places[0, a]) / chord
        slowest = min(slowest, ahead / step)
    slowest -= (change * (math.sqrt(lever) + most * apart) + 2.0 * rate * apart) * step
    return min(2.0 * tolerance / slowest, end - begin) if slowest > 0.0 else end - begin
