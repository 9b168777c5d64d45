"""What is left of the errors after what a procedure measures."""

import math

from anatomy.base.records import frozen_record
from lungaccess.problem.errors import BREATHING, CURVATURE, ErrorModel
from lungaccess.problem.procedures import Procedure


@frozen_record
class Residuals:
    """Sizes of what a procedure leaves of the errors by measuring, mm and rad; a bias counts as spread.

    Args:
        scope_mm, scope_rad: Of the scope's tip when the tubes are planned; see `fused_size` where it is
            measured.
        rotation_rad, insertion_mm: Of the tubes.
        tip_mm, tip_rad: Of the tip of the tubes when the needle is planned; None where it follows from scope
            and tubes.
        curvature, roll_rad, stop_mm: Of the needle: the logarithm of its curvature's factor, roll and
            insertion.
        target_mm, foot_mm: Of the target, along each axis, and beside that of the target towards the feet.
    """

    scope_mm: float
    scope_rad: float
    rotation_rad: float
    insertion_mm: float
    tip_mm: float | None
    tip_rad: float
    curvature: float
    roll_rad: float
    stop_mm: float
    target_mm: float
    foot_mm: float

    @staticmethod
    def of(errors: ErrorModel, procedure: Procedure, stretch: float) -> "Residuals":
        """Return what a procedure leaves of errors; `stretch` is that of `Draws`."""
        placed, aimed = errors.term("scope_position").rms, errors.term("target_position").rms
        angles = ("scope_direction", "tube_rotation", "needle_roll")
        turned, rotated, rolled = (math.radians(errors.term(kind).rms) for kind in angles)
        scope, tubes, image, needle = (
            procedure.scope, procedure.tubes, procedure.imaging, procedure.needle,
        )  # fmt: skip
        steered, breath = needle.closed_loop, abs(stretch) * errors.term(BREATHING).size
        foot = math.hypot(aimed, breath)
        if scope.measured:
            placed = fused_size(placed, scope.position_mm)
            turned = fused_size(turned, math.radians(scope.direction_deg))
        if image.measured:
            aimed, foot = fused_size(aimed, image.position_mm), fused_size(foot, image.position_mm)
        return Residuals(
            scope_mm=placed,
            scope_rad=turned,
            rotation_rad=rotated,
            insertion_mm=errors.tube_insertion.rms,
            tip_mm=tubes.position_mm if tubes.measured else needle.position_mm if steered else None,
            tip_rad=math.radians(tubes.direction_deg if tubes.measured else needle.direction_deg),
            curvature=0.0 if steered else errors.term(CURVATURE).size,
            roll_rad=0.0 if steered else rolled,
            stop_mm=errors.needle_insertion.rms,
            target_mm=aimed,
            foot_mm=math.sqrt(max(foot**2 - aimed**2, 0.0)),
        )


def fused_size(expected: float, measured: float) -> float:
    """Return the standard deviation of what two independent errors leave together."""
    if expected == 0.0 or measured == 0.0:
        return 0.0
    return expected * measured / math.hypot(expected, measured)
