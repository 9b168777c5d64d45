"""Corrections by hand are kept voxel by voxel, and stand over whatever made the masks."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.typed import Array, Mask
from anatomy.grid import Grid, Volume
from anatomy.io.masks import box_in, place
from anatomy.morphology import Window, bounds, grown_by_one, window
from anatomy.patient import PatientImages

AS_MADE, TISSUE, AIRWAY, VESSEL, FISSURE, NODULE = range(6)
"""A voxel of corrections says nothing, that it is none of the others, or that it is lumen of an airway,
vessel, fissure or nodule: one number a voxel, so that two corrections of it cannot contradict each other."""
PAINTED: Mapping[str, int] = {"airway": AIRWAY, "vessel": VESSEL, "fissure": FISSURE, "nodule": NODULE}
"""The structures that a person may correct, and what a voxel of the corrections then says."""
ROLES = {"airway": "lumen", "vessel": "vessels", "fissure": "fissures", "nodule": "nodules"}
WALL_MM = 3.0
"""The wall of an airway is no thicker: what of it is so near to erased lumen, and nearest, is erased too."""
UNUSED = (
    "Painted fissures are not used: the patient came without any, and these would pass for all of them.",
)


def with_corrections(
    images: PatientImages, corrections: Volume, sources: Mapping[str, str] | None = None
) -> PatientImages:
    """Return a patient as a person corrected it, with a warning that says how much.

    Erased lumen takes the wall nearest to it along.  What is left of the airway is closed by a wall of one
    voxel, and so is lumen that was added, where the patient has walls.  Corrections are uint8, see `PAINTED`,
    and may cover another box than the patient; `sources` are the SHA-256 of their files.
    """
    found = _placed(corrections, images.grid)
    sources = {**images.sources, **(sources or {})}
    if found is None:
        return replace(images, sources=sources)
    box, values = found
    changed = values != AS_MADE
    before = {role: _part(images, role, box) for role in (*ROLES.values(), "wall")}
    after = {
        ROLES[name]: (before[ROLES[name]] & ~changed) | (values == code) for name, code in PAINTED.items()
    }
    unused = images.fissures is None and bool(after.pop("fissures").any())
    if images.wall is not None:
        after["wall"] = _wall(
            before["wall"] & ~changed, before["lumen"], after["lumen"], changed, images.grid
        )
    made: dict[str, Any] = {
        role: _with_part(getattr(images, role), box, mask, images.grid)
        for role, mask in after.items()
        if not np.array_equal(mask, before[role])
    }
    if images.nodule_labels is not None:
        # What was painted and has no number is the next nodule.
        labels = images.nodule_labels
        numbers = np.where(after["nodules"], labels.array[box], 0).astype(labels.array.dtype)
        numbers[(values == NODULE) & (numbers == 0)] = int(labels.array.max()) + 1
        made["nodule_labels"] = _with_part(labels, box, numbers, labels.grid)
    if images.cost is not None:
        opened = changed & ~after["vessels"] & ~after["lumen"]
        opened[opened] = np.isinf(images.cost.array[box][opened])
        if opened.any():
            # What was taken for an obstacle costs as much to pass as any tissue.
            cost = np.where(opened, np.float32(1.0), images.cost.array[box])
            made["cost"] = _with_part(images.cost, box, cost, images.grid)
    warnings = (*images.warnings, *_warnings(images.grid, before, after), *UNUSED[:unused])
    return replace(images, **made, warnings=warnings, sources=sources)


def _placed(corrections: Volume, grid: Grid) -> tuple[Window, Array] | None:
    """Return the corrections on the voxels of a patient, with room for walls; None if there are none."""
    first, last = box_in(grid, corrections.grid)
    pad = np.ceil(WALL_MM / grid.spacing_mm).astype(np.int64) + 1
    low = np.clip(np.floor(first + 0.05).astype(np.int64) - pad, 0, grid.shape)
    high = np.clip(np.ceil(last - 0.05).astype(np.int64) + pad, 0, grid.shape)
    if not (low < high).all():
        return None
    values = place(corrections.array, corrections.grid, grid.crop(low, high)).array
    start, stop = bounds(values != AS_MADE, pad)
    if not (start < stop).all() or not values.any():
        return None
    return window(low + start, low + stop), values[window(start, stop)]


def _part(images: PatientImages, role: str, box: Window) -> Mask:
    volume: Volume | None = getattr(images, role)
    if volume is None:
        return np.zeros([axis.stop - axis.start for axis in box], dtype=np.bool_)
    return np.asarray(volume.array[box], dtype=np.bool_)


def _with_part(volume: Volume | None, box: Window, part: Array, grid: Grid) -> Volume:
    array = np.zeros(grid.shape, dtype=part.dtype, order="F") if volume is None else volume.array.copy("F")
    array[box] = part
    return Volume(grid=grid, array=array)


def _wall(wall: Mask, before: Mask, after: Mask, changed: Mask, grid: Grid) -> Mask:
    erased, added = before & ~after, after & ~before
    if erased.any():
        from scipy.spatial import cKDTree

        voxels = np.argwhere(wall)
        away, _ = cKDTree(np.argwhere(erased) * grid.spacing_mm).query(
            voxels * grid.spacing_mm, distance_upper_bound=WALL_MM
        )
        voxels, away = voxels[np.isfinite(away)], away[np.isfinite(away)]
        if after.any():
            left, _ = cKDTree(np.argwhere(after) * grid.spacing_mm).query(voxels * grid.spacing_mm)
            voxels = voxels[away < left]
        kept = wall.copy()
        wall[tuple(voxels.T)] = False
        wall |= grown_by_one(after) & (kept | erased)
    if added.any():
        wall |= grown_by_one(added) & ~changed
    return wall & ~after


def _warnings(grid: Grid, before: Mapping[str, Mask], after: Mapping[str, Mask]) -> list[str]:
    words = []
    for name, role in ROLES.items():
        if role not in after or np.array_equal(before[role], after[role]):
            continue
        more, less = after[role] & ~before[role], before[role] & ~after[role]
        said = [
            f"{np.count_nonzero(each) * grid.voxel_volume_mm3 / 1000.0:.2f} ml {what}"
            for each, what in ((more, "added"), (less, "erased"))
            if each.any()
        ]
        words += [f"{name} {' and '.join(said)}"] if said else []
    return [f"A person corrected the masks by hand: {'; '.join(words)}."] if words else []
