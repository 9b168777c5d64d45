"""Surfaces for 3D Slicer: small meshes of the structures, and the devices true to their radius."""

from pathlib import Path

import numpy as np

from anatomy.base.files import atomic_write, require_suffix
from anatomy.base.typed import Float
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh, smooth_surface
from lungaccess.plans.curves import DeviceCurve

MOST_TRIANGLES = 150_000
"""Enough for the shape of the vessels; models are for display alone."""
SIDES = 16
"""Corners of a ring around a device."""


def structure_surface(lung: Lung, name: str, *, most: int = MOST_TRIANGLES) -> SurfaceMesh | None:
    """Return a surface of a structure with at most so many triangles, for display; None if there is nothing.

    Parameters
    ----------
    name : str
        "lung", "airway" (lumen and wall), "vessel", "fissure" or "nodule".
    most : int
        Vertices are merged in ever larger cubes until no more triangles are left.
    """
    volume = _mask(lung, name)
    if volume is None or not volume.array.any():
        return None
    mesh = smooth_surface(volume)
    cell_mm = float(volume.grid.spacing_mm.max())
    while len(mesh.faces) > most:
        mesh = merged(mesh, cell_mm)
        cell_mm *= 1.25
    return mesh


def _mask(lung: Lung, name: str) -> Volume | None:
    if name == "nodule" and lung.nodules is None:
        return None
    if name == "airway":
        wall, lumen = lung.mask("airway"), lung.mask("lumen")
        return Volume(grid=wall.grid, array=wall.array | lumen.array)
    return lung.mask(name)


def merged(mesh: SurfaceMesh, cell_mm: float) -> SurfaceMesh:
    """Merge the vertices in each cube of `cell_mm` into their mean; the bound grows by its diagonal."""
    cells = np.floor(mesh.vertices_lps / cell_mm).astype(np.int64)
    cells -= cells.min(axis=0)
    key = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, place, count = np.unique(key, return_inverse=True, return_counts=True)
    vertices = np.stack([np.bincount(place, weights=c) for c in mesh.vertices_lps.T], axis=1)
    faces = place[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return SurfaceMesh(
        vertices_lps=vertices / count[:, None],
        faces=faces[np.sort(first)],
        bound_mm=mesh.bound_mm + cell_mm * np.sqrt(3.0),
    )


def device_surface(curve: DeviceCurve) -> SurfaceMesh:
    """Return a device as a closed tube of its outer radius: a ring of `SIDES` corners at every pose.

    The corners lie on the true surface; the flat sides between them run up to 2 % of the radius inside it.
    """
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(SIDES)], axis=1)
    frames, radius = _stepped(curve)
    rings = radius[:, None, None] * np.einsum("nij,kj->nki", frames[:, :3, :3], ring)
    rings += frames[:, None, :3, 3]
    count = len(frames)
    ends = frames[[0, -1], :3, 3]
    first, last = count * SIDES, count * SIDES + 1
    here = np.arange(SIDES)
    after = (here + 1) % SIDES
    faces = []
    for n in range(count - 1):
        low, high = n * SIDES, (n + 1) * SIDES
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    top = (count - 1) * SIDES
    faces.append(np.stack([np.full(SIDES, first), after, here], axis=1))
    faces.append(np.stack([np.full(SIDES, last), top + here, top + after], axis=1))
    return SurfaceMesh(
        vertices_lps=np.concatenate([rings.reshape(-1, 3), ends]),
        faces=np.concatenate(faces),
        bound_mm=float(curve.radius_mm.max()) * (1.0 - np.cos(np.pi / SIDES)),
    )


def _stepped(curve: DeviceCurve) -> tuple[Float, Float]:
    """Return poses and radii with a pose twice where the radius jumps, and without rolls between poses."""
    frames, radius = _untwisted(curve.lps_from_device), np.asarray(curve.radius_mm)
    jumps = np.flatnonzero(np.diff(radius) != 0.0)
    return np.insert(frames, jumps + 1, frames[jumps], axis=0), np.insert(
        radius, jumps + 1, radius[jumps + 1]
    )


def _untwisted(lps_from_device: Float) -> Float:
    """Turn poses about their +z so that no ring is rolled against the one before."""
    frames = np.array(lps_from_device)
    for n in range(1, len(frames)):
        z = frames[n, :3, 2]
        x = frames[n - 1, :3, 0] - (frames[n - 1, :3, 0] @ z) * z
        frames[n, :3, 0] = x / np.linalg.norm(x)
        frames[n, :3, 1] = np.cross(z, frames[n, :3, 0])
    return frames


def write_ply(path: str | Path, mesh: SurfaceMesh) -> None:
    """Write a mesh as binary `.ply` in LPS mm with the comment `SPACE=LPS`, which 3D Slicer reads.

    Raises
    ------
    FileError
        If the name does not end in .ply, or the file cannot be written.
    """
    require_suffix(path, ".ply")
    header = "\n".join(
        (
            "ply",
            "format binary_little_endian 1.0",
            "comment lungaccess, millimetres",
            "comment SPACE=LPS",
            f"element vertex {len(mesh.vertices_lps)}",
            "property float x",
            "property float y",
            "property float z",
            f"element face {len(mesh.faces)}",
            "property list uchar int vertex_indices",
            "end_header",
            "",
        )
    )
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    with atomic_write(path) as temporary:
        temporary.write_bytes(
            header.encode("ascii") + mesh.vertices_lps.astype("<f4").tobytes() + faces.tobytes()
        )
