"""Needle motion on SE(3) states, for planners that know no arcs.

A `state` is a tuple of seven floats: a position in mm and a unit quaternion x, y, z, w whose third axis
is the direction of insertion.  `origin` is the start of the needle as such a planner can know it, a tuple
of seven floats: its position, the direction from which the limit of the angle counts, and the length
inserted before.
"""

import math

import numpy as np

from anatomy.kernels.arcs import any_normal, point_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel
from stages.needle.kernels.cost import map_costs_on_arc
from stages.needle.kernels.proof import TINY, blocker_on_arc

# Typed: a kernel is compiled once more for every literal that it is called with.
_FIRST = np.bool_(True)


@kernel()
def state_of(frame):
    """Return the state of a frame (4, 4)."""
    xx, yy, zz = frame[0, 0], frame[1, 1], frame[2, 2]
    # The squares of the four components, four times each; the largest is safe to divide by.
    w4, x4, y4, z4 = 1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz
    yz, zx, xy = frame[2, 1] - frame[1, 2], frame[0, 2] - frame[2, 0], frame[1, 0] - frame[0, 1]
    syz, szx, sxy = frame[2, 1] + frame[1, 2], frame[0, 2] + frame[2, 0], frame[1, 0] + frame[0, 1]
    if w4 >= max(x4, y4, z4):
        q = (yz, zx, xy, w4)
    elif x4 >= max(y4, z4):
        q = (x4, sxy, szx, yz)
    elif y4 >= z4:
        q = (sxy, y4, syz, zx)
    else:
        q = (szx, syz, z4, xy)
    return frame[0, 3], frame[1, 3], frame[2, 3], *_unit(q)


@kernel()
def rolled(state, angle):
    """Return a state turned about its own third axis."""
    px, py, pz, x, y, z, w = state
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return px, py, pz, x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s


@kernel()
def _unit(q):
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


@kernel()
def axes(state):
    """Return the three axes of a state as tuples."""
    _px, _py, _pz, x, y, z, w = state
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@inner_kernel
def inserted_at(state, origin):
    """Return a length that the needle's length at a state is never below."""
    straight = math.sqrt(
        (state[0] - origin[0]) * (state[0] - origin[0])
        + (state[1] - origin[1]) * (state[1] - origin[1])
        + (state[2] - origin[2]) * (state[2] - origin[2])
    )
    return origin[6] + straight


@kernel()
def is_allowed(obstacles, limits, state, origin, branch):
    """Tell whether a needle's tip may have a state: clear, and within length and angle as far as it shows."""
    length = inserted_at(state, origin)
    _ex, _ey, (tx, ty, tz) = axes(state)
    cosine = tx * origin[3] + ty * origin[4] + tz * origin[5]
    if not (length <= limits.max_length_mm + TINY and cosine >= math.cos(limits.max_angle_rad) - 2.0 * TINY):
        return False
    pose = (state[0], state[1], state[2], tx, ty, tz)
    nx, ny, nz = any_normal(tx, ty, tz)
    return blocker_on_arc(obstacles, limits, pose, (0.0, nx, ny, nz), 0.0, length, branch) == 0


@inner_kernel
def _arc_from(state, c, s, curvature):
    """Return pose and bend of an arc from a state, towards the angle of cosine `c` and sine `s` about it."""
    ex, ey, ez = axes(state)
    pose = (state[0], state[1], state[2], ez[0], ez[1], ez[2])
    return pose, (curvature, c * ex[0] + s * ey[0], c * ex[1] + s * ey[1], c * ex[2] + s * ey[2])


@kernel()
def is_forbidden(costs, geometry, state, roll, curvature, length):
    """Tell whether an arc from a state meets a voxel of infinite cost, or leaves the grid."""
    pose, bend = _arc_from(state, math.cos(roll), math.sin(roll), curvature)
    return map_costs_on_arc(costs, geometry, pose, bend, length, _FIRST)[0] == math.inf


@kernel()
def proved_step(obstacles, limits, state, roll, curvature, length, origin, branch):
    """Return the state at the end of an arc, not a number where the arc is not proved clear.

    The arc bends towards the angle `roll` about the tip's axis, which the rotation does not keep: the
    end is the start turned about the arc's axis alone.  A negative length is no arc.
    """
    c, s = math.cos(roll), math.sin(roll)
    pose, bend = _arc_from(state, c, s, curvature)
    begin = inserted_at(state, origin)
    if not length >= 0.0 or blocker_on_arc(obstacles, limits, pose, bend, length, begin, branch) != 0:
        return math.nan, math.nan, math.nan, state[3], state[4], state[5], state[6]
    half = 0.5 * curvature * length
    bx, by, bw = -s * math.sin(half), c * math.sin(half), math.cos(half)
    _px, _py, _pz, x, y, z, w = state
    turned = (
        w * bx + x * bw - z * by,
        w * by + y * bw + z * bx,
        x * by - y * bx + z * bw,
        w * bw - x * bx - y * by,
    )
    return *point_on_arc(pose, bend, length), *_unit(turned)
