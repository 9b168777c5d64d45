"""How near a moving bronchoscope comes to the border of the lumen, in its states and between them.

All places of the body's axis during a motion are cut into cells: pieces of arc that the section slides along,
and pieces of section and time where it twists or bends in place.  A cell is measured at its middle; no other
place of it is farther from the middle than its length and its motion say, so that a cell that may come too
near is cut in two, until it is seen whether it does.
"""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from lungaccess.judging.checking.boxes import Boxes
from lungaccess.judging.checking.scope_motion import Motion

FIRST_MM = 1.0
"""Half the length of cells to begin with: about the room that a scope has in the airways it fits into."""
SURE_MM = 1e-3
"""A cell whose places differ by less is not cut further."""


@frozen_record
class Cells:
    """Places of a moving section: C cells.

    Args:
        state ((C,) int64): State from which on the scope moves.
        along_mm, half_mm ((C,) float64): Middle and half length of the piece of arc, from the base of that
            state.
        time, half_time ((C,) float64): Middle and half length of the share of the way to the next state; 0
            where the section slides.
    """

    state: Int
    along_mm: Float
    half_mm: Float
    time: Float
    half_time: Float

    def pick(self, which: Bool | Int) -> "Cells":
        """Return some of the cells."""
        parts = {name: value[which] for name, value in vars(self).items()}
        return Cells(**parts)

    def halves(self, in_time: Bool) -> "Cells":
        """Cut every cell in two, along time where asked for, else along the arc."""
        twice = self.pick(np.repeat(np.arange(len(self.state)), 2))
        side = np.tile([-0.5, 0.5], len(self.state))
        over = np.repeat(in_time, 2)
        return Cells(
            state=twice.state,
            along_mm=np.where(over, twice.along_mm, twice.along_mm + side * twice.half_mm),
            half_mm=np.where(over, 1.0, 0.5) * twice.half_mm,
            time=np.where(over, twice.time + side * twice.half_time, twice.time),
            half_time=np.where(over, 0.5, 1.0) * twice.half_time,
        )


def least_gap_mm(motion: Motion, boxes: Boxes, needed_mm: float, stated_mm: float) -> float:
    """Return a distance of the axis of the body from a structure that occurs during a motion.

    It is below `needed_mm` if any is, and below `stated_mm` if any is; else there may be smaller ones.
    """
    cells, least = first_cells(motion), np.inf
    while len(cells.state):
        gaps = boxes.distance_mm(places(motion, cells))
        least = min(least, float(gaps.min()))
        kept = [limit for limit in (needed_mm, stated_mm) if limit <= least]
        if not kept:
            break
        arc, swept = cells.half_mm, swept_mm(motion, cells)
        open_ = (gaps - arc - swept < max(kept)) & (arc + swept > SURE_MM)
        cells = cells.pick(open_).halves(swept[open_] > arc[open_])
    return least


def first_cells(motion: Motion) -> Cells:
    """Return cells that cover all places of the section: it slides, twists and bends, and stays at the end.

    The shaft lies on what the section has slid along.
    """
    # From which states the section slides on, and the lengths of the arcs that it covers.
    moves = motion.moves
    begins = np.flatnonzero(moves & ~np.append(False, moves[:-1]))
    ends = np.flatnonzero(moves & ~np.append(moves[1:], False)) + 1
    advance = motion.states[:, 0]
    slides, lengths = begins, advance[ends] - advance[begins] + motion.section_mm
    in_place = np.flatnonzero(motion.turns)
    last = len(motion.states) - 1
    states = np.concatenate([slides, in_place, [last]])
    total = np.concatenate([lengths, np.full(len(in_place) + 1, motion.section_mm)])
    half_time = np.concatenate([np.zeros(len(slides)), np.full(len(in_place), 0.5), [0.0]])
    order = np.argsort(states, kind="stable")
    states, total, half_time = states[order], total[order], half_time[order]
    counts = np.maximum(np.ceil(0.5 * total / FIRST_MM).astype(np.int64), 1)
    half = np.repeat(0.5 * total / counts, counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return Cells(
        state=np.repeat(states, counts),
        along_mm=(2 * number + 1) * half,
        half_mm=half,
        time=np.repeat(half_time, counts),
        half_time=np.repeat(half_time, counts),
    )


def places(motion: Motion, cells: Cells) -> Float:
    """Return the middles of cells, `(C, 3)` LPS mm."""
    after = np.minimum(cells.state + 1, len(motion.states) - 1)
    begin, end = motion.states[cells.state, 1:], motion.states[after, 1:]
    still = cells.half_time == 0.0
    time = np.where(still, 0.0, cells.time)[:, None]
    twist, bend = (begin + time * (end - begin)).T
    curvature = bend / motion.section_mm
    bends = curvature[:, None] * np.stack([np.cos(twist), np.sin(twist)], axis=1)
    return motion.points(cells.state, cells.along_mm, bends)


def swept_mm(motion: Motion, cells: Cells) -> Float:
    """Return how far `(C,)` a place of a cell moves at most from the middle of its time, mm.

    A curvature that changes by d turns the section at the arc length s by no more than d s, and so moves it
    by no more than d s^2 / 2.
    """
    after = np.minimum(cells.state + 1, len(motion.states) - 1)
    change = motion.states[after, 1:] - motion.states[cells.state, 1:]
    most = np.maximum(np.abs(motion.states[after, 2]), np.abs(motion.states[cells.state, 2]))
    rate = np.hypot(change[:, 1], most * change[:, 0]) / motion.section_mm
    return np.asarray(rate * cells.half_time * 0.5 * (cells.along_mm + cells.half_mm) ** 2)
