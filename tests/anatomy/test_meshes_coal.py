"""Distances of FCL beside those of a second library, Coal, for capsules of no radius, by iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from anatomy.meshes import MeshDistance, SurfaceMesh, box_surface
from tests.anatomy.test_meshes import oblique_grid

coal = pytest.importorskip("coal", reason="Coal (the extra 'test') is not installed", exc_type=ImportError)

ALIKE_MM = 1e-5
SIDE_VOXELS, BEYOND_VOXELS = 24, 4


def coal_distances_mm(surface: SurfaceMesh, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(surface.faces), len(surface.vertices_lps))
    mesh.addVertices(surface.vertices_lps)
    mesh.addTriangles(surface.faces)
    mesh.endModel()
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-9
    here = coal.Transform3s.Identity()

    def distance(start: np.ndarray, end: np.ndarray) -> float:
        result = coal.DistanceResult()
        capsule = coal.Capsule(0.0, float(np.linalg.norm(end - start)))
        found: Any = coal.distance(mesh, here, capsule, along(start, end), request, result)
        return max(float(found), 0.0)

    return np.array([distance(a, b) for a, b in zip(starts, ends, strict=True)])


def along(start: np.ndarray, end: np.ndarray) -> Any:
    """Return the placement of a capsule, whose axis is z, from one point to another."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return coal.Transform3s(np.stack([x, np.cross(z, x), z], axis=1), 0.5 * (start + end))


@pytest.mark.parametrize(
    ("seed", "queries"), [(0, 5_000), pytest.param(1, 100_000, marks=pytest.mark.slow)], ids=["5e3", "1e5"]
)
def test_coal_agrees_on_random_segments(seed: int, queries: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((SIDE_VOXELS,) * 3) < 0.01
    grid = oblique_grid(mask.shape, seed=seed)
    surface = box_surface(mask, grid)
    starts = grid.lps(rng.uniform(-BEYOND_VOXELS, SIDE_VOXELS + BEYOND_VOXELS, (queries, 3)))
    ends = starts + rng.normal(scale=2.0, size=(queries, 3))
    ours = MeshDistance(surface).segment_distance_mm(starts, ends)
    theirs = coal_distances_mm(surface, starts, ends)
    assert 0.01 < np.mean(ours == 0.0) < 0.5  # Some cross the surface, most do not.
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=ALIKE_MM)
    moved = MeshDistance(surface).segment_distance_mm(starts[:100] + 3e-5, ends[:100] + 3e-5)
    assert np.abs(moved - theirs[:100]).max() > ALIKE_MM  # Such an error would be seen.
