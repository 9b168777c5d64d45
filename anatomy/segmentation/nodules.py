"""The target of a procedure: radiologists' contours, a mask or a point; and its removal from the vessels."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import FileError, GridMismatchError
from anatomy.base.files import DAMAGE, read_json, reading
from anatomy.base.typed import Float, Int16, Mask
from anatomy.grid import Grid
from anatomy.morphology import bounds, components, distance_mm, largest_piece, window

_CONTOURS = '{"annotations": [{"contours": [{"z_mm": ..., "ij": [[column, row], ...]}]}]}'
_REMEDY = "`lungaccess template contours` prints an example; a mask can be given with --nodule-mask"
RIM_MM = 2.0
"""A nodule blurs this far into the lung around it, and may be taken for a vessel there."""
ATTACHED_MM = 1.5
"""Within the rim, what is this close to a vessel beyond it stays vessel."""
LEAST_STOUT_ML, MOST_SLENDER = 0.35, 2.0
"""Volume of the smallest large vessel, and how many times as long as wide what is no vessel is at most."""


def nodule_from_contours(path: str | Path, grid: Grid) -> Mask:
    """Draw the nodules that radiologists outlined in a CT, by the majority of those who outlined each.

    The file is JSON: `{"annotations": [{"contours": [{"z_mm": -510.8, "ij": [[184, 245], ...], "inclusion":
    true}, ...]}, ...]}`, one annotation a radiologist and nodule, as the LIDC-IDRI database has them
    [Armato2011].  `ij` are columns and rows of the DICOM slice at `z_mm` (LPS); a contour runs through the
    first pixels outside the nodule, and one with `"inclusion": false` cuts a hole.  A voxel belongs to a
    nodule if at least half of those who outlined this nodule have it inside.  Raises FileError if the file
    has another form, or holds no contour, and GridMismatchError if a contour lies outside the image, or the
    slices of the image are not axial.
    """
    annotations = _annotations(Path(path))
    if not np.abs(np.abs(grid.lps_from_ijk[:3, :3] / grid.spacing_mm) - np.eye(3)).max() <= 1e-3:
        raise GridMismatchError(
            "Contours in columns and rows were given for an image that is not axial",
            expected="the CT whose slices the contours were drawn in",
            remedy="Give the nodule as a mask with --nodule-mask",
        )
    with reading(path):
        masks = [annotation_mask(annotation, grid, Path(path)) for annotation in annotations]
    votes = np.zeros(grid.shape, dtype=np.int16, order="F")
    for mask in masks:
        votes += mask
    return _majority(votes, masks)


def _annotations(path: Path) -> list[Mapping[str, Any]]:
    content = read_json(path, expected=_CONTOURS, remedy=_REMEDY)
    annotations = content.get("annotations") if isinstance(content, Mapping) else None
    if not isinstance(annotations, list) or not annotations:
        raise _not_contours(path, "has no annotations")
    for annotation in annotations:
        contours = annotation.get("contours") if isinstance(annotation, Mapping) else None
        if not isinstance(contours, list) or not contours or not all(map(_is_contour, contours)):
            raise _not_contours(path, "has an annotation without proper contours")
    return annotations


def _is_contour(contour: Any) -> bool:
    if not isinstance(contour, Mapping) or not isinstance(contour.get("z_mm"), int | float):
        return False
    try:
        points = np.asarray(contour.get("ij"), dtype=np.float64)
        height = float(contour["z_mm"])
    except DAMAGE:
        return False
    shaped = points.ndim == 2 and points.shape[1] == 2 and len(points) > 0
    return shaped and math.isfinite(height) and bool(np.isfinite(points).all())


def _not_contours(path: Path, what: str) -> FileError:
    return FileError(f"{path} {what}", expected=_CONTOURS, remedy=_REMEDY)


def annotation_mask(annotation: Mapping[str, Any], grid: Grid, path: Path) -> Mask:
    """Return the inside of the contours of one annotation."""
    mask = np.zeros(grid.shape, dtype=np.bool_, order="F")
    for included in (True, False):
        for contour in annotation["contours"]:
            if bool(contour.get("inclusion", True)) is included:
                k, inside = _inside(contour, grid, path)
                mask[:, :, k] = (mask[:, :, k] | inside) if included else (mask[:, :, k] & ~inside)
    return mask


def _inside(contour: Mapping[str, Any], grid: Grid, path: Path) -> tuple[int, Mask]:
    """Return the slice of a contour and the voxels inside it; those on it if none are."""
    from skimage.draw import polygon2mask, polygon_perimeter

    columns_rows = np.asarray(contour["ij"], dtype=np.float64)
    level = (float(contour["z_mm"]) - grid.lps_from_ijk[2, 3]) / grid.lps_from_ijk[2, 2]
    k = int(np.floor(level + 0.5))
    shape = np.asarray(grid.shape[:2])
    if not 0 <= k < grid.shape[2] or (columns_rows < 0).any() or (columns_rows > shape - 1).any():
        raise GridMismatchError(
            f"{path} holds a contour at z = {contour['z_mm']:.1f} mm that lies outside the image",
            expected=f"contours within {grid.describe()}",
            remedy="Give the contours of this CT",
        )
    # Columns and rows count along +x and +y, whichever way the voxels of this image do.
    points = np.where(np.diag(grid.lps_from_ijk)[:2] < 0, shape - 1 - columns_rows, columns_rows)
    filled = polygon2mask(tuple(shape), points) if len(points) > 2 else np.zeros(shape, dtype=np.bool_)
    line = np.zeros(shape, dtype=np.bool_)
    line[polygon_perimeter(points[:, 0], points[:, 1], shape=tuple(shape), clip=True)] = True
    inside = filled & ~line
    return k, inside if inside.any() else line


def _majority(votes: Int16, masks: list[Mask]) -> Mask:
    """Keep, of each connected nodule, the voxels that half of its own annotations have inside."""
    from scipy import ndimage

    low, high = bounds(votes > 0)
    box = window(low, high)
    pieces, count = ndimage.label(votes[box] > 0)
    of_piece = np.zeros(count + 1, dtype=np.int64)
    for mask in masks:
        touched = np.unique(pieces[mask[box]])
        of_piece[touched[touched > 0]] += 1
    nodule = np.zeros(votes.shape, dtype=np.bool_, order="F")
    nodule[box] = (pieces > 0) & (2 * votes[box] >= of_piece[pieces])
    return nodule


def centre_of(nodule: Mask, grid: Grid) -> Float:
    """Return the voxel of the largest nodule that is deepest inside it, LPS mm `(3,)`."""
    low, high = bounds(nodule)
    part = np.asfortranarray(largest_piece(nodule[window(low, high)]))
    depth = distance_mm(part, grid.spacing_mm, bordered=True)
    return grid.lps(low + np.asarray(np.unravel_index(int(np.argmax(depth)), depth.shape)))


def without_nodule(vessels: Mask, nodule: Mask, grid: Grid) -> Mask:
    """Return the vessels without the nodule, which is a target and no obstacle.

    Around the nodule, the rim of `RIM_MM` that its blur turned into vessel is taken away too, except for
    what lies within `ATTACHED_MM` of a vessel that runs on beyond the rim.  Both are bool on the grid.
    """
    from scipy import ndimage

    cleared = np.array(vessels, dtype=np.bool_, order="F")
    if not nodule.any():
        return cleared
    box = window(*bounds(nodule, np.ceil((RIM_MM + 2.0 * ATTACHED_MM) / grid.spacing_mm).astype(np.int64)))
    distance = distance_mm(~nodule[box], grid.spacing_mm)
    gone = distance <= RIM_MM
    pieces, count = ndimage.label(cleared[box] & ~gone)
    runs_on = np.zeros(count + 1, dtype=np.bool_)
    runs_on[np.unique(pieces[distance > RIM_MM + ATTACHED_MM])] = True
    runs_on[0] = False
    beyond = runs_on[pieces]
    gone |= (pieces > 0) & ~beyond
    if beyond.any():
        gone &= (distance_mm(~beyond, grid.spacing_mm) > ATTACHED_MM) | nodule[box]
    cleared[box] &= ~gone
    return cleared


def stout_warnings(vessels: Mask, lungs: Mask, grid: Grid) -> list[str]:
    """Warn of pieces of the large vessels that lie in the lungs alone and are hardly longer than wide.

    A vessel of this width runs to the hilum, outside of the lungs, or is cut off from it and long.
    """
    voxels, part = components(vessels)
    ml = np.bincount(part) * grid.voxel_volume_mm3 / 1000.0
    ml[part[~lungs[tuple(voxels.T)]]] = 0.0
    found = []
    for piece in np.flatnonzero(ml >= LEAST_STOUT_ML):
        lps = grid.lps(voxels[part == piece])
        _, across, along = np.sqrt(np.linalg.eigvalsh(np.cov(lps.T)))
        if along <= MOST_SLENDER * across:
            middle = lps[np.argmin(np.linalg.norm(lps - lps.mean(axis=0), axis=1))]
            place = ",".join(f"{x:.0f}" for x in middle)
            found.append(
                f"{ml[piece]:.1f} ml of solid tissue at LPS ({place}) mm were taken for a large vessel, but "
                "have no way to the hilum and are hardly longer than wide: a nodule, a scar, or tissue at "
                f"the pleura. They are an obstacle; if they are a nodule, add --nodule lps:{place}."
            )
    return found
