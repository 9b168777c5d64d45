"""Validation of single deployments: shape, tip pose and exit through the wall, or why one is refused."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import bending_directions
from stages.tube import kernels
from stages.tube.arcs import TubeShape, points_on_arcs
from stages.tube.design_shapes import shapes_of
from stages.tube.device import ConcentricTubes
from stages.tube.environment import tube_constants, tube_environment

REASONS: dict[int, str] = {
    kernels.NO_EXIT: "the tube does not leave the airway",
    kernels.NEAR_VESSEL: "the tube comes too near a vessel",
    kernels.NEAR_PLEURA: "the tube comes too near the pleura or leaves the lung",
    kernels.NEAR_FISSURE: "the tube comes too near a fissure",
    kernels.NEAR_OTHER_BRANCH: "the tube comes too near another airway",
    kernels.REENTERS_LUMEN: "the tube enters an airway again",
    kernels.FLAT_EXIT: "the tube meets the airway wall at too flat an angle",
    kernels.LONG_WALL_RUN: "the tube runs too far in the wall of the airway that it leaves",
    kernels.SWEEPS: "the tube would sweep tissue sideways",
    kernels.TOO_LONG: "the tube would extend too far",
    kernels.PROTRUDES: "the inner tube is too short to protrude so far",
    kernels.LEAVES_MEDIASTINAL: "the tube would leave the trachea or a main bronchus, in the mediastinum",
}
"""Why a deployment is refused, by the code of the kernels."""


@frozen_record
class Deployment:
    """One accepted deployment in full.

    Parameters
    ----------
    rotation_rad : float
        Rotation of all tubes together about +z of the scope tip.
    outer_mm, inner_mm : float
        Insertions of the outermost and the innermost tube.
    lps_from_tip : (4, 4) float64
        +z forward; +x towards the bend of planar tubes, else carried from the scope tip without turning.
    shape : TubeShape or None
        None for planar tubes, whose shape follows from their insertions.
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
    shape: TubeShape | None = None

    def points(self, tubes: ConcentricTubes, lps_from_scope_tip: Float, arc_lengths_mm: ArrayLike) -> Float:
        """Return points `(N, 3)` LPS mm of the centreline at arc lengths `(N,)` from the scope tip."""
        if self.shape is not None:
            return points_on_arcs(self.shape.arcs, lps_from_scope_tip, self.rotation_rad, arc_lengths_mm)
        insertions = self.outer_mm, self.inner_mm
        return centreline(tubes, lps_from_scope_tip, self.rotation_rad, *insertions, arc_lengths_mm)

    @property
    def length_in_tissue_mm(self) -> float:
        """Length of tube beyond the lumen that it leaves."""
        return self.inner_mm - self.exit_mm


class DeploymentValidator:
    """Accepts or refuses single deployments of tubes in one lung.

    Parameters
    ----------
    with_fissures : bool
        Whether fissures are obstacles.
    """

    def __init__(self, lung: Lung, tubes: ConcentricTubes, margins: Margins, *, with_fissures: bool) -> None:
        self._environment = tube_environment(lung, with_fissures=with_fissures)
        self._tubes, self._constants = tubes, tube_constants(tubes, margins)
        self._trace = np.zeros(kernels.N_TRACE)
        self._tip = np.zeros(9)

    def choose(
        self,
        lps_from_scope_tip: Float,
        rotation_rad: float,
        outer_mm: float,
        inner_mm: float,
        shape: int | TubeShape,
    ) -> Deployment | str:
        """Return a deployment by its shape, or by its place as in `Deployments`, or why it is refused."""
        if not isinstance(shape, int):
            return self.validate_shape(lps_from_scope_tip, rotation_rad, shape)
        if shape < 0:
            return self.validate(lps_from_scope_tip, rotation_rad, outer_mm, inner_mm)
        return self.validate_shape(lps_from_scope_tip, rotation_rad, shapes_of(self._tubes).member(shape))

    def validate(
        self, lps_from_scope_tip: Float, rotation_rad: float, outer_mm: float, inner_mm: float
    ) -> Deployment | str:
        """Return the deployment of planar tubes, or the reason why it is refused.

        Parameters
        ----------
        lps_from_scope_tip : (4, 4) float64
        rotation_rad : float
            Direction of the bend about +z of the scope tip, counted from its +x.
        outer_mm, inner_mm : float
            Insertions beyond the scope tip.

        Raises
        ------
        SettingsError
            If the outer tube would be ahead of the inner one, or the tubes are not planar.
        """
        if not 0.0 <= outer_mm <= inner_mm:
            raise SettingsError(
                f"The insertions of outer and inner tube are {outer_mm:g} and {inner_mm:g} mm",
                expected="0 <= outer <= inner",
            )
        self._tubes.require_planar("A deployment by two insertions and one rotation")
        base, normal = _start(lps_from_scope_tip, rotation_rad)
        reason = kernels.validate_deployment(
            self._environment, self._constants, base, normal, float(outer_mm), float(inner_mm), self._trace,
            self._tip,
        )  # fmt: skip
        if reason != kernels.ACCEPTED:
            return REASONS[reason]
        sweep = kernels.lateral_sweep(self._constants, float(outer_mm), float(inner_mm))
        return self._accepted(rotation_rad, (outer_mm, inner_mm), float(sweep), None)

    def validate_shape(
        self, lps_from_scope_tip: Float, rotation_rad: float, shape: TubeShape
    ) -> Deployment | str:
        """Return the deployment of a shape of the design, or the reason why it is refused.

        Parameters
        ----------
        lps_from_scope_tip : (4, 4) float64
        rotation_rad : float
            Of all tubes together about +z of the scope tip, counted from its +x.
        shape : TubeShape
            Its own limits (extension, sweep, strain, snaps) are kept by all members of `TubeShapes`.
        """
        base, normal = _start(lps_from_scope_tip, rotation_rad)
        reason = kernels.validate_arcs(
            self._environment, self._constants, base, normal, shape.arcs, shape.required_beside_mm,
            self._trace, self._tip,
        )  # fmt: skip
        if reason != kernels.ACCEPTED:
            return REASONS[reason]
        ends = float(shape.insertions_mm[-1]), float(shape.insertions_mm[0])
        return self._accepted(rotation_rad, ends, shape.lateral_sweep_mm, shape)

    def _accepted(
        self, rotation_rad: float, ends_mm: tuple[float, float], sweep_mm: float, shape: TubeShape | None
    ) -> Deployment:
        """Return the deployment that the kernel has just followed and accepted."""
        trace, tip = self._trace, self._tip
        return Deployment(
            rotation_rad=float(rotation_rad),
            outer_mm=float(ends_mm[0]),
            inner_mm=float(ends_mm[1]),
            lps_from_tip=frames.pose(tip[:3], tip[3:6], tip[6:9]),
            branch=int(trace[kernels.BRANCH]),
            exit_mm=float(trace[kernels.LEFT_AT]),
            wall_angle_rad=float(trace[kernels.WALL_ANGLE]),
            wall_run_mm=float(trace[kernels.WALL_RUN]),
            lateral_sweep_mm=sweep_mm,
            shape=shape,
        )


def _start(lps_from_scope_tip: Float, rotation_rad: float) -> tuple[Float, Float]:
    """Return the pose `(6,)` of the scope tip, and the direction `(3,)` to which the tubes are turned."""
    base = np.concatenate([lps_from_scope_tip[:3, 3], lps_from_scope_tip[:3, 2]])
    return base, np.asarray(frames.bending_directions(lps_from_scope_tip, rotation_rad)[0])


def centreline(
    tubes: ConcentricTubes,
    lps_from_scope_tip: Float,
    rotation_rad: float,
    outer_mm: float,
    inner_mm: float,
    arc_lengths_mm: ArrayLike,
) -> Float:
    """Return points `(N, 3)` LPS mm of planar tubes' centreline at arc lengths `(N,)` from the scope tip.

    The deployment is given as to `DeploymentValidator.validate`.
    """
    constants = tube_constants(tubes, Margins())
    at_mm = np.array(arc_lengths_mm, dtype=np.float64, ndmin=1)
    planar = np.zeros((len(at_mm), 2))
    kernels.planar_points(constants, float(outer_mm), float(inner_mm), at_mm, planar)
    bend = bending_directions(lps_from_scope_tip, rotation_rad)[0]
    forward = lps_from_scope_tip[:3, 2]
    return np.asarray(lps_from_scope_tip[:3, 3] + planar[:, :1] * bend + planar[:, 1:] * forward)
