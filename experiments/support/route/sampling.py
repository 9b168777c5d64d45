"""RRT and RRT* whose samples are points of the centreline."""

from __future__ import annotations

import math

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel
from anatomy.kernels.random import uniform
from stages.scope.route.kernels.lumen import deep_enough


@inner_kernel
def _free(cones, index, cell_start, cell_cones, ax, ay, az, bx, by, bz, needed, look_mm):
    """Tell whether points every `look_mm` of a straight edge lie `needed` deep in the lumen."""
    length = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)
    count = max(int(math.ceil(length / look_mm)), 1)
    hint = -1
    for i in range(count + 1):
        t = i / count
        depth, _x, _y, _z, hint = deep_enough(
            cones,
            index,
            cell_start,
            cell_cones,
            hint,
            needed,
            ax + t * (bx - ax),
            ay + t * (by - ay),
            az + t * (bz - az),
        )
        if depth < needed:
            return False
    return True


@inner_kernel
def _distance(points, a, x, y, z):
    return math.sqrt((points[a, 0] - x) ** 2 + (points[a, 1] - y) ** 2 + (points[a, 2] - z) ** 2)


@inner_kernel
def _rewire(points, parent, cost, size, reach, near, gap, cones, index, cell_start, cell_cones, needed, look):
    """Choose the cheapest parent of the last vertex among its `reach` nearest, and lead these through it."""
    last = size - 1
    x, y, z = points[last, 0], points[last, 1], points[last, 2]
    found = 0
    for v in range(last):
        d = _distance(points, v, x, y, z)
        if found == reach and d >= gap[reach - 1]:
            continue
        at = min(found, reach - 1)
        while at > 0 and gap[at - 1] > d:
            gap[at] = gap[at - 1]
            near[at] = near[at - 1]
            at -= 1
        gap[at] = d
        near[at] = v
        found = min(found + 1, reach)
    for i in range(found):
        v = near[i]
        if cost[v] + gap[i] < cost[last] and _free(
            cones, index, cell_start, cell_cones, points[v, 0], points[v, 1], points[v, 2], x, y, z, needed,
            look,
        ):  # fmt: skip
            parent[last] = v
            cost[last] = cost[v] + gap[i]
    for i in range(found):
        v = near[i]
        gain = cost[v] - cost[last] - gap[i]
        if gain > 0.0 and _free(
            cones, index, cell_start, cell_cones, x, y, z, points[v, 0], points[v, 1], points[v, 2], needed,
            look,
        ):  # fmt: skip
            parent[v] = last
            cost[v] = cost[last] + gap[i]


@numba.njit(cache=True, nogil=True)
def grow(
    nodes, goal, cones, index, cell_start, cell_cones, numbers, reach, points, parent, cost, counts, state
):
    """Grow a tree until the goal is connected from a vertex that was not tried last, or samples run out.

    Parameters
    ----------
    nodes : (N, 3) float64
        What is sampled.
    goal : (3,) float64
    numbers : (4,) float64
        Depth needed in the lumen, longest edge, spacing of the tests of an edge, probability that a sample
        is followed by an attempt to connect the goal.
    reach : int
        Neighbours that RRT* looks at; 0 for RRT.
    points (V, 3), parent (V,), cost (V,)
        The tree so far; as many samples are taken as its arrays hold.
    counts : (3,) int64
        Vertices, samples taken, vertex that was last connected to the goal; continued from there.
    state : (1,) uint64
        Of the random numbers.

    Returns
    -------
    bool
        Whether the goal is connected; to the vertex `counts[2]`.
    """
    near = np.zeros(max(reach, 1), dtype=np.int64)
    gap = np.zeros(max(reach, 1))
    needed, step_mm, look_mm, try_goal = numbers
    size = counts[0]
    samples = points.shape[0] - 1
    best = 0
    while counts[1] < samples:
        counts[1] += 1
        node = min(int(uniform(state) * nodes.shape[0]), nodes.shape[0] - 1)
        x, y, z = nodes[node, 0], nodes[node, 1], nodes[node, 2]
        least = math.inf
        for v in range(size):
            d = _distance(points, v, x, y, z)
            if d < least:
                least = d
                best = v
        if least > 1e-9:
            share = min(step_mm / least, 1.0)
            px, py, pz = points[best, 0], points[best, 1], points[best, 2]
            x = px + share * (x - px)
            y = py + share * (y - py)
            z = pz + share * (z - pz)
            if _free(cones, index, cell_start, cell_cones, px, py, pz, x, y, z, needed, look_mm):
                points[size, 0] = x
                points[size, 1] = y
                points[size, 2] = z
                parent[size] = best
                cost[size] = cost[best] + share * least
                size += 1
                if reach > 0:
                    _rewire(points, parent, cost, size, reach, near, gap, cones, index, cell_start,
                            cell_cones, needed, look_mm)  # fmt: skip
        if uniform(state) < try_goal or counts[1] == samples:
            least = math.inf
            for v in range(size):
                d = _distance(points, v, goal[0], goal[1], goal[2])
                if d < least:
                    least = d
                    best = v
            if best != counts[2] and _free(
                cones, index, cell_start, cell_cones, points[best, 0], points[best, 1], points[best, 2],
                goal[0], goal[1], goal[2], needed, look_mm,
            ):  # fmt: skip
                counts[0] = size
                counts[2] = best
                return True
    counts[0] = size
    return False
