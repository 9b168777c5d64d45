"""Circular arcs in space.

A `pose` is a tuple of six floats: a point and the unit tangent there.  A `bend` is a tuple of four:
the curvature in 1/mm and the unit normal towards the centre of curvature.  Lengths in mm.
"""

import math

from anatomy.kernels.compiling import kernel

SMALL_ANGLE = 1e-4
"""Below it the series is exact to double precision, and the quotient is not."""


@kernel()
def sine_length(kappa, s):
    """Return `sin(kappa s) / kappa`, the advance along the start tangent."""
    a = kappa * s
    if abs(a) < SMALL_ANGLE:
        return s * (1.0 - a * a / 6.0)
    return math.sin(a) / kappa


@kernel()
def versine_length(kappa, s):
    """Return `(1 - cos(kappa s)) / kappa`, the advance towards the bend."""
    a = kappa * s
    if abs(a) < SMALL_ANGLE:
        return 0.5 * s * a * (1.0 - a * a / 12.0)
    return (1.0 - math.cos(a)) / kappa


@kernel()
def any_normal(tx, ty, tz):
    """Return a unit vector perpendicular to a unit vector."""
    if abs(tx) < 0.6:
        nx, ny, nz = 0.0, tz, -ty
    else:
        nx, ny, nz = -tz, 0.0, tx
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / norm, ny / norm, nz / norm


@kernel()
def arc_to_point(pose, q):
    """Return length, bend and turn (rad) of the one arc from `pose` to a point; infinite straight behind."""
    px, py, pz, tx, ty, tz = pose
    dx = q[0] - px
    dy = q[1] - py
    dz = q[2] - pz
    h = dx * tx + dy * ty + dz * tz
    rx = dx - h * tx
    ry = dy - h * ty
    rz = dz - h * tz
    rho = math.sqrt(rx * rx + ry * ry + rz * rz)
    if rho < 1e-12:
        nx, ny, nz = any_normal(tx, ty, tz)
        return (h if h >= 0.0 else math.inf), (0.0, nx, ny, nz), 0.0
    kappa = 2.0 * rho / (rho * rho + h * h)
    turn = 2.0 * math.atan2(rho, h)
    return turn / kappa, (kappa, rx / rho, ry / rho, rz / rho), turn


@kernel()
def point_on_arc(pose, bend, s):
    """Return the point at arc length `s` as a tuple."""
    px, py, pz, tx, ty, tz = pose
    kappa, nx, ny, nz = bend
    a = sine_length(kappa, s)
    b = versine_length(kappa, s)
    return px + a * tx + b * nx, py + a * ty + b * ny, pz + a * tz + b * nz


@kernel()
def pose_on_arc(pose, bend, s):
    """Return the pose at arc length `s`, its tangent normalised."""
    x, y, z = point_on_arc(pose, bend, s)
    c = math.cos(bend[0] * s)
    d = math.sin(bend[0] * s)
    tx = c * pose[3] + d * bend[1]
    ty = c * pose[4] + d * bend[2]
    tz = c * pose[5] + d * bend[3]
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    return x, y, z, tx / norm, ty / norm, tz / norm


@kernel()
def normal_on_arc(pose, bend, s):
    """Return the unit normal towards the centre of curvature at arc length `s`."""
    c = math.cos(bend[0] * s)
    d = math.sin(bend[0] * s)
    return c * bend[1] - d * pose[3], c * bend[2] - d * pose[4], c * bend[3] - d * pose[5]
