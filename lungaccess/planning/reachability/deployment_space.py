"""All deployments that a system may make in a lung, in boxes: what every proof of a target begins with."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Int32
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER, ROTATION
from lungaccess.planning.reachability.kernels.blocked import ProofEnvironment
from lungaccess.planning.reachability.kernels.deployment_boxes import BOX_COLUMNS, EAST, NORTH, PLACE_X
from lungaccess.planning.reachability.kernels.unreachable import Pieces, divide, measures
from lungaccess.planning.reachability.layers import THREADS
from lungaccess.planning.reachability.tip_places import PlacePiece
from stages.tube.kernels import CURVED_LENGTH

TASK_BOXES = 2048
"""Boxes that a thread takes at a time."""


@frozen_record
class DeploymentSpace:
    """Boxes that hold all deployments of a system in a lung, M of P pieces of the airway.

    Args:
        boxes ((M, BOX_COLUMNS) float64): See `lungaccess.planning.reachability.kernels.deployment_boxes`.
        owners ((M,) int32): The piece of each.
        measures ((M,) float64): Of each: mm^3 of places x rad^2 of directions x rad of rotations x mm^2 of
            insertions.
    """

    pieces: tuple[PlacePiece, ...]
    arrays: Pieces
    boxes: Float
    owners: Int32
    measures: Float
    looked: int


def divided_space(
    environment: ProofEnvironment,
    tubes: Float,
    insertions: Float,
    pieces: Sequence[PlacePiece],
    *,
    between: Callable[[], None] = lambda: None,
) -> DeploymentSpace:
    """Halve the boxes of all pieces, the largest first, and drop those that hold no deployment.

    Args:
        environment: Its `passable` does not count.
        insertions ((N,) float64): See `greatest_insertions`.
        between: Called now and then.
    """
    arrays = _as_arrays(pieces)
    boxes, owners = _first_boxes(tubes, float(insertions.max()), pieces)
    looked = 0
    greatest = np.inf if not len(boxes) else float(_measures(boxes).max())
    with ThreadPoolExecutor(THREADS) as pool:
        # Boxes into which the space is divided: 20 MB, and a second or two of work before the first target.
        while 0 < len(boxes) <= 150_000 // 2:
            between()
            greatest *= 0.5
            looked += int((_measures(boxes) > greatest).sum())

            def part(begin: int, greatest: float = greatest, boxes: Float = boxes, owners: Int32 = owners):  # type: ignore[no-untyped-def]
                some, own = boxes[begin : begin + TASK_BOXES], owners[begin : begin + TASK_BOXES]
                parts, part_owners = np.zeros((2 * len(some), BOX_COLUMNS)), np.zeros(2 * len(some), np.int32)
                kept = divide(environment, tubes, insertions, arrays, some, own, greatest, parts, part_owners)
                return parts[:kept], part_owners[:kept]

            found = list(pool.map(part, range(0, len(boxes), TASK_BOXES)))
            boxes = np.concatenate([parts for parts, _ in found])
            owners = np.concatenate([own for _, own in found])
    return DeploymentSpace(
        pieces=tuple(pieces),
        arrays=arrays,
        boxes=boxes,
        owners=owners,
        measures=_measures(boxes),
        looked=looked,
    )


def in_tasks(pool: ThreadPoolExecutor, work: Callable[[Int], Any], rows: Int, size: int) -> Iterator[Int]:
    """Do work on rows, so many a task, on the threads of a pool; yield those that are done, in order."""
    tasks = iter(range(0, len(rows), size))
    # Tasks after which it is looked whether to stop; the same number whatever the threads.
    while begins := list(islice(tasks, 8)):
        list(pool.map(lambda begin: work(rows[begin : begin + size]), begins))
        yield rows[begins[0] : begins[-1] + size]


def _as_arrays(pieces: Sequence[PlacePiece]) -> Pieces:
    counts = [len(piece.cones) for piece in pieces]
    return Pieces(
        frames=np.array([piece.frame for piece in pieces]).reshape(-1, 3, 3),
        cones=np.concatenate([np.zeros((0, 7)), *(piece.cones for piece in pieces)]),
        first_cone=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
    )


def _first_boxes(tubes: Float, longest: float, pieces: Sequence[PlacePiece]) -> tuple[Float, Int32]:
    """Return boxes that hold everything of each piece, up to the curved length and beyond; and the pieces."""
    curved = min(float(tubes[CURVED_LENGTH]), longest)
    ranges = [each for each in ((0.0, curved), (curved, longest)) if each[1] > each[0]]
    boxes = np.zeros((len(pieces), len(ranges), BOX_COLUMNS))
    boxes[..., [OUTER, HALF + OUTER]] = 0.5 * longest
    boxes[..., HALF + ROTATION] = np.pi
    for part, (low, high) in enumerate(ranges):
        boxes[:, part, [INNER, HALF + INNER]] = 0.5 * (low + high), 0.5 * (high - low)
    for each, piece in zip(boxes, pieces, strict=True):
        each[:, [HALF + EAST, HALF + NORTH]] = piece.wide
        least, greatest = piece.places
        each[:, PLACE_X:HALF] = 0.5 * (least + greatest)
        each[:, HALF + PLACE_X :] = 0.5 * (greatest - least)
    owners = np.repeat(np.arange(len(pieces), dtype=np.int32), len(ranges))
    return boxes.reshape(-1, BOX_COLUMNS), owners


def _measures(boxes: Float) -> Float:
    found = np.zeros(len(boxes))
    measures(boxes, found)
    return found
