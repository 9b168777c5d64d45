"""Compiled kernels of decisions: what may be done from poses as measured, and what most likely succeeds.

A path of the needle is `(A, 3)`: length in mm, roll in rad before it and curvature in 1/mm of each arc.  A
small error moves a point `p` by `W x p - U`: a turn about the axis `a` through `r` has `W = a`, `U = a x r`.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, Int, UInt16
from anatomy.kernels.arcs import arc_to_point, normal_on_arc, point_on_arc, pose_on_arc
from anatomy.kernels.compiling import inner_kernel, kernel
from anatomy.kernels.field import distance_bound
from lungaccess.planning.procedure.kernels import spread
from lungaccess.uncertainty.risk.kernels.chain import BORDER, TARGET, TILT, TUBE_PIECES, find_end, set_planar
from lungaccess.uncertainty.risk.kernels.deviation import N_PIECE, follow
from stages.needle.kernels import Limits, Obstacles, blocker_on_arc, single_arc_exceeds
from stages.tube.kernels import ACCEPTED, BRANCH, N_TRACE, validate_arcs

STATIONS = 16
"""Points of a path at which clearance is compared with the errors: some mm apart, as vessels are wide."""
FEW = 12.0
"""Places as good as so many equal ones have to be near a measurement to stand for where a tip may be."""
LOOKED_AT = 5
"""Deployments whose tubes are followed in draws from one pose, the likeliest to first order."""
BETTER = 0.01
"""Another deployment than the best so far has to promise so much more: less is not told by the draws."""
TIE = 1e-3
"""Of paths whose chances differ by less, the one that is aimed again is taken: it ends in the target."""
PLANNED, THROUGH, DIRECT = range(3)
"""What a path is made of: the planned arcs, arcs through where these would have turned, and a single arc."""


class Scene(NamedTuple):
    """What surrounds the devices, and what they may do.

    `obstacles` and `limits` are the needle's, `judged` are all obstacles with the flags that are `forbidden`,
    `depth` and `depth_geometry` are those of the lumen, `radius` is that of the goal, and `aside` is how far
    from its centre it is aimed at where that cannot be reached.
    """

    around: spread.Around
    obstacles: Obstacles
    limits: Limits
    judged: Obstacles
    forbidden: int
    depth: UInt16
    depth_geometry: Float
    mediastinal: Bool
    radius: float
    aside: float
    with_needle: bool
    replanned: bool


class Choices(NamedTuple):
    """C deployments to choose from; the first is the planned one.

    `shapes` `(C, A, ARC_COLUMNS)` holds `n_arcs` arcs of each, and `beside` what these need free around them.
    `tubes` `(C, 11)` are those of planar tubes as `chain.Devices` has them; of others it is empty.
    """

    scope_from_tip: Float
    rotations: Float
    exits: Float
    lengths: Float
    tubes: Float
    shapes: Float
    n_arcs: Int
    beside: Float
    errors: Float


@inner_kernel
def _below(standard):
    return 0.5 * math.erfc(-standard * 0.7071067811865476)


@inner_kernel
def _goal_chance(offset, sums, radius):
    """Return the chance to end within a radius, of a sum of chi-squares [Satterthwaite1946, Wilson1931]."""
    x, y, z = offset
    mean = sums[0] + sums[1] + sums[2] + spread.dot(offset, offset)
    squares = sums[0] ** 2 + sums[1] ** 2 + sums[2] ** 2
    squares += 2.0 * (sums[3] ** 2 + sums[4] ** 2 + sums[5] ** 2)
    across = sums[0] * x * x + sums[1] * y * y + sums[2] * z * z
    across += 2.0 * (sums[3] * x * y + sums[4] * x * z + sums[5] * y * z)
    variance = 2.0 * squares + 4.0 * across
    if variance < spread.SMALL:
        return 1.0 if mean <= radius * radius else 0.0
    ninths = variance / (9.0 * mean * mean)
    return _below(((radius * radius / mean) ** (1.0 / 3.0) - 1.0 + ninths) / math.sqrt(ninths))


@inner_kernel
def _moved(moves, point):
    """Return what an error `(6,)` does to a point, see the module."""
    turned = spread.cross((moves[0], moves[1], moves[2]), point)
    return turned[0] - moves[3], turned[1] - moves[4], turned[2] - moves[5]


@inner_kernel
def _turned_normal(pose, normal, roll):
    c, s = math.cos(roll), math.sin(roll)
    b = spread.cross((pose[3], pose[4], pose[5]), normal)
    return c * normal[0] + s * b[0], c * normal[1] + s * b[1], c * normal[2] + s * b[2]


@inner_kernel
def _set_turn(moves, t, r, sign):
    """Add a turn about the axis `t` through the point `r` to an error `(6,)`."""
    u = spread.cross(t, r)
    for m in range(3):
        moves[m] += sign * t[m]
        moves[3 + m] += sign * u[m]


@inner_kernel
def path_chance(scene, sizes, base, forward, tip, arcs, count, target, rolls, needed):
    """Return the chance to first order that a needle stays clear along a path and ends in the goal.

    The path starts at a tip (4, 4), behind a scope tip; without any of its `count` arcs it is the tubes that
    end in the goal.  `rolls` (A + 1, 6) is scratch: errors of each roll, and of the curvature.  A
    chance below `needed` is of no use, and is returned as 0 as soon as that is known.
    """
    at, ahead = (tip[0, 3], tip[1, 3], tip[2, 3]), (tip[0, 2], tip[1, 2], tip[2, 2])
    about, _size = spread.unit(spread.cross(forward, ahead))
    normal = (tip[0, 0], tip[1, 0], tip[2, 0])
    pose = (at[0], at[1], at[2], ahead[0], ahead[1], ahead[2])
    rolls[: count + 1] = 0.0
    curved = rolls[count]
    spacing = max(arcs[:count, 0].sum() / STATIONS, 1e-6)
    least, done, point = spread.CAP, 0.0, at
    sums = spread.of_tip(sizes, at, base, forward, about, at, ahead)
    for a in range(count):
        length, kappa = arcs[a, 0], arcs[a, 2]
        normal = _turned_normal(pose, normal, arcs[a, 1])
        bend = (kappa, normal[0], normal[1], normal[2])
        t, r = (pose[3], pose[4], pose[5]), (pose[0], pose[1], pose[2])
        axis = spread.cross(t, normal)
        _set_turn(rolls[a], t, r, 1.0)
        steps = max(int(math.ceil(length / spacing - 1e-9)), 1)
        for k in range(steps):
            step = length / steps
            _set_turn(curved, axis, point_on_arc(pose, bend, (k + 0.5) * step), kappa * step)
            point = point_on_arc(pose, bend, (k + 1) * step)
            sums = spread.of_tip(sizes, point, base, forward, about, at, ahead)
            sums = spread.add(sums, sizes.curvature, _moved(curved, point))
            for e in range(a + 1):
                sums = spread.add(sums, sizes.roll, _moved(rolls[e], point))
            if done + (k + 1) * step > sizes.exempt:
                x, y, z = point
                clear = distance_bound(scene.obstacles.clearance, scene.obstacles.geometry, x, y, z)
            else:
                clear = spread.clearance_at(scene.around, point, False)
            margin = spread.margin_of(clear - sizes.needle_radius, sums)
            if margin < least:
                least = margin
                if _below(least) < needed:
                    return 0.0
        normal = normal_on_arc(pose, bend, length)
        pose = pose_on_arc(pose, bend, length)
        done += length
        _set_turn(rolls[a], (pose[3], pose[4], pose[5]), (pose[0], pose[1], pose[2]), -1.0)
    sums = spread.add(spread.shift(sums, sizes.target), sizes.stop, (pose[3], pose[4], pose[5]))
    sums = spread.add(sums, sizes.breathing, (0.0, 0.0, 1.0))
    offset = (point[0] - target[0], point[1] - target[1], point[2] - target[2])
    return _goal_chance(offset, sums, scene.radius) * _below(least)


@inner_kernel
def _path_through(limits, tip, vias, count, target, arcs):
    """Fill the arcs from a tip through points to the target; tell whether they keep the needle's limits."""
    pose = (tip[0, 3], tip[1, 3], tip[2, 3], tip[0, 2], tip[1, 2], tip[2, 2])
    normal = (tip[0, 0], tip[1, 0], tip[2, 0])
    long, turned = 0.0, 0.0
    for a in range(count + 1):
        goal = target
        if a < count:
            goal = (
                tip[0, 0] * vias[a, 0] + tip[0, 1] * vias[a, 1] + tip[0, 2] * vias[a, 2] + tip[0, 3],
                tip[1, 0] * vias[a, 0] + tip[1, 1] * vias[a, 1] + tip[1, 2] * vias[a, 2] + tip[1, 3],
                tip[2, 0] * vias[a, 0] + tip[2, 1] * vias[a, 1] + tip[2, 2] * vias[a, 2] + tip[2, 3],
            )
        length, bend, turn = arc_to_point(pose, goal)
        long, turned = long + length, turned + turn
        if single_arc_exceeds(limits, bend, long, turned):
            return False
        towards = (bend[1], bend[2], bend[3])
        side = spread.cross((pose[3], pose[4], pose[5]), normal)
        roll = math.atan2(spread.dot(towards, side), spread.dot(towards, normal))
        arcs[a, 0], arcs[a, 1], arcs[a, 2] = length, roll, bend[0]
        normal = normal_on_arc(pose, bend, length)
        pose = pose_on_arc(pose, bend, length)
    return True


@inner_kernel
def _is_clear(scene, tip, arcs, count, branch):
    """Tell whether a path is proved clear."""
    pose = (tip[0, 3], tip[1, 3], tip[2, 3], tip[0, 2], tip[1, 2], tip[2, 2])
    normal, done = (tip[0, 0], tip[1, 0], tip[2, 0]), 0.0
    for a in range(count):
        length = arcs[a, 0]
        normal = _turned_normal(pose, normal, arcs[a, 1])
        bend = (arcs[a, 2], normal[0], normal[1], normal[2])
        if blocker_on_arc(scene.obstacles, scene.limits, pose, bend, length, done, branch) != 0:
            return False
        normal = normal_on_arc(pose, bend, length)
        pose = pose_on_arc(pose, bend, length)
        done += length
    return True


@inner_kernel
def _reach_chance(scene, sizes, base, forward, tip, target):
    """Return the chance that the target lies within the needle's bending from where the tubes truly end."""
    if not scene.replanned:
        return 1.0
    at, ahead = (tip[0, 3], tip[1, 3], tip[2, 3]), (tip[0, 2], tip[1, 2], tip[2, 2])
    about, _size = spread.unit(spread.cross(forward, ahead))
    offset = (target[0] - at[0], target[1] - at[1], target[2] - at[2])
    along = spread.dot(offset, ahead)
    x, y, z = along * ahead[0], along * ahead[1], along * ahead[2]
    normal, off = spread.unit((offset[0] - x, offset[1] - y, offset[2] - z))
    sums = spread.of_scope(sizes, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), target, base, forward)
    sums = spread.of_insertion(sizes, sums, target, at, ahead, about)
    return _below(spread.reach_margin(sizes, along, off, normal, sums))


@inner_kernel
def _set_start(frame, place, errors, d, start):
    """Fill the start of a chain at a place, tilted against a frame by small errors."""
    a, b = errors[d, TILT], errors[d, TILT + 1]
    size = math.sqrt(1.0 + a * a + b * b)
    for m in range(3):
        start[m] = place[m]
        start[3 + m] = (frame[m, 2] - a * frame[m, 1] + b * frame[m, 0]) / size
    along = start[3] * frame[0, 0] + start[4] * frame[1, 0] + start[5] * frame[2, 0]
    size = math.sqrt(1.0 - along * along)
    for m in range(3):
        start[6 + m] = (frame[m, 0] - along * start[3 + m]) / size


@inner_kernel
def _share_clear(scene, choices, c, frame, places, target, of_needle, best, start, pieces):
    """Return the share of draws in which planar tubes touch nothing forbidden; 0 once it cannot be enough.

    Without a needle they have to end in the goal, too.
    """
    depth = (scene.depth, scene.depth_geometry)
    draws, failed = choices.errors.shape[0], 0
    for d in range(draws):
        _set_start(frame, places[d], choices.errors, d, start)
        set_planar(choices.tubes[c], choices.errors, d, pieces)
        good = True
        if not scene.with_needle:
            end = find_end(start, pieces)
            x = end[0] - target[0] - choices.errors[d, TARGET]
            y = end[1] - target[1] - choices.errors[d, TARGET + 1]
            z = end[2] - target[2] - choices.errors[d, TARGET + 2]
            good = math.sqrt(x * x + y * y + z * z) <= scene.radius
        if good:
            touched = follow(
                scene.judged,
                depth,
                scene.mediastinal,
                start,
                pieces,
                TUBE_PIECES,
                0.0,
                scene.forbidden,
                choices.errors[d, BORDER],
            )
            good = touched & scene.forbidden == 0
        failed += not good
        if of_needle * (draws - failed) <= best * draws:
            return 0.0
    return (draws - failed) / draws


@inner_kernel
def _share(scene, untracked, choices, c, frame, places, target, tip, planned, chances, scratch):
    """Return the chance that the tubes of a choice are clear, and end in the goal where there is no needle.

    Args:
        chances (tuple of 3 floats): Of the needle and of the tubes to first order, and what both together
            have to be better than.
    """
    of_needle, of_tubes, least = chances
    rolls, start, pieces = scratch
    if choices.tubes.shape[0] > 0:
        clear = _share_clear(scene, choices, c, frame, places, target, of_needle, least, start, pieces)
        return min(of_tubes, clear)
    if scene.with_needle:
        return of_tubes
    base, forward = (frame[0, 3], frame[1, 3], frame[2, 3]), (frame[0, 2], frame[1, 2], frame[2, 2])
    return of_tubes * path_chance(scene, untracked, base, forward, tip, planned, 0, target, rolls, 0.0)


@kernel(nogil=True)
def find_places(places, measured, size, fallback, luck, likely, drawn):
    """Find where tips most likely are that were measured, and draw places where they may be.

    Args:
        places ((M, 3) float64): Where tips may be before anything is measured, all alike.
        measured, size: (N, 3) float64, with this standard deviation along each axis.
        fallback ((N, D, 3) float64): Places to draw where too few of all are near what was measured.
        luck ((D,) float64): Numbers from 0 to 1, in rising order, that choose among them.
        likely ((N, 3) float64): Holds what holds where too few are near, and receives the mean.
        drawn ((N, D, 3) float64): Receives places.
    """
    weights = np.zeros(places.shape[0])
    for n in range(measured.shape[0]):
        total, squares = 0.0, 0.0
        for m in range(places.shape[0]):
            x, y = places[m, 0] - measured[n, 0], places[m, 1] - measured[n, 1]
            z = places[m, 2] - measured[n, 2]
            weights[m] = math.exp(-0.5 * (x * x + y * y + z * z) / max(size * size, spread.SMALL))
            total += weights[m]
            squares += weights[m] * weights[m]
        if total * total < FEW * squares or squares == 0.0:
            drawn[n] = fallback[n]
            continue
        likely[n] = 0.0
        below, d = 0.0, 0
        for m in range(places.shape[0]):
            share = weights[m] / total
            below += share
            for k in range(3):
                likely[n, k] += share * places[m, k]
            while d < luck.shape[0] and luck[d] <= below:
                drawn[n, d] = places[m]
                d += 1
        while d < luck.shape[0]:
            drawn[n, d] = places[-1]
            d += 1


@inner_kernel
def _validated(environment, constants, choices, c, frame, trace, tip):
    """Tell whether the tubes may be deployed from a pose as a choice has them, and note what they pierce."""
    base, normal, turn = np.zeros(6), np.zeros(3), choices.rotations[c]
    for m in range(3):
        base[m], base[3 + m] = frame[m, 3], frame[m, 2]
        normal[m] = math.cos(turn) * frame[m, 0] + math.sin(turn) * frame[m, 1]
    arcs = choices.shapes[c, : choices.n_arcs[c]]
    beside = choices.beside[c]
    return validate_arcs(environment, constants, base, normal, arcs, beside, trace, tip) == ACCEPTED


@kernel(nogil=True)
def choose_tubes(
    scene, sizes, environment, constants, choices, planned, vias, branch, target, placed, found, chances, arcs
):
    """Choose tubes, and the needle behind them, from poses of the scope's tip.

    Args:
        sizes (pair of Sizes): What is left of the errors for a needle that is planned again behind the tubes,
            and for another.
        environment, constants: Of the tubes, see `stages.tube.kernels.placing`.
        planned, vias ((A, 3), (A - 1, 3) float64): The planned path of the needle and where its arcs meet, in
            the frame of its start.
        branch (int): The branch that is pierced as planned.
        placed (pair of (N, 4, 4) and (N, D, 3) float64): Most likely poses of the scope's tip, and places
            where it may be.
        found ((N, 3) int64): Receives the number of the choice, arcs of the path, and the pierced branch.
        chances, arcs ((N,), (N, A, 3) float64): Receive the chance of the choice to first order, and the
            path.
    """
    count, known, untracked = choices.rotations.shape[0], sizes[0], sizes[1]
    frames, drawn = placed
    tips, tubes = np.zeros((count, 4, 4)), np.zeros(count)
    needles, order = np.zeros(count), np.zeros(count)
    kinds = np.zeros(count, dtype=np.int64)
    most = arcs.shape[1]
    paths, rolls = np.zeros((3, most, 3)), np.zeros((most + 1, 6))
    start, pieces = np.zeros(9), np.zeros((TUBE_PIECES, N_PIECE))
    trace, end = np.zeros(N_TRACE), np.zeros(9)
    straight = np.zeros((count, 3))
    for n in range(frames.shape[0]):
        frame = frames[n]
        base, forward = (frame[0, 3], frame[1, 3], frame[2, 3]), (frame[0, 2], frame[1, 2], frame[2, 2])
        best, chosen, kind, taken, looked = 0.0, 0, PLANNED, 1, 0
        for c in range(count):
            tip = tips[c]
            for i in range(4):
                for j in range(4):
                    tip[i, j] = 0.0
                    for k in range(4):
                        tip[i, j] += frame[i, k] * choices.scope_from_tip[c, k, j]
            at, ahead = (tip[0, 3], tip[1, 3], tip[2, 3]), (tip[0, 2], tip[1, 2], tip[2, 2])
            margin = spread.tube_margin(
                scene.around, known, base, forward, at, ahead, choices.exits[c], choices.lengths[c]
            )
            tubes[c], needles[c] = _below(margin), 0.0 if scene.with_needle else 1.0
            # Going on as planned comes first: whatever else there is has to be better.
            least = best + BETTER if c > 0 else -1.0
            if (
                scene.with_needle
                and tubes[c] > least
                and _path_through(scene.limits, tip, vias, 0, target, paths[DIRECT])
            ):
                reached = _reach_chance(scene, known, base, forward, tip, target)
                if tubes[c] * reached > least:
                    straight[c] = paths[DIRECT, 0]
                    kinds[c] = DIRECT
                    needed = least / max(tubes[c] * reached, spread.SMALL)
                    needles[c] = reached * path_chance(
                        scene, known, base, forward, tip, paths[DIRECT], 1, target, rolls, needed
                    )
            order[c] = -needles[c] * tubes[c]
            if c > 0:
                continue
            accepted = _validated(environment, constants, choices, c, frame, trace, end)
            found[n, 2] = np.int64(trace[BRANCH]) if accepted else branch
            if scene.with_needle:
                direct, size, pierced = needles[0], planned.shape[0], found[n, 2]
                if direct > 0.0 and not _is_clear(scene, tip, straight[:1], 1, pierced):
                    direct = 0.0
                paths[PLANNED, :size] = planned
                needles[0] = path_chance(
                    scene, untracked, base, forward, tip, planned, size, target, rolls, 0.0
                )
                kinds[0] = PLANNED
                if size > 1 and _path_through(scene.limits, tip, vias, size - 1, target, paths[THROUGH]):
                    through = path_chance(
                        scene, known, base, forward, tip, paths[THROUGH], size, target, rolls, 0.0
                    )
                    if through > needles[0] - TIE and _is_clear(scene, tip, paths[THROUGH], size, pierced):
                        needles[0], kinds[0] = through, THROUGH
                if direct > max(needles[0] - TIE, 0.0):
                    needles[0], kinds[0] = direct, DIRECT
            best = needles[0] * _share(
                scene, untracked, choices, c, frame, drawn[n], target, tip, planned,
                (needles[0], tubes[0], 0.0), (rolls, start, pieces),
            )  # fmt: skip
            kind = kinds[0]
        order[0] = 0.0
        for c in np.argsort(order):
            if needles[c] * tubes[c] <= best + BETTER or looked == LOOKED_AT:
                break
            if c == 0 or not _validated(environment, constants, choices, c, frame, trace, end):
                continue
            pierced = np.int64(trace[BRANCH])
            if scene.with_needle and not _is_clear(scene, tips[c], straight[c : c + 1], 1, pierced):
                continue
            looked += 1
            share = _share(
                scene, untracked, choices, c, frame, drawn[n], target, tips[c], planned,
                (needles[c], tubes[c], best + BETTER), (rolls, start, pieces),
            )  # fmt: skip
            if needles[c] * share > best:
                best, chosen, kind = needles[c] * share, c, kinds[c]
                found[n, 2] = pierced
        if kind == DIRECT:
            paths[DIRECT, 0] = straight[chosen]
        elif scene.with_needle:
            taken = planned.shape[0]
        if scene.with_needle:
            arcs[n] = 0.0
            arcs[n, :taken] = paths[kind, :taken]
        found[n, 0], found[n, 1], chances[n] = chosen, taken if scene.with_needle else 0, best


@inner_kernel
def _aside(scene, tip, target, number):
    """Return the point of the goal beside its centre that needs the `number`th least bending, of six."""
    bends, points = np.zeros(6), np.zeros((6, 3))
    for side in range(6):
        for m in range(3):
            points[side, m] = target[m]
        points[side, side % 3] += scene.aside if side < 3 else -scene.aside
        pose = (tip[0, 3], tip[1, 3], tip[2, 3], tip[0, 2], tip[1, 2], tip[2, 2])
        _length, bend, _turn = arc_to_point(pose, (points[side, 0], points[side, 1], points[side, 2]))
        bends[side] = bend[0]
    best = points[np.argsort(bends)[number]]
    return best[0], best[1], best[2]


@kernel(nogil=True)
def choose_needles(scene, sizes, tips, branches, targets, asides, found, chances, arcs):
    """Choose the path of the needle from N poses of the tubes' tip, with what is left once it is measured.

    Args:
        asides (int): Points beside the target that are aimed at where its centre cannot be reached.
        found ((N, 3) int64): Holds in its second column how many arcs the path so far has, and receives how
            many the new one has, and in the third one how many paths are proved clear.
        chances, arcs ((N,), (N, A, 3) float64): Receive the chances and the paths; the latter hold those so
            far.
    """
    most = arcs.shape[1]
    paths, rolls, vias = np.zeros((3, most, 3)), np.zeros((most + 1, 6)), np.zeros((most, 3))
    nowhere = (0.0, 0.0, 0.0)
    for n in range(tips.shape[0]):
        tip, size, branch = tips[n], found[n, 1], branches[n]
        target = (targets[n, 0], targets[n, 1], targets[n, 2])
        pose, normal = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
        for a in range(size):
            paths[PLANNED, a] = arcs[n, a]
            normal = _turned_normal(pose, normal, arcs[n, a, 1])
            bend = (arcs[n, a, 2], normal[0], normal[1], normal[2])
            normal = normal_on_arc(pose, bend, arcs[n, a, 0])
            pose = pose_on_arc(pose, bend, arcs[n, a, 0])
            vias[a, 0], vias[a, 1], vias[a, 2] = pose[0], pose[1], pose[2]
        best = path_chance(scene, sizes, nowhere, nowhere, tip, paths[PLANNED], size, target, rolls, 0.0)
        proved = 0
        for attempt in range(2 + asides):
            through = attempt == 0
            if (through and size < 2) or (attempt > 1 and proved > 0):
                continue
            count = size if through else 1
            path = paths[THROUGH] if through else paths[DIRECT]
            goal = target if attempt < 2 else _aside(scene, tip, target, attempt - 2)
            if not _path_through(scene.limits, tip, vias, count - 1, goal, path):
                continue
            if not _is_clear(scene, tip, path, count, branch):
                continue
            proved += 1
            chance = path_chance(scene, sizes, nowhere, nowhere, tip, path, count, target, rolls, 0.0)
            # Beside the target nothing is gained where going on succeeds as often.
            if chance > best + (TIE if attempt > 1 else -TIE):
                best, found[n, 1] = chance, count
                arcs[n] = 0.0
                arcs[n, :count] = path[:count]
        found[n, 2], chances[n] = proved, best


@kernel(nogil=True)
def deviated_planar(tubes, errors, pieces):
    """Fill the arcs `(N, TUBE_PIECES, 4)` of planar tubes `(N, 11)` with errors of their own."""
    for n in range(tubes.shape[0]):
        set_planar(tubes[n], errors, n, pieces[n])
