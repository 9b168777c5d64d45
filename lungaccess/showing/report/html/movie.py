"""Virtual bronchoscopy as an animated picture: rays marched through the depth of the lumen."""

import os
from pathlib import Path

import numpy as np

from anatomy.base.files import atomic_write
from anatomy.base.typed import Array, Float, UInt8
from anatomy.lung import Lung
from anatomy.structures import LUMEN
from lungaccess.plans.insertion import shown_motion
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html.deployment import moved_mm

PIXELS, FRAMES, FRAME_MS, LAST_MS = 240, 72, 90, 1500
HALF_ANGLE_RAD = np.deg2rad(48.0)
MARCHES, FARTHEST_MM, LEAST_STEP_MM = 120, 160.0, 0.2
AROUND_MM = 45.0
"""Border of the box around the route in which the lumen is drawn."""
HALF = 0.5
NORMAL_MM = 0.7
"""Step of the differences from which the direction of the wall is taken: about a voxel."""
DARK, BRIGHT = np.array([0.50, 0.16, 0.13]), np.array([0.98, 0.72, 0.64])
"""Colours of the wall with little and with much light."""


def bronchoscopy_webp(
    plan: Plan, lung: Lung, path: str | os.PathLike[str], *, frames: int = FRAMES, pixels: int = PIXELS
) -> Path:
    """Write what the scope's camera sees on its route to the plan's site as an animated WebP.

    Up is where a positive bend turns the tip: the picture rolls with the twist.  The wall is where blurred
    lumen is half full, so that voxels do not show; no device is drawn.  Raises FileError if the file cannot
    be written.

    Args:
        frames, pixels: Number of pictures, and their width and height.
    """
    from PIL import Image

    lumen = SmoothLumen(lung, shown_motion(plan).tips[:, :3, 3])
    pictures = [Image.fromarray(view(lumen, pose, pixels)) for pose in camera_poses(plan, frames)]
    target = Path(path)
    with atomic_write(target) as temporary:
        pictures[0].save(
            temporary, format="WEBP", save_all=True, append_images=pictures[1:], quality=70, method=4, loop=0,
            duration=[FRAME_MS] * (len(pictures) - 1) + [LAST_MS],
        )  # fmt: skip
    return target


def camera_poses(plan: Plan, frames: int) -> list[Float]:
    """Return `lps_from_camera` (4, 4) at states of the scope, evenly along its motion; +z forward, -y up."""
    moving = shown_motion(plan)
    moved, tips = moved_mm(moving), moving.tips
    chosen = np.searchsorted(moved, np.linspace(0.0, moved[-1], max(frames, 1)))
    # The top of the picture is +x of the tip, its right +y.
    camera_from_tip = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return [np.asarray(tips[n] @ camera_from_tip) for n in chosen]


class SmoothLumen:
    """The lumen around a route with a smooth wall, for rays.

    Args:
        points_lps ((N, 3) float64, LPS mm): What lies farther than `AROUND_MM` from the box of these is not
            seen.
    """

    def __init__(self, lung: Lung, points_lps: Float) -> None:
        from scipy.ndimage import gaussian_filter

        grid = lung.grid
        places = grid.ijk(points_lps)
        around = AROUND_MM / grid.spacing_mm
        start = np.maximum(np.floor(places.min(axis=0) - around), 0).astype(int)
        stop = np.minimum(np.ceil(places.max(axis=0) + around) + 1, grid.shape).astype(int)
        part = lung.labels[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))]
        filled = ((part & LUMEN) != 0).astype(np.float32)
        # Smoothing of the mask: its voxels do not show as steps on the wall.
        self._share = gaussian_filter(filled, 0.9 * grid.spacing_mm.max() / grid.spacing_mm)
        self._grid = grid.crop(start, stop)
        self._depth = lung.lumen_depth

    def share(self, lps: Float) -> Float:
        """Return how full of lumen `(N,)` the surroundings of points `(N, 3)` are; `HALF` at the wall."""
        from scipy.ndimage import map_coordinates

        return np.asarray(map_coordinates(self._share, self._grid.ijk(lps).T, order=1, mode="constant"))

    def wall_distance(self, eye_lps: Float, rays: Float) -> Float:
        """Return how far the wall is in mm along each ray, at most `FARTHEST_MM`.

        A ray goes on by the distance that is free all around [Hart1996], near the wall by short steps.

        Args:
            eye_lps: (3,) float64, LPS mm.
            rays ((N, 3) float64): Unit vectors.
        """
        away = np.full(len(rays), LEAST_STEP_MM)
        going = np.arange(len(rays))
        for _ in range(MARCHES):
            points = eye_lps + away[going, None] * rays[going]
            depth = self._depth.lower_bound_mm(points)
            # The smooth wall is looked for only where the voxels' wall is so near.
            near = depth < 2.5
            at_wall = np.zeros(len(going), dtype=np.bool_)
            at_wall[near] = self.share(points[near]) < HALF
            going, depth = going[~at_wall], depth[~at_wall]
            away[going] += np.maximum(depth, LEAST_STEP_MM)
            going = going[away[going] < FARTHEST_MM]
            if not len(going):
                break
        return np.asarray(np.minimum(away, FARTHEST_MM))

    def normals(self, wall_lps: Float) -> Float:
        """Return unit vectors `(N, 3)` from the wall into the lumen."""
        slopes = [
            self.share(wall_lps + NORMAL_MM * axis) - self.share(wall_lps - NORMAL_MM * axis)
            for axis in np.eye(3)
        ]
        inwards = np.stack(slopes, axis=1)
        return np.asarray(inwards / np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9))


def view(lumen: SmoothLumen, lps_from_camera: Float, pixels: int) -> UInt8:
    """Return what a camera in the lumen sees, `(pixels, pixels, 3)`; black beyond the round picture."""
    steps = (np.arange(pixels) + 0.5) / pixels * 2.0 - 1.0
    across, down = np.meshgrid(steps, steps)
    inside = across**2 + down**2 <= 1.0
    spread = np.tan(HALF_ANGLE_RAD)
    rays = np.stack([across[inside] * spread, down[inside] * spread, np.ones(int(inside.sum()))], axis=1)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ lps_from_camera[:3, :3].T
    eye = np.asarray(lps_from_camera[:3, 3])
    away = lumen.wall_distance(eye, rays)
    straight = np.clip(-(lumen.normals(eye + away[:, None] * rays) * rays).sum(axis=1), 0.0, 1.0)
    # More light comes back from near, half as much from 23 mm, and from a wall seen face on.
    light = (0.25 + 0.85 * straight) / (1.0 + away**2 / 520.0)
    picture: Array = np.zeros((pixels, pixels, 3))
    share = np.clip(1.15 * light, 0.0, 1.0)[:, None]
    picture[inside] = ((1.0 - share) * DARK + share * BRIGHT) * np.clip(1.5 * light, 0.0, 1.0)[:, None]
    return np.asarray(np.rint(255.0 * picture), dtype=np.uint8)
