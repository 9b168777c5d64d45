"""A plan and its anatomy as models that other programs read: STL, glTF, and the camera of a film."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from anatomy.base.files import atomic_write, require_writable_folder, write_json
from anatomy.lung import Lung
from anatomy.meshes import SurfaceMesh
from lungaccess.plans.bifurcations import HALF_ANGLE_RAD, lps_from_camera
from lungaccess.plans.plan import Plan
from lungaccess.showing.live import plan_trajectory
from lungaccess.showing.slicer.export import STEP_MM, STRUCTURES
from lungaccess.showing.slicer.models import device_surface, structure_surface

SCENE_FILE, CAMERA_FILE = "plan.glb", "camera.json"
GLTF_FROM_LPS = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1000]]) / 1000.0
"""The frame of glTF, in metres with +y up and the front of the patient towards +z, from LPS in mm."""
FRAMES_PER_S = 25.0
"""The pictures of a film in a second."""


def export_models(plan: Plan, lung: Lung, folder: str | Path) -> tuple[str, ...]:
    """Write anatomy and devices of a plan as models, and the way of its camera; return the files' names.

    Each structure and device is an STL in LPS mm.  `plan.glb` holds all of them with their colours in the
    frame of glTF, metres with +y up.  `camera.json` has the eye of the bronchoscope for each picture of a
    film: `eye` and `target`, 10 mm ahead of it, LPS mm, and the direction `up` of the picture.  Raises
    FileError if the folder cannot be written.
    """
    import trimesh

    target = require_writable_folder(folder)
    surfaces: dict[str, tuple[SurfaceMesh, tuple[float, ...]]] = {
        curve.name: (device_surface(curve), (*curve.colour, 1.0)) for curve in plan.shown_curves(STEP_MM)
    }
    for name, (colour, opacity) in STRUCTURES.items():
        if (found := structure_surface(lung, name)) is not None:
            surfaces[name] = found, (*colour, opacity)
    scene = trimesh.Scene()
    for name, (mesh, shade) in surfaces.items():
        solid = mesh.to_trimesh()
        _write(target / f"{name}.stl", solid.export(file_type="stl"))
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=shade, alphaMode="OPAQUE" if shade[3] == 1.0 else "BLEND", doubleSided=True
        )
        solid.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(solid, node_name=name, geom_name=name, transform=GLTF_FROM_LPS)
    _write(target / SCENE_FILE, scene.export(file_type="glb"))
    write_json(target / CAMERA_FILE, _camera_frames(plan))
    return (*(f"{name}.stl" for name in surfaces), SCENE_FILE, CAMERA_FILE)


def _camera_frames(plan: Plan) -> dict[str, object]:
    """Return the eye of the bronchoscope for each picture of a film of a plan, as plain JSON values."""
    motion = plan_trajectory(plan, step_s=1.0 / FRAMES_PER_S)
    eyes = lps_from_camera(plan.system, motion.lps_from_scope_tip)
    return {
        "frame": "LPS, mm",
        "field_of_view_deg": math.degrees(2.0 * HALF_ANGLE_RAD),
        "frames": [
            {
                "time_s": float(time_s), "moves": stage, "eye": eye[:3, 3].tolist(),
                "target": (eye[:3, 3] + 10.0 * eye[:3, 2]).tolist(), "up": eye[:3, 0].tolist(),
            }
            for time_s, stage, eye in zip(motion.time_s, motion.stages, eyes, strict=True)
        ],
    }  # fmt: skip


def _write(path: Path, content: bytes) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
