"""The parts of a plan: what each of the three devices does, and the one wall that they may touch."""

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from anatomy.base.records import LEFT_OUT_IF_EMPTY, frozen_record
from anatomy.base.typed import Float, Int
from lungaccess.plans.record import Record, shaped
from stages.tube.arcs import TubeShape
from stages.tube.device import ConcentricTubes


@frozen_record
class ScopeInsertion(Record):
    """How the bronchoscope gets from the trachea to where it stops, and the frame of its tip there.

    Args:
        lps_from_entry ((4, 4) float64): Base of the bending section when the motion begins, in the trachea;
            +z is forward, +x the way a positive bend turns the tip at twist 0.
        states ((M, 3) float64): Advance of that base in mm, twist in rad and bend in rad; see
            `stages.scope.ScopeMotion`.
        lps_from_scope_tip ((4, 4) float64): Frame of the working channel in the last state: +z is forward, +x
            the way a positive bend turns the tip, which is up in the camera's picture.
        branches ((B,) int64): Branches of the airway tree from the trachea to the one in which the tip is.
        length_mm, length_from_carina_mm: Length of the body from the entry to the tip, and of its part beyond
            the place nearest to the carina.
        min_lumen_margin_mm: Smallest distance of the body's axis from the border of the lumen, in every state
            and between them, minus the radius of the scope.
        max_curvature_per_mm: Largest curvature of the body in the last state, which the tubes pass in the
            working channel.
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

    Args:
        point_lps: (3,) float64, LPS mm.
        arc_length_mm: Length of tube between the tip of the scope and that point.
        wall_angle_rad: Angle between tube and wall; pi/2 is perpendicular.
        wall_run_mm: Length of the tube's body, beyond that point, that lies in the wall of the branch.
    """

    branch: int
    point_lps: Float = field(metadata=shaped(3))
    arc_length_mm: float
    wall_angle_rad: float
    wall_run_mm: float


@frozen_record
class DeployedShape(Record):
    """The shape of the tubes, as the mechanics give it.

    Args:
        relative_rotations_rad: By "outer", "middle" and "inner": how much farther than
            `TubeDeployment.rotation_rad` the rear end of that tube is turned.
        arcs ((A, 4) float64): Length in mm; direction of the bend in rad about the tangent, from +x of a
            frame that is carried from the scope tip, turned by `TubeDeployment.rotation_rad`, without
            turning; curvature in 1/mm; radius of the outermost tube in mm.
        arc_error_mm: Largest distance between the arcs and the tubes.
        least_determinant: Least on the way of the derivative of rear by front rotations: the tubes snap at 0.
    """

    relative_rotations_rad: Mapping[str, float]
    arcs: Float = field(metadata=shaped(None, 4))
    arc_error_mm: float
    least_determinant: float

    @classmethod
    def of(cls, tubes: ConcentricTubes, shape: TubeShape) -> "DeployedShape":
        """Return a shape of the tubes as a plan states it."""
        turned = zip(tubes.named, shape.rotations_rad[::-1].tolist(), strict=True)
        return cls(
            relative_rotations_rad={name: angle for (name, _tube), angle in turned},
            arcs=shape.arcs,
            arc_error_mm=shape.arc_error_mm,
            least_determinant=shape.least_determinant,
        )


@frozen_record
class TubeDeployment(Record):
    """How the concentric tubes are turned and inserted, and what that does.

    Args:
        rotation_rad: All tubes are turned by this: a tube that is turned no farther bends towards local (cos,
            sin) of the scope tip.
        outer_insertion_mm, inner_insertion_mm: Lengths of outer and inner tube beyond the tip of the scope.
        middle_insertion_mm: That of the middle tube, 0 where there is none.
        lps_from_tip ((4, 4) float64): Pose of the tip of the inner tube; +z is forward; +x is carried from
            the scope tip, turned by `rotation_rad`, without turning.
        lateral_sweep_mm: Largest sideways motion of the tubes while they are deployed.
        follow_the_leader_error_mm: Largest distance between the path of the tip and the final shape.
    """

    rotation_rad: float
    outer_insertion_mm: float
    inner_insertion_mm: float
    lps_from_tip: Float = field(metadata=shaped(4, 4))
    exit: WallExit
    lateral_sweep_mm: float
    follow_the_leader_error_mm: float
    shape: DeployedShape
    middle_insertion_mm: float = field(default=0.0, metadata={LEFT_OUT_IF_EMPTY: True})

    def insertions_mm(self, tubes: ConcentricTubes) -> tuple[float, ...]:
        """Return the insertions of the tubes that there are, the outermost first."""
        of = {
            "outer": self.outer_insertion_mm,
            "middle": self.middle_insertion_mm,
            "inner": self.inner_insertion_mm,
        }
        return tuple(of[name] for name, _tube in tubes.named)

    def rotations_rad(self, tubes: ConcentricTubes) -> tuple[float, ...]:
        """Return the rotations of the rear ends of the tubes that there are, the outermost first."""
        relative = self.shape.relative_rotations_rad
        return tuple(self.rotation_rad + relative.get(name, 0.0) for name, _tube in tubes.named)

    @property
    def clearance_loss_mm(self) -> float:
        """What has to be free around the tubes beside their radius and the margins."""
        return self.lateral_sweep_mm + self.shape.arc_error_mm


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

    Args:
        lps_from_start ((4, 4) float64): Pose of the needle where it leaves the tube.
        end_lps: (3,) float64, LPS mm.
        max_angle_from_start_rad: Largest angle between the needle and its start direction.
        accumulated_turn_rad: Sum of the angles of all arcs.
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

    It holds for the tube and for the first `needle_length_mm` of the needle, 0 where there is none.
    """

    branch: int
    exit_point_lps: Float = field(metadata=shaped(3))
    needle_length_mm: float


@frozen_record
class Pass(Record):
    """A further pass of the needle from where the scope stands: what differs from the first, as of a plan."""

    tube: TubeDeployment
    needle: NeedlePath
    exemption: Exemption
    clearance_mm: Mapping[str, Mapping[str, float]]
    costs: Mapping[str, float]
    end_lps: Float = field(metadata=shaped(3))
