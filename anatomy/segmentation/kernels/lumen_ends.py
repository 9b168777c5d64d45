"""The ends of a grown lumen, and the places behind them from which another branch may part.

Volumes are `(nk, nj, ni)`, C-contiguous, with a border of two voxels or more that is neither lung nor lumen.
Points are in mm from the first voxel along these axes, `per_mm` is the number of voxels in a mm, `(3,)`
float64.
"""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from anatomy.segmentation.kernels.states import LUMEN

BACK_MM = np.array([3.0, 6.0])
"""The direction of an end is that from the middle of the lumen so far behind it: beyond the last voxels,
which are ragged, and before the next fork."""
SIDES = 6
"""So many places, so far apart, behind an end are searched for the other branch of a fork: over 9 mm, as long
as a thin branch."""
THIN_MM2 = 5.0
"""Only where the lumen has no larger section: beside wide airways lie corridors between vessels."""


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
