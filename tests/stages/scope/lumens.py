"""Lumens of analytic shape, sampled for the resting shaft, and motions into them."""

from collections.abc import Callable

import numpy as np

from anatomy.fields import corner_geometry
from anatomy.grid import Grid
from stages.scope import ScopeMotion
from stages.scope.device import Bronchoscope
from stages.scope.kernels.resting import Lumen

Depth = Callable[[np.ndarray], np.ndarray]
"""Signed depth in mm at points `(N, 3)` mm."""


def sampled(depth: Depth, low: tuple[float, ...], high: tuple[float, ...], step_mm: float) -> Lumen:
    """Return a lumen with the depth at the corners of voxels of a size, from a low corner to a high one."""
    shape = tuple(int(np.ceil((b - a) / step_mm)) for a, b in zip(low, high, strict=True))
    lps_from_ijk = np.diag([step_mm, step_mm, step_mm, 1.0])
    lps_from_ijk[:3, 3] = np.array(low) + 0.5 * step_mm
    corners = np.stack(np.meshgrid(*(np.arange(n + 1) for n in shape), indexing="ij"), axis=-1)
    points = np.array(low) + step_mm * corners.reshape(-1, 3)
    field = depth(points).reshape(corners.shape[:3]).astype(np.float32)
    return Lumen(np.asfortranarray(field), corner_geometry(Grid(shape=shape, lps_from_ijk=lps_from_ijk)))


def scope_of(section_mm: float = 12.0, radius_mm: float = 1.5) -> Bronchoscope:
    """Return a bronchoscope of 420 N mm2."""
    return Bronchoscope(
        name="test", outer_diameter_mm=2.0 * radius_mm, channel_diameter_mm=radius_mm, bend_up_deg=180.0,
        bend_down_deg=130.0, bending_length_mm=section_mm, min_bending_radius_mm=5.0, min_shaft_radius_mm=5.0,
        bending_stiffness_n_mm2=420.0,
    )  # fmt: skip


def motion_of(states: list[tuple[float, float, float]], section_mm: float = 12.0) -> ScopeMotion:
    """Return a motion that begins at the origin along +z."""
    return ScopeMotion(lps_from_entry=np.eye(4), states=np.array(states), bending_length_mm=section_mm)


def torus(bend_mm: float, radius_mm: float, straight_mm: float) -> Depth:
    """Return the depth of a straight tube along +z that bends towards +x with a radius, and goes on so."""

    def depth(points: np.ndarray) -> np.ndarray:
        x, y, z = (points - [0.0, 0.0, straight_mm]).T
        ring = np.hypot(x - bend_mm, z) - bend_mm
        aside = np.where(z > 0.0, np.hypot(ring, y), np.hypot(x, y))
        return np.asarray(radius_mm - aside)

    return depth


def s_bend(bend_mm: float, radius_mm: float, angle_rad: float) -> Depth:
    """Return the depth of a tube that bends towards +x by an angle, then back towards -x as tightly."""
    turn = np.array([bend_mm * (1.0 - np.cos(angle_rad)), 0.0, bend_mm * np.sin(angle_rad)])
    ahead = np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)])
    out = np.array([np.cos(angle_rad), 0.0, -np.sin(angle_rad)])
    centre = turn - bend_mm * out

    def depth(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        first = np.hypot(np.where(z > 0.0, np.hypot(x - bend_mm, z) - bend_mm, x), y)
        from_centre = points - centre
        flat = np.hypot(from_centre[:, 0], from_centre[:, 2])
        second = np.hypot(flat - bend_mm, y)
        return np.asarray(radius_mm - np.where((points - turn) @ ahead > 0.0, second, first))

    return depth
