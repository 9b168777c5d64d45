"""The bronchoscope as a chain of links, and how it moves [Rosell2012, Table I and Algorithm 1].

The scope points along -z of its base frame.  After the twist (alpha, about z) come n links: a step of `link`
along -z, then a turn by xi = beta / n about x.  Only with the step first do all joints lie on the circle on
which Algorithm 1 moves the base.  That circle touches the middle of the base link; its curvature there is
2 tan(xi / 2) / link, which is 0 for a straight tip, so that nothing is singular.

A `state` is (14,) float64: rotation matrix (9, by rows) and origin (3, LPS mm) of the base, alpha and beta in
rad.
"""

import math

import numpy as np

from anatomy.kernels.arcs import sine_length, versine_length
from anatomy.kernels.compiling import inlined_kernel, kernel

STATE = 14


@inlined_kernel
def circle_curvature(link, links, beta):
    """Return the signed curvature (1/mm) of the circle of the base link's middle."""
    return 2.0 * math.tan(0.5 * beta / links) / link


@inlined_kernel
def bend_axis(state, alpha):
    """Return the unit vector towards which a positive bend turns the tip."""
    c = math.cos(alpha)
    s = math.sin(alpha)
    return c * state[1] - s * state[0], c * state[4] - s * state[3], c * state[7] - s * state[6]


@inlined_kernel
def move_base(state, link, kappa, distance, alpha, out):
    """Write the base pose of `state`, moved by `distance` mm, into the first 12 numbers of `out`.

    Lines 5 to 7 of Algorithm 1 multiplied out; the rotation by xi in its T_C cancels.  `state` may be `out`.
    """
    c = math.cos(alpha)
    s = math.sin(alpha)
    turn = kappa * distance
    ct = math.cos(turn)
    st = math.sin(turn)
    aside = versine_length(kappa, distance) - 0.5 * link * st
    back = -sine_length(kappa, distance) - 0.5 * link * (1.0 - ct)
    for row in range(3):
        x, y, z = state[3 * row], state[3 * row + 1], state[3 * row + 2]
        across = c * x + s * y
        towards = c * y - s * x
        out[9 + row] = state[9 + row] + aside * towards + back * z
        turned = ct * towards + st * z
        out[3 * row] = c * across - s * turned
        out[3 * row + 1] = s * across + c * turned
        out[3 * row + 2] = ct * z - st * towards


@inlined_kernel
def tip_of(state, link, links, alpha, beta):
    """Return the position of the tool centre point."""
    bx, by, bz = bend_axis(state, alpha)
    xi = beta / links
    ct = math.cos(xi)
    st = math.sin(xi)
    forward = 0.0
    aside = 0.0
    c = 1.0
    s = 0.0
    for _ in range(links):
        forward += c
        aside += s
        c, s = ct * c - st * s, st * c + ct * s
    forward *= link
    aside *= link
    return (
        state[9] - forward * state[2] + aside * bx,
        state[10] - forward * state[5] + aside * by,
        state[11] - forward * state[8] + aside * bz,
    )


@inlined_kernel
def joints_of(state, link, links, alpha, beta, out):
    """Fill `out` (links + 1, 3) with the base, the joints and the tool centre point."""
    bx, by, bz = bend_axis(state, alpha)
    xi = beta / links
    ct = math.cos(xi)
    st = math.sin(xi)
    c = link
    s = 0.0
    for row in range(3):
        out[0, row] = state[9 + row]
    for k in range(links):
        out[k + 1, 0] = out[k, 0] - c * state[2] + s * bx
        out[k + 1, 1] = out[k, 1] - c * state[5] + s * by
        out[k + 1, 2] = out[k, 2] - c * state[8] + s * bz
        c, s = ct * c - st * s, st * c + ct * s


@kernel()
def bodies(states, link, links, joints, frames):
    """Fill `joints` (M, links + 1, 3) and tool frames (M, 4, 4), zeros before, of states (M, 14)."""
    for m in range(states.shape[0]):
        state = states[m]
        alpha, beta = state[12], state[13]
        joints_of(state, link, links, alpha, beta, joints[m])
        c, s = math.cos(alpha), math.sin(alpha)
        ct, st = math.cos(beta), math.sin(beta)
        for row in range(3):
            x, y, z = state[3 * row], state[3 * row + 1], state[3 * row + 2]
            towards = c * y - s * x
            frames[m, row, 0] = c * x + s * y
            frames[m, row, 1] = ct * towards + st * z
            frames[m, row, 2] = ct * z - st * towards
            frames[m, row, 3] = joints[m, links, row]
        frames[m, 3, 3] = 1.0


@kernel()
def advance(state, link, links, distance, alpha, beta):
    """Algorithm 1: return the state advanced by `distance` mm with a new twist and bend."""
    out = np.zeros(STATE)
    move_base(state, link, circle_curvature(link, links, beta), distance, alpha, out)
    out[12] = alpha
    out[13] = beta
    return out
