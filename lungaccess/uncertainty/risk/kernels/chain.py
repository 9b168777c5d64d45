"""Compiled kernel of the risk: the chain of arcs that a deviated plan is, and where it ends."""

import math
from typing import NamedTuple

from anatomy.base.typed import Float
from anatomy.kernels.arcs import SMALL_ANGLE
from anatomy.kernels.compiling import borrowing_kernel
from anatomy.kernels.field import distance_bound
from lungaccess.uncertainty.risk.kernels.deviation import CURVATURE, LENGTH, RADIUS, ROLL, STEP_MM

TUBE_PIECES = 4
"""Arcs of planar tubes: straight and bent within the outer tube, straight and bent beyond it."""
SHIFT, TILT, ROTATION, FACTOR, TARGET, BORDER, INSERTION = 0, 3, 5, 6, 7, 10, 11
"""Where the errors of a draw begin in a row: behind the insertions of all tubes stand the roll and the stop
of each arc of the needle."""


class Devices(NamedTuple):
    """A plan as kernels take it.

    Args:
        frame ((4, 4) float64, LPS mm): Of the scope tip.
        tubes ((11,) float64): Of planar tubes: rotation, insertions of outer and inner tube, the most that
            the inner one may be inserted and be ahead of the outer one, its curved length, the curvatures
            inside and beyond the outer tube, the radii of outer and inner tube, and the most that the outer
            one may be inserted.
        needle ((A, 4) float64): Of each arc: insertion at its end, roll from the tip of the tubes, curvature
            and radius.
        shapes ((S, T, 4) float64): Arcs of tubes that are not planar, as pieces of the chain; none of planar
            tubes.
        rolled_rad ((S,) float64): By how much too far the end of such tubes is rolled.
        n_tube: Pieces of the tubes, T.
    """

    frame: Float
    tubes: Float
    needle: Float
    shapes: Float
    rolled_rad: Float
    n_tube: int
    max_needle_mm: float


@borrowing_kernel
def share_in_lumen(depth, geometry, least_mm, frame, dx, dy, dz):
    """Return the largest share of a shift up to which the scope's tip stands in the lumen all the way."""
    far = math.sqrt(dx * dx + dy * dy + dz * dz)
    stands, fails, at = 0.0, math.inf, min(STEP_MM, far)
    while stands < far and fails - stands > STEP_MM:
        share = at / far
        x, y, z = frame[0, 3] + share * dx, frame[1, 3] + share * dy, frame[2, 3] + share * dz
        deep = distance_bound(depth, geometry, x, y, z)
        if deep < least_mm or deep == 0.0:
            fails = at
        else:
            stands = at
        if math.isfinite(fails):
            at = 0.5 * (stands + fails)
        else:
            # The depth changes by no more than one moves; what is known of it may change faster.
            at = min(at + max(deep - least_mm, STEP_MM), far)
    return stands / far if far > 0.0 else 1.0


@borrowing_kernel
def _turned(x, y, z, vx, vy, vz):
    """Turn a direction by a rotation vector."""
    angle = math.sqrt(vx * vx + vy * vy + vz * vz)
    if angle == 0.0:
        return x, y, z
    ax, ay, az = vx / angle, vy / angle, vz / angle
    c, s = math.cos(angle), math.sin(angle)
    along = (1.0 - c) * (ax * x + ay * y + az * z)
    return (
        c * x + s * (ay * z - az * y) + along * ax,
        c * y + s * (az * x - ax * z) + along * ay,
        c * z + s * (ax * y - ay * x) + along * az,
    )


@borrowing_kernel
def set_start(frame, depth, geometry, least_mm, errors, n, start):
    """Fill the start `(9,)` of deviated plan `n`; its shift ends where the tip would leave the lumen."""
    dx, dy, dz = errors[n, SHIFT], errors[n, SHIFT + 1], errors[n, SHIFT + 2]
    share = share_in_lumen(depth, geometry, least_mm, frame, dx, dy, dz)
    start[0] = frame[0, 3] + share * dx
    start[1] = frame[1, 3] + share * dy
    start[2] = frame[2, 3] + share * dz
    a, b = errors[n, TILT], errors[n, TILT + 1]
    vx = frame[0, 0] * a + frame[0, 1] * b
    vy = frame[1, 0] * a + frame[1, 1] * b
    vz = frame[2, 0] * a + frame[2, 1] * b
    start[3], start[4], start[5] = _turned(frame[0, 2], frame[1, 2], frame[2, 2], vx, vy, vz)
    start[6], start[7], start[8] = _turned(frame[0, 0], frame[1, 0], frame[2, 0], vx, vy, vz)


@borrowing_kernel
def set_planar(tubes, errors, n, pieces):
    """Fill the first four pieces.

    No tube goes back behind the scope tip nor behind the tube around it, and none farther than it can.
    """
    most, curved, within, beyond, most_outer = tubes[3], tubes[5], tubes[6], tubes[7], tubes[10]
    outer = min(max(tubes[1] + errors[n, INSERTION], 0.0), most_outer)
    inner = min(max(tubes[2] + errors[n, INSERTION + 1], outer), min(most, outer + tubes[4]))
    straight = max(inner - curved, 0.0)
    first, third = min(straight, outer), max(straight, outer)
    pieces[0, LENGTH], pieces[1, LENGTH] = first, outer - first
    pieces[2, LENGTH], pieces[3, LENGTH] = third - outer, inner - third
    pieces[0, CURVATURE], pieces[1, CURVATURE] = 0.0, within
    pieces[2, CURVATURE], pieces[3, CURVATURE] = 0.0, beyond
    pieces[0, RADIUS] = pieces[1, RADIUS] = tubes[8]
    pieces[2, RADIUS] = pieces[3, RADIUS] = tubes[9]
    pieces[0, ROLL] = tubes[0] + errors[n, ROTATION]
    pieces[1, ROLL] = pieces[2, ROLL] = pieces[3, ROLL] = 0.0


@borrowing_kernel
def set_twisted(shapes, shape, rotation_error, pieces):
    """Fill the pieces of tubes that are not planar."""
    for p in range(shapes.shape[1]):
        for column in range(shapes.shape[2]):
            pieces[p, column] = shapes[shape, p, column]
    pieces[0, ROLL] += rotation_error


@borrowing_kernel
def set_needle(needle, max_needle_mm, n_tube, rolled_rad, errors, n, pieces):
    """Fill the pieces of a needle behind tubes that end rolled too far.

    It does not go back behind the end of an arc, nor farther than it is long.
    """
    n_arcs = needle.shape[0]
    stop = errors.shape[1] - n_arcs
    roll = stop - n_arcs
    done, turned = 0.0, rolled_rad
    for arc in range(n_arcs):
        end = max(min(needle[arc, 0] + errors[n, stop + arc], max_needle_mm), done)
        angle = needle[arc, 1] + errors[n, roll + arc]
        p = n_tube + arc
        pieces[p, LENGTH], pieces[p, ROLL] = end - done, angle - turned
        pieces[p, CURVATURE], pieces[p, RADIUS] = errors[n, FACTOR] * needle[arc, 2], needle[arc, 3]
        done, turned = end, angle


@borrowing_kernel
def find_end(start, pieces):
    """Return the pose in which a chain ends: point, direction ahead, and the normal across it."""
    x, y, z = start[0], start[1], start[2]
    tx, ty, tz = start[3], start[4], start[5]
    nx, ny, nz = start[6], start[7], start[8]
    for p in range(pieces.shape[0]):
        length, roll, kappa = pieces[p, LENGTH], pieces[p, ROLL], pieces[p, CURVATURE]
        if roll != 0.0:
            c, s = math.cos(roll), math.sin(roll)
            bx, by, bz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
            nx, ny, nz = c * nx + s * bx, c * ny + s * by, c * nz + s * bz
        turn = kappa * length
        if turn == 0.0:
            x, y, z = x + length * tx, y + length * ty, z + length * tz
            continue
        c, s = math.cos(turn), math.sin(turn)
        if abs(turn) < SMALL_ANGLE:
            along = length * (1.0 - turn * turn / 6.0)
            aside = 0.5 * length * turn * (1.0 - turn * turn / 12.0)
        else:
            along, aside = s / kappa, (1.0 - c) / kappa
        x, y, z = x + along * tx + aside * nx, y + along * ty + aside * ny, z + along * tz + aside * nz
        ux, uy, uz = c * tx + s * nx, c * ty + s * ny, c * tz + s * nz
        nx, ny, nz = c * nx - s * tx, c * ny - s * ty, c * nz - s * tz
        norm = math.sqrt(ux * ux + uy * uy + uz * uz)
        tx, ty, tz = ux / norm, uy / norm, uz / norm
    return x, y, z, tx, ty, tz, nx, ny, nz
