"""Thin airways, seen along a stretch of tube and followed from the ends of a lumen.

Volumes are `(nk, nj, ni)`, C-contiguous, with a border of two voxels or more that is neither lung nor lumen.
Points are in mm from the first voxel along these axes, `per_mm` is the number of voxels in a mm, `(3,)`
float64.  A stretch of tube is a straight line of `STATIONS` points with a ring of `ANGLES` points around
each.  Its contrast is how much brighter than the line the darkest side of the ring is, each averaged along
the whole stretch: noise falls with the square root of its length, and a groove between vessels has a dark
side.
"""

from __future__ import annotations

import numba
import numpy as np

from anatomy.kernels.compiling import inner_kernel

LUMEN = np.uint8(1)
BANNED = np.uint8(2)

STATIONS = 8
STATION_MM = 0.65
"""A stretch is 5.2 mm long: airways as thin as this run so far between two forks."""
LENGTH_MM = STATIONS * STATION_MM
HALF = STATIONS // 2
ANGLES = 8
ACROSS = np.stack([f(2.0 * np.pi * np.arange(ANGLES) / ANGLES) for f in (np.cos, np.sin)])
OFFSETS_MM = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
"""Where a stretch may begin beside the point it is sought from."""
JIGGLE_MM = np.array([0.35, 0.175])
"""Both ends of the best stretch are moved by so much to and fro."""
END_COS, TURN_COS = np.cos(np.radians(70.0)), np.cos(np.radians(30.0))
"""How far a tube may turn at an end, which may be a fork, and from one stretch to the next."""
APART_COS = np.cos(np.radians(35.0))
"""Two branches of a fork part by at least this angle."""
CLEAR_MM = 3.9
"""A tube may lie beside the lumen for so much of its first stretch, near a fork."""
APART = 2
"""Beyond that no lumen lies within so many voxels of a tube: there is room for walls, and no ring."""
ADVANCE_MM = 1.5
"""The next stretch begins so far along the one before."""
TAIL_MM = 4.0
"""So much of the last stretch is airway."""
HALF_SHARE = 0.3
"""Each half of a stretch has at least this share of the contrast asked of it."""
HOLD_SHARE = 0.75
"""A stretch is added down to this share of the contrast asked of the best of its tube."""
LEAST_STRETCHES = 2
MOST_STRETCHES = 60
BACK_MM = np.array([3.0, 6.0])
"""The direction of an end is that from the middle of the lumen so far behind it."""
SIDE_MM = 1.5
SIDES = 6
"""So many places, so far apart, behind an end are searched for the other branch of a fork."""
THIN_REACH = 2
THIN_MM2 = 5.0
"""Only where the lumen has no larger section: beside wide airways lie corridors between vessels."""
NOTHING = -1e9


@inner_kernel
def value_at(hu, z, y, x):
    """Return the image between voxels, by linear interpolation; beyond its ends the value there."""
    z = min(max(z, 0.0), hu.shape[0] - 1.001)
    y = min(max(y, 0.0), hu.shape[1] - 1.001)
    x = min(max(x, 0.0), hu.shape[2] - 1.001)
    one = np.uint64(1)
    k, j, i = np.uint64(z), np.uint64(y), np.uint64(x)
    c, b, a = z - k, y - j, x - i
    low = (hu[k, j, i] * (1.0 - a) + hu[k, j, i + one] * a) * (1.0 - b)
    low += (hu[k, j + one, i] * (1.0 - a) + hu[k, j + one, i + one] * a) * b
    high = (hu[k + one, j, i] * (1.0 - a) + hu[k + one, j, i + one] * a) * (1.0 - b)
    high += (hu[k + one, j + one, i] * (1.0 - a) + hu[k + one, j + one, i + one] * a) * b
    return low * (1.0 - c) + high * c


@inner_kernel
def span_across(way, u, v):
    """Fill `u` and `v` with unit vectors that are square to the unit vector `way` and to each other."""
    least = 0
    for n in range(1, 3):
        if abs(way[n]) < abs(way[least]):
            least = n
    for n in range(3):
        u[n] = -way[least] * way[n]
    u[least] += 1.0
    length = np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    for n in range(3):
        u[n] /= length
    v[0] = way[1] * u[2] - way[2] * u[1]
    v[1] = way[2] * u[0] - way[0] * u[2]
    v[2] = way[0] * u[1] - way[1] * u[0]


@inner_kernel
def darkest_side(ring):
    """Return the lowest mean of three neighbours in a ring, the middle one weighted twice."""
    least = 1e9
    for n in range(ANGLES):
        least = min(least, 0.25 * (ring[n - 1] + 2.0 * ring[n] + ring[(n + 1) % ANGLES]))
    return least


@inner_kernel
def contrast_of(hu, per_mm, begin, way, radius_mm, work):
    """Return the contrast of a stretch, that of its worse half, and the mean of its ring above its line.

    A stretch whose first half has no contrast has none.  `work` is `(4, ANGLES)` float64.
    """
    u, v, ring, first = work[0, :3], work[1, :3], work[2], work[3]
    span_across(way, u, v)
    ring[:] = 0.0
    line = 0.0
    first_line = 0.0
    for s in range(STATIONS):
        along = s * STATION_MM
        z, y, x = begin[0] + along * way[0], begin[1] + along * way[1], begin[2] + along * way[2]
        line += value_at(hu, z * per_mm[0], y * per_mm[1], x * per_mm[2])
        for n in range(ANGLES):
            c, d = radius_mm * ACROSS[0, n], radius_mm * ACROSS[1, n]
            ring[n] += value_at(
                hu,
                (z + c * u[0] + d * v[0]) * per_mm[0],
                (y + c * u[1] + d * v[1]) * per_mm[1],
                (x + c * u[2] + d * v[2]) * per_mm[2],
            )
        if s == HALF - 1:
            first_line = line
            first[:] = ring
            if darkest_side(first) < line:
                return NOTHING, NOTHING, 0.0
    whole = (darkest_side(ring) - line) / STATIONS
    mean = ring.sum() / (ANGLES * STATIONS)
    half = (darkest_side(first) - first_line) / HALF
    ring -= first
    return whole, min(half, (darkest_side(ring) - line + first_line) / (STATIONS - HALF)), mean


@inner_kernel
def allowed(way, about, least_cos, other):
    """Tell whether a direction lies in the cone about one and keeps away from another, which may be zero."""
    inside = way[0] * about[0] + way[1] * about[1] + way[2] * about[2] >= least_cos
    return inside and way[0] * other[0] + way[1] * other[1] + way[2] * other[2] <= APART_COS


@inner_kernel
def is_free(state, lung, per_mm, begin, way):
    """Tell whether a stretch lies in the lung, and after `CLEAR_MM` apart from lumen and what is banned."""
    along = 0.0
    while along <= LENGTH_MM:
        k = int(np.rint((begin[0] + along * way[0]) * per_mm[0]))
        j = int(np.rint((begin[1] + along * way[1]) * per_mm[1]))
        i = int(np.rint((begin[2] + along * way[2]) * per_mm[2]))
        if min(k, j, i) < APART or max(k - lung.shape[0], j - lung.shape[1], i - lung.shape[2]) >= -APART:
            return False
        if not lung[k, j, i]:
            return False
        if along >= CLEAR_MM:
            if state[k, j, i] == BANNED:
                return False
            for c in range(k - APART, k + APART + 1):
                for b in range(j - APART, j + APART + 1):
                    for a in range(i - APART, i + APART + 1):
                        if state[c, b, a] == LUMEN:
                            return False
        along += 0.5 * STATION_MM
    return True


@inner_kernel
def best_stretch(
    hu, state, lung, per_mm, point, about, least_cos, other, directions, radii_mm, work, begin, way
):  # fmt: skip
    """Find the stretch of tube of the greatest contrast that begins near a point.

    All `directions` in the cone about one are tried, from all `OFFSETS_MM`, with all radii; then both ends
    of the best are moved.  Fills `begin` and `way`; returns contrast, that of the worse half, and mean of
    the ring.  `work` is `(8, ANGLES)` float64.
    """
    trial, turned, u, v, middle, axis = (
        work[4, :3], work[5, :3], work[6, :3], work[7, :3], work[6, 3:6], work[7, 3:6],
    )  # fmt: skip
    best, half, mean = NOTHING, NOTHING, 0.0
    radius_mm = radii_mm[0]
    for n in range(len(directions)):
        turned[:] = directions[n]
        if not allowed(turned, about, least_cos, other):
            continue
        span_across(turned, u, v)
        for m in range(len(OFFSETS_MM)):
            for k in range(3):
                trial[k] = point[k] + OFFSETS_MM[m, 0] * u[k] + OFFSETS_MM[m, 1] * v[k]
            for r in radii_mm:
                found = contrast_of(hu, per_mm, trial, turned, r, work)
                if found[0] > best and is_free(state, lung, per_mm, trial, turned):
                    best, half, mean = found
                    radius_mm = r
                    begin[:] = trial
                    way[:] = turned
    if best == NOTHING:
        return best, half, mean
    for size in JIGGLE_MM:
        middle[:] = begin
        axis[:] = way
        span_across(axis, u, v)
        for n in range(81):
            a, b, c, d = n % 3 - 1, n // 3 % 3 - 1, n // 9 % 3 - 1, n // 27 - 1
            norm = 0.0
            for k in range(3):
                trial[k] = middle[k] + size * (a * u[k] + b * v[k])
                turned[k] = LENGTH_MM * axis[k] + size * ((c - a) * u[k] + (d - b) * v[k])
                norm += turned[k] * turned[k]
            turned /= np.sqrt(norm)
            if not allowed(turned, about, least_cos, other):
                continue
            found = contrast_of(hu, per_mm, trial, turned, radius_mm, work)
            if found[0] > best and is_free(state, lung, per_mm, trial, turned):
                best, half, mean = found
                begin[:] = trial
                way[:] = turned
    return best, half, mean


@numba.njit(cache=True)
def best_contrasts(hu, state, lung, per_mm, points, ways, directions, radii_mm, out):
    """Write the contrast of the best stretch from each point in the cone about its way, `(N, 3)` each."""
    work = np.zeros((8, ANGLES))
    begin, way, nowhere = np.zeros(3), np.zeros(3), np.zeros(3)
    for n in range(len(points)):
        out[n] = best_stretch(
            hu, state, lung, per_mm, points[n], ways[n], END_COS, nowhere, directions, radii_mm, work,
            begin, way,
        )[0]  # fmt: skip


@numba.njit(cache=True)
def places_beside_bright(smooth, state, lung, stride, apart, bright_hu, out):
    """List voxels of the lung that lie beside something bright, far from the lumen, `(N, 3)` int64.

    Every `stride`-th voxel of the lung is looked at.  No voxel within `apart` voxels, `(3,)` int64, is lumen.
    Returns how many were listed, at most as many as `out` has room for.
    """
    nk, nj, ni = smooth.shape
    count = 0
    wait = 0
    for k in range(apart[0], nk - apart[0]):
        for j in range(apart[1], nj - apart[1]):
            for i in range(apart[2], ni - apart[2]):
                if not lung[k, j, i]:
                    continue
                wait += 1
                if wait % stride != 0 or count == len(out):
                    continue
                if smooth[k - 1 : k + 2, j - 1 : j + 2, i - 1 : i + 2].max() < bright_hu:
                    continue
                free = True
                for c in range(k - apart[0], k + apart[0] + 1):
                    for b in range(j - apart[1], j + apart[1] + 1):
                        for a in range(i - apart[2], i + apart[2] + 1):
                            free = free and state[c, b, a] != LUMEN
                if free:
                    out[count, 0], out[count, 1], out[count, 2] = k, j, i
                    count += 1
    return count


@numba.njit(cache=True)
def measure_way(state, near, queue, known, parent, far):
    """Walk through the lumen from the first `known` voxels of `queue`; all lists are as long as the lumen.

    Fills `queue` with the voxels in the order of their steps from the start, `parent` with the place in the
    queue where each came from, -1 at the start, and `far`, zero and as large as the image, with one more than
    the steps.  Returns the number of voxels.
    """
    for q in range(known):
        parent[q] = -1
        far[queue[q]] = 1
    head = 0
    tail = known
    while head < tail:
        at = queue[head]
        for d in near:
            if state[at + d] == LUMEN and far[at + d] == 0:
                far[at + d] = far[at] + 1
                parent[tail] = head
                queue[tail] = at + d
                tail += 1
        head += 1
    return tail


@inner_kernel
def place_of(flat, shape, spacing_mm, point):
    """Write where a voxel lies, in mm."""
    point[0] = flat // (shape[1] * shape[2]) * spacing_mm[0]
    point[1] = flat // shape[2] % shape[1] * spacing_mm[1]
    point[2] = flat % shape[2] * spacing_mm[2]


@inner_kernel
def is_last(far, at, reach):
    """Tell whether no voxel within `reach` of one is farther from the start."""
    nk, nj, ni = far.shape
    here = far[at[0], at[1], at[2]]
    for c in range(max(at[0] - reach[0], 0), min(at[0] + reach[0] + 1, nk)):
        for b in range(max(at[1] - reach[1], 0), min(at[1] + reach[1] + 1, nj)):
            for a in range(max(at[2] - reach[2], 0), min(at[2] + reach[2] + 1, ni)):
                if far[c, b, a] > here:
                    return False
    return True


@inner_kernel
def section_mm2(far, point, spacing_mm):
    """Return about the cross-section of the lumen at a point: its volume in a box over the box's side."""
    reach = THIN_REACH
    low = np.zeros(3, dtype=np.int64)
    for n in range(3):
        low[n] = max(int(np.rint(point[n] / spacing_mm[n])) - reach, 0)
    side = 2 * reach + 1
    part = far[low[0] : low[0] + side, low[1] : low[1] + side, low[2] : low[2] + side]
    voxel_mm3 = spacing_mm[0] * spacing_mm[1] * spacing_mm[2]
    return (part > 0).sum() * voxel_mm3 ** (2.0 / 3.0) / side


@inner_kernel
def point_away(begin, end, way):
    """Write the unit vector from one point to another; return whether there is one."""
    norm = 0.0
    for n in range(3):
        way[n] = end[n] - begin[n]
        norm += way[n] * way[n]
    if norm > 0.0:
        way /= np.sqrt(norm)
    return norm > 0.0


@numba.njit(cache=True)
def find_ends(far, lung, queue, known, count, parent, reach, spacing_mm, starts, ways, others):
    """List the ends of the lumen in the lung, and places behind them.

    Nothing within `reach`, `(3,)` int64, of an end is farther from the start; of voxels just as far one is an
    end.  Where the lumen behind is too short to have a direction, there is none.

    Fills `starts`, `(M, 3)` float64 mm, with the ends and then `SIDES` places behind each where the lumen is
    thin, as long as there is room; `ways`, the unit vectors in which these point, towards the end; and
    `others`, zero for an end, and the way for places behind, from which another branch parts.
    Returns their number.
    """
    _, nj, ni = far.shape
    size = 0
    at = np.zeros(3, dtype=np.int64)
    here, old, behind = np.zeros(3), np.zeros(3), np.zeros(3)
    of_end = np.zeros(len(starts), dtype=np.int64)
    for q in range(count - 1, known - 1, -1):
        if size == len(starts):
            break
        at[0], at[1], at[2] = queue[q] // (nj * ni), queue[q] // ni % nj, queue[q] % ni
        if not lung[at[0], at[1], at[2]] or not is_last(far, at, reach):
            continue
        far[at[0], at[1], at[2]] += 1
        place_of(queue[q], far.shape, spacing_mm, starts[size])
        behind[:] = 0.0
        seen = 0
        walked = 0.0
        old[:] = starts[size]
        p = q
        while parent[p] >= 0 and walked < BACK_MM[1]:
            p = parent[p]
            place_of(queue[p], far.shape, spacing_mm, here)
            walked += np.sqrt(((here - old) ** 2).sum())
            old[:] = here
            if walked >= BACK_MM[0]:
                behind += here
                seen += 1
        if seen > 0 and point_away(behind / seen, starts[size], ways[size]):
            of_end[size] = q
            size += 1
    n_ends = size
    for n in range(n_ends):
        walked = 0.0
        sides = 0
        old[:] = starts[n]
        p = of_end[n]
        while parent[p] >= 0 and sides < SIDES and size < len(starts):
            p = parent[p]
            place_of(queue[p], far.shape, spacing_mm, here)
            walked += np.sqrt(((here - old) ** 2).sum())
            old[:] = here
            if walked >= (sides + 1) * SIDE_MM:
                sides += 1
                starts[size] = here
                thin = section_mm2(far, here, spacing_mm) <= THIN_MM2
                if thin and point_away(here, starts[n], ways[size]):
                    others[size] = ways[size]
                    size += 1
    return size


@inner_kernel
def trace(
    hu, state, lung, per_mm, end, about, other, directions, radii_mm, least_contrast, least_ring_hu,
    work, begin, way, path,
):  # fmt: skip
    """Follow one tube from an end; fill `path`, `(N, 3)` mm, and return the number of its points.

    Stretch joins stretch while its contrast reaches `HOLD_SHARE` of `least_contrast`, that of each half
    `HALF_SHARE`, and the mean of its ring `least_ring_hu`.  The best of them has to reach `least_contrast`.
    """
    point, along = np.zeros(3), np.zeros(3)
    point[:] = end
    along[:] = about
    path[0] = end
    size = 1
    least_cos = END_COS
    greatest = 0.0
    for n in range(MOST_STRETCHES):
        contrast, half, mean = best_stretch(
            hu, state, lung, per_mm, point, along, least_cos, other, directions, radii_mm, work,
            begin, way,
        )  # fmt: skip
        held = contrast >= HOLD_SHARE * least_contrast and half >= HALF_SHARE * least_contrast
        if not held or mean < least_ring_hu:
            break
        greatest = max(greatest, contrast)
        for k in range(3):
            path[size, k] = begin[k] + ADVANCE_MM * way[k]
            path[size + 1, k] = begin[k] + TAIL_MM * way[k]
        size += 1
        point[:] = path[size - 1]
        along[:] = way
        other = np.zeros(3)
        least_cos = TURN_COS
        if n == MOST_STRETCHES - 1:
            break
    if size - 1 < LEAST_STRETCHES or greatest < least_contrast:
        return 0
    return size + 1


@inner_kernel
def draw(path, size, state, per_mm, spacing_mm, lumen, count):
    """Make the voxels along a path lumen, each a neighbour of the one before; return the new count."""
    nj, ni = state.shape[1], state.shape[2]
    flat = state.reshape(-1)
    step_mm = 0.25 * spacing_mm.min()
    for n in range(size - 1):
        length = np.sqrt(((path[n + 1] - path[n]) ** 2).sum())
        parts = int(length / step_mm) + 1
        for m in range(parts + 1):
            share = m / parts
            k = int(np.rint((path[n, 0] + share * (path[n + 1, 0] - path[n, 0])) * per_mm[0]))
            j = int(np.rint((path[n, 1] + share * (path[n + 1, 1] - path[n, 1])) * per_mm[1]))
            i = int(np.rint((path[n, 2] + share * (path[n + 1, 2] - path[n, 2])) * per_mm[2]))
            at = (k * nj + j) * ni + i
            if flat[at] != LUMEN and count < len(lumen):
                flat[at] = LUMEN
                lumen[count] = at
                count += 1
    return count


@numba.njit(cache=True)
def follow_tubes(
    hu, state, lung, per_mm, spacing_mm, directions, radii_mm, least_contrast, least_ring_hu,
    starts, ways, others, n_starts, lumen, count,
):  # fmt: skip
    """Add to the lumen the thin airways that go on from its ends.

    Parameters
    ----------
    hu, state, lung : (nk, nj, ni) int16, uint8, bool
        `state` holds LUMEN and BANNED, and is changed.
    per_mm, spacing_mm : (3,) float64
        Voxels in a mm, and mm of a voxel.
    directions : (D, 3) float64
        Unit vectors all around.
    radii_mm : (R,) float64
        Radii of the ring.
    least_contrast : float
        Contrast of the best stretch of an airway, HU.
    least_ring_hu : float
        What a wall has at least, HU.
    starts, ways, others : (M, 3) float64
        The first `n_starts` hold where a tube may begin, its direction, and one that it keeps away from, or
        zero.  Both ends of new tubes are filled in, as long as there is room.
    lumen : (V,) int64
        Its first `count` entries list the lumen; the others are filled in.

    Returns
    -------
    count : int
    n_tubes : int
    """
    work = np.zeros((8, ANGLES))
    begin, way = np.zeros(3), np.zeros(3)
    path = np.zeros((MOST_STRETCHES + 3, 3))
    n_tubes = 0
    n = 0
    while n < n_starts:
        size = trace(
            hu, state, lung, per_mm, starts[n], ways[n], others[n], directions, radii_mm, least_contrast,
            least_ring_hu, work, begin, way, path,
        )  # fmt: skip
        if size > 0:
            drawn = draw(path, size, state, per_mm, spacing_mm, lumen, count)
            if drawn == count:
                n += 1
                continue
            count = drawn
            n_tubes += 1
            for m in (0, size - 1):
                if n_starts == len(starts):
                    break
                starts[n_starts] = path[m]
                last = m == size - 1
                if point_away(path[m - 1 if last else m], path[m if last else m + 1], ways[n_starts]):
                    if not last:
                        others[n_starts] = ways[n_starts]
                    n_starts += 1
        n += 1
    return count, n_tubes
