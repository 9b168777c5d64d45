"""What is said of a mask that lies on a grid of its own: where it was put, what was lost, what is unknown."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float, Mask
from anatomy.grid import Grid
from anatomy.io.placement import Placed, box_in

_BEYOND = {
    "lumen": "nothing counts as airway",
    "lung": "nothing counts as lung",
    "lobes": "nothing counts as lung",
    "liver": "nothing counts as liver",
    "wall": "no airway wall is known, so that none is avoided",
    **dict.fromkeys(
        ("vessels", "hepatic-vein", "portal-vein", "hepatic-artery"),
        "no vessel is known, so that none is avoided",
    ),
    "fissures": "no fissure is known, so that none is avoided",
    "nodules": "there is no nodule",
}


def placement(name: str, role: str, mask: Mask, grid: Grid, target: Grid, found: Placed) -> str:
    """Say how a mask on another grid was placed by its header.

    Parameters
    ----------
    name, role : str
        The file, and what it shows.
    mask, grid : Mask, Grid
        The mask on its own grid.
    target : Grid
        The common grid of the patient.
    found : Placed
        The mask on it.
    """
    if found.n_voxels and found.n_lost == found.n_voxels:
        return (
            f"{name} lies outside the images: by its header it holds {grid.describe()}, the images hold "
            f"{target.describe()}. None of its {found.n_voxels} voxels is used."
        )
    low, high = box_in(target, grid)
    low, high = np.rint(np.maximum(low, 0)), np.rint(np.minimum(high, target.shape))
    covered = f"{_times(high - low)} of the {_times(target.shape)} voxels, from ({_comma(low)}) on"
    sentences = [f"{name} was placed by its header: it covers {covered}."]
    if found.is_resampled:
        half = float(np.linalg.norm(grid.spacing_mm)) / 2
        sentences.append(f"Its own grid is {grid.describe()}: borders moved by up to {half:.1f} mm.")
    if (low > 0).any() or (high < target.shape).any():
        sentences.append(f"Beyond it {_BEYOND.get(role, 'nothing is known')}.")
    faces = _touched_faces(mask)
    if faces and role != "lung":
        sentences.append(f"It reaches {faces} of its 6 faces, so that it may go on beyond them.")
    if found.n_lost:
        sentences.append(
            f"{found.n_lost} of its {found.n_voxels} voxels ({found.n_lost / found.n_voxels:.1%}) "
            "lie outside the images and are left out."
        )
    return " ".join(sentences)


def moved(
    name: str,
    basis: str,
    offset_mm: Float,
    found: Placed,
    *,
    share_by_header: float | None,
    share_by_index: float | None,
) -> str:
    """Say that a mask of as many voxels as another one lies `offset_mm` (3,) away by its header.

    The shares tell how much of it is in the lungs by its header, and if it lay where the other one lies.
    """
    sentences = [
        f"{name} has as many voxels as {basis}, but its header puts its first voxel "
        f"({', '.join(f'{x:.1f}' for x in offset_mm)}) mm away in LPS: it was placed by its header, "
        "which may be wrong."
    ]
    if share_by_header is not None or share_by_index is not None:
        sentences.append(
            f"By its header {share_by_header or 0.0:.0%} of it lie in the lungs, voxel by voxel "
            f"{share_by_index or 0.0:.0%}."
        )
    if found.n_lost:
        sentences.append(f"{found.n_lost} of its {found.n_voxels} voxels lie outside the images.")
    return " ".join(sentences)


def _touched_faces(mask: Mask) -> int:
    return sum(bool(np.moveaxis(mask, axis, 0)[end].any()) for axis in range(3) for end in (0, -1))


def _times(numbers: object) -> str:
    return " x ".join(f"{float(n):g}" for n in np.asarray(numbers))


def _comma(numbers: object) -> str:
    return ", ".join(f"{float(n):g}" for n in np.asarray(numbers))
