"""Deviations from a plan, and the deviated devices as arcs."""

from __future__ import annotations

import numpy as np

from anatomy.records import frozen_record
from anatomy.typed import Float
from lungaccess.plans.plan import Plan
from lungaccess.risk.kernels import deviation as kernel
from lungaccess.risk.twisted import twisted_pieces

TUBE_PIECES = 4
"""Arcs of planar tubes, see `stages.tube.device.TubeArcs`."""


@frozen_record
class Deviations:
    """N sets of errors of a plan whose needle has A arcs, 0 where there is none.

    Parameters
    ----------
    scope_mm : (N, 3) float64, LPS mm
        Shift of the scope tip.
    tilt_rad : (N, 2) float64
        Rotation vector of the scope tip's tilt, along +x and +y of its frame.
    rotation_rad : (N,) float64
        Added to the rotation of all tubes; it leaves the roll of the needle where it is.
    relative_rad : (N, n) float64
        Added to the rotation of each of n tubes that are not planar, the outermost first; n is 0 for planar.
    insertion_mm : (N, 2 or n) float64
        Added to the insertions of outer and inner tube, or of n tubes that are not planar.
    factor : (N,) float64
        Multiplies the curvature of all arcs.
    roll_rad, stop_mm : (N, A) float64
        Added to the needle's angle in each arc, and to its insertion where the arc ends.
    target_mm : (N, 3) float64, LPS mm
        Shift of the target.
    """

    scope_mm: Float
    tilt_rad: Float
    rotation_rad: Float
    relative_rad: Float
    insertion_mm: Float
    factor: Float
    roll_rad: Float
    stop_mm: Float
    target_mm: Float

    @property
    def count(self) -> int:
        """Number of sets, N."""
        return len(self.factor)


def no_deviations(count: int, n_arcs: int, n_twisted: int = 0) -> dict[str, Float]:
    """Return the fields of `Deviations` for `count` sets without any error.

    Parameters
    ----------
    n_twisted : int
        Number of tubes if they are not planar, else 0.
    """
    return {
        "scope_mm": np.zeros((count, 3)),
        "tilt_rad": np.zeros((count, 2)),
        "rotation_rad": np.zeros(count),
        "relative_rad": np.zeros((count, n_twisted)),
        "insertion_mm": np.zeros((count, n_twisted or 2)),
        "factor": np.ones(count),
        "roll_rad": np.zeros((count, n_arcs)),
        "stop_mm": np.zeros((count, n_arcs)),
        "target_mm": np.zeros((count, 3)),
    }


FIELD_OF: dict[str, str] = {
    "scope_position": "scope_mm",
    "scope_direction": "tilt_rad",
    "tube_rotation": "rotation_rad",
    "tube_insertion": "insertion_mm",
    "needle_roll": "roll_rad",
    "needle_insertion": "stop_mm",
    "target_position": "target_mm",
}
"""The field of `Deviations` that holds each kind of error."""


def deviated_starts(plan: Plan, deviations: Deviations) -> Float:
    """Return point, tangent and +x axis `(N, 9)` of the deviated scope tips, LPS mm."""
    frame = np.asarray(plan.scope.lps_from_scope_tip)
    vectors = deviations.tilt_rad @ frame[:3, :2].T
    starts = np.zeros((deviations.count, 9))
    starts[:, :3] = frame[:3, 3] + deviations.scope_mm
    starts[:, 3:6] = _rotated(frame[:3, 2], vectors)
    starts[:, 6:] = _rotated(frame[:3, 0], vectors)
    return starts


def _rotated(direction: Float, vectors: Float) -> Float:
    """Turn one direction by many rotation vectors `(N, 3)`."""
    angle = np.linalg.norm(vectors, axis=1)[:, None]
    axis = vectors / np.where(angle > 0.0, angle, 1.0)
    along = (axis @ direction)[:, None]
    turned = np.cos(angle) * direction + np.sin(angle) * np.cross(axis, direction)
    return np.asarray(turned + (1.0 - np.cos(angle)) * along * axis)


def deviated_pieces(plan: Plan, deviations: Deviations) -> Float:
    """Return the arcs `(N, T + A, 4)` of tubes and needle, see `lungaccess.risk.kernels.deviation`.

    Planar tubes have T = 4 arcs.  The radius of the tubes includes the sideways sweep of the plan.  No tube
    goes back behind the scope tip, nor one behind that around it, nor the needle behind the end of an arc.
    """
    if plan.tube.shape is None:
        tubes, rolled = _planar_pieces(plan, deviations), deviations.rotation_rad
    else:
        tubes, rolled = twisted_pieces(
            plan, deviations.insertion_mm, deviations.relative_rad, deviations.rotation_rad
        )
    return np.concatenate([tubes, _needle_pieces(plan, deviations, rolled)], axis=1)


def _planar_pieces(plan: Plan, deviations: Deviations) -> Float:
    pieces = np.zeros((deviations.count, TUBE_PIECES, kernel.N_PIECE))
    outer = np.maximum(plan.tube.outer_insertion_mm + deviations.insertion_mm[:, 0], 0.0)
    inner = np.maximum(plan.tube.inner_insertion_mm + deviations.insertion_mm[:, 1], outer)
    tubes = plan.system.tubes.arcs(outer, inner)
    pieces[:, :, kernel.LENGTH] = tubes.length_mm
    pieces[:, 0, kernel.ROLL] = plan.tube.rotation_rad + deviations.rotation_rad
    pieces[:, :, kernel.CURVATURE] = tubes.curvature_per_mm
    pieces[:, :, kernel.RADIUS] = tubes.radius_mm + plan.tube.lateral_sweep_mm
    return pieces


def _needle_pieces(plan: Plan, deviations: Deviations, rolled_rad: Float) -> Float:
    """Return the arcs `(N, A, 4)` of the needle behind tubes that end rolled too far by `(N,)`."""
    arcs = () if plan.needle is None else plan.needle.arcs
    pieces = np.zeros((deviations.count, len(arcs), kernel.N_PIECE))
    pieces[:, :, kernel.RADIUS] = plan.system.track_radius_mm
    ends = np.cumsum([arc.length_mm for arc in arcs]) + deviations.stop_mm
    ends = np.maximum.accumulate(np.maximum(ends, 0.0), axis=1)
    pieces[:, :, kernel.LENGTH] = np.diff(ends, axis=1, prepend=0.0)
    angles = np.cumsum([arc.roll_rad for arc in arcs]) + deviations.roll_rad
    pieces[:, :, kernel.ROLL] = np.diff(angles, axis=1, prepend=rolled_rad[:, None])
    bends = np.array([arc.curvature_per_mm for arc in arcs])
    pieces[:, :, kernel.CURVATURE] = deviations.factor[:, None] * bends
    return pieces
