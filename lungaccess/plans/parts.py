"""The parts of a plan: what each of the three devices does, and the one wall that they may touch."""

from __future__ import annotations

from dataclasses import field

import numpy as np

from anatomy.records import frozen_record
from anatomy.typed import Float, Int
from lungaccess.plans.record import Record, shaped


@frozen_record
class ScopeInsertion(Record):
    """How the bronchoscope gets from the trachea to where it stops, and the frame of its tip there.

    Parameters
    ----------
    lps_from_entry : (4, 4) float64
        Base of the bending section when the motion begins, in the trachea; +z is forward, +x the way a
        positive bend turns the tip at twist 0.
    states : (M, 3) float64
        Advance of that base in mm, twist in rad and bend in rad; see `stages.scope.ScopeMotion`.
    lps_from_scope_tip : (4, 4) float64
        Frame of the working channel in the last state: +z is forward, +x the way a positive bend turns the
        tip, which is up in the camera's picture.
    branches : (B,) int64
        Branches of the airway tree from the trachea to the one in which the tip is.
    generation : int
        Generation of the last branch; the trachea is 0.
    length_mm, length_from_carina_mm : float
        Length of the body from the entry to the tip, and of its part beyond the place nearest to the carina.
    min_lumen_margin_mm : float
        Smallest distance of the body's axis from the border of the lumen, in every state and between them,
        minus the radius of the scope.
    max_curvature_per_mm : float
        Largest curvature of the body in the last state, which the tubes pass in the working channel.
    """

    lps_from_entry: Float = field(metadata=shaped(4, 4))
    states: Float = field(metadata=shaped(None, 3))
    lps_from_scope_tip: Float = field(metadata=shaped(4, 4))
    branches: Int = field(metadata=shaped(None, dtype=np.int64))
    generation: int
    length_mm: float
    length_from_carina_mm: float
    min_lumen_margin_mm: float
    max_curvature_per_mm: float


@frozen_record
class WallExit(Record):
    """Where the axis of the tube leaves the airway lumen for good.

    Parameters
    ----------
    branch : int
        Branch whose wall is pierced.
    point_lps : (3,) float64, LPS mm
    arc_length_mm : float
        Length of tube between the tip of the scope and that point.
    wall_angle_rad : float
        Angle between tube and wall; pi/2 is perpendicular.
    wall_run_mm : float
        Length of the tube's body, beyond that point, that lies in the wall of the branch.
    """

    branch: int
    point_lps: Float = field(metadata=shaped(3))
    arc_length_mm: float
    wall_angle_rad: float
    wall_run_mm: float


@frozen_record
class TubeDeployment(Record):
    """How the concentric tubes are turned and inserted, and what that does.

    Parameters
    ----------
    rotation_rad : float
        Both tubes are turned by this; the inner one bends towards local (cos, sin) of the scope tip.
    outer_insertion_mm, inner_insertion_mm : float
        Lengths of outer and inner tube beyond the tip of the scope.
    lps_from_tip : (4, 4) float64
        Pose of the tip of the inner tube; +z is forward.
    lateral_sweep_mm : float
        Largest sideways motion of the tubes while they are deployed.
    follow_the_leader_error_mm : float
        Largest distance between the path of the tip and the final shape.
    """

    rotation_rad: float
    outer_insertion_mm: float
    inner_insertion_mm: float
    lps_from_tip: Float = field(metadata=shaped(4, 4))
    exit: WallExit
    lateral_sweep_mm: float
    follow_the_leader_error_mm: float


@frozen_record
class NeedleArc(Record):
    """One arc: turn by `roll_rad` about the axis, then insert `length_mm`, bending towards local +x.

    The turn stays in the frame: the next roll starts from it.
    """

    length_mm: float
    roll_rad: float
    curvature_per_mm: float


@frozen_record
class NeedlePath(Record):
    """The arcs of the steerable needle, from the tip of the tube to the target.

    Parameters
    ----------
    lps_from_start : (4, 4) float64
        Pose of the needle where it leaves the tube.
    end_lps : (3,) float64, LPS mm
    max_angle_from_start_rad : float
        Largest angle between the needle and its start direction.
    accumulated_turn_rad : float
        Sum of the angles of all arcs.
    """

    lps_from_start: Float = field(metadata=shaped(4, 4))
    arcs: tuple[NeedleArc, ...]
    end_lps: Float = field(metadata=shaped(3))
    length_mm: float
    max_angle_from_start_rad: float
    accumulated_turn_rad: float


@frozen_record
class Exemption(Record):
    """The one obstacle that may be touched: the wall of the pierced branch.

    It holds for the tube and for the first `needle_length_mm` of the needle.
    """

    branch: int
    exit_point_lps: Float = field(metadata=shaped(3))
    needle_length_mm: float
