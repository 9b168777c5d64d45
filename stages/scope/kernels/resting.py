"""The shape of least energy of a shaft in a lumen with a yielding wall, by Newton steps along the shaft.

The shaft is a row of arcs.  Frames are `(12,)`, and an arc's curvature vector `(u, v)` in 1/mm lies in a
Bishop frame, as in `stages.scope.kernels.body`: the shaft may not twist.  The energy in N mm is that of
bending against the curvature at rest, and of the wall that yields by what the body reaches into it, less the
work of given forces.  The entry is clamped, and the tip may be held at its depth by a spring.

Its minimum is a problem of optimal control: frames are states, curvatures are controls.  One step goes back
from the tip with the gradient and the second derivatives of the energy of what lies ahead, as functions of
the frame (differential dynamic programming [Jacobson1970]), and forth along the new shape: its cost grows
with the length of the shaft, where that of a Newton step in all curvatures grows with the cube.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Float32
from anatomy.kernels.compiling import inner_kernel, kernel
from stages.scope.kernels.body import STRAIGHT_RAD, arc_parts, move_along

LONGEST_MM = 1.0
"""No place of the shaft moves farther in a step: a longer step could pass the wall between two airways."""
HALVINGS = 12
"""A step that does not lower the energy is halved so often; then the shape is at rest up to rounding."""
ENOUGH = 0.1
"""A step is taken if the energy falls by this share of what was expected: a small one lets kinks pass."""
DAMPING_LEAST, DAMPING_FIRST, DAMPING_MOST = 1e-6, 1e-2, 1e6
"""Damping of a step, as a share of the stiffness of an arc: the least that is kept, the first that is tried
where a step fails, and that beyond which the shape is given up."""
WORK = 28
"""Room that a look at the wall needs: its gradient, and the weights of the spline along three axes."""


class Lumen(NamedTuple):
    """What the body reaches into.

    depth : (ni, nj, nk) float32, signed distance to the wall at voxel corners in mm, positive in the lumen;
    geometry : (3, 6) of it, see `anatomy.kernels.field`.  The values are the coefficients of a cubic
    B-spline, which is smooth where voxels have edges, as if they were blurred by 0.58 of their size.
    """

    depth: Float32
    geometry: Float


class Shaft(NamedTuple):
    """A shaft of N arcs, its ends numbered 1 to N.

    length : (N,) mm; stiffness : (N,) N mm2; rest : (N, 2) curvature at rest, 1/mm; wall : (N,) N/mm, by how
    much the wall presses at the end of an arc for each mm that the body reaches into it, at first; yields :
    mm, at which it presses twice as hard as that, for it stiffens with the square; radius : mm, of the body;
    tip, ahead : (3,) LPS mm, the place past which the tip shall not come, nor stay behind, along a direction;
    hold : N/mm, how stiffly that is so, 0 for not at all.
    """

    length: Float
    stiffness: Float
    rest: Float
    wall: Float
    yields: float
    radius: float
    tip: Float
    ahead: Float
    hold: float


@inner_kernel
def _weights(f, row):
    """Fill a row (8,) with the weights of a cubic B-spline at a fraction of a cell, and their slopes."""
    g = 1.0 - f
    row[0], row[3] = g * g * g / 6.0, f * f * f / 6.0
    row[1], row[2] = 2.0 / 3.0 - 0.5 * f * f * (1.0 + g), 2.0 / 3.0 - 0.5 * g * g * (1.0 + f)
    row[4], row[7] = -0.5 * g * g, 0.5 * f * f
    row[5], row[6] = f * (1.5 * f - 2.0), g * (2.0 - 1.5 * g)


@inner_kernel
def depth_at(lumen, x, y, z, work):
    """Return a point's signed depth, mm, deep in the wall off the grid; `work` (28,) gets its gradient."""
    g, field = lumen.geometry, lumen.depth
    u = g[0, 0] * x + g[0, 1] * y + g[0, 2] * z + g[0, 3]
    v = g[1, 0] * x + g[1, 1] * y + g[1, 2] * z + g[1, 3]
    w = g[2, 0] * x + g[2, 1] * y + g[2, 2] * z + g[2, 3]
    ni, nj, nk = field.shape
    if not (1.0 <= u < ni - 2 and 1.0 <= v < nj - 2 and 1.0 <= w < nk - 2):
        work[0] = work[1] = work[2] = 0.0
        # The depth off the grid: no shape of least energy goes there.
        return -1e3
    i, j, k = int(u), int(v), int(w)
    a, b, c = work[4:12], work[12:20], work[20:28]
    _weights(u - i, a)
    _weights(v - j, b)
    _weights(w - k, c)
    total = du = dv = dw = 0.0
    for n in range(4):
        uk = np.uint64(k - 1 + n)
        sheet = sheet_u = sheet_v = 0.0
        for m in range(4):
            uj = np.uint64(j - 1 + m)
            line = line_u = 0.0
            for h in range(4):
                value = float(field[np.uint64(i - 1 + h), uj, uk])
                line += a[h] * value
                line_u += a[4 + h] * value
            sheet += b[m] * line
            sheet_u += b[m] * line_u
            sheet_v += b[4 + m] * line
        total += c[n] * sheet
        du += c[n] * sheet_u
        dv += c[n] * sheet_v
        dw += c[4 + n] * sheet
    for n in range(3):
        work[n] = du * g[0, n] + dv * g[1, n] + dw * g[2, n]
    return total


@inner_kernel
def energy_of(lumen, shaft, frames, curvature, pull, slope):
    """Lay arcs from the first of `frames` (N + 1, 12); return the energy, N mm; `pull` (N, 3) is in N."""
    total = 0.0
    for n in range(curvature.shape[0]):
        u, v = curvature[n, 0], curvature[n, 1]
        move_along(frames[n], u, v, shaft.length[n], frames[n + 1])
        du, dv = u - shaft.rest[n, 0], v - shaft.rest[n, 1]
        total += 0.5 * shaft.stiffness[n] * shaft.length[n] * (du * du + dv * dv)
        x, y, z = frames[n + 1, 9], frames[n + 1, 10], frames[n + 1, 11]
        over = shaft.radius - depth_at(lumen, x, y, z, slope)
        if over > 0.0:
            harder = over / shaft.yields
            total += 0.5 * shaft.wall[n] * over * over * (1.0 + 0.5 * harder * harder)
        total -= pull[n, 0] * x + pull[n, 1] * y + pull[n, 2] * z
    short = 0.0
    for k in range(3):
        short += (frames[-1, 9 + k] - shaft.tip[k]) * shaft.ahead[k]
    return total + 0.5 * shaft.hold * short * short


@inner_kernel
def _add_end(lumen, shaft, frames, n, pull, slope, grad, hess):
    """Add what the energy at the end of arc `n - 1` gives to gradient (6,) and second derivatives (6, 6)."""
    over = shaft.radius - depth_at(lumen, frames[n, 9], frames[n, 10], frames[n, 11], slope)
    for a in range(3):
        grad[a] -= pull[n - 1, a]
    if over > 0.0:
        harder = (over / shaft.yields) ** 2
        force, stiff = shaft.wall[n - 1] * over * (1.0 + harder), shaft.wall[n - 1] * (1.0 + 3.0 * harder)
        for a in range(3):
            grad[a] -= force * slope[a]
            for b in range(3):
                hess[a, b] += stiff * slope[a] * slope[b]


@inner_kernel
def _arc_moves(frame, u, v, s, by):
    """Fill `by` (2, 6) with how an arc's end moves and turns with `u` and `v`, in the world's axes."""
    kappa2 = u * u + v * v
    kappa = math.sqrt(kappa2)
    ahead, aside = arc_parts(kappa, s)
    angle = kappa * s
    if angle < 100.0 * STRAIGHT_RAD:
        ahead_k, aside_k = -s * s * s / 3.0, -s * s * s * s / 12.0
        sinc, cosc, rest = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0, s * s / 6.0
    else:
        ahead_k, aside_k = (s * math.cos(angle) - ahead) / kappa2, (s * ahead - 2.0 * aside) / kappa2
        sinc, cosc = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
        rest = (1.0 - sinc) / kappa2
    for which in range(2):
        one, two = (1.0, 0.0) if which == 0 else (0.0, 1.0)
        own = u if which == 0 else v
        ax = aside * one + u * own * aside_k
        ay = aside * two + v * own * aside_k
        az = own * ahead_k
        # The arc turns by s (-v, u, 0); what a change of that turns is its left Jacobian.
        fx, fy = -s * two, s * one
        along = (-v * fx + u * fy) * rest
        wx, wy = sinc * fx - along * v, sinc * fy + along * u
        wz = cosc * s * (-v * fy - u * fx)
        for k in range(3):
            by[which, k] = ax * frame[k] + ay * frame[3 + k] + az * frame[6 + k]
            by[which, 3 + k] = wx * frame[k] + wy * frame[3 + k] + wz * frame[6 + k]


@inner_kernel
def _back_over_arc(shaft, frames, curvature, n, damping, work, grad, hess, step, gain):
    """Carry the derivatives back over arc `n`, fill step and gain; return the step's fall, -1: not convex."""
    by, moved, cross = work[0:2], work[2:8], work[8:10]
    s, stiff = shaft.length[n], shaft.stiffness[n]
    u, v = curvature[n, 0], curvature[n, 1]
    _arc_moves(frames[n], u, v, s, by)
    dx = frames[n + 1, 9] - frames[n, 9]
    dy = frames[n + 1, 10] - frames[n, 10]
    dz = frames[n + 1, 11] - frames[n, 11]
    px, py, pz = grad[0], grad[1], grad[2]
    # A turn t at the begin moves the end by t x d: `moved` holds the second derivatives times that.
    for a in range(6):
        hx, hy, hz = hess[a, 0], hess[a, 1], hess[a, 2]
        moved[a, 0], moved[a, 1], moved[a, 2] = hx, hy, hz
        moved[a, 3] = hess[a, 3] + dy * hz - dz * hy
        moved[a, 4] = hess[a, 4] + dz * hx - dx * hz
        moved[a, 5] = hess[a, 5] + dx * hy - dy * hx
    for c in range(2):
        for a in range(6):
            total = 0.0
            for b in range(6):
                total += by[c, b] * moved[b, a]
            cross[c, a] = total
        # Turning what the curvature moves: the force on the end, and half of what the moment turns.
        bx, by_, bz = by[c, 0], by[c, 1], by[c, 2]
        wx, wy, wz = 0.5 * by[c, 3], 0.5 * by[c, 4], 0.5 * by[c, 5]
        cross[c, 3] += by_ * pz - bz * py + wy * grad[5] - wz * grad[4]
        cross[c, 4] += bz * px - bx * pz + wz * grad[3] - wx * grad[5]
        cross[c, 5] += bx * py - by_ * px + wx * grad[4] - wy * grad[3]
    q0, q1 = stiff * s * (u - shaft.rest[n, 0]), stiff * s * (v - shaft.rest[n, 1])
    h00 = h11 = stiff * s * (1.0 + damping)
    h01 = 0.0
    for a in range(6):
        q0 += by[0, a] * grad[a]
        q1 += by[1, a] * grad[a]
        b0, b1 = 0.0, 0.0
        for b in range(6):
            b0 += hess[a, b] * by[0, b]
            b1 += hess[a, b] * by[1, b]
        h00 += by[0, a] * b0
        h01 += by[0, a] * b1
        h11 += by[1, a] * b1
    det = h00 * h11 - h01 * h01
    if not (h00 > 0.0 and det > 1e-12 * h00 * h00):
        return -1.0
    step[n, 0], step[n, 1] = (h01 * q1 - h11 * q0) / det, (h01 * q0 - h00 * q1) / det
    for a in range(6):
        gain[n, 0, a] = (h01 * cross[1, a] - h11 * cross[0, a]) / det
        gain[n, 1, a] = (h01 * cross[0, a] - h00 * cross[1, a]) / det
    # Second derivatives at the begin: those of the moved end, of the turned force, less what the arc gives.
    for a in range(3):
        for b in range(6):
            hess[a, b] = moved[a, b]
    for b in range(6):
        mx, my, mz = moved[0, b], moved[1, b], moved[2, b]
        hess[3, b] = moved[3, b] + dy * mz - dz * my
        hess[4, b] = moved[4, b] + dz * mx - dx * mz
        hess[5, b] = moved[5, b] + dx * my - dy * mx
    pd = px * dx + py * dy + pz * dz
    hess[3, 3] += px * dx - pd
    hess[4, 4] += py * dy - pd
    hess[5, 5] += pz * dz - pd
    hess[3, 4] += 0.5 * (px * dy + py * dx)
    hess[3, 5] += 0.5 * (px * dz + pz * dx)
    hess[4, 5] += 0.5 * (py * dz + pz * dy)
    grad[3] += dy * pz - dz * py
    grad[4] += dz * px - dx * pz
    grad[5] += dx * py - dy * px
    for a in range(6):
        grad[a] += cross[0, a] * step[n, 0] + cross[1, a] * step[n, 1]
        for b in range(a, 6):
            both = hess[a, b] + cross[0, a] * gain[n, 0, b] + cross[1, a] * gain[n, 1, b]
            hess[a, b] = hess[b, a] = both
    return -0.5 * (q0 * step[n, 0] + q1 * step[n, 1])


@inner_kernel
def _back(lumen, shaft, frames, curvature, pull, damping, work, slope, grad, hess, step, gain):
    """Find the step of every arc, from tip to entry; return the energy's expected fall, -1: not convex."""
    last = curvature.shape[0]
    expected = short = 0.0
    for k in range(3):
        short += (frames[last, 9 + k] - shaft.tip[k]) * shaft.ahead[k]
    grad[:] = 0.0
    hess[:] = 0.0
    for a in range(3):
        grad[a] = shaft.hold * short * shaft.ahead[a]
        for b in range(3):
            hess[a, b] = shaft.hold * shaft.ahead[a] * shaft.ahead[b]
    for back in range(last):
        n = last - 1 - back
        _add_end(lumen, shaft, frames, n + 1, pull, slope, grad, hess)
        worth = _back_over_arc(shaft, frames, curvature, n, damping, work, grad, hess, step, gain)
        if worth < 0.0:
            return -1.0
        expected += worth
    return expected


@inner_kernel
def _forth(shaft, size, frames, curvature, step, gain, to_frames, to_curvature):
    """Lay the shaft anew in steps of a size, each arc answering to its begin; return the longest way, mm."""
    to_frames[0] = frames[0]
    longest = 0.0
    for n in range(curvature.shape[0]):
        old, new = frames[n], to_frames[n]
        # The turn from the old frame to the new one: half the sum of the cross products, made an angle.
        tx, ty, tz, trace = 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            ox, oy, oz = old[3 * c], old[3 * c + 1], old[3 * c + 2]
            nx, ny, nz = new[3 * c], new[3 * c + 1], new[3 * c + 2]
            tx += 0.5 * (oy * nz - oz * ny)
            ty += 0.5 * (oz * nx - ox * nz)
            tz += 0.5 * (ox * ny - oy * nx)
            trace += ox * nx + oy * ny + oz * nz
        sine = math.sqrt(tx * tx + ty * ty + tz * tz)
        grow = 1.0 if sine < 1e-9 else math.atan2(sine, 0.5 * (trace - 1.0)) / sine
        tx, ty, tz = grow * tx, grow * ty, grow * tz
        for c in range(2):
            more = size * step[n, c] + gain[n, c, 3] * tx + gain[n, c, 4] * ty + gain[n, c, 5] * tz
            for k in range(3):
                more += gain[n, c, k] * (new[9 + k] - old[9 + k])
            to_curvature[n, c] = curvature[n, c] + more
        move_along(new, to_curvature[n, 0], to_curvature[n, 1], shaft.length[n], to_frames[n + 1])
        way = 0.0
        for k in range(9, 12):
            way += (to_frames[n + 1, k] - frames[n + 1, k]) ** 2
        longest = max(longest, way)
    return math.sqrt(longest)


@kernel(nogil=True)
def bring_to_rest(lumen, shaft, entry, curvature, pull, frames, enough, most_steps):
    """Bring a shaft to rest: `curvature` (N, 2) becomes that of a shape of least energy.

    Returns the energy in N mm, what the next step is expected to be worth in N mm, and the number of steps.

    Args:
        entry, frames ((12,), (N + 1, 12) float64): Frame in which the shaft begins; becomes those of ends.
        pull ((N, 3) float64): Forces on the ends of the arcs, N, which do not change with the shape.
        enough (float): No step is taken that is expected to lower the energy by less than this, N mm.
    """
    count = curvature.shape[0]
    work, slope = np.zeros((10, 6)), np.zeros(WORK)
    grad, hess = np.zeros(6), np.zeros((6, 6))
    step, gain = np.zeros((count, 2)), np.zeros((count, 2, 6))
    to_frames, to_curvature = np.zeros((count + 1, 12)), np.zeros((count, 2))
    frames[0] = entry
    energy = energy_of(lumen, shaft, frames, curvature, pull, slope)
    damping, expected = 0.0, math.inf
    for taken in range(most_steps):
        expected = _back(lumen, shaft, frames, curvature, pull, damping, work, slope, grad, hess, step, gain)
        if 0.0 <= expected < enough:
            return energy, expected, taken
        size, found = 1.0, False
        for _ in range(HALVINGS if expected > 0.0 else 0):
            longest = _forth(shaft, size, frames, curvature, step, gain, to_frames, to_curvature)
            if longest > LONGEST_MM:
                size *= max(0.9 * LONGEST_MM / longest, 0.1)
                continue
            after = energy_of(lumen, shaft, to_frames, to_curvature, pull, slope)
            if energy - after >= ENOUGH * size * expected:
                found = True
                break
            size *= 0.5
        if found:
            damping = 0.25 * damping if damping > DAMPING_LEAST else 0.0
            frames[:], curvature[:] = to_frames, to_curvature
            energy = after
        elif damping > DAMPING_MOST:
            break
        else:
            damping = max(8.0 * damping, DAMPING_FIRST)
    return energy, expected if expected >= 0.0 else math.inf, most_steps


@kernel(nogil=True)
def press(lumen, shaft, frames, give, force):
    """Fill how far the wall yields at the ends of the arcs, (N,) mm, and how it presses there, (N, 3) N."""
    slope = np.zeros(WORK)
    for n in range(give.shape[0]):
        at = frames[n + 1]
        over = shaft.radius - depth_at(lumen, at[9], at[10], at[11], slope)
        give[n] = over if over > 0.0 and shaft.wall[n] > 0.0 else 0.0
        pressed = shaft.wall[n] * give[n] * (1.0 + (give[n] / shaft.yields) ** 2)
        for k in range(3):
            force[n, k] = pressed * slope[k]
