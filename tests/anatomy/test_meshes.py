"""Surface meshes and FCL distances against brute force over solid boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.meshes import MeshDistance, SurfaceMesh, box_surface, smooth_surface

SPACING_MM = np.array([0.55, 0.6, 0.7])


def oblique_grid(shape: tuple[int, int, int], seed: int = 3) -> Grid:
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ np.diag(SPACING_MM)
    matrix[:3, 3] = [3.0, -20.0, 100.0]
    return Grid(shape=shape, lps_from_ijk=matrix)


def box_distance(mask: np.ndarray, ijk: np.ndarray) -> np.ndarray:
    gap = np.maximum(np.abs(ijk[:, None] - np.argwhere(mask)) - 0.5, 0.0) * SPACING_MM
    return np.sqrt((gap**2).sum(axis=-1)).min(axis=1)


def test_a_single_voxel_is_a_box() -> None:
    grid = oblique_grid((1, 1, 1))
    mesh = box_surface(np.ones((1, 1, 1), dtype=bool), grid)
    assert mesh.bound_mm == 0.0
    assert len(mesh.vertices_lps) == 8
    assert len(mesh.faces) == 12
    solid = mesh.to_trimesh()
    assert solid.is_watertight
    assert np.isclose(solid.volume, grid.voxel_volume_mm3)  # positive: faces turned outwards


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), share=st.floats(0.02, 0.9))
def test_box_surface_encloses_the_volume_of_the_mask(seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((6, 5, 7)) < share
    grid = oblique_grid(mask.shape)
    mesh = box_surface(mask, grid)
    volume = mesh.to_trimesh().volume if mask.any() else 0.0
    assert np.isclose(volume, mask.sum() * grid.voxel_volume_mm3, atol=1e-9)
    differences = sum(np.diff(np.pad(mask, 1).astype(int), axis=a).astype(bool).sum() for a in range(3))
    assert len(mesh.faces) == 2 * differences


@settings(max_examples=40)
@given(
    start=st.tuples(*[st.floats(-3.0, 15.0)] * 3),
    step=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    seed=st.integers(0, 3),
)
def test_segment_distance_against_brute_force(
    start: tuple[float, float, float], step: tuple[float, float, float], seed: int
) -> None:
    mask = np.random.default_rng(seed).random((12, 12, 12)) < 0.02
    grid = oblique_grid(mask.shape)
    a, b = np.array(start), np.array(start) + np.array(step)
    samples = a + np.linspace(0.0, 1.0, 800)[:, None] * (b - a)
    wanted = float(box_distance(mask, samples).min())
    found = float(MeshDistance(box_surface(mask, grid)).segment_distance_mm(grid.lps(a), grid.lps(b))[0])
    spacing = float(np.linalg.norm((samples[1] - samples[0]) * SPACING_MM))
    hollow = box_distance(mask, samples).max() == 0.0
    assert found <= wanted + 1e-9 or hollow
    assert found >= wanted - spacing / 2 - 1e-9


def test_a_point_is_a_segment_of_no_length() -> None:
    mask = np.random.default_rng(5).random((8, 8, 8)) < 0.05
    grid = oblique_grid(mask.shape)
    ijk = np.random.default_rng(6).uniform(-3, 11, (60, 3))
    free = box_distance(mask, ijk) > 0
    found = MeshDistance(box_surface(mask, grid)).segment_distance_mm(grid.lps(ijk), grid.lps(ijk))
    np.testing.assert_allclose(found[free], box_distance(mask, ijk)[free], atol=1e-9)


def test_a_surface_is_hollow() -> None:
    mask = np.ones((20, 20, 20), dtype=bool)
    grid = oblique_grid(mask.shape)
    middle = grid.lps([9.5, 9.5, 9.5])
    assert MeshDistance(box_surface(mask, grid)).segment_distance_mm(middle, middle)[0] > 5.0


def test_nothing_is_infinitely_far() -> None:
    mesh = box_surface(np.zeros((4, 4, 4), dtype=bool), oblique_grid((4, 4, 4)))
    assert len(mesh.faces) == 0
    assert np.isinf(MeshDistance(mesh).segment_distance_mm([[0, 0, 0]], [[1, 1, 1]])).all()


@pytest.mark.parametrize("seed", range(4))
def test_smooth_surface_keeps_its_bound(seed: int) -> None:
    mask = np.random.default_rng(seed).random((9, 8, 7)) < 0.4
    grid = oblique_grid(mask.shape)
    mesh = smooth_surface(Volume(grid=grid, array=mask))
    assert mesh.bound_mm == pytest.approx(0.5 * np.linalg.norm(SPACING_MM))
    middles = mesh.vertices_lps[mesh.faces].mean(axis=1)
    exact = MeshDistance(box_surface(mask, grid))
    assert exact.segment_distance_mm(mesh.vertices_lps, mesh.vertices_lps).max() < 1e-5
    assert exact.segment_distance_mm(middles, middles).max() <= mesh.bound_mm
    corners = box_surface(mask, grid).vertices_lps
    assert MeshDistance(mesh).segment_distance_mm(corners, corners).max() <= mesh.bound_mm + 1e-5
    assert mesh.to_trimesh().volume > 0


def test_smooth_surface_of_nothing() -> None:
    grid = oblique_grid((3, 3, 3))
    with pytest.raises(AnatomyError):
        smooth_surface(Volume(grid=grid, array=np.zeros((3, 3, 3), dtype=bool)))


def test_meshes_cannot_be_changed() -> None:
    mesh = SurfaceMesh(vertices_lps=np.zeros((3, 3)), faces=np.array([[0, 1, 2]]), bound_mm=0.0)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices_lps[0, 0] = 1.0


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), count=st.integers(1, 6))
def test_a_polyline_is_its_segments(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((8, 8, 8)) < 0.05
    grid = oblique_grid(mask.shape)
    mesh = MeshDistance(box_surface(mask, grid))
    line = grid.lps(rng.uniform(-2, 10, (count, 3)))
    ends = line[1:] if count > 1 else line
    wanted = mesh.segment_distance_mm(line[: max(count - 1, 1)], ends).min()
    assert mesh.polyline_distance_mm(line) == pytest.approx(wanted, abs=1e-9)


def test_a_mask_may_go_on_beyond_the_grid() -> None:
    mask = np.zeros((6, 6, 6), dtype=bool)
    mask[:2] = True
    grid = oblique_grid(mask.shape)
    closed, room = box_surface(mask, grid), box_surface(mask, grid, beyond=True)
    assert len(closed.faces) == 2 * (2 * 36 + 4 * 12)
    assert len(room.faces) == 2 * (2 * 36 + 4 * 24)
    assert room.to_trimesh().volume == pytest.approx(-(~mask).sum() * grid.voxel_volume_mm3)
    point = grid.lps([[4.5, 3.0, 3.0]])
    assert MeshDistance(room).polyline_distance_mm(point) == pytest.approx(1.0 * SPACING_MM[0])
    assert MeshDistance(closed).polyline_distance_mm(point) == pytest.approx(3.0 * SPACING_MM[0])
