"""Deployments of any design, and tubes with a needle in them, by CasADi alone: a second opinion for checks.

Nothing of the kernels takes part: neither their integration nor their judgement of stability.  Tubes with a
needle, in tissue or free, are a boundary value problem: force and moment of the whole, and the torsional
moments of the tubes, are carried by Runge-Kutta steps from the tip, where they are 0, to the front plate,
where frame and rear ends are given; Newton's method finds the tip [Rucker2011].
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.casadi_model import CasadiEquilibrium, CasadiTubes
from stages.tube.casadi_rates import (
    SAME_MM,
    about_z,
    bending_n_mm2,
    forward_of,
    landmarks_mm,
    rest_curvature_per_mm,
    runge_kutta,
    spin_of,
)
from stages.tube.device import Tube
from stages.tube.errors import ConvergenceError
from stages.tube.sequences import BEND_RAD, joint_steps, together

STEPS = 24
"""Runge-Kutta steps in each piece."""
STAGES = tuple((k / 12.0) ** 3 for k in range(13))
"""Shares of the needle's stiffness with which its shape is looked for, one after the other."""
LARGEST_RESIDUAL = 1e-9
"""In mm, rad and units of a quaternion: a larger one after Newton's method means that it did not converge."""
# Places in the state of the loaded tubes: position, quaternion of the Bishop frame, force and moment in the
# frame of the front plate; then angles and torsional moments.  The same without force and moment follow for
# the tubes before the needle comes.
POSITION, ROTATION, FORCE, MOMENT, FIRST_ANGLE = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13), 13


@frozen_record
class LoadedShape:
    """Tubes with a needle in them, in the frame of the front plate: N points `(N, 3)` up to the tubes' tip.

    The frame `(4, 4)` of the tip is carried along without turning; `tip_angles_rad` (n,) are those of each
    tube at its own end.
    """

    arc_lengths_mm: Float
    points_mm: Float
    base_from_tip: Float
    tip_angles_rad: Float


def derive_loaded(
    tubes: Sequence[Tube],
    needle: Tube,
    base_angles_rad: ArrayLike,
    beta_mm: ArrayLike,
    needle_mm: float,
    *,
    tissue_n_mm2: float = 0.0,
    tissue_from_mm: float = 0.0,
    begun: "DerivedShape | None" = None,
) -> LoadedShape:
    """Return the shape of tubes that stood in tissue without a needle, when its tip is at `needle_mm`.

    Tubes are listed from the innermost, their joints `(n,)` are those of
    `stages.tube.mechanics.TubeMechanics`; the needle is straight, and its tip counts along the tubes from the
    front plate.  Tissue presses with `tissue_n_mm2` for each mm of tube and mm aside, beyond the arc length
    `tissue_from_mm`; one far stiffer than lungs makes the problem too steep.

    Args:
        begun: The shape with the needle in them from which they come.  Tubes that are turned against each
            other may have several; without it the one is found that follows from the tubes alone.

    Raises:
        ConvergenceError: If no shape is found.
        SettingsError: As `CasadiTubes.solve`, or if nothing is ahead of the front plate.
    """
    beta, base = np.asarray(beta_mm, dtype=np.float64), np.asarray(base_angles_rad, dtype=np.float64)
    before = CasadiTubes(tubes).solve(base, beta)
    pieces = _pieces(tubes, needle, beta, needle_mm, tissue_from_mm)
    if not pieces:
        raise SettingsError("No tube is ahead of the front plate", expected="deployed tubes")
    problem = _Shooting(tubes, needle, beta, needle_mm, pieces, tissue_n_mm2, tissue_from_mm)
    reference = _tip_of(before)
    unknown = reference.copy() if begun is None else _tip_of(begun)
    for share in STAGES if begun is None else STAGES[-1:]:
        unknown = problem.solved(unknown, reference, base, share)
    states = np.array(problem.body(unknown, reference, 1.0).full())
    places = np.concatenate([np.linspace(far, near, STEPS + 1)[1:] for far, near in pieces])
    found = np.eye(4)
    found[:3, 3] = unknown[:3]
    found[:3, :3] = Rotation.from_quat(np.roll(unknown[3:7], -1)).as_matrix()
    return LoadedShape(
        arc_lengths_mm=read_only(np.append(pieces[0][0], places)[::-1].copy()),
        points_mm=read_only(np.vstack([unknown[:3], states[POSITION].T])[::-1].copy()),
        base_from_tip=read_only(found),
        tip_angles_rad=read_only(unknown[7:]),
    )


def _tip_of(shape: "CasadiEquilibrium | DerivedShape") -> Float:
    """Return position and quaternion of the tip's frame, as it is carried without turning, and all angles."""
    tip, angles = shape.base_from_tip, shape.tip_angles_rad
    carried = Rotation.from_matrix(tip[:3, :3]) * Rotation.from_euler("z", -angles[0])
    return np.concatenate([tip[:3, 3], np.roll(carried.as_quat(canonical=True), 1), angles])


def _pieces(
    tubes: Sequence[Tube], needle: Tube, beta: Float, needle_mm: float, tissue_from_mm: float
) -> list[tuple[float, float]]:
    """Return far and near ends of the pieces in which nothing changes, from the tip to the front plate."""
    tip = float(beta[0]) + tubes[0].length_mm
    marks = {0.0, tip, tissue_from_mm}
    for body, rear in zip((*tubes, needle), (*beta, needle_mm - needle.length_mm), strict=True):
        marks |= {float(rear) + mark for mark in landmarks_mm(body)}
    ends = [0.0]
    for mark in sorted(marks):
        if ends[-1] + SAME_MM < mark <= tip:
            ends.append(mark)
    return [(far, near) for near, far in itertools.pairwise(ends)][::-1]


class _Shooting:
    """Carries a guess of the tip to the front plate."""

    def __init__(
        self,
        tubes: Sequence[Tube],
        needle: Tube,
        beta: Float,
        needle_mm: float,
        pieces: list[tuple[float, float]],
        tissue_n_mm2: float,
        tissue_from_mm: float,
    ) -> None:
        self._tubes, self._beta, self._pieces = tubes, beta, pieces
        self._needle, self._needle_rear = needle, needle_mm - needle.length_mm
        self._twisting = [tube.torsional_stiffness_n_mm2 for tube in tubes]
        self._tissue = [tissue_n_mm2 if near >= tissue_from_mm - SAME_MM else 0.0 for _far, near in pieces]
        n = len(tubes)
        unknown, reference = casadi.MX.sym("unknown", 7 + n), casadi.MX.sym("reference", 7 + n)
        base, share = casadi.MX.sym("base", n), casadi.MX.sym("share")
        states = self._carried(unknown, reference, share)
        last = states[:, -1]
        twisted = last[FIRST_ANGLE + n : FIRST_ANGLE + 2 * n] / casadi.DM(self._twisting)
        angles = last[FIRST_ANGLE : FIRST_ANGLE + n] + casadi.DM(beta) * twisted
        residual = casadi.vertcat(last[POSITION], last[ROTATION] - casadi.DM([1, 0, 0, 0]), angles - base)
        self.body = casadi.Function("body", [unknown, reference, share], [states])
        given = casadi.vertcat(reference, base, share)
        self._residual = casadi.Function("residual", [unknown, given], [residual])
        options = {"abstol": 1e-12, "max_iter": 40, "error_on_fail": False}
        self._root = casadi.rootfinder("root", "newton", {"x": unknown, "p": given, "g": residual}, options)

    def solved(self, guess: Float, reference: Float, base: Float, share: float) -> Float:
        """Return tip position, quaternion and angles for which the front plate is where it is."""
        given = np.concatenate([reference, base, [share]])
        found = self._root(x0=guess, p=given)["x"]
        left = float(np.abs(self._residual(found, given).full()).max())
        if not left <= LARGEST_RESIDUAL:
            raise ConvergenceError(
                f"With {share:.3g} of the needle's stiffness Newton's method leaves a residual of {left:.3g}",
                expected=f"at most {LARGEST_RESIDUAL:g}",
                remedy="Take softer tissue, or tubes farther from a snap",
            )
        return np.asarray(found.full()[:, 0])

    def _carried(self, unknown: Any, reference: Any, share: Any) -> Any:
        """Return the states after each step, from the tip on."""
        rest, states = casadi.MX.zeros(len(self._tubes)), []
        state = casadi.vertcat(unknown[:7], casadi.MX.zeros(6), unknown[7:], rest, reference, rest)
        for (far, near), tissue in zip(self._pieces, self._tissue, strict=True):
            step = self._step(0.5 * (far + near), tissue)
            shares, length = casadi.repmat(share, 1, STEPS), casadi.DM([(near - far) / STEPS])
            states.append(step.mapaccum(STEPS)(state, casadi.repmat(length, 1, STEPS), shares))
            state = states[-1][:, -1]
        return casadi.horzcat(*states)

    def _step(self, middle: float, tissue: float) -> Any:
        """Return the Runge-Kutta step in a piece: state, step in mm, share of the needle -> state."""
        n = len(self._tubes)
        state, length = casadi.SX.sym("state", FIRST_ANGLE + 4 * n + 7), casadi.SX.sym("step_mm")
        share = casadi.SX.sym("share")
        rate = casadi.Function("rate", [state, share], [self._rates(state, share, middle, tissue)])
        return casadi.Function("step", [state, length, share], [runge_kutta(rate, state, length, share)])

    def _rates(self, state: Any, share: Any, middle: float, tissue: float) -> Any:
        """Return the derivative of the state by arc length [Rucker2011]."""
        n = len(self._tubes)
        bending, rest = [], []
        for tube, rear in zip(self._tubes, self._beta, strict=True):
            marks = landmarks_mm(tube)
            part = int(np.searchsorted(marks, middle - rear))
            bending.append(bending_n_mm2(tube, marks, part))
            rest.append(rest_curvature_per_mm(tube, marks, part))
        marks = landmarks_mm(self._needle)
        stiff = bending_n_mm2(self._needle, marks, int(np.searchsorted(marks, middle - self._needle_rear)))
        loaded, before = state[: FIRST_ANGLE + 2 * n], state[FIRST_ANGLE + 2 * n :]
        ahead, ahead_before = forward_of(loaded[ROTATION]), forward_of(before[ROTATION])
        off = loaded[POSITION] - before[POSITION]
        across = off - ahead_before * casadi.dot(ahead_before, off)
        # A vector in the frame of a quaternion.
        vector, w, axis = loaded[MOMENT], loaded[ROTATION][0], -loaded[ROTATION][1:]
        aside = 2 * casadi.cross(axis, vector)
        local = vector + w * aside + casadi.cross(axis, aside)
        rates = []
        for part, moment, total in (
            (loaded[FIRST_ANGLE:], local, sum(bending) + share * stiff),
            (before[7:], casadi.SX.zeros(3), sum(bending)),
        ):
            turns = [about_z(part[i])[:2, :2] @ rest[i] for i in range(n)]
            u = (moment[:2] + sum(bending[i] * turns[i] for i in range(n))) / total
            twists = [part[n + i] / self._twisting[i] if bending[i] else casadi.SX(0) for i in range(n)]
            pulls = [bending[i] * (u[0] * turns[i][1] - u[1] * turns[i][0]) for i in range(n)]
            rates.append((u, [*twists, *pulls]))
        (u, twisted), (u_before, twisted_before) = rates
        return casadi.vertcat(
            ahead, spin_of(loaded[ROTATION], u[0], u[1]), tissue * across, casadi.cross(loaded[FORCE], ahead),
            *twisted,
            ahead_before, spin_of(before[ROTATION], u_before[0], u_before[1]), *twisted_before,
        )  # fmt: skip


STEP_MM = 1.0
"""Largest motion between two steps."""
LARGEST_TURN_RAD = 0.2
"""Largest turn of a tip in a step that is no jump: where the tubes are about to snap they turn faster."""
BEYOND_MM = 1e-6
"""So far ahead of the tubes' tip a needle's is that has arrived, lest rounding put it behind."""
LEAST_SHARE = 1.0 / 64.0
"""Tips that still turn as far in this share of a step are said to jump."""


@frozen_record
class DerivedShape:
    """One deployment, followed from the scope tip on.

    Args:
        arc_lengths_mm ((N,) float64): From the scope tip, rising from 0.
        points_mm ((N, 3) float64): Of the centreline, in the frame of the scope tip.
        relative_rad ((N, n - 1) float64): Angles of the tubes around the innermost where they are, less its.
        base_from_tip ((4, 4) float64): Material frame of the innermost tube at its end.
        tip_angles_rad ((n,) float64): Of each tube at its own end.
        way (tuple of (K, 4) float64): Arc lengths and points, mm, of every step; the last is the deployment.
        least_determinant: Least derivative of base by tip angles on the way: above 0 the tubes nowhere snap.
    """

    arc_lengths_mm: Float
    points_mm: Float
    relative_rad: Float
    base_from_tip: Float
    tip_angles_rad: Float
    least_determinant: float
    way: tuple[Float, ...]

    def at(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return points `(M, 3)` mm at arc lengths `(M,)`, straight between those that were derived."""
        s = np.asarray(arc_lengths_mm, dtype=np.float64)
        return np.stack([np.interp(s, self.arc_lengths_mm, axis) for axis in self.points_mm.T], axis=1)


def derive_shape(
    tubes: Sequence[Tube], rotations_rad: ArrayLike, insertions_mm: ArrayLike, *, needle: Tube | None = None
) -> DerivedShape:
    """Follow the tubes to a deployment by the sequence `together`, with the CasADi model.

    Tubes are listed from the innermost, their joints `(n,)` are those of `stages.tube.shapes.TubeShapes`.  A
    straight needle's tip stays where that of the innermost tube is, so it is one more tube, the innermost.

    Raises:
        ConvergenceError: If the tubes snap on the way: their equilibrium loses stability or jumps.
        SettingsError: If the insertions are impossible.
    """
    turned = np.asarray(rotations_rad, dtype=np.float64) + BEND_RAD
    sequence = together(tubes, turned, insertions_mm)
    angles, betas, moves = joint_steps(sequence, tubes, step_mm=STEP_MM, step_rad=np.pi)
    if needle is not None:
        # Its rear end goes with that of the innermost tube, and it has no torsion: its angle stays 0.
        behind = betas[:, :1] + (tubes[0].length_mm - needle.length_mm)
        betas, angles = np.hstack([behind, betas]), np.hstack([np.zeros_like(behind), angles])
        tubes = (replace(needle, length_mm=needle.length_mm + BEYOND_MM), *tubes)
        turned = np.append(0.0, turned)
    model = CasadiTubes(tubes)
    tips, least, before = turned, 1.0, betas[moves == 0][-1]
    way = []
    for base, beta in zip(angles[moves > 0], betas[moves > 0], strict=True):
        tips, determinant = _stepped(model, base, before, beta, tips)
        least, before = min(least, determinant), beta
        way.append(model.body(tips, beta))
    body, tip = way[-1], np.array(model.given_tip_angles(tips, betas[-1]).base_from_tip)
    relative = body[:, 4:]
    if needle is not None:
        relative = relative[:, 1:] - relative[:, :1]
        tip[:3, :3] = tip[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, tips[1] - tips[0]]).as_matrix()
    return DerivedShape(
        arc_lengths_mm=read_only(body[:, 0].copy()),
        points_mm=read_only(body[:, 1:4].copy()),
        relative_rad=read_only(relative.copy()),
        base_from_tip=read_only(tip),
        tip_angles_rad=read_only(tips if needle is None else tips[1:]),
        least_determinant=least,
        way=tuple(read_only(each[:, :4].copy()) for each in way),
    )


def derive_arrival(
    tubes: Sequence[Tube], needle: Tube, rotations_rad: ArrayLike, insertions_mm: ArrayLike
) -> tuple[Float, Float]:
    """Return the frames `(4, 4)` of the tubes' tip without a needle, and of a needle's that has come to it.

    With its tip at theirs a needle is one more tube, the innermost and straight.  No tissue holds the tubes.
    Raises ConvergenceError if no equilibrium is found, as of tubes that snap on their way, and SettingsError
    if the insertions are impossible.
    """
    turned = np.asarray(rotations_rad, dtype=np.float64) + BEND_RAD
    out = np.asarray(insertions_mm, dtype=np.float64)
    if np.ptp(turned) > 0.0:
        # Tubes that are turned against each other may have several shapes: theirs is the one they come to.
        alone, loaded = (derive_shape(tubes, rotations_rad, out, needle=each) for each in (None, needle))
        return alone.base_from_tip, loaded.base_from_tip
    beta = out - [tube.length_mm for tube in tubes]
    rear = out[0] + BEYOND_MM - needle.length_mm
    before = CasadiTubes(tubes).solve(turned, beta)
    arrived = CasadiTubes((needle, *tubes)).solve(np.append(0.0, turned), np.append(rear, beta))
    return before.base_from_tip, arrived.base_from_tip


def derive_inserted(
    tubes: Sequence[Tube], needle: Tube, rotations_rad: ArrayLike, insertions_mm: ArrayLike, needle_mm: float
) -> Float:
    """Return the tubes' tip frame `(4, 4)`, the needle `needle_mm` beyond it; errors as `derive_shape`."""
    turned = np.asarray(rotations_rad, dtype=np.float64) + BEND_RAD
    out = np.asarray(insertions_mm, dtype=np.float64)
    beta = out - [tube.length_mm for tube in tubes]
    # The shape to which turned tubes come, as in `derive_arrival`.
    begun = derive_shape(tubes, rotations_rad, out, needle=needle) if np.ptp(turned) > 0.0 else None
    return derive_loaded(tubes, needle, turned, beta, float(out[0] + needle_mm), begun=begun).base_from_tip


def _stepped(model: CasadiTubes, base: Float, begin: Float, end: Float, tips: Float) -> tuple[Float, float]:
    """Follow the rear ends from `begin` to `end`; return the tip angles there, and the least determinant."""
    done, share, least = 0.0, 1.0, 1.0
    while done < 1.0:
        to = min(done + share, 1.0)
        beta = begin + to * (end - begin) if to < 1.0 else end
        try:
            found = model.solve(base, beta, tips)
        except ConvergenceError:
            # Next to opposite tubes Newton's method needs a guess that is nearer.
            if share <= LEAST_SHARE:
                raise
            share *= 0.5
            continue
        jumped = float(np.abs(found.tip_angles_rad - tips).max())
        if found.determinant > 0.0 and jumped <= LARGEST_TURN_RAD:
            done, tips, least = to, found.tip_angles_rad, min(least, found.determinant)
            continue
        share *= 0.5
        if share < LEAST_SHARE:
            raise ConvergenceError(
                f"With rear ends at {np.round(beta, 2).tolist()} mm the tips turn by {jumped:.3g} rad and "
                f"the determinant is {found.determinant:.3g}",
                expected=f"at most {LARGEST_TURN_RAD:g} rad in {LEAST_SHARE * STEP_MM:g} mm, and a "
                "determinant above 0",
                remedy="Turn the tubes less against each other, or insert them less far",
            )
    return tips, least
