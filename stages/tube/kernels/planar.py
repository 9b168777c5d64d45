"""The planar shape of deployed tubes, in closed form, and how they sweep sideways.

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
    worst = max(
        off_track(tubes, outer, inner, curved), off_track(tubes, outer, inner, min(outer + curved, inner))
    )
    for m in range(every, SWEEP_SAMPLES + 1, every):
        worst = max(worst, off_track(tubes, outer, inner, inner * m / SWEEP_SAMPLES))
    return worst
