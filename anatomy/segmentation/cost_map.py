"""The pulmonary cost map [Fu2018]: what it costs a needle to cross a voxel, infinite in obstacles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.base.typed import Int, Mask
from anatomy.grid import Grid, Volume

if TYPE_CHECKING:
    from anatomy.segmentation.airway import Airways
    from anatomy.segmentation.vessels import Vessels


def cost_map(
    vessels: Vessels, airways: Airways, lung_mask: Mask, grid: Grid, *, total_radius_mm: float = 0.0
) -> Volume:
    """Return M_cost [Fu2018, sec. IV-A and IV-B]: infinite in obstacles, elsewhere the vesselness, 0 to 1.

    Obstacles are all voxels outside the lungs, which are filled, the lumen and wall of the airways, and the
    large vessels.  They are grown by `total_radius_mm`, the radius of the needle and a safety margin, see
    `inflation_voxels`. By default they are not: the planners keep their clearance by a proved distance.
    Raises GridMismatchError if a mask has another shape, and SettingsError if the radius is negative or not
    finite.
    """
    parts = {
        "vesselness": vessels.vesselness,
        "large vessels": vessels.large,
        "lumen": airways.lumen,
        "wall": airways.wall,
        "lung": lung_mask,
    }
    for name, part in parts.items():
        if part.shape != grid.shape:
            raise GridMismatchError(
                f"The {name} has the shape {part.shape}", expected=f"that of the grid, {grid.shape}"
            )
    if not 0.0 <= total_radius_mm < np.inf:
        raise SettingsError(f"The radius is {total_radius_mm} mm", expected="a number that is not negative")
    barred = ~lung_mask | airways.lumen | airways.wall | vessels.large
    if total_radius_mm > 0.0:
        barred = grown_by_voxels(barred, inflation_voxels(grid.spacing_mm, total_radius_mm))
    values = np.clip(vessels.vesselness, np.float32(0.0), np.float32(1.0))
    return Volume(grid=grid, array=np.where(barred, np.float32(np.inf), values))


ROUNDING = 1e-6
"""Relative: quotients and squared distances are whole numbers and fractions of small ones."""


def inflation_voxels(spacing_mm: ArrayLike, total_radius_mm: float) -> Int:
    """Return by how many voxels obstacles grow along i, j and k: `ceil(r_total / s_i)` [Fu2018, sec. IV-B].

    It stands for growing by a radius and proves nothing.  An ellipsoid of voxels is no ball, and the printed
    step bound `2 sqrt(min(a_i s_i)^2 - r_total^2)` takes the tip for the centre of its voxel, although it may
    be half a diagonal nearer to the obstacle.  Maps grown so are for comparison with the paper alone.

    The spacing `(3,)` is that along i, j, k; the total radius is that of the needle and the safety margin.
    """
    quotient = total_radius_mm / np.asarray(spacing_mm, dtype=np.float64)
    return np.ceil(quotient * (1.0 - ROUNDING)).astype(np.int64)


def grown_by_voxels(mask: Mask, axes: Int) -> Mask:
    """Return the voxels within an ellipsoid of semi-axes `axes`, in voxels, about a voxel of `mask`."""
    import edt

    if not mask.any():
        return mask
    sides = tuple(float(1.0 / a) for a in axes)
    distance = edt.edt(np.asfortranarray(~mask), anisotropy=sides, order="F", black_border=False, parallel=1)
    return np.asarray(distance <= 1.0 + ROUNDING)
