"""Models of a plan as other programs read them: STL, glTF and the camera of a film."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.model_files import CAMERA_FILE, GLTF_FROM_LPS, SCENE_FILE, export_models


@pytest.fixture(scope="module")
def models(small_plan: Plan, breathing_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    names = export_models(small_plan, breathing_lung, folder)
    assert {path.name for path in folder.iterdir()} == set(names)
    return folder


def test_surfaces_lie_where_the_devices_are(models: Path, small_plan: Plan) -> None:
    for curve in small_plan.curves().present:
        surface = trimesh.load_mesh(models / f"{curve.name}.stl")
        assert surface.is_watertight
        low, high = surface.bounds
        radius = curve.radius_mm.max()
        assert (curve.points_lps >= low - 1e-3).all() and (curve.points_lps <= high + 1e-3).all()
        assert (low >= curve.points_lps.min(axis=0) - radius - 1e-3).all()
        assert (high <= curve.points_lps.max(axis=0) + radius + 1e-3).all()


def test_the_scene_holds_all_surfaces_in_the_frame_of_gltf(models: Path) -> None:
    scene = trimesh.load_scene(models / SCENE_FILE)
    surfaces = {path.stem: trimesh.load_mesh(path) for path in models.glob("*.stl")}
    assert {"airway", "vessel", "lung", "scope", "tubes", "needle"} <= set(surfaces) == set(scene.geometry)
    rotation = GLTF_FROM_LPS[:3, :3] * 1000.0
    assert np.linalg.det(rotation) == pytest.approx(1.0) and (rotation @ [0, 0, 1] == [0, 1, 0]).all()
    for name, surface in surfaces.items():
        node = scene.graph.get(name)[0]
        placed = trimesh.transform_points(scene.geometry[name].vertices, node)
        expected = surface.bounds @ rotation.T / 1000.0
        np.testing.assert_allclose(np.sort(expected, axis=0), [placed.min(0), placed.max(0)], atol=1e-5)
    assert scene.geometry["lung"].visual.material.alphaMode == "BLEND"


def test_the_camera_goes_with_the_scope(models: Path, small_plan: Plan) -> None:
    stated = json.loads((models / CAMERA_FILE).read_text())
    frames = stated["frames"]
    times = [each["time_s"] for each in frames]
    assert times == sorted(set(times)) and max(np.diff(times)) <= 0.04 + 1e-3
    eye, target, up = (np.array([each[name] for each in frames]) for name in ("eye", "target", "up"))
    np.testing.assert_allclose(np.linalg.norm(target - eye, axis=1), 10.0)
    np.testing.assert_allclose(np.einsum("ij,ij->i", target - eye, up), 0.0, atol=1e-6)
    tip = small_plan.scope.lps_from_scope_tip[:3, 3]
    assert np.linalg.norm(eye[-1] - tip) <= small_plan.system.scope.radius_mm
