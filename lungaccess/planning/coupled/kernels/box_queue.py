"""The open boxes of a bound, the lowest first, and how they are divided; see `cost_bound`."""

import math

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER, ROTATION, costliest, split
from lungaccess.planning.coupled.kernels.cost_bound import bound_box
from lungaccess.planning.coupled.kernels.deployment_box import (
    ACROSS,
    AWAY,
    BOUND,
    BOX_COLUMNS,
    LOSS,
    SIDES,
    TIP,
    UP,
    WIDE,
)

MOST_BOXES = 1_000_000
"""Boxes that may wait; they take 150 MB."""
WAITING, UNUSED = 0, 1
"""Of the numbers of a queue: boxes that wait, and rows that hold none."""
ENDED, EMPTY, FULL, WHOLE = 0, 1, 2, 3
"""Why dividing ended: after so many boxes; none is below the limit; no row is left; the lowest is small."""
BEGUN_MM = 40.0
"""Tips differ by less in the boxes with which a bound begins."""
MOST_STACKED = 200
SMALL_MM = 0.005
"""Sides that make less difference are not halved."""


@inner_kernel
def _push(boxes, heap, numbers, row):
    at = numbers[WAITING]
    numbers[WAITING] += 1
    while at > 0:
        above = (at - 1) // 2
        if boxes[heap[above], BOUND] <= boxes[row, BOUND]:
            break
        heap[at] = heap[above]
        at = above
    heap[at] = row


@inner_kernel
def _pop(boxes, heap, numbers):
    lowest = heap[0]
    numbers[WAITING] -= 1
    count = numbers[WAITING]
    row, at = heap[count], 0
    while True:
        below = 2 * at + 1
        if below >= count:
            break
        if below + 1 < count and boxes[heap[below + 1], BOUND] < boxes[heap[below], BOUND]:
            below += 1
        if boxes[row, BOUND] <= boxes[heap[below], BOUND]:
            break
        heap[at] = heap[below]
        at = below
    heap[at] = row
    return lowest


@kernel(nogil=True)
def begin_queue(environment, tubes, insertions, tips, target, longest, limit, first, last, state):
    """Let boxes wait that hold all deployments whose bound may be below a limit, from tips `first` to `last`.

    Boxes of more than BEGUN_MM are divided at once, depth first.  Before `longest` (the greatest insertion,
    mm) stand the arguments of `bound_box`.

    Args:
        first, last (int): Rows of tips, without the last; those of the first call begin with 0.
        state (tuple of arrays): Boxes (N, BOX_COLUMNS) float64, heap (N,) and unused rows (N,) int64, and
            numbers (2,) int64.

    Returns:
        bool: False if there was no room for all.
    """
    boxes, heap, unused, numbers = state
    if first == 0:
        numbers[WAITING], numbers[UNUSED] = 0, 0
        for row in range(len(boxes) - 1, -1, -1):
            unused[numbers[UNUSED]] = row
            numbers[UNUSED] += 1
    stack = np.zeros((MOST_STACKED, BOX_COLUMNS))
    for n in range(first, last):
        box = stack[0]
        box[:] = 0.0
        box[TIP], box[HALF + ROTATION] = n, math.pi
        box[OUTER] = box[INNER] = box[HALF + OUTER] = box[HALF + INNER] = 0.5 * longest
        box[HALF + ACROSS] = box[HALF + UP] = -1.0
        stacked = 1
        while stacked > 0:
            box = stack[stacked - 1]
            box[BOUND] = bound_box(environment, tubes, insertions, tips, target, limit, box, False)
            if box[BOUND] >= limit:
                stacked -= 1
                continue
            if box[AWAY] > BEGUN_MM and stacked < MOST_STACKED:
                split(box, stack[stacked], costliest(box, LOSS, SIDES))
                stacked += 1
                continue
            if numbers[UNUSED] == 0:
                return False
            numbers[UNUSED] -= 1
            row = unused[numbers[UNUSED]]
            boxes[row] = box
            _push(boxes, heap, numbers, row)
            stacked -= 1
    return True


@kernel(nogil=True)
def divide(environment, tubes, insertions, tips, target, most, limit, state):
    """Divide the box of the lowest bound, and so on, at most so many times.

    Boxes whose bounds are as high as the limit are left out; it ends once there is no other.  For the other
    arguments see `begin_queue`.

    Returns:
        tuple of (int, int): ENDED, EMPTY, FULL or WHOLE, and how many were divided.
    """
    boxes, heap, unused, numbers = state
    for done in range(most):
        if numbers[WAITING] == 0 or boxes[heap[0], BOUND] >= limit:
            return EMPTY, done
        if numbers[UNUSED] < 1:
            return FULL, done
        row = _pop(boxes, heap, numbers)
        floor = boxes[row, BOUND]
        other = unused[numbers[UNUSED] - 1]
        side, halves = costliest(boxes[row], LOSS, SIDES), 2
        if boxes[row, LOSS + side] < SMALL_MM:
            _push(boxes, heap, numbers, row)
            return WHOLE, done
        same_tubes = side <= UP
        if same_tubes and boxes[row, HALF + ACROSS] < 0.0:  # From now on paths are told apart halfway.
            boxes[row, HALF + ACROSS] = boxes[row, HALF + UP] = boxes[row, WIDE]
            halves = 1
        else:
            numbers[UNUSED] -= 1
            split(boxes[row], boxes[other], side)
        for part in range(halves):
            at = row if part == 0 else other
            box = boxes[at]
            bound = bound_box(environment, tubes, insertions, tips, target, limit, box, same_tubes)
            box[BOUND] = max(bound, floor)
            if boxes[at, BOUND] < limit:
                _push(boxes, heap, numbers, at)
            else:
                unused[numbers[UNUSED]] = at
                numbers[UNUSED] += 1
    return ENDED, most
