"""Torsion of nested precurved tubes, integrated from tip to base [Rucker2010], [Dupont2010].

With the Bishop frame of the centreline, tube i is turned by the angle psi_i and twisted by u_i = psi_i', and

    u_i' = -(1 / kt_i) sum_j [kb_i kappa_i kb_j kappa_j / sum kb] sin(psi_j - psi_i)

where psi includes the direction of the precurvature, and u_i = 0 at the end of each tube.  Angles at the tip
are given, so this is an initial value problem; its derivatives by them are carried along.

Up to three tubes are integrated in plain numbers, more of them in arrays: the results are the same, and the
numbers, which stay in the processor, take half the time.
"""

import math

from anatomy.kernels.compiling import borrowing_kernel, inlined_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import BENT, FAR, NEAR, SOFTNESS, STEPS

# Nystroem's method of order 5 for y'' = f(y) [Hairer1993, sec. II.14].
C2, C3 = 1.0 / 5.0, 2.0 / 3.0
A21 = 1.0 / 50.0
A31, A32 = -1.0 / 27.0, 7.0 / 27.0
A41, A42, A43 = 3.0 / 10.0, -2.0 / 35.0, 9.0 / 35.0
P1, P2, P3 = 14.0 / 336.0, 100.0 / 336.0, 54.0 / 336.0
R1, R2, R3, R4 = 14.0 / 336.0, 125.0 / 336.0, 162.0 / 336.0, 35.0 / 336.0

FEW = 3
"""Up to so many tubes are integrated in triples of numbers, one for each tube or each pair of tubes."""
NOTHING = (0.0, 0.0, 0.0)
# Rows of the scratch of more tubes: pulls at the four stages of a step, and the angles looked at.
ANGLES, SCRATCH_ROWS = 4, 5


@inlined_kernel
def _scaled(factor, x):
    return factor * x[0], factor * x[1], factor * x[2]


@inlined_kernel
def _sum(x, y):
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@inlined_kernel
def _times(x, y):
    return x[0] * y[0], x[1] * y[1], x[2] * y[2]


@inlined_kernel
def _between(x):
    """Return what differs between the tubes of each pair, the later one less the earlier one."""
    return x[1] - x[0], x[2] - x[0], x[2] - x[1]


@inlined_kernel
def _pulled(first, second, y):
    """Return what the pairs pull at each tube: `first` and `second` times `y` at the tubes of a pair."""
    one, two = _times(first, y), _times(second, y)
    return -one[0] - one[1], two[0] - one[2], two[1] + two[2]


@inlined_kernel
def _pair(softness, moment, other, torsional, other_torsional):
    """Return what the sine between two tubes pulls at each, 0 where not both are bent."""
    most = softness * moment * other
    if most == 0.0:
        return 0.0, 0.0
    return most / torsional, most / other_torsional


@inlined_kernel
def _waves(first, rest, angles):
    """Return sine and cosine of the angle between the tubes of each pair that pulls."""
    between = _sum(_between(angles), rest)
    s0 = s1 = s2 = c0 = c1 = c2 = 0.0
    if first[0] != 0.0:
        s0, c0 = math.sin(between[0]), math.cos(between[0])
    if first[1] != 0.0:
        s1, c1 = math.sin(between[1]), math.cos(between[1])
    if first[2] != 0.0:
        s2, c2 = math.sin(between[2]), math.cos(between[2])
    return (s0, s1, s2), (c0, c1, c2)


@inlined_kernel
def _ahead(x, v, h, share, bent):
    """Return `x` at a share of the step of -h, with slope `v` and mean second derivative."""
    return _sum(_sum(x, _scaled(-(share * h), v)), _scaled(h * h, bent))


@inlined_kernel
def _bent3(one, two):
    return _sum(_scaled(A31, one), _scaled(A32, two))


@inlined_kernel
def _bent4(one, two, three):
    return _sum(_sum(_scaled(A41, one), _scaled(A42, two)), _scaled(A43, three))


@inlined_kernel
def _landed(x, v, h, one, two, three):
    bent = _sum(_sum(_scaled(P1, one), _scaled(P2, two)), _scaled(P3, three))
    return _ahead(x, v, h, 1.0, bent), _sum(_scaled(R1, one), _scaled(R2, two))


@inlined_kernel
def _turn_on(x, v, h, first, second, rest):
    """Return angles and rates after a step of -h, and the cosines between tubes at its four stages."""
    sines, cosines = _waves(first, rest, x)
    one = _pulled(first, second, sines)
    sines, cosines2 = _waves(first, rest, _ahead(x, v, h, C2, _scaled(A21, one)))
    two = _pulled(first, second, sines)
    sines, cosines3 = _waves(first, rest, _ahead(x, v, h, C3, _bent3(one, two)))
    three = _pulled(first, second, sines)
    sines, cosines4 = _waves(first, rest, _ahead(x, v, h, 1.0, _bent4(one, two, three)))
    four = _pulled(first, second, sines)
    x, turned = _landed(x, v, h, one, two, three)
    turned = _sum(_sum(turned, _scaled(R3, three)), _scaled(R4, four))
    return x, _sum(v, _scaled(-h, turned)), (cosines, cosines2, cosines3, cosines4)


@inlined_kernel
def _change_on(x, v, h, first, second, cosines):
    """Return the derivatives of angles and rates after the step of `_turn_on` with these cosines."""
    one = _pulled(first, second, _times(cosines[0], _between(x)))
    ahead = _ahead(x, v, h, C2, _scaled(A21, one))
    two = _pulled(first, second, _times(cosines[1], _between(ahead)))
    ahead = _ahead(x, v, h, C3, _bent3(one, two))
    three = _pulled(first, second, _times(cosines[2], _between(ahead)))
    ahead = _ahead(x, v, h, 1.0, _bent4(one, two, three))
    four = _pulled(first, second, _times(cosines[3], _between(ahead)))
    x, turned = _landed(x, v, h, one, two, three)
    turned = _sum(turned, _sum(_scaled(R3, three), _scaled(R4, four)))
    return x, _sum(v, _scaled(-h, turned))


@merged_kernel
def _row(array, at, n):
    return array[at, 0], array[at, 1] if n > 1 else 0.0, array[at, 2] if n > 2 else 0.0


@merged_kernel
def _put(array, at, n, x):
    array[at, 0] = x[0]
    if n > 1:
        array[at, 1] = x[1]
    if n > 2:
        array[at, 2] = x[2]


@borrowing_kernel
def _step_few(stiffness, cutting, k, h, nodes, at, number):
    """Take `number` steps of -h down from node `at`, in piece `k`, with up to `FEW` tubes."""
    pieces, moments, directions, _count = cutting
    _s, psi, rate, dpsi, drate = nodes
    n, softness = psi.shape[1], pieces[k, SOFTNESS]
    bent = _row(moments, k, n)
    soft = stiffness[0, 1], stiffness[1, 1] if n > 1 else 0.0, stiffness[2, 1] if n > 2 else 0.0
    f0, s0 = _pair(softness, bent[0], bent[1], soft[0], soft[1])
    f1, s1 = _pair(softness, bent[0], bent[2], soft[0], soft[2])
    f2, s2 = _pair(softness, bent[1], bent[2], soft[1], soft[2])
    first, second, rest = (f0, f1, f2), (s0, s1, s2), _between(_row(directions, k, n))
    x, v = _row(psi, at, n), _row(rate, at, n)
    for to in range(at - 1, at - 1 - number, -1):
        x, v, cosines = _turn_on(x, v, h, first, second, rest)
        _put(psi, to, n, x)
        _put(rate, to, n, v)
        for c in range(dpsi.shape[1]):
            y, w = _row(dpsi[to + 1], c, n), _row(drate[to + 1], c, n)
            y, w = _change_on(y, w, h, first, second, cosines)
            _put(dpsi[to], c, n, y)
            _put(drate[to], c, n, w)


@borrowing_kernel
def _pull(stiffness, cutting, k, angles, pull):
    """Fill `pull` (1 + columns, n) with psi'' at `angles` in piece `k`, and with its derivatives."""
    pieces, moments, directions, _count = cutting
    rows, n = pull.shape
    for row in range(rows):
        for i in range(n):
            pull[row, i] = 0.0
    for i in range(n):
        for j in range(i + 1, n):
            first, second = _pair(
                pieces[k, SOFTNESS], moments[k, i], moments[k, j], stiffness[i, 1], stiffness[j, 1]
            )
            if first == 0.0:
                continue
            angle = angles[0, j] - angles[0, i] + (directions[k, j] - directions[k, i])
            sine, cosine = math.sin(angle), math.cos(angle)
            pull[0, i] -= first * sine
            pull[0, j] += second * sine
            for row in range(1, rows):
                change = cosine * (angles[row, j] - angles[row, i])
                pull[row, i] -= first * change
                pull[row, j] += second * change


@borrowing_kernel
def _look_ahead(nodes, at, h, share, a1, a2, a3, work):
    """Put into `work[ANGLES]` the angles at a share of the step down from node `at`, and derivatives."""
    _s, psi, rate, dpsi, drate = nodes
    along, h2 = share * h, h * h
    for i in range(work.shape[2]):
        bent = a1 * work[0, 0, i] + a2 * work[1, 0, i] + a3 * work[2, 0, i]
        work[ANGLES, 0, i] = psi[at, i] - along * rate[at, i] + h2 * bent
    for c in range(work.shape[1] - 1):
        for i in range(work.shape[2]):
            bent = a1 * work[0, c + 1, i] + a2 * work[1, c + 1, i] + a3 * work[2, c + 1, i]
            work[ANGLES, c + 1, i] = dpsi[at, c, i] - along * drate[at, c, i] + h2 * bent


@merged_kernel
def _look_from(nodes, at, h, stiffness, cutting, k, work):
    """Fill the four stages of `work` of the step of `h` down from node `at`."""
    _look_ahead(nodes, at, h, 0.0, 0.0, 0.0, 0.0, work)
    _pull(stiffness, cutting, k, work[ANGLES], work[0])
    _look_ahead(nodes, at, h, C2, A21, 0.0, 0.0, work)
    _pull(stiffness, cutting, k, work[ANGLES], work[1])
    _look_ahead(nodes, at, h, C3, A31, A32, 0.0, work)
    _pull(stiffness, cutting, k, work[ANGLES], work[2])
    _look_ahead(nodes, at, h, 1.0, A41, A42, A43, work)
    _pull(stiffness, cutting, k, work[ANGLES], work[3])


@borrowing_kernel
def _step(nodes, at, h, stiffness, cutting, k, work):
    """Take a step of -h from node `at` to the one before it; `rate` is along s, so its sign is turned."""
    _s, psi, rate, dpsi, drate = nodes
    _look_from(nodes, at, h, stiffness, cutting, k, work)
    h2 = h * h
    for i in range(work.shape[2]):
        bent = P1 * work[0, 0, i] + P2 * work[1, 0, i] + P3 * work[2, 0, i]
        turned = R1 * work[0, 0, i] + R2 * work[1, 0, i] + R3 * work[2, 0, i] + R4 * work[3, 0, i]
        psi[at - 1, i] = psi[at, i] - h * rate[at, i] + h2 * bent
        rate[at - 1, i] = rate[at, i] - h * turned
        for c in range(work.shape[1] - 1):
            dbent = P1 * work[0, c + 1, i] + P2 * work[1, c + 1, i] + P3 * work[2, c + 1, i]
            dturned = R1 * work[0, c + 1, i] + R2 * work[1, c + 1, i]
            dturned += R3 * work[2, c + 1, i] + R4 * work[3, c + 1, i]
            dpsi[at - 1, c, i] = dpsi[at, c, i] - h * drate[at, c, i] + h2 * dbent
            drate[at - 1, c, i] = drate[at, c, i] - h * dturned


@merged_kernel
def _coast(nodes, at, h):
    """Take a step of -h from node `at` where no two tubes are bent: torsion stays."""
    _s, psi, rate, dpsi, drate = nodes
    for i in range(psi.shape[1]):
        psi[at - 1, i] = psi[at, i] - h * rate[at, i]
        rate[at - 1, i] = rate[at, i]
        for c in range(dpsi.shape[1]):
            dpsi[at - 1, c, i] = dpsi[at, c, i] - h * drate[at, c, i]
            drate[at - 1, c, i] = drate[at, c, i]


@kernel(_nrt=False)
def twist(design, cutting, tip_angles, nodes, steps, work):
    """Integrate torsion from the tip to the front plate.

    Args:
        design (tuple): See `assembly`.
        cutting (tuple): pieces, moments, directions, and the number of pieces, as `assembly.cut` fills them.
        tip_angles ((n,) float64): psi_i at the end of each tube, rad.
        nodes (tuple): s (N + 1,), psi and u in rad and rad/mm (N + 1, n), their derivatives by the tip angles
            of the first m tubes (N + 1, m, n); node 0 is at the front plate, node N at the tip.  Is filled.
        steps (tuple): Length in mm (N,) and the piece (N,) int64 of each step.  Is filled.
        work ((SCRATCH_ROWS, n, n) float64): Scratch.
    """
    pieces, _moments, _directions, count = cutting
    s, psi, rate, dpsi, drate = nodes
    lengths, piece_of = steps
    n, columns, at = tip_angles.shape[0], dpsi.shape[1], lengths.shape[0]
    work[:] = 0.0
    s[at] = pieces[count - 1, FAR] if count > 0 else 0.0
    for i in range(n):
        psi[at, i], rate[at, i] = tip_angles[i], 0.0
        for c in range(columns):
            dpsi[at, c, i] = 1.0 if c == i else 0.0
            drate[at, c, i] = 0.0
    for k in range(count - 1, -1, -1):
        number = int(pieces[k, STEPS])
        h = (pieces[k, FAR] - pieces[k, NEAR]) / number
        bent = pieces[k, BENT] > 1.0
        if bent and n <= FEW:
            _step_few(design[0], cutting, k, h, nodes, at, number)
        for m in range(number):
            at -= 1
            s[at] = pieces[k, NEAR] + (number - 1 - m) * h
            lengths[at], piece_of[at] = h, k
            if not bent:
                _coast(nodes, at + 1, h)
            elif n > FEW:
                _step(nodes, at + 1, h, design[0], cutting, k, work)
