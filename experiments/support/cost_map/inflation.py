"""Obstacles grown by whole voxels and looked up at the ends of steps [Fu2018, sec. IV-B]: the paper's mode.

It is here to be compared with the clearance field, and proves nothing.  The paper calls the lookup
conservative if steps are no longer than `largest_step_mm`.  It is not: the bound takes the tip for the centre
of its voxel, and the ellipsoid of voxels for the ball it stands for.  Paths found in an environment of this
mode are never called proved; `refuting_labels` puts them to the proof.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Int, Mask
from anatomy.grid import Volume, read_only
from anatomy.structures import OUTSIDE
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels.proof import Obstacles
from stages.needle.path import ArcPath, blocker_on_path

LEAST_STEP_MM = 1e-3
"""Shorter steps are no steps."""
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


def largest_step_mm(spacing_mm: ArrayLike, total_radius_mm: float) -> float:
    """Return the greatest step as printed: `2 sqrt(min(a_i s_i)^2 - r_total^2)` [Fu2018, sec. IV-B].

    Raises:
        SettingsError: If it is 0, as it is wherever `total_radius_mm` is a multiple of the voxel size along
            the axis that decides.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    reach = float((inflation_voxels(spacing, total_radius_mm) * spacing).min())
    step = 2.0 * math.sqrt(max(reach**2 - total_radius_mm**2, 0.0))
    if step < LEAST_STEP_MM:
        raise SettingsError(
            f"The step bound of [Fu2018] is 0: radius and margin of {total_radius_mm:g} mm are a multiple of "
            f"the voxel size, so that obstacles grow by {reach:g} mm and nothing is left for the step",
            expected=f"radius and margin that are no multiple of a voxel size of {spacing.tolist()} mm",
            remedy="Choose another margin, or plan with the clearance field, which has no step bound",
        )
    return step


def inflated_environment(environment: NeedleEnvironment) -> NeedleEnvironment:
    """Return the same environment in the paper's mode: obstacles grown, and looked up at the ends of steps.

    Each structure that is an obstacle, and the voxels of infinite cost (as OUTSIDE), grow by an ellipsoid of
    `inflation_voxels`; grown voxels have infinite cost.  The kernels then look up voxels at steps of at most
    `largest_step_mm`, which is also the longest arc of an RRT's step.  The exemption at the exit does not
    exist in the paper: a start in a grown voxel has no path.  Clearance, where an objective weighs it, is
    still that to the obstacles as they were.

    No path of this environment is proved clear, whatever the searches say of theirs: see `refuting_labels`.

    Args:
        environment: Its `required_clearance_mm` is the paper's `r_total`.

    Raises:
        SettingsError: If the step bound is 0.
    """
    field, labels, geometry, bits = environment.obstacles
    step = largest_step_mm(environment.grid.spacing_mm, environment.required_clearance_mm)
    axes = inflation_voxels(environment.grid.spacing_mm, environment.required_clearance_mm)
    grown = np.zeros(environment.grid.shape, dtype=np.uint16, order="F")
    for bit in (1 << n for n in range(16) if bits >> n & 1):
        grown |= np.where(grown_by_voxels((labels & bit) != 0, axes), np.uint16(bit), np.uint16(0))
    costs = environment.cost_map
    if costs is not None:
        barred = grown_by_voxels(np.isposinf(costs.array), axes)
        grown |= np.where(barred & (grown == 0), np.uint16(OUTSIDE), np.uint16(0))
        bits |= OUTSIDE if barred.any() else 0
        values = np.where(grown != 0, np.float32(math.inf), costs.array)
        costs = Volume(grid=costs.grid, array=np.asfortranarray(values, dtype=np.float32))
    limits = environment.limits
    limits = limits._replace(lookup_step_mm=step, max_step_mm=min(step, limits.max_step_mm))
    return replace(
        environment,
        obstacles=Obstacles(field, read_only(grown), geometry, bits),
        limits=limits,
        cost_map=costs,
    )


def refuting_labels(environment: NeedleEnvironment, paths: Iterable[ArcPath], branch: int = -1) -> Int:
    """Put paths to the proof: return `(P,)` 0 where a path is clear, else the label of what is too near.

    Args:
        environment: That from which the inflated one was made.
        branch: Pierced branch, whose wall is exempt at the exit; -1 for none.

    Raises:
        SettingsError: If the environment is itself of the paper's mode.
    """
    if environment.limits.lookup_step_mm > 0.0:
        raise SettingsError(
            "Paths cannot be proved in an environment of inflated obstacles",
            expected="the environment from which it was made",
        )
    return np.array([blocker_on_path(environment, path, branch) for path in paths], dtype=np.int64)
