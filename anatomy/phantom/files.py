"""Write a phantom as a patient folder that `anatomy.io.load_patient` reads, and how it breathes.

A place at depth t below the apex of the lungs, as a share of their height at end-exhale, moves by A t^2 to
the feet and by A t^2 / 4 to the front until end-inhale.  The left lung moves a little less than the right
one.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np

from anatomy.base.files import require_writable_folder, write_text
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume
from anatomy.io.images import write_volume
from anatomy.io.motion_files import write_vectors
from anatomy.io.own_masks import DESCRIPTION, description_text
from anatomy.motion.source import MotionSource
from anatomy.patient import MASKS
from anatomy.phantom.branching import Centerlines
from anatomy.phantom.chest import LOBES
from anatomy.phantom.patient import SCALES, Phantom
from anatomy.phantom.rasterize import LABELS
from anatomy.phantom.territory import Bulla

BORDER_MM = 12.0
"""The field goes on so far beyond the lungs."""

MOTION_FILE = "motion.nrrd"


def write_phantom(
    phantom: Phantom, folder: str | Path, *, breathing: bool = False, with_ct: bool = True
) -> Path:
    """Write masks, `patient.toml`, CT and the truth of a phantom into a folder, made if needed; return it.

    `lumen`, `wall`, `vessels`, `lung`, `fissures`, `nodules`, `ct`, `labels` and `lobes` become NIfTI images;
    `truth.json` holds the centrelines, the nodules and the meaning of the labels (LPS mm). Without `with_ct`
    there is no CT, which takes most of the room.  With `breathing` there is `motion.nrrd` as well, and
    `patient.toml` names it.  `patient.toml` is written last, so that a folder that has it is complete.
    Raises FileError if the folder cannot be written to.
    """
    folder = require_writable_folder(folder)
    images = phantom.images
    volumes: dict[str, Volume | None] = {role: getattr(images, role) for role in MASKS}
    volumes |= {"ct": phantom.ct if with_ct else None, "labels": phantom.labels, "lobes": phantom.lobes}
    for name, volume in volumes.items():
        if volume is not None:
            write_volume(folder / f"{name}.nii.gz", volume)
    truth: dict[str, Any] = {
        "seed": phantom.seed,
        "size": phantom.size,
        "traits": asdict(phantom.traits),
        "frame": "lps",
        "labels": LABELS,
        "lobes": LOBES,
        "nodules": [{**_ball(each), "lobe": each.lobe} for each in phantom.nodules],
        "bullae": [_ball(each) for each in phantom.bullae],
        "centerlines": {kind: _tree(lines) for kind, lines in phantom.centerlines.items()},
    }
    lines = description_text(
        {
            "name": images.name,
            "breath_hold": images.breath_hold,
            **{key: f"{key}.nii.gz" for key in ("lumen", "wall", "vessels", "lung", "fissures")},
            "nodule": "nodules.nii.gz",
            "targets": [f"lps:{','.join(map(repr, n.centre_lps.tolist()))}" for n in phantom.nodules],
        }
    )
    if breathing:
        motion = PhantomBreathing.of(phantom)
        write_vectors(folder / MOTION_FILE, *motion.field(phantom))
        truth["breathing"] = asdict(motion)
        lines += f'\n[motion]\nfile = "{MOTION_FILE}"\nmaps_from = "end-exhale"\nmasks_phase = 1.0\n'
    write_text(folder / "truth.json", json.dumps(truth))
    write_text(folder / DESCRIPTION, lines)
    return folder


def _ball(ball: Bulla) -> dict[str, Any]:
    return {"centre_lps": ball.centre_lps.tolist(), "radius_mm": ball.radius_mm}


def _tree(lines: Centerlines) -> dict[str, Any]:
    lengths = ("points_lps", "radius_mm", "outer_radius_mm")
    counts = ("branch_start", "branch_parent", "generation", "horsfield_order", "strahler_order", "lobe")
    rounded = {name: getattr(lines, name).round(4).tolist() for name in lengths}
    return rounded | {name: getattr(lines, name).tolist() for name in counts} | {"names": list(lines.names)}


@frozen_value
class PhantomBreathing:
    """The true motion of a phantom, whose masks show end-inhale; the carina is at x = 0.

    Apex, where nothing moves, and height of the lungs are those at end-exhale; A is told of each lung.
    """

    apex_z_mm: float
    height_mm: float
    right_mm: float
    left_mm: float

    @classmethod
    def of(cls, phantom: Phantom) -> Self:
        """Return the breathing of a phantom."""
        z = phantom.grid.lps(np.argwhere(phantom.images.lung.array))[:, 2]
        # Motion of the base of an adult's right lung, about the median of the population's.
        motion = 16.0 * SCALES[phantom.size] * phantom.traits.stature
        apex, base = float(z.max()), float(z.min())
        # At end-inhale, which the masks show, the height is longer by A.
        # The heart hinders the left lung.
        return cls(apex_z_mm=apex, height_mm=apex - base - motion, right_mm=motion, left_mm=0.85 * motion)

    def _motion_mm(self, points: Float) -> Float:
        return np.where(points[:, 0] > 0.0, self.left_mm, self.right_mm)

    def _vectors(self, motion_mm: Float, depth: Float) -> Float:
        down = motion_mm * np.maximum(depth, 0.0) ** 2
        # The front of the chest rises by some millimetres.
        return np.stack([np.zeros_like(down), -0.25 * down, -down], axis=1)

    def from_exhale(self, points_lps: Float) -> Float:
        """Return the displacements `(N, 3)` to end-inhale of places `(N, 3)` at end-exhale."""
        depth = (self.apex_z_mm - points_lps[:, 2]) / self.height_mm
        return self._vectors(self._motion_mm(points_lps), depth)

    def at_masks(self, points_lps: Float) -> Float:
        """Return the displacements from end-exhale to end-inhale of places `(N, 3)` at end-inhale."""
        motion = self._motion_mm(points_lps)
        below = np.maximum(self.apex_z_mm - points_lps[:, 2], 0.0)
        root = np.sqrt(self.height_mm**2 + 4.0 * motion * below)
        return self._vectors(motion, (root - self.height_mm) / (2.0 * motion))

    def field(self, phantom: Phantom) -> tuple[Grid, Float]:
        """Return grid and vectors `(ni, nj, nk, 3)` of the displacement field from end-exhale."""
        lungs = phantom.grid.lps(np.argwhere(phantom.images.lung.array))
        low, high = lungs.min(axis=0) - BORDER_MM, lungs.max(axis=0) + BORDER_MM
        grid = Grid.over(low, high, 4.0)
        return grid, self.from_exhale(grid.centres_lps.reshape(-1, 3)).reshape(*grid.shape, 3)

    def source(self, phantom: Phantom) -> MotionSource:
        """Return the motion as it would be read from the field."""
        grid, vectors = self.field(phantom)
        words = "the phantom's own breathing"
        return MotionSource(description=words, masks_phase=1.0, grid=grid, vectors=vectors)
