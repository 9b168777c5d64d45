"""Tubes while a needle comes through them: the shapes that it bends them to, followed step by step."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.tube.kernels.pose import frames_at, lay
from stages.tube.kernels.shapes import largest_strain, reach

# Columns of a result: least determinant; largest strain of a tube, and of the needle ahead of the scope;
# how far the tubes are from where they are on arrival, before it and after it; then the tip's pose before
# the needle comes, on its arrival at the tubes' tip, and when it is inserted farthest.
LEAST, STRAIN, NEEDLE_STRAIN, SWEEP, SWEEP_AFTER = 0, 1, 2, 3, 4
BEFORE, ARRIVED, AFTER, ARRIVAL_COLUMNS = 5, 17, 29, 41


@inner_kernel
def _sweep(bodies, begin, end, final):
    """Return how far the places `begin` to `end` of a body are from the final one.

    What lies between two places is bounded by second differences, as in `sweep.sweep_of`.
    """
    sweep = bow = 0.0
    for at in range(begin, end):
        for j in range(bodies.shape[1]):
            off = bent = 0.0
            for m in range(3):
                off += (bodies[at, j, m] - bodies[final, j, m]) ** 2
                if at + 2 < end:
                    change = bodies[at, j, m] - 2.0 * bodies[at + 1, j, m] + bodies[at + 2, j, m]
                    bent += change * change
            sweep = max(sweep, off)
            bow = max(bow, bent)
    return math.sqrt(sweep) + 0.25 * math.sqrt(bow)


@kernel(nogil=True)
def arrive_all(design, strained, base_angles, beta, stop, beyond, step, tips, results):
    """Let a needle come through deployed tubes and go on beyond their tip.

    Args:
        design (tuple): See `assembly`: n tubes and, the last body, the needle.
        strained ((n + 1,) float64): Strain of each body for each 1/mm of change of curvature, mm.
        base_angles, beta ((M, n) float64): Deployments, rad and mm.
        stop (float): Largest motion of the needle between two looks on its way to the tubes' tip, mm.
        beyond ((K,) float64): How far it is beyond the tubes' tip in the looks after that, rising, mm.
        step (float): See `assembly.cut`.
        tips ((M, n) float64): Angles at the tubes' own ends before the needle comes; becomes those when it is
            inserted farthest.
        results ((M, ARRIVAL_COLUMNS) float64): Is filled; a least determinant of 0 or less says that the
            tubes snap.
    """
    n = base_angles.shape[1]
    needle_length = design[1][n]
    still = np.zeros(n)
    begin, end = np.zeros(n + 1), np.zeros(n + 1)
    for m in range(beta.shape[0]):
        out = beta[m, 0] + design[1][0]
        arrival = max(int(math.ceil(out / stop - 1e-9)), 1)
        looks = arrival + 1 + beyond.shape[0]
        bodies = np.zeros((looks, arrival, 3))
        found, angles, rates = np.zeros((arrival, 12)), np.zeros((arrival, n)), np.zeros((arrival, n))
        places = out * np.arange(1, arrival + 1) / arrival
        results[m] = 0.0
        results[m, LEAST] = 1.0
        begin[:n] = end[:n] = beta[m]
        begin[n] = -needle_length
        for look in range(looks):
            at = out * look / arrival if look <= arrival else out + beyond[look - arrival - 1]
            end[n] = at - needle_length
            least, cutting, nodes, steps = reach(design, base_angles[m], still, begin, end, step, tips[m])
            results[m, LEAST] = min(results[m, LEAST], least)
            if least <= 0.0:
                break
            begin[n] = end[n]
            poses = np.zeros((steps[0].shape[0] + 1, 12))
            lay(cutting, nodes, steps, poses)
            frames_at(cutting, nodes, steps, poses, places, found, angles, rates)
            bodies[look] = found[:, 9:]
            strain = largest_strain(design, strained[:n], end, cutting, nodes, steps, 0)
            results[m, STRAIN] = max(results[m, STRAIN], strain)
            strain = largest_strain(design, strained, end, cutting, nodes, steps, n)
            results[m, NEEDLE_STRAIN] = max(results[m, NEEDLE_STRAIN], strain)
            if look == 0:
                results[m, BEFORE:ARRIVED] = poses[-1]
            if look == arrival:
                results[m, ARRIVED:AFTER] = poses[-1]
            if look == looks - 1:
                results[m, AFTER:] = poses[-1]
                results[m, SWEEP] = _sweep(bodies, 0, arrival + 1, arrival)
                results[m, SWEEP_AFTER] = _sweep(bodies, arrival, looks, arrival)
