"""Carry out a sequence of joint motions: every step's equilibrium, sideways motion, and snaps."""

from collections.abc import Sequence as SequenceOf

import numpy as np
from scipy.spatial import cKDTree

from anatomy.base.errors import LungaccessError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.tube.equilibrium import Equilibrium
from stages.tube.errors import ConvergenceError
from stages.tube.kernels.shapes import LARGEST_STRAY_RAD, SAME_BRANCH_RAD, UNSUSPICIOUS_RAD
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import Sequence, joint_steps

DEFAULT_STEP_MM = 1.0
DEFAULT_STEP_RAD = 0.1
"""Largest motion of a joint between two steps: small against the bends, so that branches are followed."""
SAMPLE_MM = 0.25
"""Spacing of the points of the body that are looked at; the tip is always one of them."""


class SnapError(LungaccessError):
    """The tubes would snap: during the motion they lose stability, or their branch of equilibria ends.

    Args:
        move: During which move of the sequence.
        base_angles_rad, insertions_mm ((n,) float64): First joints found out of reach, innermost tube first.
        last: The last stable equilibrium before them.
    """

    def __init__(
        self, why: str, *, move: str, base_angles_rad: Float, insertions_mm: Float, last: Equilibrium
    ) -> None:
        self.why, self.move, self.last = why, move, last
        self.base_angles_rad, self.insertions_mm = base_angles_rad, insertions_mm
        turned = ", ".join(f"{angle:.1f}" for angle in np.degrees(base_angles_rad))
        out = ", ".join(f"{length:.2f}" for length in insertions_mm)
        super().__init__(
            f"The tubes snap during the move {move!r}: {why} at rotations of {turned} deg and insertions of "
            f"{out} mm, innermost tube first",
            expected="stable equilibria during the whole motion, each next to the one before",
            remedy="Turn the tubes less against each other, insert them less far, or take less precurvature",
        )


@frozen_record
class DeployedSequence:
    """All K steps of a deployment.

    Args:
        move ((K,) int64): The move of the sequence that a step belongs to.
        lateral_sweep_by_step_mm ((K,) float64): Largest distance of a point of the body from its final place:
            the point of the final centreline at the same arc length from the scope tip, or the final tip if
            the body is longer by then.
        follow_the_leader_by_step_mm ((K,) float64): Largest distance of a point of the body from the nearest
            point of the final centreline.
    """

    sequence: Sequence
    move: Int
    steps: tuple[Equilibrium, ...]
    lateral_sweep_by_step_mm: Float
    follow_the_leader_by_step_mm: Float

    @property
    def final(self) -> Equilibrium:
        """The equilibrium at the end."""
        return self.steps[-1]

    @property
    def lateral_sweep_mm(self) -> float:
        """Largest distance of any point of the body, at any step, from its final place, in mm."""
        return float(self.lateral_sweep_by_step_mm.max())

    @property
    def follow_the_leader_error_mm(self) -> float:
        """Largest distance of any point of the body, at any step, from the final centreline, in mm."""
        return float(self.follow_the_leader_by_step_mm.max())

    @property
    def least_determinant(self) -> float:
        """Least stability determinant of all steps; 0 is the point of snapping."""
        return min(step.least_determinant for step in self.steps)


def deploy(
    mechanics: TubeMechanics,
    sequence: Sequence,
    *,
    step_mm: float = DEFAULT_STEP_MM,
    step_rad: float = DEFAULT_STEP_RAD,
) -> DeployedSequence:
    """Follow the equilibrium of the tubes through a sequence [Kuntz2015], by steps that are no larger.

    Each step is solved from the tip angles of the one before.  A step is accepted if its equilibrium is
    stable, near the one before and, solved backwards, leads to it; otherwise the step is halved.

    Raises:
        SnapError: If the tubes snap during the motion.
        SettingsError: If the sequence does not fit the tubes.
    """
    angles, beta, move = joint_steps(sequence, mechanics.tubes, step_mm=step_mm, step_rad=step_rad)
    steps = [_first(mechanics, angles[0], beta[0])]
    for number in range(1, len(beta)):
        try:
            # How often a step is halved before its branch of equilibria is said to end there.
            steps.append(_reach(mechanics, steps[-1], angles[number], beta[number], 12))
        except _BranchEndError as end:
            raise SnapError(
                end.why,
                move=sequence.moves[move[number]],
                base_angles_rad=read_only(end.base_angles_rad),
                insertions_mm=read_only(end.beta_mm + mechanics.lengths_mm),
                last=end.last,
            ) from None
    sweep, error = motion_by_step(steps)
    return DeployedSequence(
        sequence=sequence,
        move=read_only(move),
        steps=tuple(steps),
        lateral_sweep_by_step_mm=read_only(sweep),
        follow_the_leader_by_step_mm=read_only(error),
    )


class _BranchEndError(Exception):
    """No stable equilibrium continues the branch."""

    def __init__(self, why: str, base_angles_rad: Float, beta_mm: Float, last: Equilibrium) -> None:
        super().__init__(why)
        self.why, self.base_angles_rad, self.beta_mm, self.last = why, base_angles_rad, beta_mm, last


def _first(mechanics: TubeMechanics, angles: Float, beta: Float) -> Equilibrium:
    found = mechanics.given_base_angles(angles, beta, guess_rad=angles)
    if not found.stable:
        raise SnapError(
            "the first joint values have no stable equilibrium",
            move="start",
            base_angles_rad=angles,
            insertions_mm=beta + mechanics.lengths_mm,
            last=found,
        )
    return found


def _reach(tubes: TubeMechanics, last: Equilibrium, angles: Float, beta: Float, halvings: int) -> Equilibrium:
    """Return the equilibrium that continues the branch of `last`, in smaller steps where needed."""
    found, why = _step(tubes, last, angles, beta)
    if found is not None:
        return found
    if halvings == 0:
        raise _BranchEndError(why, angles, beta, last)
    half_angles, half_beta = 0.5 * (last.base_angles_rad + angles), 0.5 * (last.beta_mm + beta)
    middle = _reach(tubes, last, half_angles, half_beta, halvings - 1)
    return _reach(tubes, middle, angles, beta, halvings - 1)


Found = tuple[Equilibrium | None, str]


def _step(tubes: TubeMechanics, last: Equilibrium, angles: Float, beta: Float) -> Found:
    """Return the next equilibrium, or None and why it does not continue the branch."""
    turn = angles - last.base_angles_rad
    try:
        found = tubes.given_base_angles(angles, beta, guess_rad=last.tip_angles_rad + turn)
        if not found.stable:
            return None, "stability is lost"
        stray = np.abs(found.tip_angles_rad - last.tip_angles_rad - turn).max()
        if stray > LARGEST_STRAY_RAD:
            return None, "they jump to another equilibrium"
        if stray > UNSUSPICIOUS_RAD:
            guess = found.tip_angles_rad - turn
            back = tubes.given_base_angles(last.base_angles_rad, last.beta_mm, guess_rad=guess)
            if np.abs(back.tip_angles_rad - last.tip_angles_rad).max() > SAME_BRANCH_RAD:
                return None, "they jump to another equilibrium"
    except ConvergenceError:
        return None, "no equilibrium was found nearby"
    return found, ""


def motion_by_step(steps: SequenceOf[Equilibrium]) -> tuple[Float, Float]:
    """Return (K,) sideways sweep and (K,) follow-the-leader error of steps against the last one, in mm."""
    final = steps[-1]
    arcs = [_samples(step.length_mm) for step in steps]
    bodies = np.concatenate([step.backbone(arc) for step, arc in zip(steps, arcs, strict=True)])
    places = final.backbone(np.minimum(np.concatenate(arcs), final.length_mm))
    # Spacing of the final centreline, which is taken to be straight in between: good to 1e-4 mm.
    track = final.backbone(_samples(final.length_mm, 0.1))
    first = np.cumsum([0, *(len(arc) for arc in arcs[:-1])])
    sweep = np.maximum.reduceat(np.linalg.norm(bodies - places, axis=1), first)
    error = np.maximum.reduceat(_distance_to_track(bodies, track), first)
    return sweep, np.minimum(error, sweep)


def _samples(length_mm: float, spacing_mm: float = SAMPLE_MM) -> Float:
    """Return arc lengths at fixed multiples of the spacing, and the end."""
    return np.append(np.arange(0.0, length_mm, spacing_mm), length_mm)


def _distance_to_track(points: Float, track: Float) -> Float:
    """Return the distances (N,) of points to a polyline, in mm."""
    if len(track) == 1:
        return np.asarray(np.linalg.norm(points - track[0], axis=1))
    _, nearest = cKDTree(track).query(points)
    begins = np.maximum(nearest - 1, 0), np.minimum(nearest, len(track) - 2)
    return np.minimum(*(_distance_to_segment(points, track[each], track[each + 1]) for each in begins))


def _distance_to_segment(points: Float, a: Float, b: Float) -> Float:
    along = b - a
    length2 = np.maximum(np.einsum("ij,ij->i", along, along), np.finfo(np.float64).tiny)
    share = np.clip(np.einsum("ij,ij->i", points - a, along) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - share[:, None] * along, axis=1))
