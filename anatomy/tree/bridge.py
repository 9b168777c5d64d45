"""Join broken-off pieces of a lumen across short gaps that lie in the direction of both sides."""

import itertools
from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int

MAX_TURN_COS = 0.5
"""Both sides may turn away from the gap by at most 60 degrees."""

NEAR_MM = 5.0
"""The side of a gap that faces it is judged from the voxels within this distance."""

STRETCH_MM = 15.0


@frozen_record
class Piece:
    """A separate piece of the mask; its voxels `(M, 3)` int64, ijk."""

    voxels: Int

    MIN_VOXELS: ClassVar[int] = 10
    """Fewer voxels are noise and have no direction."""
    MIN_EXTENT_MM: ClassVar[float] = 3.0
    """A shorter piece may point anywhere."""


@frozen_record
class Join:
    """A piece that belongs to the tree and the bridge to it, `(M, 3)` voxel indices."""

    voxels: Int
    bridge: Int
    middle_ijk: Float
    length_mm: float


def join_pieces(main: Int, pieces: list[Piece], spacing_mm: Float, max_gap_mm: float) -> Iterator[Join]:
    """Yield the pieces to join, nearest first; a piece may be joined to one joined before.

    `main` are the voxels `(M, 3)` of the main piece; a gap lies between two facing voxels, as solid boxes.
    """
    gaps = (_best_gap(main, piece.voxels, spacing_mm, max_gap_mm) for piece in pieces)
    best = {p: gap for p, gap in enumerate(gaps) if gap is not None}
    open_pieces = set(range(len(pieces)))
    while best:
        chosen = min(best, key=lambda p: (best[p].length_mm, p))
        gap, voxels = best.pop(chosen), pieces[chosen].voxels
        open_pieces.remove(chosen)
        yield Join(
            voxels=voxels,
            bridge=_face_connected_line(gap.begin, gap.end),
            middle_ijk=(gap.begin + gap.end) / 2,
            length_mm=gap.length_mm,
        )
        for p in open_pieces:
            other = _best_gap(voxels, pieces[p].voxels, spacing_mm, max_gap_mm)
            if other is not None and (p not in best or other.length_mm < best[p].length_mm):
                best[p] = other


@frozen_record
class _Gap:
    begin: Int
    end: Int
    length_mm: float


def _best_gap(near: Int, far: Int, spacing_mm: Float, max_gap_mm: float) -> _Gap | None:
    """Find the shortest gap from `near` to `far`, or None if it is too long or out of direction."""
    from scipy.spatial import KDTree

    reach = max_gap_mm + float(np.linalg.norm(spacing_mm))
    margin = reach + NEAR_MM
    window = (far.min(axis=0) - margin / spacing_mm, far.max(axis=0) + margin / spacing_mm)
    near = near[((near >= window[0]) & (near <= window[1])).all(axis=1)]
    if len(near) == 0:
        return None
    distance, index = KDTree(near * spacing_mm).query(far * spacing_mm, distance_upper_bound=reach)
    shortest = distance.min()
    if not np.isfinite(shortest):
        return None
    # Of the pairs that are about as near, the one in the middle of the facing surfaces.
    tied = np.flatnonzero(distance <= shortest + float(spacing_mm.max()) / 2)
    centre = (far[tied] + near[index[tied]]).mean(axis=0) / 2
    middle = (far[tied] + near[index[tied]]) / 2
    pick = tied[np.argmin(np.linalg.norm((middle - centre) * spacing_mm, axis=1))]
    begin, end = near[index[pick]], far[pick]
    apart = np.maximum(np.abs(end - begin) - 1, 0) * spacing_mm
    length = float(np.linalg.norm(apart))
    if length > max_gap_mm or not _in_direction(near, far, begin, end, spacing_mm):
        return None
    return _Gap(begin=begin, end=end, length_mm=length)


def _in_direction(near: Int, far: Int, begin: Int, end: Int, spacing_mm: Float) -> bool:
    """Tell whether the two sides and the gap between them point in about the same direction.

    A piece must meet the gap with its end, not with its side; one that has no axis (a blob) is joined
    only if it is large.
    """
    out = _towards(near, begin, spacing_mm)
    onwards = -_towards(far, end, spacing_mm)
    across = (end - begin) * spacing_mm
    across /= np.linalg.norm(across)
    if min(out @ across, onwards @ across, out @ onwards) < MAX_TURN_COS:
        return False
    offset = (far - end) * spacing_mm
    reach = np.linalg.norm(offset, axis=1)
    variance, axes = np.linalg.eigh(np.cov(offset[reach <= STRETCH_MM], rowvar=False))
    # A piece runs along an axis if, within `STRETCH_MM`, its variance along it is this many times the next.
    if variance[2] >= 1.5 * variance[1]:
        return bool(abs(axes[:, 2] @ across) >= MAX_TURN_COS)
    return bool(reach.max() > STRETCH_MM)


def _towards(voxels: Int, contact: Int, spacing_mm: Float) -> Float:
    offset = (contact - voxels) * spacing_mm
    vector = offset[np.linalg.norm(offset, axis=1) <= NEAR_MM].mean(axis=0)
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


def _face_connected_line(begin: Int, end: Int) -> Int:
    """Return the voxels of a straight line, each sharing a face with the next, `(M, 3)`."""
    steps = 4 * int(np.abs(end - begin).max()) + 1
    line = np.rint(begin + np.linspace(0, 1, steps + 1)[:, None] * (end - begin)).astype(np.int64)
    voxels = [line[0]]
    for target in line[1:]:
        for axis in range(3):
            if target[axis] != voxels[-1][axis]:
                moved = voxels[-1].copy()
                moved[axis] = target[axis]
                voxels.append(moved)
    return np.array(voxels)


def face_paths(step: Int) -> list[list[Int]]:
    """Return the paths of a step to one of the 26 neighbours by faces, as voxels in between."""
    axes = [a for a in range(3) if step[a]]
    paths = []
    for order in itertools.permutations(axes):
        at = np.zeros(3, dtype=np.int64)
        path = []
        for axis in order[:-1]:
            at = at.copy()
            at[axis] = step[axis]
            path.append(at)
        paths.append(path)
    return paths
