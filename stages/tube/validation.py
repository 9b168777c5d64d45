"""Validation of single deployments: shape, tip pose and exit through the wall, or why one is refused."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from stages.tube import kernels
from stages.tube.arcs import TubeShape, points_on_arcs
from stages.tube.design_shapes import shapes_of
from stages.tube.device import ConcentricTubes
from stages.tube.one_shape import design_arrays, shape_or_reason, tube_constants, tube_environment

REASONS: dict[int, str] = {
    kernels.NO_EXIT: "the tube does not leave the airway",
    kernels.NEAR_VESSEL: "the tube comes too near a vessel",
    kernels.NEAR_PLEURA: "the tube comes too near the pleura or leaves the lung",
    kernels.NEAR_FISSURE: "the tube comes too near a fissure",
    kernels.NEAR_OTHER_BRANCH: "the tube comes too near another airway",
    kernels.REENTERS_LUMEN: "the tube enters an airway again",
    kernels.FLAT_EXIT: "the tube meets the airway wall at too flat an angle",
    kernels.LONG_WALL_RUN: "the tube runs too far in the wall of the airway that it leaves",
    kernels.LEAVES_MEDIASTINAL: "the tube would leave the trachea or a main bronchus, in the mediastinum",
}
"""Why a deployment is refused, by the code of the kernels."""


@frozen_record
class Deployment:
    """One accepted deployment in full.

    Args:
        rotation_rad: Rotation of all tubes together about +z of the scope tip.
        outer_mm, inner_mm: Insertions of the outermost and the innermost tube.
        lps_from_tip ((4, 4) float64): +z forward; +x carried from the scope tip, turned by the rotation,
            without turning: towards the bend of tubes that bend in one plane.
    """

    rotation_rad: float
    outer_mm: float
    inner_mm: float
    lps_from_tip: Float
    branch: int
    exit_mm: float
    wall_angle_rad: float
    wall_run_mm: float
    lateral_sweep_mm: float
    shape: TubeShape

    def points(self, lps_from_scope_tip: Float, arc_lengths_mm: ArrayLike) -> Float:
        """Return points `(N, 3)` LPS mm of the centreline at arc lengths `(N,)` from the scope tip."""
        return points_on_arcs(self.shape.arcs, lps_from_scope_tip, self.rotation_rad, arc_lengths_mm)

    def exit_point(self, lps_from_scope_tip: Float) -> Float:
        """Return the point `(3,)` LPS mm at which the axis leaves the lumen for good."""
        return np.asarray(self.points(lps_from_scope_tip, [self.exit_mm])[0])

    @property
    def length_in_tissue_mm(self) -> float:
        """Length of tube beyond the lumen that it leaves."""
        return self.inner_mm - self.exit_mm


class DeploymentValidator:
    """Accepts or refuses single deployments of tubes in one lung, with or without fissures as obstacles."""

    def __init__(self, lung: Lung, tubes: ConcentricTubes, margins: Margins, *, with_fissures: bool) -> None:
        self._environment = tube_environment(lung, with_fissures=with_fissures)
        self._tubes, self._constants = tubes, tube_constants(tubes, margins)
        self._design = design_arrays(tubes)
        self._trace = np.zeros(kernels.N_TRACE)
        self._tip = np.zeros(9)

    def choose(
        self, lps_from_scope_tip: Float, rotation_rad: float, shape: int | TubeShape
    ) -> Deployment | str:
        """Return a deployment by its shape, or by its number as in `Deployments`, or why it is refused."""
        member = shapes_of(self._tubes).member(shape) if isinstance(shape, int) else shape
        return self.validate_shape(lps_from_scope_tip, rotation_rad, member)

    def validate(
        self,
        lps_from_scope_tip: Float,
        rotation_rad: float,
        insertions_mm: ArrayLike,
        rotations_rad: ArrayLike | None = None,
    ) -> Deployment | str:
        """Return the deployment of any joint values, or the reason why it is refused.

        The rotation counts about +z of the scope tip, from its +x.  Insertions beyond the scope tip, and how
        much farther the rear ends are turned (nothing if None), are `(n,)`, the outermost tube first.

        Raises:
            SettingsError: If a tube would be ahead of one inside it, or numbers are missing or not finite.
        """
        inserted = np.array(insertions_mm, dtype=np.float64, ndmin=1)[::-1]
        turned = np.zeros_like(inserted)
        if rotations_rad is not None:
            turned = np.array(rotations_rad, dtype=np.float64)[::-1]
        n = len(self._tubes.nested)
        ordered = inserted.shape == turned.shape == (n,) and bool(np.isfinite(turned).all())
        if not (ordered and (np.diff(inserted) <= 0.0).all() and 0.0 <= inserted[-1] <= inserted[0] < np.inf):
            raise SettingsError(
                f"The insertions are {', '.join(f'{mm:g}' for mm in inserted[::-1])} mm, the outermost tube "
                "first",
                expected=f"{n} finite lengths, 0 <= outer <= inner, and as many rotations or none",
            )
        shape = shape_or_reason(self._design, inserted, turned)
        return (
            shape if isinstance(shape, str) else self.validate_shape(lps_from_scope_tip, rotation_rad, shape)
        )

    def validate_shape(
        self, lps_from_scope_tip: Float, rotation_rad: float, shape: TubeShape
    ) -> Deployment | str:
        """Return the deployment of a shape of the design, or the reason why it is refused; see `validate`.

        The shape's own limits (extension, sweep, strain, snaps) are kept by all members of `TubeShapes`.
        """
        base = np.concatenate([lps_from_scope_tip[:3, 3], lps_from_scope_tip[:3, 2]])
        normal = np.asarray(frames.bending_directions(lps_from_scope_tip, rotation_rad)[0])
        reason = kernels.validate_arcs(
            self._environment, self._constants, base, normal, shape.arcs, shape.required_beside_mm,
            self._trace, self._tip,
        )  # fmt: skip
        if reason != kernels.ACCEPTED:
            return REASONS[reason]
        trace, tip = self._trace, self._tip
        return Deployment(
            rotation_rad=float(rotation_rad),
            outer_mm=float(shape.insertions_mm[-1]),
            inner_mm=float(shape.insertions_mm[0]),
            lps_from_tip=frames.pose(tip[:3], tip[3:6], tip[6:9]),
            branch=int(trace[kernels.BRANCH]),
            exit_mm=float(trace[kernels.LEFT_AT]),
            wall_angle_rad=float(trace[kernels.WALL_ANGLE]),
            wall_run_mm=float(trace[kernels.WALL_RUN]),
            lateral_sweep_mm=shape.lateral_sweep_mm,
            shape=shape,
        )
