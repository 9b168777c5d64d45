"""Thin airways, followed stretch by stretch from the ends of a lumen.

Volumes are `(nk, nj, ni)`, C-contiguous, with a border of two voxels or more that is neither lung nor lumen.
Points are in mm from the first voxel along these axes, `per_mm` is the number of voxels in a mm, `(3,)`
float64.
"""

import numpy as np

from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.segmentation.kernels.lumen_ends import heading_between
from anatomy.segmentation.kernels.states import LUMEN
from anatomy.segmentation.kernels.tube_stretch import ANGLES, END_COS, NOTHING, best_stretch

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
    starts, headings, others : (M, 3) float64
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
