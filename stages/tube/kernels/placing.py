"""Where shapes fit in a patient: one by itself, and many with equal beginnings as a tree, each followed once.

`environment` and `trace` are those of `wall_exit`, `tubes` is the array of `planar`.

A node is a stretch of tube between two stops.  It lies where its first shape has it, in the frame of the
scope tip; the others that it stands for are within its `error`, which enters the clearance.
"""

import math

import numpy as np

from anatomy.kernels.arcs import point_on_arc
from anatomy.kernels.compiling import borrowing_kernel, kernel, merged_kernel
from stages.tube.kernels import planar, wall_exit
from stages.tube.kernels.shapes import CURVATURE, DIRECTION, LENGTH, RADIUS, bend_towards, carried

SAME_MM = 1e-9
# Columns of a stretch: point, tangent and normal where it begins, curvature, length, arc length there.
POINT, TANGENT, NORMAL, KAPPA, STRETCH_LENGTH, BEGINS, STRETCH_COLUMNS = 0, 3, 6, 9, 10, 11, 12
# Columns of a placed shape: shape, pierced branch, exit (mm along), wall angle (rad), run in the wall (mm).
PLACED_SHAPE, PLACED_BRANCH, PLACED_EXIT, PLACED_ANGLE, PLACED_RUN, PLACED_COLUMNS = range(6)


@kernel()
def cut_at_stops(arcs, stop, stretches, ends, middles, radii):
    """Cut one shape into stretches between stops, `stop` mm apart; return how many stretches there are.

    The stretches (rows, STRETCH_COLUMNS) are filled; a stop may have several.  For the stretch before each of
    K + 1 stops are filled where it ends, its middle `(K + 1, 3)`, and the outermost radius there.
    """
    pose, across = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    rows, at, place = 0, 0.0, 1
    for a in range(arcs.shape[0]):
        bend = bend_towards(pose, across, arcs[a, DIRECTION], arcs[a, CURVATURE])
        done, left = 0.0, arcs[a, LENGTH]
        here, sideways = pose, across
        while left > SAME_MM:
            half = (place - 0.5) * stop
            if at <= half <= at + left:
                middles[place, 0], middles[place, 1], middles[place, 2] = point_on_arc(here, bend, half - at)
                radii[place] = arcs[a, RADIUS]
            length = min(left, place * stop - at)
            if length > SAME_MM:
                row = stretches[rows]
                for m in range(6):
                    row[POINT + m] = here[m]
                for m in range(3):
                    row[NORMAL + m] = bend[1 + m]
                row[KAPPA], row[STRETCH_LENGTH], row[BEGINS] = bend[0], length, at
                rows += 1
            here, sideways = carried(here, sideways, bend, arcs[a, DIRECTION], length)
            bend = bend_towards(here, sideways, arcs[a, DIRECTION], arcs[a, CURVATURE])
            at += length
            done += length
            left = arcs[a, LENGTH] - done
            if at >= place * stop - SAME_MM:
                for m in range(3):
                    ends[place, m] = here[m]
                at = place * stop
                place += 1
        pose, across = here, sideways
    return rows


@merged_kernel
def _off(ends, middles, one, other, place):
    """Return how far two shapes are from each other between two stops, at most."""
    begin2 = middle2 = end2 = bow = 0.0
    for m in range(3):
        begin = ends[one, place - 1, m] - ends[other, place - 1, m]
        middle = middles[one, place, m] - middles[other, place, m]
        end = ends[one, place, m] - ends[other, place, m]
        begin2 += begin * begin
        middle2 += middle * middle
        end2 += end * end
        bow += (begin - 2.0 * middle + end) ** 2
    return math.sqrt(max(begin2, middle2, end2)) + 0.25 * math.sqrt(bow)


@kernel()
def grow(places, groups, ends, middles, radii, tolerance, nodes, errors, leaf):
    """Sort shapes into a tree of stretches that they share within a tolerance.

    Args:
        places ((S,) int64): At which stop each shape ends, 1 or more.
        groups ((S,) int64): Shapes of different groups share nothing.
        ends, middles, radii ((S, K + 1, 3), (S, K + 1, 3), (S, K + 1) float64): See `cut_at_stops`.
        tolerance (float): mm.
        nodes ((N, 4) int64): Is filled, N at most: parent, stop at its end, first shape, next of the parent.
        errors ((N,) float64): Is filled: how far others are from the first shape.
        leaf ((S,) int64): Is filled: the node at which each shape ends.

    Returns:
        int: Number of nodes, -1 if there is no room.
    """
    count = 0
    youngest = np.full(nodes.shape[0] + 1, -1)  # of the root first, then of each node
    for shape in range(places.shape[0]):
        parent = -1
        for place in range(1, places[shape] + 1):
            child, found, off = youngest[parent + 1], -1, 0.0
            while child >= 0 and found < 0:
                first = nodes[child, 2]
                if groups[first] == groups[shape] and radii[first, place] == radii[shape, place]:
                    off = _off(ends, middles, first, shape, place)
                    if off <= tolerance:
                        found = child
                child = nodes[child, 3]
            if found < 0:
                if count == nodes.shape[0]:
                    return -1
                found = count
                nodes[count, 0], nodes[count, 1], nodes[count, 2] = parent, place, shape
                nodes[count, 3] = youngest[parent + 1]
                youngest[parent + 1] = count
                errors[count] = 0.0
                count += 1
            else:
                errors[found] = max(errors[found], off)
            parent = found
        leaf[shape] = parent
    return count


@borrowing_kernel
def _seen(base, forward, row, at):
    """Return a vector of a stretch in the frame of the patient: `base` (9,) is +x, +y and +z of the scope."""
    x, y, z = row[at], row[at + 1], row[at + 2]
    return (
        base[0] * x + base[3] * y + forward[0] * z,
        base[1] * x + base[4] * y + forward[1] * z,
        base[2] * x + base[5] * y + forward[2] * z,
    )


@borrowing_kernel
def _place_turned(environment, tubes, frame, tree, wanted, before, reasons, traces, placed):
    """Follow shapes from one scope tip with one rotation of all tubes together; see `place_tree`.

    `before` (S + 1,) int64 begins with 0, and is filled: how many shapes before each are wanted.
    """
    depth, skip, first, stretches, radius, clearance, first_shape, shapes = tree
    for e in range(shapes.shape[0]):
        before[e + 1] = before[e] + wanted[shapes[e]]
    across = (frame[0, 0], frame[1, 0], frame[2, 0], frame[0, 1], frame[1, 1], frame[2, 1])
    forward = (frame[0, 2], frame[1, 2], frame[2, 2])
    wall_exit.reset(traces[0])
    count, node = 0, 0
    while node < depth.shape[0]:
        beneath = before[first_shape[skip[node]]] - before[first_shape[node]]
        if beneath == 0:
            node = skip[node]
            continue
        trace = traces[depth[node]]
        for m in range(trace.shape[0]):
            trace[m] = traces[depth[node] - 1, m]
        reason = wall_exit.ACCEPTED
        for r in range(first[node], first[node + 1]):
            row = stretches[r]
            x, y, z = _seen(across, forward, row, POINT)
            tx, ty, tz = _seen(across, forward, row, TANGENT)
            nx, ny, nz = _seen(across, forward, row, NORMAL)
            pose = (frame[0, 3] + x, frame[1, 3] + y, frame[2, 3] + z, tx, ty, tz)
            reason = wall_exit.march(
                environment, tubes, trace, pose, (row[KAPPA], nx, ny, nz), row[BEGINS], row[STRETCH_LENGTH],
                radius[node], clearance[node],
            )  # fmt: skip
            if reason != wall_exit.ACCEPTED:
                break
        if reason != wall_exit.ACCEPTED:
            reasons[reason] += beneath
            node = skip[node]
            continue
        for e in range(first_shape[node], first_shape[node + 1]):
            if not wanted[shapes[e]]:
                continue
            if trace[wall_exit.PHASE] != wall_exit.IN_TISSUE:
                reasons[wall_exit.NO_EXIT] += 1
                continue
            row = placed[count]
            row[PLACED_SHAPE], row[PLACED_BRANCH] = shapes[e], trace[wall_exit.BRANCH]
            row[PLACED_EXIT] = trace[wall_exit.LEFT_AT]
            row[PLACED_ANGLE], row[PLACED_RUN] = trace[wall_exit.WALL_ANGLE], trace[wall_exit.WALL_RUN]
            count += 1
        node += 1
    return count


@kernel(nogil=True)
def place_tree(environment, tubes, frames, tree, wanted, reasons, traces, placed, counts):
    """Follow shapes from one scope tip with T rotations of all tubes together.

    Of the tubes only the limits at the wall are looked at.  The tree is that of
    `stages.tube.design_shapes.ShapeTree.with_margin`, of which the `wanted` (T, S) are looked at from
    `frames` (T, 4, 4), the scope tip with +x where the tubes are turned to.  `reasons` counts the refused
    shapes; `placed` (T S, PLACED_COLUMNS) receives those that fit, one rotation after the other, and `counts`
    (T,) how many.
    """
    total, before = 0, np.zeros(wanted.shape[1] + 1, np.int64)
    for t in range(frames.shape[0]):
        rows = placed[total:]
        counts[t] = _place_turned(
            environment, tubes, frames[t], tree, wanted[t], before, reasons, traces, rows
        )
        total += counts[t]


@kernel(nogil=True, _nrt=False)
def validate_arcs(environment, tubes, base, normal, arcs, beside, trace, tip):
    """Validate a shape of any tubes from the scope tip pose `base`.

    Directions of `arcs` (a, ARC_COLUMNS) count from `normal`; `beside` mm beside radius and margins have to
    be free.  Fills `trace` and `tip` (9,): the pose of the tip, and the normal carried to it without turning.
    Returns a reason.
    """
    wall_exit.reset(trace)
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = (normal[0], normal[1], normal[2])
    clearance, at = tubes[planar.MARGIN] + beside, 0.0
    for a in range(arcs.shape[0]):
        length, direction, radius = arcs[a, LENGTH], arcs[a, DIRECTION], arcs[a, RADIUS]
        bend = bend_towards(pose, across, direction, arcs[a, CURVATURE])
        reason = wall_exit.march(environment, tubes, trace, pose, bend, at, length, radius, clearance)
        if reason != wall_exit.ACCEPTED:
            return reason
        pose, across = carried(pose, across, bend, direction, length)
        at += length
    for m in range(6):
        tip[m] = pose[m]
    for m in range(3):
        tip[6 + m] = across[m]
    return wall_exit.ACCEPTED if trace[wall_exit.PHASE] == wall_exit.IN_TISSUE else wall_exit.NO_EXIT


@borrowing_kernel
def tip_of_arcs(base, normal, arcs):
    """Return the pose at the end of a shape's arcs; see `validate_arcs`."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = (normal[0], normal[1], normal[2])
    for a in range(arcs.shape[0]):
        bend = bend_towards(pose, across, arcs[a, DIRECTION], arcs[a, CURVATURE])
        pose, across = carried(pose, across, bend, arcs[a, DIRECTION], arcs[a, LENGTH])
    return pose
