"""The shape of one deployment of any design, derived by the CasADi model alone: a second opinion for checks.

Nothing of the kernels takes part: neither their integration nor their judgement of stability.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.casadi_model import CasadiTubes
from stages.tube.casadi_statics import derive_loaded
from stages.tube.device import Tube
from stages.tube.errors import ConvergenceError
from stages.tube.sequences import BEND_RAD, joint_steps, together

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
        relative_rad ((N, n - 1) float64): Angles of the tubes around the innermost, relative to it, where
            they are.
        base_from_tip ((4, 4) float64): Material frame of the innermost tube at its end.
        way (tuple of (K, 4) float64): Arc lengths and points, mm, of every step of the way, the last of which
            is the deployment.
        least_determinant: Least on the way of the derivative of base angles by tip angles: above 0 the tubes
            nowhere snap.
    """

    arc_lengths_mm: Float
    points_mm: Float
    relative_rad: Float
    base_from_tip: Float
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

    Args:
        tubes: The innermost first.
        rotations_rad, insertions_mm ((n,) float64): As in `stages.tube.shapes.TubeShapes`.
        needle: Straight; its tip stays where that of the innermost tube is, so it is one more tube, the
            innermost.

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
        tubes, turned = (
            (replace(needle, length_mm=needle.length_mm + BEYOND_MM), *tubes),
            np.append(0.0, turned),
        )
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
        least_determinant=least,
        way=tuple(read_only(each[:, :4].copy()) for each in way),
    )


def derive_arrival(
    tubes: Sequence[Tube], needle: Tube, rotations_rad: ArrayLike, insertions_mm: ArrayLike
) -> tuple[Float, Float]:
    """Return the frames `(4, 4)` of the tubes' tip without a needle, and of a needle's that has come to it.

    With its tip at theirs a needle is one more tube, the innermost and straight.  No tissue holds the tubes.

    Raises:
        ConvergenceError: If no equilibrium is found.
        SettingsError: If the insertions are impossible.
    """
    turned = np.asarray(rotations_rad, dtype=np.float64) + BEND_RAD
    out = np.asarray(insertions_mm, dtype=np.float64)
    beta = out - [tube.length_mm for tube in tubes]
    rear = out[0] + BEYOND_MM - needle.length_mm
    before = CasadiTubes(tubes).solve(turned, beta)
    arrived = CasadiTubes((needle, *tubes)).solve(np.append(0.0, turned), np.append(rear, beta))
    return before.base_from_tip, arrived.base_from_tip


def derive_inserted(
    tubes: Sequence[Tube], needle: Tube, rotations_rad: ArrayLike, insertions_mm: ArrayLike, needle_mm: float
) -> Float:
    """Return the frame `(4, 4)` of the tubes' tip with a needle whose tip is `needle_mm` beyond it.

    Errors are those of `derive_arrival`.
    """
    turned = np.asarray(rotations_rad, dtype=np.float64) + BEND_RAD
    out = np.asarray(insertions_mm, dtype=np.float64)
    beta = out - [tube.length_mm for tube in tubes]
    return derive_loaded(tubes, needle, turned, beta, float(out[0] + needle_mm)).base_from_tip


def _stepped(model: CasadiTubes, base: Float, begin: Float, end: Float, tips: Float) -> tuple[Float, float]:
    """Follow the rear ends from `begin` to `end`, in parts of the step where the tips turn fast.

    Returns the tip angles there, and the least determinant.
    """
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
