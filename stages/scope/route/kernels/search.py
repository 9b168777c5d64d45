"""Breadth-first search over the nearest nodes of a centreline."""

import numpy as np

from anatomy.kernels.compiling import kernel


@kernel()
def breadth_first(start, links, source, goal):
    """Return the nodes from `source` to `goal` with the fewest hops, empty if there is none.

    `links[start[n]:start[n + 1]]` are the neighbours of node n, nearest first.
    """
    came_from = np.full(start.shape[0] - 1, -1, dtype=np.int64)
    queue = np.zeros(start.shape[0] - 1, dtype=np.int64)
    queue[0] = source
    came_from[source] = source
    head = 0
    tail = 1
    while head < tail and came_from[goal] < 0:
        node = queue[head]
        head += 1
        for at in range(start[node], start[node + 1]):
            other = links[at]
            if came_from[other] < 0:
                came_from[other] = node
                queue[tail] = other
                tail += 1
    if came_from[goal] < 0:
        return np.zeros(0, dtype=np.int64)
    count = 1
    node = goal
    while node != source:
        node = came_from[node]
        count += 1
    path = np.zeros(count, dtype=np.int64)
    node = goal
    for at in range(count - 1, -1, -1):
        path[at] = node
        node = came_from[node]
    return path
