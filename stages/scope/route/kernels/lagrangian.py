"""The augmented Lagrangian of the route's repair: its value, and its gradient with the Gauss-Newton matrix.

The terms of a sample are the objective (distance from the reference, bending), the curvature and the depth in
the lumen; at free ends, the distance from the wanted points.  See `repair` for the program.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float, Int
from anatomy.kernels.compiling import inner_kernel, merged_kernel
from stages.scope.route.kernels.lumen import cone_depth, deep_enough

CENTRING, BENDING, LIMIT, NEEDED, SPARE_CURVATURE, SPARE_DEPTH, TOLERANCE = range(7)
"""Places in `Program.weights`."""

INSIDE = 0.99
"""Ends are held to this share of their tolerance, so that the proof does not fail for the last digit."""


class Program(NamedTuple):
    """The program of a repair; S samples.

    lo, hi : the control points `lo` to `hi - 1` are free; first (S,), rows (S, 3, 4) : first control point
    and basis rows of each sample; samples (S, 7), weights (7,) : see `repair`; cones, cells, cell_start,
    cell_cones : the lumen, see `lumen`; guide_cones (P, 8) : cones along the guide path; ends (2, 3) : the
    wanted first and last points.
    """

    lo: int
    hi: int
    first: Int
    rows: Float
    samples: Float
    cones: Float
    cells: Float
    cell_start: Int
    cell_cones: Int
    guide_cones: Float
    weights: Float
    ends: Float


@inner_kernel
def _sample_at(control, f, rows, v):
    """Fill `v` (3, 3) with the point of a sample, and its first and second derivatives."""
    for d in range(3):
        for axis in range(3):
            v[d, axis] = 0.0
            for c in range(4):
                v[d, axis] += rows[d, c] * control[f + c, axis]


@inner_kernel
def _curvature_violation(v, weights):
    """Return the violation of the curvature limit, then c' x c'' (norm, vector), and |c'|^2 and |c'|^3."""
    nx = v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1]
    ny = v[1, 2] * v[2, 0] - v[1, 0] * v[2, 2]
    nz = v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0]
    speed2 = v[1, 0] ** 2 + v[1, 1] ** 2 + v[1, 2] ** 2 + 1e-12
    speed3 = speed2 * math.sqrt(speed2)
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    value = norm / speed3 / weights[LIMIT] - 1.0 + weights[SPARE_CURVATURE]
    return value, norm, nx, ny, nz, speed2, speed3


@inner_kernel
def _depth_violation(program, s, v, multiplier, hints):
    """Return the violation of the depth at sample `s` in reference radii, and the centre of its best ball."""
    weights, sample = program.weights, program.samples[s]
    wanted = weights[NEEDED] + weights[SPARE_DEPTH]
    enough = math.inf if multiplier > 0.0 else wanted
    depth, cx, cy, cz, hints[s] = deep_enough(
        program.cones, program.cells, program.cell_start, program.cell_cones, hints[s], enough,
        v[0, 0], v[0, 1], v[0, 2],
    )  # fmt: skip
    if depth < 0.0:
        # Outside the lumen, the cones along the guide path lead back.
        for e in range(int(sample[5]), int(sample[6])):
            found, px, py, pz = cone_depth(program.guide_cones, e, v[0, 0], v[0, 1], v[0, 2])
            if found > depth:
                depth, cx, cy, cz = found, px, py, pz
    return (wanted - depth) / sample[4], cx, cy, cz


@inner_kernel
def _end_violation(program, control, end):
    """Return the violation at an end, the vector from the wanted point, its length, and the control point.

    A clamped spline ends at its first and last control points.  The control point is -1 if the end is held.
    """
    a = 0 if end == 0 else control.shape[0] - 1
    if a < program.lo or a >= program.hi:
        return -1.0, 0.0, 0.0, 0.0, 0.0, -1
    dx = control[a, 0] - program.ends[end, 0]
    dy = control[a, 1] - program.ends[end, 1]
    dz = control[a, 2] - program.ends[end, 2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    return distance / program.weights[TOLERANCE] - INSIDE, dx, dy, dz, distance, a


@inner_kernel
def _add_row(band, slope, first, lo, hi, value, row, weight):
    """Add one residual with its 12 derivatives to the normal equations of the free control points."""
    for i in range(12):
        a = first + i // 3
        if a < lo or a >= hi:
            continue
        at = 3 * (a - lo) + i % 3
        slope[at] += weight * row[i] * value
        for j in range(i + 1):
            b = first + j // 3
            if b < lo or b >= hi:
                continue
            other = 3 * (b - lo) + j % 3
            band[at, at - other] += weight * row[i] * row[j]


@merged_kernel
def _curvature_row(rows, v, limit, norm, nx, ny, nz, speed2, speed3, row):
    """Fill `row` (12,) with the derivatives of the curvature by the four control points."""
    nx /= norm
    ny /= norm
    nz /= norm
    scale = 1.0 / (speed3 * limit)
    fade = 3.0 * norm * scale / speed2
    ax = (v[2, 1] * nz - v[2, 2] * ny) * scale - fade * v[1, 0]
    ay = (v[2, 2] * nx - v[2, 0] * nz) * scale - fade * v[1, 1]
    az = (v[2, 0] * ny - v[2, 1] * nx) * scale - fade * v[1, 2]
    bx = (ny * v[1, 2] - nz * v[1, 1]) * scale
    by = (nz * v[1, 0] - nx * v[1, 2]) * scale
    bz = (nx * v[1, 1] - ny * v[1, 0]) * scale
    for c in range(4):
        row[3 * c] = rows[1, c] * ax + rows[2, c] * bx
        row[3 * c + 1] = rows[1, c] * ay + rows[2, c] * by
        row[3 * c + 2] = rows[1, c] * az + rows[2, c] * bz


@merged_kernel
def _add_end(band, slope, at, dx, dy, dz, distance, active, penalty, weights):
    """Add a free end, whose first unknown is `at`, to the normal equations."""
    tolerance = weights[TOLERANCE]
    pull = weights[CENTRING] / tolerance
    d = np.array((dx, dy, dz))
    for i in range(3):
        slope[at + i] += pull * d[i]
        band[at + i, 0] += pull
        if active > 0.0 and distance > 0.0:
            slope[at + i] += penalty * active * d[i] / (distance * tolerance)
            for j in range(i + 1):
                band[at + i, i - j] += penalty * d[i] * d[j] / (distance * tolerance) ** 2


@inner_kernel
def lagrangian(program, control, multipliers, penalty, hints, violation, band, slope):
    """Return the augmented Lagrangian; fill its gradient `slope` and the Gauss-Newton matrix `band`.

    `violation` (S + 2, 2) receives the constraint values, curvature and depth at the samples, then the
    distances of the ends.  `hints` (S,) keeps the cone in which each sample was found.
    """
    lo, hi, weights = program.lo, program.hi, program.weights
    band[:] = 0.0
    slope[:] = 0.0
    row, v = np.zeros(12), np.zeros((3, 3))
    count, total = program.first.shape[0], 0.0
    for s in range(count):
        f, rows, sample = program.first[s], program.rows[s], program.samples[s]
        _sample_at(control, f, rows, v)
        centring, bending = (
            weights[CENTRING] * sample[0] / (sample[4] * sample[4]),
            weights[BENDING] * sample[0],
        )
        for axis in range(3):
            off = v[0, axis] - sample[1 + axis]
            total += 0.5 * (centring * off * off + bending * v[2, axis] * v[2, axis])
            for c in range(max(lo - f, 0), min(hi - f, 4)):
                at = 3 * (f + c - lo) + axis
                slope[at] += centring * rows[0, c] * off + bending * rows[2, c] * v[2, axis]
                for e in range(max(lo - f, 0), c + 1):
                    band[at, 3 * (c - e)] += (
                        centring * rows[0, c] * rows[0, e] + bending * rows[2, c] * rows[2, e]
                    )
        value, norm, nx, ny, nz, speed2, speed3 = _curvature_violation(v, weights)
        violation[s, 0] = value
        active = value + multipliers[s, 0] / penalty
        if active > 0.0:
            total += 0.5 * penalty * active * active
            if norm > 0.0:
                _curvature_row(rows, v, weights[LIMIT], norm, nx, ny, nz, speed2, speed3, row)
                _add_row(band, slope, f, lo, hi, active, row, penalty)
        value, cx, cy, cz = _depth_violation(program, s, v, multipliers[s, 1], hints)
        violation[s, 1] = value
        active = value + multipliers[s, 1] / penalty
        dx, dy, dz = v[0, 0] - cx, v[0, 1] - cy, v[0, 2] - cz
        size = math.sqrt(dx * dx + dy * dy + dz * dz) * sample[4]
        if active > 0.0:
            total += 0.5 * penalty * active * active
            if size > 0.0:
                for c in range(4):
                    row[3 * c] = rows[0, c] * dx / size
                    row[3 * c + 1] = rows[0, c] * dy / size
                    row[3 * c + 2] = rows[0, c] * dz / size
                _add_row(band, slope, f, lo, hi, active, row, penalty)
    ends = 0.0
    for end in range(2):
        value, dx, dy, dz, distance, a = _end_violation(program, control, end)
        violation[count + end, 0] = value
        if a < 0:
            continue
        # The wanted point also draws, gently.
        pull = weights[CENTRING] / weights[TOLERANCE]
        ends += 0.5 * pull * distance * distance
        active = value + multipliers[count + end, 0] / penalty
        if active > 0.0:
            ends += 0.5 * penalty * active * active
        _add_end(band, slope, 3 * (a - lo), dx, dy, dz, distance, active, penalty, weights)
    return total + ends
