"""Where nested tubes begin, end and bend: the pieces in which their mechanics is smooth.

Units mm, N, rad.  A `design` is the tuple of `stiffness` (b, 2) float64, bending and torsional stiffness in
N mm^2 of each body where it is plain; `lengths` (b,) float64; and `bends` (m, 6) float64, the stretches that
are not straight and plain: body, begin and end by arc length from the body's rear end, precurvature in 1/mm,
its direction in rad, and bending stiffness as a share of the plain one.  `beta` (b,) float64 is where the
rear ends are, 0 or less; the front plate is at 0.

The first n bodies are the tubes, innermost first, each with an angle.  Bodies after them are straight, such
as a needle in the tubes: they add bending stiffness where they lie, and as turning them changes nothing they
have no angle.
"""

import math

import numpy as np

from anatomy.kernels.compiling import kernel, merged_kernel

SHORTEST_PIECE_MM = 1e-9
"""Shorter pieces are rounding and are left out."""

# Columns of `pieces`: arc lengths of both ends; 1 / the sum of bending stiffnesses; how many tubes are bent
# here; the only one if it is one; number of steps.  After them follows the bending stiffness of each body
# here, 0 where it is not.
NEAR, FAR, SOFTNESS, BENT, BENT_TUBE, STEPS, PIECE_COLUMNS = range(7)


@merged_kernel
def _breakpoints(lengths, bends, beta, found):
    """Fill `found` (B,) with the arc lengths, rising from 0, where a body or bend ends; return how many."""
    count = 1
    found[0] = 0.0
    bodies = lengths.shape[0]
    for m in range(bodies + 2 * bends.shape[0]):
        if m < bodies:
            s = beta[m] + lengths[m]
        else:
            bend = bends[(m - bodies) // 2]
            s = beta[int(bend[0])] + bend[1 + (m - bodies) % 2]
        if s <= SHORTEST_PIECE_MM:
            continue
        at = count
        while found[at - 1] > s:
            found[at] = found[at - 1]
            at -= 1
        found[at] = s
        count += 1
    return count


@kernel()
def cut(design, beta, step, pieces, moments, directions):
    """Cut the tubes ahead of the front plate into pieces; return their number and that of all steps.

    The last piece ends where the last tube does, even if a straight body goes on.  A step spans at most the
    angle `step`, in rad of the fastest torsional oscillation of a piece.

    Args:
        pieces ((1 + b + 2 m, PIECE_COLUMNS + b) float64): Is filled, the nearest piece first.
        moments, directions ((1 + b + 2 m, n) float64): Are filled: bending stiffness times precurvature in N
            mm of each tube in each piece, 0 where it is straight or not there, and its direction in rad.
    """
    stiffness, lengths, bends = design
    found = np.zeros(1 + lengths.shape[0] + 2 * bends.shape[0])
    n_found = _breakpoints(lengths, bends, beta, found)
    count = last = 0
    for m in range(1, n_found):
        if found[m] - found[last] < SHORTEST_PIECE_MM:
            continue
        piece = pieces[count]
        piece[NEAR], piece[FAR] = found[last], found[m]
        last = m
        middle = 0.5 * (piece[NEAR] + piece[FAR])
        if not _fill(design, beta, middle, piece[PIECE_COLUMNS:], moments[count], directions[count]):
            break
        total = 0.0
        for i in range(lengths.shape[0]):
            total += piece[PIECE_COLUMNS + i]
        piece[SOFTNESS] = 1.0 / total
        count += 1
    return count, _count_steps(stiffness, pieces, moments, count, step)


@merged_kernel
def _fill(design, beta, middle, bending, moments, directions):
    """Fill what bends the bodies at the arc length `middle`; return whether any tube is there."""
    stiffness, lengths, bends = design
    n = moments.shape[0]
    any_tube = False
    for i in range(lengths.shape[0]):
        there = beta[i] + lengths[i] > middle
        bending[i] = stiffness[i, 0] if there else 0.0
        if i < n:
            moments[i] = directions[i] = 0.0
            any_tube = any_tube or there
    for b in range(bends.shape[0]):
        i = int(bends[b, 0])
        if beta[i] + bends[b, 1] < middle < beta[i] + bends[b, 2]:
            bending[i] *= bends[b, 5]
            if i < n:
                moments[i] = bending[i] * bends[b, 3]
                directions[i] = bends[b, 4]
    return any_tube


@merged_kernel
def _count_steps(stiffness, pieces, moments, count, step):
    """Choose the number of steps of each piece by how fast torsion can change there; return their sum."""
    n, total = moments.shape[1], 0
    rate = fastest = 0.0
    for k in range(count - 1, -1, -1):
        piece = pieces[k]
        length = piece[FAR] - piece[NEAR]
        stiffest = turning = piece[BENT] = 0.0
        for i in range(n):
            if moments[k, i] == 0.0:
                continue
            piece[BENT] += 1.0
            piece[BENT_TUBE] = i
            coupling = own = 0.0
            for j in range(n):
                if j != i:
                    pull = piece[SOFTNESS] * moments[k, i] * moments[k, j]
                    coupling += pull * (1.0 / stiffness[i, 1] + 1.0 / stiffness[j, 1])
                    own += pull / stiffness[i, 1]
            stiffest = max(stiffest, coupling)
            turning = max(turning, own)
        fastest = max(fastest, stiffest)
        # No tube twists faster than this: what all pieces so far can give, and what their energy allows.
        rate = min(rate + turning * length, 2.0 * math.sqrt(fastest))
        piece[STEPS] = 1.0
        if piece[BENT] > 1.0:
            piece[STEPS] = math.ceil(length * max(math.sqrt(stiffest), rate) / step)
        total += int(piece[STEPS])
    return total
