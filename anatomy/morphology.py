"""Masks by whole voxels: bounds, growing, closing with a ball by exact distances, filling of holes."""

import itertools
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Array, Float, Float32, Int, Int32, Mask
from anatomy.grid import Grid

Window = tuple[slice, slice, slice]
"""A box of voxels, as an index of arrays."""


def grown_by_one(mask: Mask) -> Mask:
    """Grow a mask by one voxel in all 26 directions, one axis after the other."""
    for axis in range(3):
        lower = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        upper = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        grown = mask.copy(order="F")
        grown[lower] |= mask[upper]
        grown[upper] |= mask[lower]
        mask = grown
    return mask


def at_label_borders(labels: Array) -> Mask:
    """Mark both of any two face neighbours that have different labels; 0 is no label."""
    found = np.zeros(labels.shape, dtype=np.bool_, order="F")
    for axis in range(3):
        behind = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        ahead = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        a, b = labels[behind], labels[ahead]
        meet = (a != b) & (a > 0) & (b > 0)
        found[behind] |= meet
        found[ahead] |= meet
    return found


def bounds(mask: Array, pad: int | Int = 0) -> tuple[Int, Int]:
    """Return `low` and `high` such that every voxel of a mask has `low <= ijk < high`; zeros if it is empty.

    They are wider by `pad` voxels, of all axes or of each `(3,)`, as far as the array reaches.
    """
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for axis, line in enumerate((mask.any(axis=(1, 2)), mask.any(axis=(0, 2)), mask.any(axis=(0, 1)))):
        hits = np.flatnonzero(line)
        if hits.size:
            low[axis], high[axis] = hits[0], hits[-1] + 1
    return np.maximum(low - pad, 0), np.minimum(high + pad, mask.shape)


def voxels_of(mask: Mask) -> Int:
    """Return the indices `(N, 3)` of the voxels of a mask as numpy.argwhere does, fast where they are few."""
    order: Literal["C", "F"] = "F" if mask.flags.f_contiguous else "C"
    ijk = np.stack(np.unravel_index(np.flatnonzero(mask.ravel(order=order)), mask.shape, order=order), axis=1)
    return ijk if order == "C" else ijk[np.lexsort(ijk.T[::-1])]


def voxels_in(window: Window, mask: Mask) -> Int:
    """Return the indices `(N, 3)`, in the whole image, of the voxels of a mask of a window of it."""
    return np.asarray(np.argwhere(mask) + np.array([axis.start for axis in window]))


def components(mask: Mask) -> tuple[Int, Int]:
    """Return the voxels `(N, 3)` of a mask, and the number `(N,)` of the part of each, from 0.

    Voxels that share a corner belong to one part; parts are numbered by their first voxels.  Made for few
    voxels, such as nodules: no library is imported for it.
    """
    voxels = voxels_of(mask)
    if not len(voxels):
        return voxels, np.zeros(0, dtype=np.int64)
    low, high = voxels.min(axis=0), voxels.max(axis=0)
    padded = high - low + 3
    flat = np.ravel_multi_index(tuple((voxels - low + 1).T), tuple(padded))
    steps = [step for step in itertools.product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for step in np.array(steps) @ np.array([padded[1] * padded[2], padded[2], 1]):
        place = np.minimum(np.searchsorted(flat, flat + step), len(flat) - 1)
        here = np.flatnonzero(flat[place] == flat + step)
        pairs.append(np.stack([here, place[here]]))
    first, second = np.concatenate(pairs, axis=1)
    part = np.arange(len(voxels))
    while (part[first] != part[second]).any():
        np.minimum.at(part, part[first], part[second])
        np.minimum.at(part, part[second], part[first])
        while (part != part[part]).any():
            part = part[part]
    return voxels, np.unique(part, return_inverse=True)[1]


def window(low: Int, high: Int) -> Window:
    """Return the voxels `low <= ijk < high` as an index."""
    i, j, k = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return i, j, k


def lattice_of(grid: Grid, cube_mm: float) -> Window:
    """Return the index of about one voxel in each cube of `cube_mm`."""
    i, j, k = (slice(None, None, max(1, round(cube_mm / float(side)))) for side in grid.spacing_mm)
    return i, j, k


def sampled(mask: Mask, grid: Grid, cube_mm: float) -> Float:
    """Return about one point of a mask in each cube of `cube_mm`, LPS mm `(N, 3)`."""
    lattice = lattice_of(grid, cube_mm)
    return np.asarray(grid.lps(np.argwhere(mask[lattice]) * np.array([axis.step for axis in lattice])))


_THREADS = 2


def closed(mask: Mask, radius_mm: float, spacing_mm: ArrayLike) -> Mask:
    """Close a mask `(ni, nj, nk)` with a ball: dilation, then erosion [Fu2018, text of III-A.1].

    Every gap is filled into which no ball of this radius fits; all of the mask stays.  Beyond the edge of the
    array the mask is taken to go on as it ends there.
    """
    if not mask.any():
        return mask.copy(order="F")
    grown = distance_mm(~mask, spacing_mm) <= radius_mm
    if grown.all():
        return grown
    shrunk: Mask = distance_mm(grown, spacing_mm) > radius_mm
    shrunk |= mask
    return shrunk


def without_holes(mask: Mask) -> Mask:
    """Fill what cannot be reached from the edge of the array through face neighbours."""
    from scipy import ndimage

    pieces, count = ndimage.label(~mask.T)
    open_to_edge = np.zeros(count + 1, dtype=np.bool_)
    for axis in range(3):
        for end in (0, -1):
            open_to_edge[np.unique(np.take(pieces, end, axis=axis))] = True
    open_to_edge[0] = False
    filled: Mask = ~open_to_edge[pieces].T
    return filled


def pieces_of(mask: Mask, *, corners: bool = False) -> tuple[Int32, Int]:
    """Return the number of the piece of each voxel, 0 outside, and the size of each piece by its number.

    Pieces are joined by faces, or by corners as well; the size of 0 is 0.
    """
    from scipy import ndimage

    joined = ndimage.generate_binary_structure(mask.ndim, mask.ndim if corners else 1)
    pieces, count = ndimage.label(mask, joined)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return pieces, sizes


def largest_piece(mask: Mask) -> Mask:
    """Return the piece of most voxels, joined by faces; the first of several equal ones."""
    from scipy import ndimage

    pieces, count = ndimage.label(mask.T)
    if count < 2:
        return mask
    largest: Mask = (pieces == int(np.argmax(np.bincount(pieces[mask.T])))).T
    return largest


def near(mask: Mask, reach_mm: float, spacing_mm: ArrayLike) -> Mask:
    """Mark what lies within a distance of a mask."""
    box = window(*bounds(mask, np.ceil(reach_mm / np.asarray(spacing_mm)).astype(np.int64)))
    found = np.zeros(mask.shape, dtype=np.bool_, order="F")
    if mask.any():
        found[box] = distance_mm(~mask[box], spacing_mm) <= reach_mm
    return found


def distance_mm(mask: Mask, spacing_mm: ArrayLike, *, bordered: bool = False) -> Float32:
    """Return the distance of every True voxel to the nearest False one, centre to centre; 0 elsewhere.

    With `bordered` False voxels lie all around the image.
    """
    import edt

    spacing = tuple(float(s) for s in np.asarray(spacing_mm))
    solid = np.require(mask, requirements=["F", "W"])  # the transform takes no read-only arrays
    return np.asarray(edt.edt(solid, anisotropy=spacing, order="F", black_border=bordered, parallel=_THREADS))
