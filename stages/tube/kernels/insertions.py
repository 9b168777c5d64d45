"""Which insertions of the tubes there are: how the sideways sweep bounds them, all over a range."""

import math

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.tube.kernels.planar import (
    CURVED_LENGTH,
    INNER_CURVATURE,
    MAX_PROTRUSION,
    MAX_SWEEP,
    OVERLAP_CURVATURE,
    sampled_sweep,
)

INSERTION_STEP_MM = 0.05
"""The step of the outer tube in the table of greatest insertions."""

SAMPLED_EVERY = 25
"""Samples of the sweep of which one is looked at for that table: the sweep peaks elsewhere."""


@inner_kernel
def sweep_slope(bend):
    """Return how fast the lateral sweep may change with an insertion, mm a mm; `bend` (rad) is curvature x
    length.

    The sweep is the distance of two points: the tip when it first got there, and the body of the final
    shape.  Where the tip is sampled moves with the insertion by at most as much; the first point moves by at
    most 1 + `bend` with it, the second by 1; and the final shape at a fixed place changes by at most `bend`
    with each insertion, the first by `bend` with the outer.
    """
    return 2.0 + 3.0 * bend


@inner_kernel
def insertions_exist(tubes, insertions, outer, half_outer, inner, half_inner):
    """Tell whether ranges (middle and half width) hold insertions that are possible and sweep little.

    `insertions` is the table of `greatest_insertions`.
    """
    low_outer, high_outer = outer - half_outer, outer + half_outer
    low_inner = inner - half_inner
    if low_outer > inner + half_inner or low_inner - high_outer > tubes[MAX_PROTRUSION]:
        return False
    last = len(insertions) - 1
    first = min(max(int(low_outer / INSERTION_STEP_MM), 0), last)
    longest = 0.0
    for m in range(first, min(int(high_outer / INSERTION_STEP_MM), last) + 1):
        longest = max(longest, insertions[m])
    return low_inner <= longest


@kernel(nogil=True)
def greatest_insertions(tubes, longest, spacing, insertions):
    """Find how far the inner tube may come out before it sweeps sideways too far.

    Args:
        tubes: (N_TUBES,) float64.
        longest (float): Greatest insertion at all, mm.
        spacing (float): Of the insertions that are tried; what lies between is bounded, mm.
        insertions ((N,) float64): `insertions[m]` receives a length, mm, that is at least the greatest
            allowed one with the outer tube at m INSERTION_STEP_MM to (m + 1) INSERTION_STEP_MM.
    """
    curved = tubes[CURVED_LENGTH]
    most = max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE]))
    slope = sweep_slope(most * curved)
    for m in range(len(insertions)):
        greatest = min(curved, longest)
        tried = int(math.ceil(INSERTION_STEP_MM / spacing))
        for n in range(tried):
            outer = (m + (n + 0.5) / tried) * INSERTION_STEP_MM
            inner = longest
            while inner > max(greatest, outer - spacing):
                over = sampled_sweep(tubes, min(outer, inner), inner, SAMPLED_EVERY) - tubes[MAX_SWEEP]
                # Half a spacing for the outer tube, and what the least step passes over.
                over -= 0.75 * slope * spacing
                if over <= 0.0:
                    greatest = inner
                    break
                inner -= max(over / slope, 0.25 * spacing)
        insertions[m] = min(greatest + spacing, longest)
