"""Surfaces for looking at: marching cubes, vertices gathered in cells, smoothed, and stored small."""

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int
from anatomy.grid import Volume
from anatomy.kept_records import kept
from anatomy.lung import Lung
from lungaccess.showing.report.pack import Packed, pack
from stages.needle import StartRegion

SURFACES_VERSION = 4
STEPS = 65535
SMOOTHINGS = 6
SHRINK, GROW = 0.5, -0.53
"""Factors of one smoothing there and back [Taubin1995], which keeps the volume."""


@frozen_value
class Look:
    """How a structure is shown.

    Args:
        key, name: In the file, and for people.
        colour: ``#rrggbb``.
        opacity: Of a surface seen face on.
        shown: Whether it is switched on at first.
        cell_mm: Vertices within a cell of this size are joined into one.
        most_faces: The cells grow until there are no more triangles.
        stride: Only so many voxels along each axis are looked at.
    """

    key: str
    name: str
    colour: str
    opacity: float
    shown: bool
    cell_mm: float
    most_faces: int
    stride: int = 1


LOOKS = (
    Look(
        key="lung", name="Lungs", colour="#98A2AB", opacity=0.07, shown=True, cell_mm=3.5, most_faces=40_000,
        stride=2,
    ),
    Look(
        key="fissure", name="Fissures", colour="#8F6FB8", opacity=0.16, shown=False, cell_mm=2.5,
        most_faces=50_000,
    ),
    Look(
        key="vessel", name="Vessels", colour="#C4717A", opacity=0.28, shown=True, cell_mm=1.3,
        most_faces=220_000,
    ),
    Look(
        key="airway", name="Airways (lumen)", colour="#5B9BC4", opacity=0.42, shown=True, cell_mm=0.7,
        most_faces=200_000,
    ),
    Look(
        key="nodule", name="Nodules", colour="#009E73", opacity=0.5, shown=True, cell_mm=0.6, most_faces=8_000
    ),
)  # fmt: skip

START_LOOKS = (
    Look(
        key="start-proved", name="Needle starts, all proved", colour="#0072B2", opacity=0.45, shown=True,
        cell_mm=0.0, most_faces=5_000,
    ),
    Look(
        key="start-tried", name="Places from which half of the tried directions have a path",
        colour="#F0E442", opacity=0.25, shown=False, cell_mm=0.0, most_faces=20_000,
    ),
)  # fmt: skip
"""The looks of the safe start region, whose bodies are small already."""


def structure_meshes(lung: Lung) -> list[Packed]:
    """Return the surfaces of a patient's structures for a page, kept with it; those it lacks are left out."""

    def made() -> list[Packed]:
        volumes = ((look, structure(lung, look.key)) for look in LOOKS)
        return [packed_surface(volume, look) for look, volume in volumes if volume and volume.array.any()]

    return list(kept(lung, "surfaces", SURFACES_VERSION, made))


def start_meshes(region: StartRegion) -> list[Packed]:
    """Return the bodies of a safe start region for a page; those that are empty are left out."""
    from lungaccess.uncertainty.risk import proved_body, tried_body

    bodies = (proved_body(region), tried_body(region))
    return [
        packed_mesh(body.vertices_lps, body.faces, look)
        for body, look in zip(bodies, START_LOOKS, strict=True)
        if body is not None
    ]


def structure(lung: Lung, key: str) -> Volume | None:
    """Return the voxels of a structure that a page shows, None where the patient lacks it."""
    if key == "nodule":
        return lung.nodules
    if key == "fissure" and not lung.has_fissures:
        return None
    return lung.mask("lumen" if key == "airway" else key)


def packed_surface(volume: Volume, look: Look) -> Packed:
    """Return the surface of a mask with its look."""
    return packed_mesh(*surface(volume, look), look)


def packed_mesh(vertices: Float, faces: Int, look: Look) -> Packed:
    """Return triangles with their look; they are counted first to last, and their normals point outwards."""
    a, b, c = (vertices[faces[:, n]] - vertices.mean(axis=0) for n in range(3))
    # The volume of a body whose triangles go round the wrong way is negative.
    if np.sum(a * np.cross(b, c)) < 0.0:
        faces = faces[:, [0, 2, 1]]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = np.maximum(high - low, 1e-6)
    # Small numbers: the first vertex against the face before, the others against the first.
    first = faces[:, 0]
    differences = [np.diff(first, prepend=0), faces[:, 1] - first, faces[:, 2] - first]
    return {
        "key": look.key, "name": look.name, "colour": look.colour, "opacity": look.opacity,
        "shown": look.shown, "low_lps": low.tolist(), "size_mm": size.tolist(),
        "vertices": pack(np.rint((vertices - low) / size * STEPS).astype(np.uint16), "u2"),
        "faces": pack(np.stack(differences), "i4"),
    }  # fmt: skip


def surface(volume: Volume, look: Look) -> tuple[Float, Int]:
    """Return vertices `(V, 3)`, LPS mm, and faces `(F, 3)` of a mask, as few as its look allows."""
    from anatomy.meshes import smooth_surface

    mesh = smooth_surface(_thinned(volume, look.stride))
    cell_mm = look.cell_mm
    vertices, faces = _gathered(mesh.vertices_lps, mesh.faces, cell_mm)
    while len(faces) > look.most_faces:
        cell_mm *= 1.2
        vertices, faces = _gathered(mesh.vertices_lps, mesh.faces, cell_mm)
    if not len(faces):
        vertices, faces = np.array(mesh.vertices_lps), np.array(mesh.faces)
    return smoothed(vertices, faces), faces


def _thinned(volume: Volume, stride: int) -> Volume:
    """Return every so-manieth voxel; all of them where nothing would be left."""
    array = volume.array[::stride, ::stride, ::stride]
    if stride == 1 or not array.any():
        return volume
    grid = volume.grid.crop([0, 0, 0], array.shape)
    matrix = grid.lps_from_ijk.copy()
    matrix[:3, :3] *= stride
    return Volume(grid=type(grid)(shape=grid.shape, lps_from_ijk=matrix), array=array)


def _gathered(vertices: Float, faces: Int, cell_mm: float) -> tuple[Float, Int]:
    """Join the vertices in each cell into their mean, and drop triangles that are none any more.

    Args:
        vertices: (V, 3) float64, mm.
        faces: (F, 3) int64.
    """
    cells = np.floor((vertices - vertices.min(axis=0)) / cell_mm).astype(np.int64)
    shape = tuple((cells.max(axis=0) + 1).tolist())
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    _used, index, counts = np.unique(flat, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index, vertices[:, axis]) / counts for axis in range(3)], axis=1)
    joined = index[faces]
    a, b, c = joined.T
    return _used_only(means, joined[(a != b) & (b != c) & (c != a)])


def _used_only(vertices: Float, faces: Int) -> tuple[Float, Int]:
    """Drop double triangles and vertices of none."""
    turned = np.argmin(faces, axis=1)[:, None]
    ordered = np.take_along_axis(faces, (turned + np.arange(3)) % 3, axis=1)
    distinct = np.unique(ordered, axis=0) if len(ordered) else ordered
    used, index = np.unique(distinct, return_inverse=True)
    return vertices[used], index.reshape(-1, 3).astype(np.int64)


def smoothed(vertices: Float, faces: Int) -> Float:
    """Return vertices moved towards their neighbours' means and back, several times."""
    from scipy.sparse import coo_matrix

    if not len(faces):
        return vertices
    rows, columns = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    both = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    links = coo_matrix((np.ones(len(both[0])), both), shape=(len(vertices),) * 2).tocsr()
    links.data[:] = 1.0
    degree = np.maximum(np.asarray(links.sum(axis=1)), 1.0)
    moved = vertices
    for _ in range(SMOOTHINGS):
        for factor in (SHRINK, GROW):
            moved = moved + factor * (links @ moved / degree - moved)
    return np.asarray(moved)
