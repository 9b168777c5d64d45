"""In which order joints move: turn and insert nested tubes from the scope tip to their final place."""

from collections.abc import Sequence as SequenceOf
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.device import Tube

BEND_RAD = 0.5 * np.pi
"""Rotation of a rear end at which the tube bends towards +x of the scope tip."""
ROUNDING_MM = 1e-9
"""Rounding forgiven where lengths are compared."""


@frozen_record
class Sequence:
    """Waypoints of all joints; between two of them every joint moves at a steady rate.

    Args:
        moves: What happens during the motion to each waypoint after the first, W - 1 of them.
        base_angles_rad, beta_mm ((W, n) float64): Rotations of the tubes' bases and arc lengths of these
            bases from the scope tip (never above 0), innermost tube first.

    Raises:
        SettingsError: If the numbers of waypoints, moves and tubes do not fit, or a value is not finite.
    """

    name: str
    moves: tuple[str, ...]
    base_angles_rad: Float
    beta_mm: Float

    def __post_init__(self) -> None:
        angles = np.array(self.base_angles_rad, dtype=np.float64, ndmin=2)
        beta = np.array(self.beta_mm, dtype=np.float64, ndmin=2)
        if angles.shape != beta.shape or len(beta) != len(self.moves) + 1 or beta.shape[1] == 0:
            raise SettingsError(
                f"Sequence {self.name!r} has {len(self.moves)} moves, angles of shape {angles.shape} and "
                f"insertions of shape {beta.shape}",
                expected="one row a waypoint, one column a tube, and one move less than waypoints",
            )
        if not (np.isfinite(angles).all() and np.isfinite(beta).all()):
            raise SettingsError(
                f"A joint of sequence {self.name!r} is not finite", expected="numbers in mm and rad"
            )
        object.__setattr__(self, "base_angles_rad", read_only(angles))
        object.__setattr__(self, "beta_mm", read_only(beta))

    @property
    def n_tubes(self) -> int:
        """Number of tubes, n."""
        return int(self.beta_mm.shape[1])

    def then_turn(self, base_angles_rad: ArrayLike, move: str = "turn in place") -> Self:
        """Return this sequence with one more move: the bases turn to `base_angles_rad` (n,)."""
        angles = _one_each(base_angles_rad, self.n_tubes)[None]
        return type(self)(
            name=f"{self.name}, {move}",
            moves=(*self.moves, move),
            base_angles_rad=np.concatenate([self.base_angles_rad, angles]),
            beta_mm=np.concatenate([self.beta_mm, self.beta_mm[-1:]]),
        )


def together(tubes: SequenceOf[Tube], base_angles_rad: ArrayLike, insertions_mm: ArrayLike) -> Sequence:
    """Turn in the scope, insert all tubes with flush tips; each stops at its own insertion.

    Tubes are n, the innermost first; the bases are turned by angles `(n,)`, or all by one; `insertions_mm`
    `(n,)` tells how far each tip comes out of the scope.

    Raises:
        SettingsError: If an outer tube would be ahead of an inner one, or a tube is too short.
    """
    insertions = _insertions(tubes, insertions_mm)
    levels = np.unique(insertions[insertions > 0.0])
    moves = [(_insert(tubes, insertions >= level), np.minimum(insertions, level)) for level in levels]
    return _from_insertions("together", tubes, base_angles_rad, moves)


def kuntz2015(tubes: SequenceOf[Tube], rotation_rad: ArrayLike, outer_mm: float, inner_mm: float) -> Sequence:
    """Turn, insert both tubes together, insert the inner one alone [Kuntz2015, sec. IV-B].

    Tubes are the inner and the outer one; one rotation in the scope turns both.  Raises SettingsError if
    there are not two tubes, the outer one would be ahead, or one is too short.
    """
    if len(tubes) != 2:
        raise SettingsError(f"There are {len(tubes)} tubes", expected="two tubes, the inner one first")
    made = together(tubes, rotation_rad, (inner_mm, outer_mm))
    return replace(made, name="kuntz2015")


def inner_first(tubes: SequenceOf[Tube], base_angles_rad: ArrayLike, insertions_mm: ArrayLike) -> Sequence:
    """As `together`, but each tube goes in wholly before the next; the innermost is long enough to."""
    insertions = _insertions(tubes, insertions_mm)
    numbers = np.arange(len(insertions))
    moves = [
        (_insert(tubes, numbers == last), np.where(numbers <= last, insertions, 0.0))
        for last in numbers[insertions > 0.0]
    ]
    return _from_insertions("inner first", tubes, base_angles_rad, moves)


DEFAULT_INCREMENT_MM = 5.0
"""Increment of the alternating sequences: a compromise of sweep and the number of motions."""


def alternating(
    tubes: SequenceOf[Tube],
    base_angles_rad: ArrayLike,
    insertions_mm: ArrayLike,
    *,
    increment_mm: float = DEFAULT_INCREMENT_MM,
) -> Sequence:
    """As `together`, but tubes go in by increments in turns, the innermost tube ahead."""
    if not 0.0 < increment_mm < np.inf:
        raise SettingsError(f"The increment is {increment_mm:g} mm", expected="a finite length above 0")
    insertions = _insertions(tubes, insertions_mm)
    numbers = np.arange(len(insertions))
    inserted = np.zeros_like(insertions)
    moves: list[tuple[str, Float]] = []
    while (inserted < insertions).any():
        for tube in numbers[inserted < insertions]:
            inserted = np.where(numbers == tube, np.minimum(inserted + increment_mm, insertions), inserted)
            moves.append((_insert(tubes, numbers == tube), inserted))
    return _from_insertions("alternating", tubes, base_angles_rad, moves)


def joint_steps(
    sequence: Sequence, tubes: SequenceOf[Tube], *, step_mm: float, step_rad: float
) -> tuple[Float, Float, np.ndarray]:
    """Cut a sequence into steps, also where a curved part leaves the scope or the next tube.

    No joint moves more in a step than stated.  Returned are base angles and arc lengths of bases `(K, n)`,
    and the move of each step `(K,)`, an index into `sequence.moves`; the first step, of move 0, is the first
    waypoint.

    Raises:
        SettingsError: If a step is not above 0, the tubes are others, or they get out of order on the way.
    """
    if not (0.0 < step_mm < np.inf and 0.0 < step_rad < np.inf):
        raise SettingsError(f"The steps are {step_mm:g} mm, {step_rad:g} rad", expected="finite, above 0")
    _require_order(sequence, tubes)
    landmarks = _landmarks(tubes)
    joints = np.hstack([sequence.base_angles_rad, sequence.beta_mm])
    rows, moves = [joints[:1]], [np.zeros(1, dtype=np.int64)]
    for number, (a, b) in enumerate(zip(joints[:-1], joints[1:], strict=True)):
        change = np.abs(b - a)
        n = sequence.n_tubes
        count = max(np.ceil(change[:n].max() / step_rad), np.ceil(change[n:].max() / step_mm), 1.0)
        share = np.unique(np.concatenate([np.arange(1, count + 1) / count, _crossings(landmarks, a, b)]))
        rows.append(a + share[:, None] * (b - a))
        moves.append(np.full(len(share), number))
    steps = np.concatenate(rows)
    beta = _in_order(steps[:, sequence.n_tubes :], np.array([tube.length_mm for tube in tubes]))
    return steps[:, : sequence.n_tubes], beta, np.concatenate(moves)


def _in_order(beta: Float, lengths: Float) -> Float:
    """Undo what rounding did to the order of tips that are flush, and of bases at the scope tip."""
    beta = np.minimum(np.maximum(beta, -lengths), 0.0)
    for tube in range(len(lengths) - 2, -1, -1):
        behind = beta[:, tube + 1] + lengths[tube + 1] - (beta[:, tube] + lengths[tube])
        # The last digit of a length is less.
        beta[:, tube] += np.where(behind > 0.0, behind + 1e-12, 0.0)
    return beta


def _landmarks(tubes: SequenceOf[Tube]) -> list[tuple[int, float]]:
    """Return (tube, distance from its base) of tube ends and of the borders of bent pieces."""
    marks = []
    for number, tube in enumerate(tubes):
        borders = {tube.length_mm} | {end for bend in tube.bends for end in (bend.from_mm, bend.to_mm)}
        marks += [(number, border) for border in sorted(borders)]
    return marks


def _crossings(landmarks: list[tuple[int, float]], a: Float, b: Float) -> Float:
    """Return the shares of the motion from `a` to `b` at which a landmark passes the scope tip or another."""
    n = len(a) // 2
    start = np.array([a[n + tube] + border for tube, border in landmarks] + [0.0])
    end = np.array([b[n + tube] + border for tube, border in landmarks] + [0.0])
    first, second = np.triu_indices(len(start), 1)
    gap, closing = start[first] - start[second], (start - end)[first] - (start - end)[second]
    moving = np.abs(closing) > ROUNDING_MM
    share = gap[moving] / closing[moving]
    return np.asarray(share[(share > 0.0) & (share < 1.0)])


def _insert(tubes: SequenceOf[Tube], moving: np.ndarray) -> str:
    if moving.all():
        return "insert the tube" if len(tubes) == 1 else "insert all tubes"
    if len(tubes) == 2:
        return f"insert the {'inner' if moving[0] else 'outer'} tube"
    numbers = " and ".join(str(number + 1) for number in np.flatnonzero(moving))
    return f"insert tube {numbers} (from the inside)"


def _insertions(tubes: SequenceOf[Tube], insertions_mm: ArrayLike) -> Float:
    insertions = np.array(insertions_mm, dtype=np.float64, ndmin=1)
    if insertions.shape != (len(tubes),) or not len(tubes) or not np.isfinite(insertions).all():
        raise SettingsError(
            f"The insertions are {insertions.tolist()} mm",
            expected=f"one finite length for each of the {len(tubes)} tubes",
            remedy="Give one insertion for each tube",
        )
    if not ((insertions >= 0.0).all() and (np.diff(insertions) <= ROUNDING_MM).all()):
        raise SettingsError(
            f"The insertions are {', '.join(f'{v:g}' for v in insertions)} mm, innermost tube first",
            expected="0 <= outer <= inner",
            remedy="Insert the inner tube at least as far as the outer one",
        )
    return insertions


def _one_each(base_angles_rad: ArrayLike, n: int) -> Float:
    try:
        return np.broadcast_to(np.asarray(base_angles_rad, dtype=np.float64), (n,))
    except ValueError:
        raise SettingsError(
            f"The rotations are {np.asarray(base_angles_rad).tolist()}",
            expected=f"one angle, or one for each of the {n} tubes",
        ) from None


TURN = "turn"


def _from_insertions(
    name: str, tubes: SequenceOf[Tube], base_angles_rad: ArrayLike, moves: list[tuple[str, Float]]
) -> Sequence:
    """Make the sequence that turns in the scope and then goes through insertions."""
    n = len(tubes)
    angles = _one_each(base_angles_rad, n)
    insertions = np.array([np.zeros(n), np.zeros(n), *(stop for _, stop in moves)])
    made = Sequence(
        name=name,
        moves=(TURN, *(label for label, _ in moves)),
        base_angles_rad=np.vstack([np.zeros(n), np.tile(angles, (len(moves) + 1, 1))]),
        beta_mm=insertions - [tube.length_mm for tube in tubes],
    )
    _require_order(made, tubes)
    return made


def _require_order(sequence: Sequence, tubes: SequenceOf[Tube]) -> None:
    """Refuse waypoints at which tips or bases are out of order, or a base would be in front of the scope."""
    if len(tubes) != sequence.n_tubes:
        raise SettingsError(
            f"Sequence {sequence.name!r} is for {sequence.n_tubes} tubes", expected=f"{len(tubes)} tubes"
        )
    lengths = np.array([tube.length_mm for tube in tubes])
    beta, tips = sequence.beta_mm, sequence.beta_mm + lengths
    if not (beta <= ROUNDING_MM).all():
        raise SettingsError(
            f"The insertions of sequence {sequence.name!r} reach {tips.max(axis=0).tolist()} mm",
            expected=f"at most the lengths of the tubes, {lengths.tolist()} mm",
            remedy="Insert less, or take longer tubes",
        )
    if not ((tips >= -ROUNDING_MM).all() and (np.diff(tips, axis=1) <= ROUNDING_MM).all()):
        raise SettingsError(
            f"In sequence {sequence.name!r} an outer tube is ahead of an inner one, or a tip is in the scope",
            expected="tips in order: 0 <= outer <= inner",
        )
    ahead = (tips[:, :-1] - tips[:, 1:]) - (lengths[:-1] - lengths[1:])
    if not (ahead <= ROUNDING_MM).all():
        worst = int(np.argmax(ahead.max(axis=0)))
        raise SettingsError(
            f"In sequence {sequence.name!r} tube {worst + 1} (from the inside) is "
            f"{(tips[:, worst] - tips[:, worst + 1]).max():g} mm ahead of the next one",
            expected=f"at most the difference of their lengths, {lengths[worst] - lengths[worst + 1]:g} mm",
            remedy="Make the inner tube longer, or advance the outer one with it",
        )
