"""Compiled kernel of the spread: what small errors do to the devices of many deployments, to first order.

A rotation about an axis `a` moves a point by `a x v`, where `v` is its arm.  Summed over all axes across a
direction, the squares of these are `|v|^2 I - v v^T - (f x v)(f x v)^T`.
"""

import math
from typing import NamedTuple

from anatomy.base.typed import Float, UInt16
from anatomy.kernels.compiling import borrowing_kernel, kernel
from anatomy.kernels.field import distance_bound

TUBE_STATIONS, NEEDLE_STATIONS = 6, 24
"""Points at which clearance is compared with the errors: some mm apart, as vessels are wide."""
CAP = 6.0
"""A clearance of so many standard deviations is as good as any more."""
SMALL = 1e-12
OF_TUBE, OF_NEEDLE, REACH, MEAN, VARIANCE, N_FOUND = 0, 1, 2, 3, 4, 5
"""Columns of what is found: margins of tubes, needle and reach in standard deviations; mean and variance of
the squared miss in mm."""


class Around(NamedTuple):
    """What the devices may meet: distances to vessels, pleura, fissures (or vessels again) and airways."""

    vessel: UInt16
    pleura: UInt16
    fissure: UInt16
    airway: UInt16
    geometry: Float


class Sizes(NamedTuple):
    """What does not depend on the deployment, in mm and rad: errors that are left, and devices.

    `scope` and `scope_turn` are those of the scope's tip when the tubes are planned, `tip` and `tip_turn`
    those of the tubes' tip when the needle is planned; `tip_known` tells whether these count instead of what
    comes before them.  `curvature`, the logarithm of its factor, `roll` and `stop` are the needle's, `target`
    is along each axis, and `breathing` beside it towards the feet.  `bend` is the curvature in 1/mm with
    which the inner tube bends on, `steepest` that of which the needle is capable in tissue as it mostly is,
    `slack` the share by which that differs from patient to patient, and `aside` how far beside the target the
    needle may aim.
    """

    scope: float
    scope_turn: float
    rotation: float
    insertion: float
    tip_known: bool
    tip: float
    tip_turn: float
    curvature: float
    roll: float
    stop: float
    target: float
    breathing: float
    bend: float
    steepest: float
    slack: float
    aside: float
    tube_radius: float
    needle_radius: float
    exempt: float


@borrowing_kernel
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@borrowing_kernel
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@borrowing_kernel
def add(sums, size, v):
    """Add `size^2 v v^T` to the sums xx, yy, zz, xy, xz, yz."""
    s = size * size
    return (
        sums[0] + s * v[0] * v[0],
        sums[1] + s * v[1] * v[1],
        sums[2] + s * v[2] * v[2],
        sums[3] + s * v[0] * v[1],
        sums[4] + s * v[0] * v[2],
        sums[5] + s * v[1] * v[2],
    )


@borrowing_kernel
def shift(sums, size):
    s = size * size
    return sums[0] + s, sums[1] + s, sums[2] + s, sums[3], sums[4], sums[5]


@borrowing_kernel
def tilt(sums, size, arm, forward):
    """Add what turns about all axes across `forward` do at the end of an arm."""
    s = size * size
    long = s * dot(arm, arm)
    side = cross(forward, arm)
    return (
        sums[0] + long - s * (arm[0] * arm[0] + side[0] * side[0]),
        sums[1] + long - s * (arm[1] * arm[1] + side[1] * side[1]),
        sums[2] + long - s * (arm[2] * arm[2] + side[2] * side[2]),
        sums[3] - s * (arm[0] * arm[1] + side[0] * side[1]),
        sums[4] - s * (arm[0] * arm[2] + side[0] * side[2]),
        sums[5] - s * (arm[1] * arm[2] + side[1] * side[2]),
    )


@borrowing_kernel
def of_scope(sizes, sums, point, base, forward):
    """Add the errors of the scope's tip and of the rotation of the tubes."""
    arm = (point[0] - base[0], point[1] - base[1], point[2] - base[2])
    sums = tilt(shift(sums, sizes.scope), sizes.scope_turn, arm, forward)
    return add(sums, sizes.rotation, cross(forward, arm))


@borrowing_kernel
def of_insertion(sizes, sums, point, at, ahead, about):
    """Add the error of the inner tube's insertion, which bends on as it goes."""
    arm = (point[0] - at[0], point[1] - at[1], point[2] - at[2])
    turned = cross(about, arm)
    moved = (
        ahead[0] + sizes.bend * turned[0],
        ahead[1] + sizes.bend * turned[1],
        ahead[2] + sizes.bend * turned[2],
    )
    return add(sums, sizes.insertion, moved)


@borrowing_kernel
def of_tip(sizes, point, base, forward, about, at, ahead):
    """Return the sums of what errors before the needle do to a point: of its start, or of scope and tubes."""
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if sizes.tip_known:
        arm = (point[0] - at[0], point[1] - at[1], point[2] - at[2])
        return tilt(shift(nothing, sizes.tip), sizes.tip_turn, arm, ahead)
    sums = of_scope(sizes, nothing, point, base, forward)
    return of_insertion(sizes, sums, point, at, ahead, about)


@borrowing_kernel
def clearance_at(around, point, with_airway):
    x, y, z = point
    least = distance_bound(around.vessel, around.geometry, x, y, z)
    least = min(least, distance_bound(around.pleura, around.geometry, x, y, z))
    least = min(least, distance_bound(around.fissure, around.geometry, x, y, z))
    if with_airway:
        least = min(least, distance_bound(around.airway, around.geometry, x, y, z))
    return least


@borrowing_kernel
def margin_of(clear, sums):
    """Return a clearance in standard deviations: two of three directions lie across a device."""
    variance = (sums[0] + sums[1] + sums[2]) / 1.5
    return min(max(clear / math.sqrt(max(variance, SMALL)), -CAP), CAP)


@borrowing_kernel
def unit(v):
    size = math.sqrt(dot(v, v))
    if size < 1e-9:
        return (0.0, 0.0, 0.0), size
    return (v[0] / size, v[1] / size, v[2] / size), size


@borrowing_kernel
def tube_margin(around, sizes, base, forward, at, ahead, exit_mm, length):
    """Return the least margin of the tubes beyond the exit, along the cubic through both ends."""
    least = CAP
    begin = min(max(exit_mm / max(length, 1e-9), 0.0), 1.0)
    for s in range(TUBE_STATIONS):
        u = begin + (1.0 - begin) * (s + 1) / TUBE_STATIONS
        a, b = 2 * u**3 - 3 * u**2 + 1, (u**3 - 2 * u**2 + u) * length
        c, d = 3 * u**2 - 2 * u**3, (u**3 - u**2) * length
        point = (
            a * base[0] + b * forward[0] + c * at[0] + d * ahead[0],
            a * base[1] + b * forward[1] + c * at[1] + d * ahead[1],
            a * base[2] + b * forward[2] + c * at[2] + d * ahead[2],
        )
        sums = of_scope(sizes, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), point, base, forward)
        clear = clearance_at(around, point, False) - sizes.tube_radius
        least = min(least, margin_of(clear, sums))
    return least


@borrowing_kernel
def reach_margin(sizes, along, off, normal, sums):
    """Return by how many standard deviations the target lies within what the needle can bend to."""
    most = 1.0 / sizes.steepest
    bends_less = sizes.slack * off
    if along < most:
        most -= math.sqrt(most * most - along * along)
    x, y, z = normal
    across = sums[0] * x * x + sums[1] * y * y + sums[2] * z * z
    across += 2.0 * (sums[3] * x * y + sums[4] * x * z + sums[5] * y * z)
    across += bends_less * bends_less
    return min(max((most + sizes.aside - off) / math.sqrt(max(across, SMALL)), -CAP), CAP)


@kernel(nogil=True)
def find_spread(around, sizes, tips, positions, tangents, exits, lengths, target, found):
    """Note what the errors do to the direct arcs from N deployments to a target.

    Args:
        tips ((N, 9) float64): Point, direction and +x of each scope tip.
        positions, tangents ((N, 3) float64): Of the tips of the tubes.
        exits, lengths ((N,) float64): Arc length of the tubes at the exit and at their tip.
        found ((N, N_FOUND) float64): Is filled.
    """
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for n in range(found.shape[0]):
        base, forward = (tips[n, 0], tips[n, 1], tips[n, 2]), (tips[n, 3], tips[n, 4], tips[n, 5])
        at = (positions[n, 0], positions[n, 1], positions[n, 2])
        ahead = (tangents[n, 0], tangents[n, 1], tangents[n, 2])
        found[n, OF_TUBE] = tube_margin(around, sizes, base, forward, at, ahead, exits[n], lengths[n])
        offset = (target[0] - at[0], target[1] - at[1], target[2] - at[2])
        along = dot(offset, ahead)
        aside = (offset[0] - along * ahead[0], offset[1] - along * ahead[1], offset[2] - along * ahead[2])
        normal, off = unit(aside)
        kappa = 2.0 * off / max(off * off + along * along, SMALL)
        turn = 2.0 * math.atan2(off, along)
        length = turn / max(kappa, SMALL) if turn > 1e-9 else along
        binormal = cross(ahead, normal)
        about, _size = unit(cross(forward, ahead))
        rigid = of_scope(sizes, nothing, target, base, forward)
        rigid = of_insertion(sizes, rigid, target, at, ahead, about)
        found[n, REACH] = reach_margin(sizes, along, off, normal, rigid)
        least, sums = CAP, nothing
        for s in range(NEEDLE_STATIONS):
            share = (s + 1) / NEEDLE_STATIONS
            gone, bent = share * length, 0.0
            if turn > 1e-9:
                gone = math.sin(share * turn) / max(kappa, SMALL)
                bent = (1.0 - math.cos(share * turn)) / max(kappa, SMALL)
            point = (
                at[0] + gone * ahead[0] + bent * normal[0],
                at[1] + gone * ahead[1] + bent * normal[1],
                at[2] + gone * ahead[2] + bent * normal[2],
            )
            sums = of_tip(sizes, point, base, forward, about, at, ahead)
            bow = 0.5 * kappa * (share * length) ** 2
            sums = add(add(sums, sizes.curvature * bow, normal), sizes.roll * bow, binormal)
            beyond = math.sqrt(gone * gone + bent * bent) > sizes.exempt
            clear = clearance_at(around, point, beyond) - sizes.needle_radius
            least = min(least, margin_of(clear, sums))
        found[n, OF_NEEDLE] = least
        ends = add(shift(sums, sizes.target), sizes.stop, ahead)
        ends = add(ends, sizes.breathing, (0.0, 0.0, 1.0))
        found[n, MEAN] = ends[0] + ends[1] + ends[2]
        found[n, VARIANCE] = 2.0 * (
            ends[0] ** 2 + ends[1] ** 2 + ends[2] ** 2 + 2.0 * (ends[3] ** 2 + ends[4] ** 2 + ends[5] ** 2)
        )
