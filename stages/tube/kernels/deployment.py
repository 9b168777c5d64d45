"""Validation of one deployment.

`environment` and `trace` are those of `wall_exit`, `tubes` is the array of `planar`.
"""

from anatomy.kernels.compiling import inner_kernel, kernel
from stages.tube.kernels import planar, wall_exit
from stages.tube.kernels.shapes import CURVATURE, DIRECTION, LENGTH, RADIUS, bend_towards, carried


@kernel(nogil=True)
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
        length, direction = arcs[a, LENGTH], arcs[a, DIRECTION]
        bend = bend_towards(pose, across, direction, arcs[a, CURVATURE])
        reason = wall_exit.march(
            environment, tubes, trace, pose, bend, at, length, arcs[a, RADIUS], clearance
        )
        if reason != wall_exit.ACCEPTED:
            return reason
        pose, across = carried(pose, across, bend, direction, length)
        at += length
    for m in range(6):
        tip[m] = pose[m]
    for m in range(3):
        tip[6 + m] = across[m]
    return wall_exit.ACCEPTED if trace[wall_exit.PHASE] == wall_exit.IN_TISSUE else wall_exit.NO_EXIT


@inner_kernel
def tip_of_arcs(base, normal, arcs):
    """Return the pose at the end of a shape's arcs; see `validate_arcs`."""
    pose = (base[0], base[1], base[2], base[3], base[4], base[5])
    across = (normal[0], normal[1], normal[2])
    for a in range(arcs.shape[0]):
        bend = bend_towards(pose, across, arcs[a, DIRECTION], arcs[a, CURVATURE])
        pose, across = carried(pose, across, bend, arcs[a, DIRECTION], arcs[a, LENGTH])
    return pose
