"""What the needle kernels look at: the lung's arrays and the needle's limits as numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from anatomy.grid import Float, read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import FISSURE, OBSTACLES
from stages.needle import kernels
from stages.needle.device import Needle

Arrays = tuple[NDArray[np.uint16], NDArray[np.uint16], Float, int]

RRT_STEP_MM = 20.0
COST_STEP_MM = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class NeedleSpace:
    """One needle in one lung.

    Parameters
    ----------
    lung : Lung
    needle : Needle
    margins : Margins
    with_fissures : bool
        Whether fissures are obstacles.
    arrays : tuple
        Clearance field, labels, geometry and obstacle bits, for the kernels.
    limits : (9,) float64
        See `stages.needle.kernels`.
    """

    lung: Lung
    needle: Needle
    margins: Margins
    with_fissures: bool
    arrays: Arrays
    limits: Float

    @property
    def required_clearance_mm(self) -> float:
        """Distance that the needle's axis keeps from obstacles: its radius and the margins."""
        return self.needle.radius_mm + self.margins.total_mm


def needle_space(lung: Lung, needle: Needle, margins: Margins, *, with_fissures: bool) -> NeedleSpace:
    """Gather what the kernels need to steer `needle` through `lung`."""
    field = lung.obstacle_field(with_fissures=with_fissures)
    bits = OBSTACLES | (FISSURE if with_fissures else 0)
    limits = np.zeros(kernels.N_LIMITS)
    limits[kernels.KAPPA] = needle.max_curvature_per_mm
    limits[kernels.MAX_LENGTH] = needle.max_length_mm
    limits[kernels.MAX_ANGLE] = math.radians(needle.max_angle_from_start_deg)
    limits[kernels.MAX_TURN] = math.radians(needle.max_accumulated_turn_deg)
    limits[kernels.REQUIRED] = needle.radius_mm + margins.total_mm
    limits[kernels.RADIUS] = needle.radius_mm
    limits[kernels.EXEMPT_LENGTH] = needle.exit_exemption_mm
    limits[kernels.MAX_STEP] = RRT_STEP_MM
    limits[kernels.COST_STEP] = COST_STEP_MM
    return NeedleSpace(
        lung=lung,
        needle=needle,
        margins=margins,
        with_fissures=with_fissures,
        arrays=(field.corners, lung.labels, field.geometry, bits),
        limits=read_only(limits),
    )


def workspace_lengths(
    space: NeedleSpace, positions: ArrayLike, tangents: ArrayLike, target: ArrayLike
) -> Float:
    """Return the shortest path length from each start pose to a target, infinite where there is none.

    The test is exact in free space for curvature, both turning limits and the greatest length; paths
    that turn by more than 180 degrees in all are left out.

    Parameters
    ----------
    positions, tangents : (E, 3) float64, LPS mm
    target : (3,) float64, LPS mm

    References
    ----------
    .. [Kuntz2015] fig. 4; [Dubins1957]
    """
    places = _plain(positions)
    lengths = np.zeros(len(places))
    kernels.workspace_scan(places, _plain(tangents), _plain(target), space.limits, lengths)
    return lengths


def direct_arcs(
    space: NeedleSpace,
    positions: ArrayLike,
    tangents: ArrayLike,
    branches: NDArray[np.int64],
    target: ArrayLike,
) -> tuple[NDArray[np.int64], Float, Float]:
    """Try the single arc to a target from each start pose.

    Parameters
    ----------
    positions, tangents : (E, 3) float64, LPS mm
    branches : (E,) int64
        Branch whose wall each start has pierced; -1 for none.
    target : (3,) float64, LPS mm

    Returns
    -------
    blockers : (E,) int64
        0 where the arc is proved clear, -1 where no arc fits the limits, else the label of the voxel
        that is too near.
    lengths, inverse_clearance : (E,) float64
        Length in mm, and the estimated integral of 1 / clearance where the arc is clear.
    """
    blockers = np.zeros(len(branches), dtype=np.int64)
    costs = np.zeros((len(branches), 2))
    kernels.direct_arcs(
        space.arrays,
        space.limits,
        _plain(positions),
        _plain(tangents),
        np.array(branches, dtype=np.int64),
        _plain(target),
        blockers,
        costs,
    )
    return blockers, costs[:, 0], costs[:, 1]


def _plain(array: ArrayLike) -> Float:
    """Copy to the one kind of array (writeable, contiguous) for which the kernels are compiled."""
    return np.array(array, dtype=np.float64, order="C")
