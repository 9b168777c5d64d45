"""The planar shape of deployed tubes, in closed form, its sideways sweep, and the insertions that it allows.

A straight outer tube and an inner tube with a precurved distal part, rotated together, need no torsion: the
centreline consists of arcs in one plane [Kuntz2015, sec. IV-B].  `tubes` is a `(N_TUBES,)` float64 array of
the numbers below: curvatures in 1/mm, lengths in mm, the angle in rad.
"""

import math

from anatomy.kernels.arcs import sine_length, versine_length
from anatomy.kernels.compiling import inner_kernel, kernel

OVERLAP_CURVATURE, INNER_CURVATURE, CURVED_LENGTH, OUTER_RADIUS, INNER_RADIUS, MARGIN = range(6)
MIN_WALL_ANGLE, MAX_SWEEP, MAX_EXTENSION, MAX_PROTRUSION, MAX_WALL_RUN, N_TUBES = range(6, 12)

SWEEP_SAMPLES = 100
"""Samples of the sweep between its two sharp peaks; it is smooth there, and they are computed exactly."""


@kernel()
def planar_point(tubes, outer, inner, s):
    """Return (aside, ahead) of the centreline at arc length `s` for given insertions, in mm.

    The inner tube is curved over its last CURVED_LENGTH mm.  Inside the outer tube the two share the
    curvature `kappa E_i I_i / (E_i I_i + E_o I_o)`; beyond it the inner has its own.
    """
    straight = min(max(inner - tubes[CURVED_LENGTH], 0.0), s)
    shared = min(max(outer - straight, 0.0), s - straight)
    free = s - straight - shared
    angle = tubes[OVERLAP_CURVATURE] * shared
    aside = versine_length(tubes[OVERLAP_CURVATURE], shared)
    ahead = straight + sine_length(tubes[OVERLAP_CURVATURE], shared)
    out = versine_length(tubes[INNER_CURVATURE], free)
    along = sine_length(tubes[INNER_CURVATURE], free)
    aside += math.sin(angle) * along + math.cos(angle) * out
    ahead += math.cos(angle) * along - math.sin(angle) * out
    return aside, ahead


@inner_kernel
def off_track(tubes, outer, inner, tip):
    """Return how far the point at arc length `tip` ends up from where the tip first got there, in mm."""
    x0, z0 = planar_point(tubes, min(tip, outer), tip, tip)
    x1, z1 = planar_point(tubes, outer, inner, tip)
    return math.hypot(x1 - x0, z1 - z0)


@kernel()
def lateral_sweep(tubes, outer, inner):
    """Return the largest distance of a point of the body, at any step, from its final place, in mm.

    Steps as in [Kuntz2015]: both tubes to `outer` with flush tips, then the inner to `inner`.  While the
    straight part of the inner tube moves out, the bend behind it opens steadily, so each point is
    farthest from its final place when the tip first gets there: the sweep is also the error with which
    the tubes follow their leader.  While the tip is within the curved length of the scope it is 0.
    """
    return sampled_sweep(tubes, outer, inner, 1)


@inner_kernel
def sampled_sweep(tubes, outer, inner, every):
    """Return the lateral sweep at its two sharp peaks and at one of `every` samples of the rest: no more."""
    curved = tubes[CURVED_LENGTH]
    if inner <= curved:
        return 0.0
    # It peaks sharply where the straight part leaves the scope or the outer tube; elsewhere it is smooth.
    worst = off_track(tubes, outer, inner, curved)
    worst = max(worst, off_track(tubes, outer, inner, min(outer + curved, inner)))
    for m in range(every, SWEEP_SAMPLES + 1, every):
        worst = max(worst, off_track(tubes, outer, inner, inner * m / SWEEP_SAMPLES))
    return worst


INSERTION_STEP_MM = 0.05
"""The step of the outer tube in the table of greatest insertions."""


@inner_kernel
def sweep_slope(bend):
    """Return how fast the sweep may change with an insertion, mm a mm; `bend` (rad) is curvature x length.

    The sweep is the distance of two points: the tip when it first got there, and the body of the final
    shape.  Where the tip is sampled moves with the insertion by at most as much; the first point moves by at
    most 1 + `bend` with it, the second by 1; and the final shape at a fixed place changes by at most `bend`
    with each insertion, the first by `bend` with the outer.
    """
    return 2.0 + 3.0 * bend


@inner_kernel
def insertions_exist(tubes, insertions, outer, half_outer, inner, half_inner):
    """Tell whether ranges (middle, half width) hold insertions within the table of `greatest_insertions`."""
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
    """Find how far the inner tube may come out before it sweeps sideways too far, up to `longest` mm.

    Insertions `spacing` mm apart are tried; what lies between is bounded.  `insertions[m]` receives a length,
    mm, that is at least the greatest allowed one with the outer tube at m INSERTION_STEP_MM to (m + 1)
    INSERTION_STEP_MM.
    """
    curved = tubes[CURVED_LENGTH]
    slope = sweep_slope(max(abs(tubes[INNER_CURVATURE]), abs(tubes[OVERLAP_CURVATURE])) * curved)
    for m in range(len(insertions)):
        greatest = min(curved, longest)
        tried = int(math.ceil(INSERTION_STEP_MM / spacing))
        for n in range(tried):
            outer = (m + (n + 0.5) / tried) * INSERTION_STEP_MM
            inner = longest
            while inner > max(greatest, outer - spacing):
                # Samples of the sweep of which one is looked at for that table: the sweep peaks elsewhere.
                over = sampled_sweep(tubes, min(outer, inner), inner, 25) - tubes[MAX_SWEEP]
                # Half a spacing for the outer tube, and what the least step passes over.
                over -= 0.75 * slope * spacing
                if over <= 0.0:
                    greatest = inner
                    break
                inner -= max(over / slope, 0.25 * spacing)
        insertions[m] = min(greatest + spacing, longest)
