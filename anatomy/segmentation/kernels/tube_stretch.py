"""Short straight stretches of thin tube, sought in a CT by their contrast.

Volumes are `(nk, nj, ni)`, C-contiguous, with a border of two voxels or more that is neither lung nor lumen.
Points are in mm from the first voxel along these axes, `per_mm` is the number of voxels in a mm, `(3,)`
float64.
A stretch of tube is a straight line of `STATIONS` points with a ring of `ANGLES` points around each; its
heading is a unit vector.  Its contrast is how much brighter than the line the darkest side of the ring is,
each averaged along the whole stretch.  Noise falls with the square root of its length, and a groove between
vessels has a dark side.
"""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.segmentation.kernels.states import BANNED, LUMEN

STATIONS = 8
"""Points along a stretch: enough that the noise of their mean is a third of that of a voxel."""
STATION_MM = 0.65
"""A stretch is 5.2 mm long: airways as thin as this run so far between two forks."""
LENGTH_MM = STATIONS * STATION_MM
HALF = STATIONS // 2
ANGLES = 8
"""On a ring of two voxels' radius their spacing is that of the voxels."""
ACROSS = np.stack([f(2.0 * np.pi * np.arange(ANGLES) / ANGLES) for f in (np.cos, np.sin)])
OFFSETS_MM = np.vstack([np.zeros((1, 2)), 0.5 * ACROSS.T[::2], ACROSS.T])
"""Where a stretch may begin beside the point it is sought from: the end of a lumen is known to a voxel, and
the branches of a fork begin about 1 mm beside its middle."""
SHIFTS_MM = np.array([0.35, 0.175])
"""Both ends of the best stretch are moved to and fro by these: half the offsets, then half of that."""
END_COS = np.cos(np.radians(70.0))
"""A tube turns at the end of a lumen, which may be a fork, by 70 degrees at most, as bronchi do."""
BRANCHES_COS = np.cos(np.radians(35.0))
"""Two branches of a fork part by at least this angle."""
CLEAR_MM = 3.9
"""A tube may lie beside the lumen for so much of its first stretch, near a fork."""
WALL_VOXELS = 2
"""Beyond that no lumen lies within so many voxels of a tube: there is room for walls, and no ring."""
NOTHING = -1e9
"""The contrast of no stretch, below that of any."""


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
def span_across(heading, u, v):
    """Fill `u` and `v` with unit vectors that are square to the unit vector `heading` and to each other."""
    least = 0
    for n in range(1, 3):
        if abs(heading[n]) < abs(heading[least]):
            least = n
    for n in range(3):
        u[n] = -heading[least] * heading[n]
    u[least] += 1.0
    length = np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    for n in range(3):
        u[n] /= length
    v[0] = heading[1] * u[2] - heading[2] * u[1]
    v[1] = heading[2] * u[0] - heading[0] * u[2]
    v[2] = heading[0] * u[1] - heading[1] * u[0]


@inner_kernel
def darkest_side(ring):
    """Return the lowest mean of three neighbours in a ring, the middle one weighted twice."""
    least = 1e9
    for n in range(ANGLES):
        least = min(least, 0.25 * (ring[n - 1] + 2.0 * ring[n] + ring[(n + 1) % ANGLES]))
    return least


@inner_kernel
def contrast_of(hu, per_mm, begin, heading, radius_mm, work):
    """Return the contrast of a stretch, that of its worse half, and the mean of its ring above its line.

    A stretch whose first half has no contrast has none.  `work` is `(4, ANGLES)` float64.
    """
    u, v, ring, first = work[0, :3], work[1, :3], work[2], work[3]
    span_across(heading, u, v)
    ring[:] = 0.0
    line = 0.0
    first_line = 0.0
    for s in range(STATIONS):
        along = s * STATION_MM
        z, y, x = begin[0] + along * heading[0], begin[1] + along * heading[1], begin[2] + along * heading[2]
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
def allowed(heading, about, least_cos, other):
    """Tell whether a direction lies in the cone about one and keeps away from another, which may be zero."""
    inside = heading[0] * about[0] + heading[1] * about[1] + heading[2] * about[2] >= least_cos
    return inside and heading[0] * other[0] + heading[1] * other[1] + heading[2] * other[2] <= BRANCHES_COS


@inner_kernel
def is_free(state, lung, per_mm, begin, heading):
    """Tell whether a stretch lies in the lung, and after `CLEAR_MM` clear of lumen and what is banned."""
    along = 0.0
    while along <= LENGTH_MM:
        k = int(np.rint((begin[0] + along * heading[0]) * per_mm[0]))
        j = int(np.rint((begin[1] + along * heading[1]) * per_mm[1]))
        i = int(np.rint((begin[2] + along * heading[2]) * per_mm[2]))
        if (
            min(k, j, i) < WALL_VOXELS
            or max(k - lung.shape[0], j - lung.shape[1], i - lung.shape[2]) >= -WALL_VOXELS
        ):
            return False
        if not lung[k, j, i]:
            return False
        if along >= CLEAR_MM:
            if state[k, j, i] == BANNED:
                return False
            for c in range(k - WALL_VOXELS, k + WALL_VOXELS + 1):
                for b in range(j - WALL_VOXELS, j + WALL_VOXELS + 1):
                    for a in range(i - WALL_VOXELS, i + WALL_VOXELS + 1):
                        if state[c, b, a] == LUMEN:
                            return False
        along += 0.5 * STATION_MM
    return True


@inner_kernel
def best_stretch(
    hu, state, lung, per_mm, point, about, least_cos, other, directions, radii_mm, work, begin, heading
):  # fmt: skip
    """Find the stretch of tube of the greatest contrast that begins near a point.

    All `directions` in the cone about one are tried, from all `OFFSETS_MM`, with all radii; then both ends
    of the best are moved.  Fills `begin` and `heading`; returns contrast, that of the worse half, and mean of
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
                    heading[:] = turned
    if best == NOTHING:
        return best, half, mean
    for size in SHIFTS_MM:
        middle[:] = begin
        axis[:] = heading
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
                heading[:] = turned
    return best, half, mean


@kernel()
def best_contrasts(hu, state, lung, per_mm, points, headings, directions, radii_mm, out):
    """Write the contrast of the best stretch from each point in the cone about its heading, `(N, 3)` each."""
    work = np.zeros((8, ANGLES))
    begin, heading, nowhere = np.zeros(3), np.zeros(3), np.zeros(3)
    for n in range(len(points)):
        out[n] = best_stretch(
            hu, state, lung, per_mm, points[n], headings[n], END_COS, nowhere, directions, radii_mm, work,
            begin, heading,
        )[0]  # fmt: skip


@kernel()
def places_beside_bright(smooth, state, lung, stride, distance, bright_hu, out):
    """List voxels of the lung that lie beside something bright, far from the lumen, `(N, 3)` int64.

    Every `stride`-th voxel of the lung is tested.  No voxel within `distance` voxels, `(3,)` int64, is lumen.
    Returns how many were listed, at most as many as `out` has room for.
    """
    nk, nj, ni = smooth.shape
    count = 0
    wait = 0
    for k in range(distance[0], nk - distance[0]):
        for j in range(distance[1], nj - distance[1]):
            for i in range(distance[2], ni - distance[2]):
                if not lung[k, j, i]:
                    continue
                wait += 1
                if wait % stride != 0 or count == len(out):
                    continue
                if smooth[k - 1 : k + 2, j - 1 : j + 2, i - 1 : i + 2].max() < bright_hu:
                    continue
                free = True
                for c in range(k - distance[0], k + distance[0] + 1):
                    for b in range(j - distance[1], j + distance[1] + 1):
                        for a in range(i - distance[2], i + distance[2] + 1):
                            free = free and state[c, b, a] != LUMEN
                if free:
                    out[count, 0], out[count, 1], out[count, 2] = k, j, i
                    count += 1
    return count
