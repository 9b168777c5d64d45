"""Ends of a lumen and places behind them, and thin airways, followed from there stretch by stretch.

Volumes are `(nk, nj, ni)`, C-contiguous, with a border of two voxels or more that is neither lung nor lumen.
Points are in mm from the first voxel along these axes, `per_mm` is the number of voxels in a mm, `(3,)`
float64.
"""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.segmentation.kernels.states import LUMEN
from anatomy.segmentation.kernels.tube_stretch import ANGLES, END_COS, NOTHING, best_stretch

BACK_MM = np.array([3.0, 6.0])
"""The direction of an end is that from the middle of the lumen so far behind it: beyond the last voxels,
which are ragged, and before the next fork."""
SIDES = 6
"""So many places, so far apart, behind an end are searched for the other branch of a fork: over 9 mm, as long
as a thin branch."""
THIN_MM2 = 5.0
"""Only where the lumen has no larger section: beside wide airways lie corridors between vessels."""

TURN_COS = np.cos(np.radians(30.0))
"""A tube turns by 30 degrees at most from one stretch to the next: more would be a fork."""
DRIFT = 0.6
"""A place without a tube has about half of the contrast asked of one, and a tube as thin as a voxel 0.8."""
EVIDENCE = 1.3
"""Between three and four stretches of the contrast asked give so much, 9 mm; fewer may be chance."""
DEBT = 1.0
"""A gap may cost so much: where mucus, noise or a narrow place hides some mm of a tube."""
MOST_STRETCHES = 60
"""90 mm: longer than any airway goes on behind the lumen that is seen well."""


@inner_kernel
def trace(
    hu, state, lung, per_mm, end, about, other, directions, radii_mm, least_contrast, least_ring_hu,
    work, begin, heading, path,
):  # fmt: skip
    """Follow one tube from an end; fill `path`, `(N, 3)` mm, and return the number of its points.

    Stretch joins stretch.  Each adds to the evidence its contrast over `least_contrast`, less `DRIFT`.  The
    tube ends where the evidence is greatest, and no more is sought where it has fallen by `DEBT`: so a tube
    goes on beyond a gap if what lies there makes up for it.  The evidence has to reach `EVIDENCE`, the best
    stretch `least_contrast`, and every ring the mean `least_ring_hu`.
    """
    point, along, tail = np.zeros(3), np.zeros(3), np.zeros(3)
    point[:] = end
    along[:] = about
    path[0] = end
    size, found = 1, 0
    least_cos = END_COS
    evidence, most, greatest = 0.0, 0.0, 0.0
    while size <= MOST_STRETCHES and evidence >= most - DEBT:
        contrast, half, mean = best_stretch(
            hu, state, lung, per_mm, point, along, least_cos, other, directions, radii_mm, work,
            begin, heading,
        )  # fmt: skip
        if contrast == NOTHING or mean < least_ring_hu:
            break
        # No stretch alone, however dark, counts for more.
        evidence += min(contrast / least_contrast, 1.5) - DRIFT
        greatest = max(greatest, contrast)
        for k in range(3):
            # The next stretch begins so far along the one before: most of each is seen again.
            path[size, k] = begin[k] + 1.5 * heading[k]
        # Each half of the last stretch has this share of the contrast asked of a tube: no end is half a tube.
        if evidence > most and half >= 0.3 * least_contrast:
            most, found = evidence, size
            for k in range(3):
                # This much of the last stretch is airway: its end may lie beyond the end of the tube.
                tail[k] = begin[k] + 4.0 * heading[k]
        point[:] = path[size]
        along[:] = heading
        size += 1
        other = np.zeros(3)
        least_cos = TURN_COS
    # A tube that is followed is longer than one stretch.
    if found < 2 or most < EVIDENCE or greatest < least_contrast:
        return 0
    path[found + 1] = tail
    return found + 2


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


@kernel()
def follow_tubes(
    hu, state, lung, per_mm, spacing_mm, directions, radii_mm, least_contrast, least_ring_hu,
    starts, headings, others, n_starts, lumen, count,
):  # fmt: skip
    """Add to the lumen the thin airways that go on from its ends.

    Args:
        hu, state, lung ((nk, nj, ni) int16, uint8, bool): `state` holds LUMEN and BANNED, and is changed.
        per_mm, spacing_mm ((3,) float64): Voxels in a mm, and mm of a voxel.
        directions ((D, 3) float64): Unit vectors all around.
        radii_mm ((R,) float64): Radii of the ring.
        least_contrast (float): Contrast of the best stretch of an airway, HU.
        least_ring_hu (float): What a wall has at least, HU.
        starts, headings, others ((M, 3) float64): The first `n_starts` hold where a tube may begin, its
            direction, and one that it keeps away from, or zero.  Both ends of new tubes are filled in, as
            long as there is room.
        lumen ((V,) int64): Its first `count` entries list the lumen; the others are filled in.

    Returns:
        - count (int)
        - n_tubes (int)
    """
    work = np.zeros((8, ANGLES))
    begin, heading = np.zeros(3), np.zeros(3)
    path = np.zeros((MOST_STRETCHES + 3, 3))
    n_tubes = 0
    n = 0
    while n < n_starts:
        size = trace(
            hu, state, lung, per_mm, starts[n], headings[n], others[n], directions, radii_mm, least_contrast,
            least_ring_hu, work, begin, heading, path,
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
                if heading_between(
                    path[m - 1 if last else m], path[m if last else m + 1], headings[n_starts]
                ):
                    if not last:
                        others[n_starts] = headings[n_starts]
                    n_starts += 1
        n += 1
    return count, n_tubes


@kernel()
def walk_lumen(state, near, queue, known, parent, far):
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
def position_of(flat, shape, spacing_mm, point):
    """Write where a voxel lies, in mm."""
    point[0] = flat // (shape[1] * shape[2]) * spacing_mm[0]
    point[1] = flat // shape[2] % shape[1] * spacing_mm[1]
    point[2] = flat % shape[2] * spacing_mm[2]


@merged_kernel
def is_farthest(far, at, reach):
    """Tell whether no voxel within `reach` of one is farther from the start."""
    nk, nj, ni = far.shape
    here = far[at[0], at[1], at[2]]
    for c in range(max(at[0] - reach[0], 0), min(at[0] + reach[0] + 1, nk)):
        for b in range(max(at[1] - reach[1], 0), min(at[1] + reach[1] + 1, nj)):
            for a in range(max(at[2] - reach[2], 0), min(at[2] + reach[2] + 1, ni)):
                if far[c, b, a] > here:
                    return False
    return True


@merged_kernel
def section_mm2(far, point, spacing_mm):
    """Return about the cross-section of the lumen at a point: its volume in a box over the box's side."""
    # The section is measured in a box of five voxels: it holds the whole of a lumen that is thin.
    reach = 2
    low = np.zeros(3, dtype=np.int64)
    for n in range(3):
        low[n] = max(int(np.rint(point[n] / spacing_mm[n])) - reach, 0)
    side = 2 * reach + 1
    part = far[low[0] : low[0] + side, low[1] : low[1] + side, low[2] : low[2] + side]
    voxel_mm3 = spacing_mm[0] * spacing_mm[1] * spacing_mm[2]
    return (part > 0).sum() * voxel_mm3 ** (2.0 / 3.0) / side


@inner_kernel
def heading_between(begin, end, heading):
    """Write the unit vector from one point to another; return whether there is one."""
    norm = 0.0
    for n in range(3):
        heading[n] = end[n] - begin[n]
        norm += heading[n] * heading[n]
    if norm > 0.0:
        heading /= np.sqrt(norm)
    return norm > 0.0


@kernel()
def find_ends(far, lung, queue, known, count, parent, reach, spacing_mm, starts, headings, others):
    """List the ends of the lumen in the lung, and places behind them.

    Nothing within `reach`, `(3,)` int64, of an end is farther from the start; of voxels just as far one is an
    end.  Where the lumen behind is too short to have a direction, there is none.

    Fills `starts`, `(M, 3)` float64 mm, with the ends and then `SIDES` places behind each where the lumen is
    thin, as long as there is room; `headings`, the unit vectors in which these point, towards the end; and
    `others`, zero for an end, and the heading for places behind, from which another branch parts.
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
        if not lung[at[0], at[1], at[2]] or not is_farthest(far, at, reach):
            continue
        far[at[0], at[1], at[2]] += 1
        position_of(queue[q], far.shape, spacing_mm, starts[size])
        behind[:] = 0.0
        seen = 0
        walked = 0.0
        old[:] = starts[size]
        p = q
        while parent[p] >= 0 and walked < BACK_MM[1]:
            p = parent[p]
            position_of(queue[p], far.shape, spacing_mm, here)
            walked += np.sqrt(((here - old) ** 2).sum())
            old[:] = here
            if walked >= BACK_MM[0]:
                behind += here
                seen += 1
        if seen > 0 and heading_between(behind / seen, starts[size], headings[size]):
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
            position_of(queue[p], far.shape, spacing_mm, here)
            walked += np.sqrt(((here - old) ** 2).sum())
            old[:] = here
            # Thin branches part farther from each other than this: none is missed between two places.
            if walked >= (sides + 1) * 1.5:
                sides += 1
                starts[size] = here
                thin = section_mm2(far, here, spacing_mm) <= THIN_MM2
                if thin and heading_between(here, starts[n], headings[size]):
                    others[size] = headings[size]
                    size += 1
    return size
