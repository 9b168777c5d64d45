"""The anatomy and the devices for 3D Slicer: surfaces, markups, and a label map.

Meshes of the structures are small, and devices true to their radius.  Curves have radius and pose at every
point, points have a name.  One `.seg.nrrd` holds the structures with names, colours and terminology.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from anatomy.base.files import atomic_write, require_suffix
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, UInt8
from anatomy.grid import Volume
from anatomy.io.images import write_volume
from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh, smooth_surface
from anatomy.morphology import bounds
from lungaccess.plans.curves import DeviceCurve
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingAim
from stages.scope.advisor import MARKUPS_SCHEMA

_LIST = "Segmentation category and type - 3D Slicer General Anatomy list"
_STRUCTURE = "SCT^123037004^Anatomical Structure"
_TISSUE = "SCT^85756007^Tissue"
_ALTERED = "SCT^49755003^Morphologically Altered Structure"

TARGET_COLOUR = (0.17, 0.63, 0.17)

Plain = dict[str, Any]
SIDES = 16
"""Corners of a ring around a device."""


def structure_surface(lung: Lung, name: str, *, most: int = 150_000) -> SurfaceMesh | None:
    """Return a surface of a structure with at most so many triangles, for display; None if there is nothing.

    Args:
        name: "lung", "airway" (lumen and wall), "vessel", "fissure" or "nodule".
        most: Vertices are merged in ever larger cubes until no more triangles are left; the usual number is
            enough for the shape of the vessels.
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
    low, top = SIDES * np.arange(count - 1)[:, None], (count - 1) * SIDES
    high = low + SIDES
    sides = [[low + here, low + after, high + after], [low + here, high + after, high + here]]
    caps = [[np.full(SIDES, first), after, here], [np.full(SIDES, last), top + here, top + after]]
    # Two rows of triangles between each ring and the next.
    faces = [
        np.moveaxis(np.array(sides), (0, 1), (1, 3)).reshape(-1, 3),
        np.swapaxes(np.array(caps), 1, 2).reshape(-1, 3),
    ]
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

    Raises FileError if the name does not end in .ply, or the file cannot be written.
    """
    require_suffix(path, ".ply")
    lines = (
        "ply", "format binary_little_endian 1.0", "comment lungaccess, millimetres", "comment SPACE=LPS",
        f"element vertex {len(mesh.vertices_lps)}", *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", "",
    )  # fmt: skip
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    with atomic_write(path) as temporary:
        vertices = mesh.vertices_lps.astype("<f4").tobytes()
        temporary.write_bytes("\n".join(lines).encode("ascii") + vertices + faces.tobytes())


def curve_markup(curve: DeviceCurve) -> Plain:
    """Return the content of a `.mrk.json` file: an open curve in LPS mm.

    `orientation` holds the pose of the device at each point, row by row: its columns are the x, y and z
    axes of the device.  `Radius` is the radius of the device at each point.
    """
    points = [
        _point(number, f"{curve.name} {along:.1f} mm", frame[:3, 3]) | _orientation(frame)
        for number, (frame, along) in enumerate(
            zip(curve.lps_from_device, curve.arc_length_mm.tolist(), strict=True), start=1
        )
    ]
    radius = {
        "name": "Radius", "enabled": True, "units": "mm", "description": "outer radius of the device",
        "controlPointValues": curve.radius_mm.tolist(),
    }  # fmt: skip
    return _file("Curve", curve.name, points, curve.colour, [radius])


def points_of_interest(plan: Plan) -> Plain:
    """Return the content of a `.mrk.json` file: scope tip, tip of the tubes, exit and target, LPS mm.

    The tips keep the pose of their device, also where they are moved in 3D Slicer.
    """
    tips = {"scope tip": plan.scope.lps_from_scope_tip, "tube tip": plan.tube.lps_from_tip}
    places = {
        **{label: tip[:3, 3] for label, tip in tips.items()},
        "exit through the wall": plan.tube.exit.point_lps,
        "target": plan.target_lps,
    }
    return _fiducials("points", places, tips)


def aim_point(aim: BreathingAim) -> Plain:
    """Return the content of a `.mrk.json` file: where devices end beside the target, LPS mm."""
    return _fiducials("aim", {"aim of the devices": aim.point_lps})


def _fiducials(
    name: str, places: Mapping[str, Float], poses: Mapping[str, Float] = MappingProxyType({})
) -> Plain:
    points = [
        _point(number, label, place) | (_orientation(poses[label]) if label in poses else {})
        for number, (label, place) in enumerate(places.items(), start=1)
    ]
    return _file("Fiducial", name, points, TARGET_COLOUR, [])


def _orientation(pose: Float) -> dict[str, list[float]]:
    return {"orientation": pose[:3, :3].ravel().tolist()}


def _point(number: int, label: str, place: Float) -> Plain:
    return {
        "id": f"{number}", "label": label, "position": place.tolist(), "locked": False, "visibility": True,
        "positionStatus": "defined",
    }  # fmt: skip


def _file(
    kind: str, name: str, points: list[Plain], colour: tuple[float, float, float], measurements: list[Plain]
) -> Plain:
    """Return the content of a file of markups; points alone show their labels."""
    labels = kind == "Fiducial"
    display = {
        "visibility": True, "opacity": 1.0, "color": list(colour), "selectedColor": list(colour),
        "propertiesLabelVisibility": not labels, "pointLabelsVisibility": labels, "glyphType": "Sphere3D",
        "glyphScale": 2.0 if labels else 0.5,
    }  # fmt: skip
    markup = {
        "type": kind, "name": name, "coordinateSystem": "LPS", "coordinateUnits": "mm", "locked": True,
        "fixedNumberOfControlPoints": True, "controlPoints": points, "measurements": measurements,
        "display": display,
    }  # fmt: skip
    return {"@schema": MARKUPS_SCHEMA, "markups": [markup]}


@frozen_value
class Segment:
    """One segment: value in the label map, name, colour in [0, 1], category and type (SNOMED CT).

    `mask` is the mask of a lung that shows it, and `role` a key of `anatomy.io.dicom_seg.CODES`.
    """

    value: int
    name: str
    colour: tuple[float, float, float]
    category: str
    kind: str
    mask: str
    role: str

    @property
    def terminology(self) -> str:
        """The entry that 3D Slicer stores for a segment."""
        return f"{_LIST}~{self.category}~{self.kind}~^^~Anatomic codes - DICOM master list~^^~^^"


SEGMENTS: tuple[Segment, ...] = (
    Segment(value=1, name="lung tissue", colour=(0.77, 0.64, 0.58), category=_STRUCTURE,
            kind="SCT^39607008^Lung", mask="outside", role="lung"),
    Segment(value=2, name="fissure", colour=(0.58, 0.40, 0.74), category=_TISSUE, kind=_TISSUE,
            mask="fissure", role="fissures"),
    Segment(value=3, name="nodule", colour=(0.17, 0.63, 0.17), category=_ALTERED,
            kind="SCT^27925004^Nodule", mask="nodule", role="nodules"),
    Segment(value=4, name="vessel", colour=(0.84, 0.15, 0.16), category=_STRUCTURE,
            kind="SCT^59820001^Blood vessel", mask="vessel", role="vessels"),
    Segment(value=5, name="airway wall", colour=(0.52, 0.52, 0.52), category=_STRUCTURE,
            kind="SCT^89187006^Airway structure", mask="airway", role="wall"),
    Segment(value=6, name="airway lumen", colour=(0.62, 0.85, 0.90), category=_STRUCTURE,
            kind="SCT^89187006^Airway structure", mask="lumen", role="lumen"),
)  # fmt: skip
"""From the weakest to the strongest: where two structures overlap, the voxel goes to the later one.

3D Slicer takes a grey of 0.5 for no colour, and draws one at random."""


def label_map(lung: Lung) -> Volume:
    """Return the structures of a lung as one volume of the values of `SEGMENTS`, uint8, 0 outside."""
    outside = lung.mask("outside")
    labels = np.where(outside.array, 0, 1).astype(np.uint8)
    for segment in SEGMENTS[1:]:
        if segment.mask != "nodule" or lung.nodules is not None:
            labels[lung.mask(segment.mask).array] = segment.value
    return Volume(grid=outside.grid, array=labels)


def write_segmentation(path: str | Path, lung: Lung) -> tuple[Segment, ...]:
    """Write the label map of a lung, and return the segments that are not empty.

    Raises FileError if the file cannot be written.
    """
    volume = label_map(lung)
    present = tuple(each for each in SEGMENTS if (volume.array == each.value).any())
    write_volume(path, volume, header=_header(volume.array, present))
    return present


def _header(labels: UInt8, segments: tuple[Segment, ...]) -> Mapping[str, str]:
    """Return the keys from which 3D Slicer restores the segments."""
    header = {
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for number, segment in enumerate(segments):
        low, high = bounds(labels == segment.value)
        where = np.stack([low, high - 1], axis=1).ravel().tolist()
        header |= {
            f"Segment{number}_ID": f"Segment_{segment.value}", f"Segment{number}_Name": segment.name,
            f"Segment{number}_NameAutoGenerated": "0",
            f"Segment{number}_Color": " ".join(f"{c:g}" for c in segment.colour),
            f"Segment{number}_ColorAutoGenerated": "0", f"Segment{number}_LabelValue": f"{segment.value}",
            f"Segment{number}_Layer": "0", f"Segment{number}_Extent": " ".join(str(n) for n in where),
            f"Segment{number}_Tags": f"TerminologyEntry:{segment.terminology}|",
        }  # fmt: skip
    return header
