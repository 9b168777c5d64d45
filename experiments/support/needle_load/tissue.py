"""Tubes in tissue that holds them, as a needle comes through: a nested beam on an elastic foundation.

The tubes stand in tissue along the shape that they have without a needle.  A needle bends them away from
there; tissue pushes back, sideways, in proportion to how far each point has gone [Hetenyi1946].  What comes
to rest has the least energy of bending, torsion and tissue.  It is found from the shape without a needle by
Newton's method on short arcs of constant curvature: in some tenths of a second, for chosen deployments.

As what comes to rest has the least energy, tissue stores no more energy then than it would if the tubes took
their free shape: the mean square of how far they go aside is no larger than that of the free shape.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.errors import ConvergenceError
from stages.tube.kernels.assembly import FAR, SOFTNESS
from stages.tube.mechanics import TubeMechanics

LUNG_N_MM2 = (1e-3, 1e-2)
"""Stiffness of lung parenchyma as a foundation: force for each mm of beam and mm aside.

It is taken as Young's modulus times a factor between 0.7 (a slender beam on an elastic half-space has 0.33
[Vesic1961], and tissue is on both sides) and 1.6.  Young's modulus is 1.4 to 6.1 kPa [Polio2018], and for
dogs 1.5 to 2 times the pressure of inflation [LaiFook1976]."""
ELEMENT_MM = 0.5
"""Longest arc of the discretised beam."""
LEAST_SHARE = 2.0**-20
"""A step that has to be shortened to less than this goes nowhere."""
ROUNDING = 1e-13
"""Rounding of the energy, as a share of it."""
NEWTON_STEPS = 60
"""Newton's method needs some ten."""
TOLERANCE = 1e-10
"""Newton's method ends where it moves no curvature by more than this share of the largest, and no angle by
more in rad."""


@frozen_record
class HeldShape:
    """The tubes at rest in tissue, with a needle in them, in the frame of the front plate.

    Args:
        arc_lengths_mm ((N,) float64): From the front plate to the tubes' tip.
        points_mm: (N, 3) float64.
        sideways_mm ((N,) float64): How far each point is from where it was without a needle, across the path
            there.
        base_from_tip ((4, 4) float64): Frame of the tubes' tip, carried along without turning.
        tissue_n_per_mm: Largest force of tissue for each mm of tube.
    """

    arc_lengths_mm: Float
    points_mm: Float
    sideways_mm: Float
    base_from_tip: Float
    tissue_n_per_mm: float


class _Beam(NamedTuple):
    """N arcs of n tubes: length, total stiffness `(N,)`; moments, directions `(N, n)` of the precurvature."""

    length: Float
    stiffness: Float
    moments: Float
    directions: Float


class _Tissue(NamedTuple):
    """What holds the N + 1 ends of arcs: stiffness `(N + 1,)`, their places, and projections across these."""

    weights: Float
    points: Float
    across: Float


def held_shape(
    mechanics: TubeMechanics,
    base_angles_rad: ArrayLike,
    beta_mm: ArrayLike,
    *,
    needle_mm: float,
    tissue_n_mm2: float,
    tissue_from_mm: float = 0.0,
    element_mm: float = ELEMENT_MM,
) -> HeldShape:
    """Return the shape of tubes that stand in tissue without a needle, when a needle has come.

    Args:
        mechanics: With a needle.
        base_angles_rad, beta_mm ((n,) float64): See `TubeMechanics`.
        needle_mm: Where the needle's tip is.
        tissue_n_mm2: Force of tissue for each mm of beam and mm aside, 0 or more; see `LUNG_N_MM2`.
        tissue_from_mm: Arc length at which the tubes leave the airway; before it nothing holds them.
        element_mm: Longest arc of the discretised beam; errors fall with its square.

    Raises:
        SettingsError: If a number is impossible.
        ConvergenceError: If no shape at rest is found.
    """
    if not (0.0 <= tissue_n_mm2 < math.inf and element_mm > 0.0):
        raise SettingsError(
            f"Tissue of {tissue_n_mm2:g} N/mm^2 and elements of {element_mm:g} mm",
            expected="a finite stiffness of 0 or more, and elements longer than 0",
        )
    before = mechanics.given_base_angles(base_angles_rad, beta_mm, needle_mm=0.0)
    mechanics.given_tip_angles(before.tip_angles_rad, before.beta_mm, needle_mm=needle_mm)
    rear = mechanics.rear_ends(before.beta_mm[None].repeat(2, axis=0), np.array([needle_mm, 0.0]))
    nodes = _nodes(mechanics, rear[0], tissue_from_mm, element_mm)
    if len(nodes) < 2:
        raise SettingsError("No tube is ahead of the front plate", expected="deployed tubes")
    beam, unloaded = (_beam(mechanics, each, nodes) for each in rear)
    frames, found = before.frames(nodes), before.angles(nodes)
    angles = np.where(np.isnan(found), before.tip_angles_rad, found)
    hold = np.where(nodes[:-1] >= tissue_from_mm - 1e-9, tissue_n_mm2, 0.0) * beam.length
    tissue = _Tissue(
        weights=0.5 * (np.append(hold, 0.0) + np.append(0.0, hold)),
        points=frames[:, :3, 3],
        across=np.eye(3) - frames[:, :3, 2, None] * frames[:, None, :3, 2],
    )
    twisting = np.array([tube.torsional_stiffness_n_mm2 for tube in mechanics.tubes])
    # A tube whose rear end is at the front plate is held there: its shaft is as good as rigid.
    shaft = twisting / np.maximum(-before.beta_mm, 1e-6)
    base = np.array(base_angles_rad, dtype=np.float64)
    curvature = _pulled(unloaded, angles) / unloaded.stiffness[:, None]
    curvature = _settled(beam, tissue, (twisting, shaft, base), curvature, angles)
    points, turned = _laid(beam.length, curvature)
    sideways = np.linalg.norm(np.einsum("kij,kj->ki", tissue.across, points - tissue.points), axis=1)
    tip = np.eye(4)
    tip[:3, :3], tip[:3, 3] = turned[-1], points[-1]
    return HeldShape(
        arc_lengths_mm=read_only(nodes),
        points_mm=read_only(points),
        sideways_mm=read_only(sideways),
        base_from_tip=read_only(tip),
        tissue_n_per_mm=float((sideways * (tissue.weights > 0.0)).max() * tissue_n_mm2),
    )


def _nodes(mechanics: TubeMechanics, rear: Float, tissue_from_mm: float, element_mm: float) -> Float:
    """Return the ends of short arcs, `(N + 1,)` mm, among them all places where bodies or tissue change."""
    (pieces, _moments, _directions, count), _steps = mechanics.cut(rear.copy())
    edges = {0.0, *pieces[:count, FAR].tolist()}
    if edges and 0.0 < tissue_from_mm < max(edges):
        edges.add(tissue_from_mm)
    ends = sorted(edges)
    cuts = [max(math.ceil((far - near) / element_mm), 1) for near, far in pairwise(ends)]
    spread = [
        near + (far - near) * np.arange(n) / n for (near, far), n in zip(pairwise(ends), cuts, strict=True)
    ]
    return np.concatenate([*spread, ends[-1:]])


def _beam(mechanics: TubeMechanics, rear: Float, nodes: Float) -> _Beam:
    """Return what the arcs between nodes are made of."""
    (pieces, moments, directions, count), _steps = mechanics.cut(rear.copy())
    piece = np.searchsorted(pieces[:count, FAR], 0.5 * (nodes[1:] + nodes[:-1]))
    return _Beam(
        length=np.diff(nodes),
        stiffness=1.0 / pieces[piece, SOFTNESS],
        moments=moments[piece],
        directions=directions[piece],
    )


def _pulled(beam: _Beam, angles: Float) -> Float:
    """Return the sum of the tubes' moments `(N, 2)`, N mm, for angles `(N + 1, n)`."""
    phase = 0.5 * (angles[1:] + angles[:-1]) + beam.directions
    return np.stack([(beam.moments * np.cos(phase)).sum(1), (beam.moments * np.sin(phase)).sum(1)], axis=1)


def _laid(length: Float, curvature: Float) -> tuple[Float, Float]:
    """Return points `(N + 1, 3)` and rotations `(N + 1, 3, 3)` of arcs of constant curvature `(N, 2)`."""
    steps = np.zeros((len(length), 3))
    steps[:, :2] = length[:, None] * curvature
    turns = Rotation.from_rotvec(steps).as_matrix()
    local = length[:, None] * _along(steps)[0]
    points, turned = np.zeros((len(length) + 1, 3)), np.zeros((len(length) + 1, 3, 3))
    turned[0] = np.eye(3)
    for k, turn in enumerate(turns):
        points[k + 1] = points[k] + turned[k] @ local[k]
        turned[k + 1] = turned[k] @ turn
    return points, turned


def _along(steps: Float) -> tuple[Float, Float]:
    """Return the way along arcs of length 1 that turn by `(N, 3)`, with no turn about z, and its derivatives.

    They are `(N, 3)` and `(N, 3, 2)`; series, for turns far below 1.
    """
    x, y = steps[:, 0], steps[:, 1]
    t = x * x + y * y
    sinc, slope = 1.0 - t / 6.0 + t**2 / 120.0, -1.0 / 6.0 + t / 60.0
    bow, bow_slope = 0.5 - t / 24.0 + t**2 / 720.0, -1.0 / 24.0 + t / 360.0
    way = np.stack([bow * y, -bow * x, sinc], axis=1)
    by = np.zeros((len(steps), 3, 2))
    for m, each in enumerate((x, y)):
        by[:, 0, m], by[:, 1, m] = 2.0 * each * bow_slope * y, -2.0 * each * bow_slope * x
        by[:, 2, m] = 2.0 * each * slope
    by[:, 0, 1] += bow
    by[:, 1, 0] -= bow
    return way, by


def _motions(length: Float, curvature: Float, points: Float, turned: Float) -> Float:
    """Return how the points move `(N + 1, 3, N, 2)` with the curvatures."""
    n = len(length)
    steps = np.zeros((n, 3))
    steps[:, :2] = length[:, None] * curvature
    shift = length[:, None, None] ** 2 * np.einsum("kij,kjm->kim", turned[:-1], _along(steps)[1])
    cross = np.cross(np.eye(3)[None], steps[:, None, :])
    t = (steps**2).sum(1)[:, None, None]
    left = np.eye(3) - (0.5 - t / 24.0) * cross + (1.0 / 6.0 - t / 120.0) * cross @ cross
    turn = length[:, None, None] * (turned[:-1] @ left)[:, :, :2]
    arms = points[:, None, :] - points[None, 1:, :]
    moved = np.cross(turn.transpose(0, 2, 1)[None], arms[:, :, None, :]).transpose(0, 3, 1, 2)
    moved += shift.transpose(1, 0, 2)[None]
    ahead = np.arange(n + 1)[:, None] > np.arange(n)[None]
    return np.asarray(moved * ahead[:, None, :, None])


def _energy(
    beam: _Beam, tissue: _Tissue, torsion: tuple[Float, Float, Float], u: Float, angles: Float
) -> float:
    """Return the energy but for a constant, N mm."""
    twisting, shaft, base = torsion
    bent = (beam.length * (0.5 * beam.stiffness * (u * u).sum(1) - (u * _pulled(beam, angles)).sum(1))).sum()
    twisted = 0.5 * (twisting * np.diff(angles, axis=0) ** 2 / beam.length[:, None]).sum()
    twisted += 0.5 * (shaft * (angles[0] - base) ** 2).sum()
    off = np.einsum("kij,kj->ki", tissue.across, _laid(beam.length, u)[0] - tissue.points)
    return float(bent + twisted + 0.5 * (tissue.weights * (off * off).sum(1)).sum())


def _settled(
    beam: _Beam, tissue: _Tissue, torsion: tuple[Float, Float, Float], u: Float, angles: Float
) -> Float:
    """Return the curvatures `(N, 2)` at rest, from curvatures and angles before."""
    energy = _energy(beam, tissue, torsion, u, angles)
    for _ in range(NEWTON_STEPS):
        gradient, hessian = _derivatives(beam, tissue, torsion, u, angles)
        step = -cho_solve(cho_factor(_lifted(hessian)), gradient)
        by_u, by_angles = step[: u.size].reshape(u.shape), step[u.size :].reshape(angles.shape)
        share = 1.0
        while share > LEAST_SHARE:
            tried = _energy(beam, tissue, torsion, u + share * by_u, angles + share * by_angles)
            if tried <= energy + ROUNDING * abs(energy):
                break
            share *= 0.5
        u, angles, energy = u + share * by_u, angles + share * by_angles, tried
        largest = max(float(np.abs(u).max()), 1e-6)
        if np.abs(by_u).max() < TOLERANCE * largest and np.abs(by_angles).max() < TOLERANCE:
            return u
    raise ConvergenceError(
        f"Newton's method still moves curvatures by {np.abs(by_u).max():.3g}/mm after {NEWTON_STEPS} steps",
        expected="tubes at rest in tissue",
        remedy="Turn the tubes less against each other, or insert them less far",
    )


def _lifted(hessian: Float) -> Float:
    """Return a matrix that is positive definite: itself, or raised where tubes are about to snap."""
    least = float(np.linalg.eigvalsh(hessian)[0]) if not _definite(hessian) else 1.0
    return hessian if least > 0.0 else hessian + (1e-3 * np.abs(hessian).max() - least) * np.eye(len(hessian))


def _definite(matrix: Float) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _derivatives(
    beam: _Beam, tissue: _Tissue, torsion: tuple[Float, Float, Float], u: Float, angles: Float
) -> tuple[Float, Float]:
    """Return gradient and Hessian of the energy by curvatures, then angles.

    Of the tissue's part of the Hessian what the second derivative of points gives is left out.
    """
    twisting, shaft, base = torsion
    n, tubes = beam.moments.shape
    points, turned = _laid(beam.length, u)
    by = np.einsum("kij,kjnm->kinm", tissue.across, _motions(beam.length, u, points, turned)).reshape(
        3 * n + 3, 2 * n
    )
    off = np.einsum("kij,kj->ki", tissue.across, points - tissue.points).ravel()
    weights = np.repeat(tissue.weights, 3)
    gradient, hessian = np.zeros(2 * n + tubes * (n + 1)), np.zeros((2 * n + tubes * (n + 1),) * 2)
    gradient[: 2 * n] = (beam.length[:, None] * (beam.stiffness[:, None] * u - _pulled(beam, angles))).ravel()
    gradient[: 2 * n] += by.T @ (weights * off)
    hessian[: 2 * n, : 2 * n] = by.T @ (weights[:, None] * by)
    hessian[np.arange(2 * n), np.arange(2 * n)] += np.repeat(beam.length * beam.stiffness, 2)
    phase = 0.5 * (angles[1:] + angles[:-1]) + beam.directions
    pull = beam.length[:, None] * beam.moments
    here = np.arange(n)
    for tube in range(tubes):
        c, s = np.cos(phase[:, tube]), np.sin(phase[:, tube])
        turning = -pull[:, tube] * (u[:, 1] * c - u[:, 0] * s)
        bending = pull[:, tube] * (u[:, 0] * c + u[:, 1] * s)
        stiff = twisting[tube] / beam.length
        twist = stiff * np.diff(angles[:, tube])
        first = 2 * n + tube + tubes * here
        for end, sign in ((first, -1.0), (first + tubes, 1.0)):
            gradient[end] += 0.5 * turning + sign * twist
            for m, slope in ((0, s), (1, -c)):
                hessian[2 * here + m, end] += 0.5 * pull[:, tube] * slope
                hessian[end, 2 * here + m] += 0.5 * pull[:, tube] * slope
            for other, other_sign in ((first, -1.0), (first + tubes, 1.0)):
                hessian[end, other] += 0.25 * bending + sign * other_sign * stiff
    root = 2 * n + np.arange(tubes)
    gradient[root] += shaft * (angles[0] - base)
    hessian[root, root] += shaft
    return gradient, hessian
