"""The shape of any deployed tubes: the arcs of their centreline, and points along it."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.poses import poses_on_arc

SHORTEST_ARC_MM = 1e-9
"""A piece of tube that is shorter than this is only the rounding of its neighbours' lengths."""


@frozen_record
class TubeShape:
    """One deployment of a design, in the frame of the scope tip before all tubes are turned together.

    Args:
        insertions_mm, rotations_rad, arcs ((n,), (n,), (a, 4) float64): As in `TubeShapes`.
        lateral_sweep_mm, follow_the_leader_error_mm: Largest on the whole way.
        arc_error_mm: Largest distance between the arcs and the tubes.
        least_determinant: Least on the whole way, 1 where nothing twists; the tubes snap at 0.
    """

    insertions_mm: Float
    rotations_rad: Float
    arcs: Float
    lateral_sweep_mm: float
    follow_the_leader_error_mm: float
    arc_error_mm: float
    least_determinant: float

    @property
    def required_beside_mm(self) -> float:
        """What has to be free around the tubes beside their radius and the margins: sweep and arc error."""
        return self.lateral_sweep_mm + self.arc_error_mm


def pieces_of_arcs(arcs: Float, rotation_rad: float) -> Float:
    """Return length in mm, roll before it in rad and curvature in 1/mm `(P, 3)` of arcs as a `TubeShape` has.

    Arcs shorter than SHORTEST_ARC_MM are left out; `rotation_rad` turns all tubes together.
    """
    kept = arcs[arcs[:, 0] > SHORTEST_ARC_MM]
    return np.stack([kept[:, 0], np.diff(kept[:, 1], prepend=-rotation_rad), kept[:, 2]], axis=1)


def points_on_arcs(
    arcs: Float, lps_from_scope_tip: Float, rotation_rad: float, arc_lengths_mm: ArrayLike
) -> Float:
    """Return points `(N, 3)` LPS mm of a shape's arcs at arc lengths `(N,)` from the scope tip."""
    at_mm = np.array(arc_lengths_mm, dtype=np.float64, ndmin=1)
    points = np.zeros((len(at_mm), 3))
    pieces, frame = pieces_of_arcs(arcs, rotation_rad), np.asarray(lps_from_scope_tip)
    begins = np.append(0.0, np.cumsum(pieces[:, 0]))
    place = np.clip(np.searchsorted(begins, at_mm, side="right") - 1, 0, len(pieces) - 1)
    for number, (length, roll, curvature) in enumerate(pieces):
        here = place == number
        poses = poses_on_arc(frame, roll, curvature, np.append(at_mm[here] - begins[number], length))
        points[here], frame = poses[:-1, :3, 3], poses[-1]
    return points
