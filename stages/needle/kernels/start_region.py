"""The proof that a needle reaches its target from every start pose near the planned one.

It follows one path of single arcs through fixed points, steered anew from every pose, and bounds how
far each place of it moves: docs/explanation/start_region.md has the derivation.  Stations cut the path into
cells, each with what is free around its middle.
"""

import math

import numpy as np

from anatomy.kernels.arcs import arc_to_point, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.field import MIN_GAP_MM, distance_bound, exact_distance
from anatomy.kernels.labels import LUMEN
from stages.needle.kernels.connections import least_cosine, seen_from
from stages.needle.kernels.proof import MIN_ARC_MM, TINY, WALL_ZONE_MM

CHORD, HALF_TURN, ARC_LENGTH, ARC_COLUMNS = 0, 1, 2, 3
ARC, BEGIN, END, HALF_CELL, FREE, FREE_AT_EXIT, LUMEN_DISTANCE, STATION_COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7

MOST_STATIONS = 4096
SHORTEST_CELL_MM, LONGEST_CELL_MM = 0.05, 1.0
SEARCHED_MM = 5.0
"""At the exit obstacles are looked for so far beyond the required clearance: no proved offset is larger."""
NEAR_MM = 3.0
"""Where less than this is free, the exact distance is taken instead of the bound."""
SPARE_MM = 2.0 * MIN_GAP_MM
"""The proof of a single arc gives up at `MIN_GAP_MM`; with this to spare it never has to."""
WIDEST_TILT_RAD = math.radians(60.0)

_NOBODY = np.int64(-1)
_LUMEN = np.int64(LUMEN)


@kernel()
def lay_stations(obstacles, limits, branch, start, points, arcs, stations):
    """Lay single arcs from a start `(6,)` through points `(K, 3)` and cut them into cells.

    `arcs` `(K, ARC_COLUMNS)` and `stations` `(MOST_STATIONS, STATION_COLUMNS)` receive them, all float64.
    Returned are the number of cells, 0 if an arc is missing or there are too many, and the largest angle to
    the direction at the start, rad.
    """
    count = 0
    least = 1.0
    before = 0.0
    pose = (start[0], start[1], start[2], start[3], start[4], start[5])
    for k in range(points.shape[0]):
        q = (points[k, 0], points[k, 1], points[k, 2])
        length, bend, turn = arc_to_point(pose, q)
        if not MIN_ARC_MM < length < math.inf or turn > math.pi:
            return 0, 0.0
        rho, h = seen_from(pose, q)
        arcs[k, CHORD] = math.hypot(rho, h)
        arcs[k, HALF_TURN] = 0.5 * turn
        arcs[k, ARC_LENGTH] = length
        forward = pose[3] * start[3] + pose[4] * start[4] + pose[5] * start[5]
        aside = bend[1] * start[3] + bend[2] * start[4] + bend[3] * start[5]
        least = min(least, least_cosine(forward, aside, turn))
        s = 0.0
        while s < length:
            if count == stations.shape[0]:
                return 0, 0.0
            x, y, z = point_on_arc(pose, bend, s)
            free = distance_bound(obstacles.clearance, obstacles.geometry, x, y, z) - limits.required_mm
            # Length of a cell as a share of what is free around it: half of that, 5 %, is lost in the proof.
            cell = min(max(0.1 * free, SHORTEST_CELL_MM), LONGEST_CELL_MM, length - s)
            if length - s - cell < 0.5 * SHORTEST_CELL_MM:
                cell = length - s
            _look(obstacles, limits, branch, pose, bend, s, s + cell, length, before, k, stations[count])
            count += 1
            s += cell
        before += length
        pose = pose_on_arc(pose, bend, length)
    return count, math.acos(min(max(least, -1.0), 1.0))


@inner_kernel
def _look(obstacles, limits, branch, pose, bend, begin, end, length, before, k, row):
    """Fill a cell with what is free around its middle."""
    clearance, labels, geometry, bits = obstacles
    required = limits.required_mm
    x, y, z = point_on_arc(pose, bend, 0.5 * (begin + end))
    free = distance_bound(clearance, geometry, x, y, z) - required
    if free < NEAR_MM:
        distance, _label = exact_distance(
            labels, geometry, x, y, z, bits, _NOBODY, required + free + 1.0 + MIN_GAP_MM
        )
        free = max(free, distance - required)
    row[ARC] = k
    row[BEGIN] = begin / length
    row[END] = end / length
    row[HALF_CELL] = 0.5 * (end - begin)
    row[FREE] = free
    row[FREE_AT_EXIT] = free
    row[LUMEN_DISTANCE] = free + required
    # A needle that starts elsewhere may be longer or shorter here: twice the exemption is looked at.
    if branch >= 0 and before + begin < 2.0 * limits.exempt_mm:
        cap = required + SEARCHED_MM
        distance, _label = exact_distance(labels, geometry, x, y, z, bits, branch, cap)
        row[FREE_AT_EXIT] = max(distance - required, free)
        lumen, _label = exact_distance(labels, geometry, x, y, z, _LUMEN, _NOBODY, cap)
        row[LUMEN_DISTANCE] = max(lumen, free + required)


@inner_kernel
def _x_cot(x):
    """Return `x cot x`."""
    return 1.0 - x * x / 3.0 if x < 1e-4 else x / math.tan(x)


@inner_kernel
def _sine_share(share, angle):
    """Return `sin(share * angle) / sin(angle)`."""
    return share if angle < 1e-8 else math.sin(share * angle) / math.sin(angle)


@kernel()
def displacement(chord, half_turn, begin, end, offset, tilt):
    """Bound how far the shares `begin` to `end` of an arc to a fixed point move.

    Its start moves by at most `offset`; then its direction is off by at most `tilt` from that of the arc
    that was turned and scaled about the fixed point.  `half_turn + tilt` is at most a quarter turn.
    """
    wide = half_turn + tilt
    along = _sine_share(end, wide)
    radial = (
        (_x_cot(begin * wide) - _x_cot(wide)) / wide if wide > 1e-4 else wide * (1.0 - begin * begin) / 3.0
    )
    swing = along * max(_sine_share(1.0 - begin, wide), math.hypot(radial, 1.0 - begin))
    return offset * _sine_share(1.0 - begin, half_turn) + (chord + offset) * tilt * swing


@inner_kernel
def region_kept(limits, branch, arcs, stations, count, angle, offset, tilt, worst):
    """Tell whether every start at most `offset` mm and `tilt` rad off has a clear path within all limits.

    `worst` (1,) int64 is the cell that failed the last time, which is looked at first.
    """
    if offset >= 0.5 * arcs[0, CHORD]:
        return False
    turned = math.asin(offset / arcs[0, CHORD])
    turn = longest = miss = less = 0.0
    for k in range(arcs.shape[0]):
        off = offset if k == 0 else 0.0
        wide = arcs[k, HALF_TURN] + tilt + (turned if k == 0 else 2.0 * turned)
        if wide > 0.5 * math.pi:
            return False
        length = (arcs[k, CHORD] + off) / _sine_over(wide)
        over = 2.0 * math.sin(wide) / (arcs[k, CHORD] - off) - limits.kappa * (1.0 - TINY)
        if over > 0.0:
            # The last arc may bend less than it should, and end beside the target.
            less = over * length
            miss = 0.5 * less * length
            if k < arcs.shape[0] - 1 or miss > limits.goal_tolerance_mm:
                return False
        turn += 2.0 * wide
        longest += length
    if longest > limits.max_length_mm or turn > limits.max_turn_rad:
        return False
    if min(turn, angle + 2.0 * (tilt + turned) + less) > limits.max_angle_rad:
        return False
    if not _cell_kept(limits, branch, arcs, stations[worst[0]], offset, tilt, turned, miss):
        return False
    for n in range(count):
        if not _cell_kept(limits, branch, arcs, stations[n], offset, tilt, turned, miss):
            worst[0] = n
            return False
    return True


@inner_kernel
def _sine_over(angle):
    """Return `sin(angle) / angle`."""
    return 1.0 - angle * angle / 6.0 if angle < 1e-4 else math.sin(angle) / angle


@inner_kernel
def _cell_kept(limits, branch, arcs, cell, offset, tilt, turned, miss):
    """Tell whether a cell is clear of what every path of the family may do there."""
    k = int(cell[ARC])
    off = offset if k == 0 else 0.0
    error = tilt + (turned if k == 0 else 2.0 * turned)
    needed = SPARE_MM + cell[HALF_CELL]
    needed += displacement(arcs[k, CHORD], arcs[k, HALF_TURN], cell[BEGIN], cell[END], off, error)
    if k == arcs.shape[0] - 1:
        needed += miss * cell[END] * cell[END]
    if cell[FREE] >= needed:
        return True
    if branch < 0 or cell[FREE_AT_EXIT] < needed:
        return False
    longest = 0.0
    for m in range(k + 1):
        wide = arcs[m, HALF_TURN] + tilt + (turned if m == 0 else 2.0 * turned)
        most = (arcs[m, CHORD] + (offset if m == 0 else 0.0)) / _sine_over(wide)
        longest += most * (cell[END] if m == k else 1.0)
    if longest >= limits.exempt_mm - SPARE_MM:
        return False
    kept = limits.radius_mm
    if limits.leaving_sine > 0.0:
        if longest < WALL_ZONE_MM - SPARE_MM:
            return True
        kept = min(kept, limits.leaving_sine * max(longest - WALL_ZONE_MM, 0.0))
    return cell[LUMEN_DISTANCE] - kept >= needed


@kernel(nogil=True)
def largest_factor(limits, branch, arcs, stations, count, angle, offset, tilt):
    """Return the largest factor, at most 1, by which an offset and a tilt are proved together."""
    worst = np.zeros(1, dtype=np.int64)
    if not region_kept(limits, branch, arcs, stations, count, angle, 0.0, 0.0, worst):
        return 0.0
    if region_kept(limits, branch, arcs, stations, count, angle, offset, tilt, worst):
        return 1.0
    low, high = 0.0, 1.0
    # Halvings of a factor: an offset of at most 5 mm is known to 0.002 mm.
    for _ in range(12):
        middle = 0.5 * (low + high)
        if region_kept(limits, branch, arcs, stations, count, angle, middle * offset, middle * tilt, worst):
            low = middle
        else:
            high = middle
    return low


@kernel(nogil=True)
def largest_tilts(limits, branch, arcs, stations, count, angle, offsets, tilts):
    """Fill `tilts` (K,) with the largest tilt in rad proved at rising `offsets` (K,); -1 where none is."""
    worst = np.zeros(1, dtype=np.int64)
    before = WIDEST_TILT_RAD
    for n in range(offsets.shape[0]):
        tilts[n] = -1.0
        if before < 0.0 or not region_kept(
            limits, branch, arcs, stations, count, angle, offsets[n], 0.0, worst
        ):
            before = -1.0
            continue
        low, high = 0.0, before
        # Halvings of the widest tilt: the largest is known to 0.004 degrees.
        for _ in range(14):
            middle = 0.5 * (low + high)
            if region_kept(limits, branch, arcs, stations, count, angle, offsets[n], middle, worst):
                low = middle
            else:
                high = middle
        tilts[n] = low
        before = high
