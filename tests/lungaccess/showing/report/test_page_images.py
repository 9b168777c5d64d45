"""Surfaces, volumes and the virtual bronchoscopy of a page agree with lung and CT."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from anatomy.base.errors import AnatomyError, FileError
from anatomy.grid import Grid, Volume
from anatomy.io.images import write_volume
from anatomy.lung import Lung
from anatomy.segmentation.folder import SegmentationFolder, digest_of_ct
from lungaccess.cli.commands.see import shown_ct
from lungaccess.plans.plan import Plan
from lungaccess.showing.report import pack
from lungaccess.showing.report.html import deployment, meshes, movie, volumes


def unpacked(packed: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    steps = pack.unpack(packed["vertices"]).astype(float) / meshes.STEPS
    vertices = np.array(packed["low_lps"]) + steps * np.array(packed["size_mm"])
    differences = pack.unpack(packed["faces"])
    first = np.cumsum(differences[0].astype(np.int64))
    return vertices, np.stack([first, first + differences[1], first + differences[2]], axis=1)


def test_a_ball_stays_a_ball() -> None:
    grid = Grid.from_spacing((60, 60, 60), [0.5] * 3, [-15.0, -12.0, -9.0])
    centre = grid.lps([30.0, 30.0, 30.0])
    points = grid.lps(np.stack(np.meshgrid(*[np.arange(60)] * 3, indexing="ij"), axis=-1))
    ball = Volume(grid=grid, array=np.linalg.norm(points - centre, axis=-1) <= 10.0)
    look = meshes.Look(
        key="ball", name="Ball", colour="#123456", opacity=0.5, shown=True, cell_mm=1.2, most_faces=3000
    )
    vertices, faces = unpacked(meshes.packed_surface(ball, look))
    assert 300 < len(faces) <= look.most_faces
    radii = np.linalg.norm(vertices - centre, axis=1)
    np.testing.assert_allclose(radii, 10.0, atol=0.6)
    a, b, c = (vertices[faces[:, n]] - centre for n in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 1000.0, rel=0.05)


def test_no_surface_has_more_triangles_than_its_look_allows(data: dict[str, Any], small_lung: Lung) -> None:
    looks = {look.key: look for look in (*meshes.LOOKS, *meshes.START_LOOKS)}
    assert [each["key"] for each in data["structures"]] == list(looks)
    for packed in data["structures"]:
        vertices, faces = unpacked(packed)
        assert 0 < len(faces) <= looks[packed["key"]].most_faces
        assert faces.min() == 0
        assert faces.max() == len(vertices) - 1
        if looks[packed["key"]] in meshes.START_LOOKS:
            continue
        mask = meshes.structure(small_lung, packed["key"])
        assert mask is not None
        where = mask.grid.lps(np.argwhere(mask.array))
        slack = 2.0 * looks[packed["key"]].cell_mm + 2.0 * float(mask.grid.spacing_mm.max())
        np.testing.assert_allclose(vertices.min(axis=0), where.min(axis=0), atol=slack)
        np.testing.assert_allclose(vertices.max(axis=0), where.max(axis=0), atol=slack)


def voxels(packed: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return values `[i, j, k]` and LPS centres of a packed volume."""
    array = pack.unpack(packed["voxels"])
    if packed["differences"]:
        array = np.cumsum(array, axis=2, dtype=np.uint8)
    array = array.transpose(2, 1, 0)
    grid = Grid.from_spacing(array.shape, [packed["spacing_mm"]] * 3, packed["first_lps"])
    return array, grid.lps(np.stack(np.meshgrid(*map(np.arange, array.shape), indexing="ij"), axis=-1))


def test_label_volumes_agree_with_the_labels(data: dict[str, Any], small_lung: Lung) -> None:
    codes = volumes.label_codes(small_lung, (0, 0, 0), small_lung.grid.shape)
    rng = np.random.default_rng(0)
    coarse, fine = data["labels"]
    assert fine["spacing_mm"] <= coarse["spacing_mm"]
    for packed in (coarse, fine):
        array, centres = voxels(packed)
        chosen = rng.integers(0, array.size, 4000)
        lps, values = centres.reshape(-1, 3)[chosen], array.reshape(-1)[chosen]
        ijk = small_lung.grid.ijk(lps)
        clear = (np.abs(ijk - np.floor(ijk) - 0.5) > 1e-3).all(axis=1) & small_lung.grid.contains(lps)
        index = np.floor(ijk[clear] + 0.5).astype(int)
        np.testing.assert_array_equal(values[clear], codes.array[tuple(index.T)])
    assert set(np.unique(codes.array)) == set(volumes.CODES.values())


@pytest.mark.slow
def test_ct_bytes_say_the_hounsfield_units(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    grid = small_lung.grid
    lps = grid.lps(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1))
    slope, middle = np.array([3.0, -2.0, 1.5]), lps.reshape(-1, 3).mean(axis=0)
    near = deployment.device_points(plans[0])
    assert volumes.HU_OF_BYTE.shape == (256,)
    for low, high, step in ((-1024, -200, 8), (-200, 300, 5), (300, 1548, 24)):
        centre = 0.5 * (low + high)
        ramp = Volume(grid=grid, array=((lps - middle) @ slope + centre).astype(np.float32))
        for packed in volumes.ct_volumes(ramp, small_lung, near):
            array, centres = voxels(packed)
            inner = tuple(slice(3, -3) for _ in range(3))
            wanted = (centres[inner] - middle) @ slope + centre
            found = volumes.HU_OF_BYTE[array[inner]]
            within = (wanted > low + 50) & (wanted < high - 50)
            assert within.any()
            # Half a step of rounding, and half a voxel where several are averaged to one.
            allowed = 0.5 * step + np.abs(slope) @ grid.spacing_mm
            assert np.abs(found - wanted)[within].max() <= allowed
            assert abs((found - wanted)[within].mean()) <= 0.6 * step


def test_a_ct_of_something_else_is_refused(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    far = Grid.from_spacing((8, 8, 8), [1.0] * 3, [900.0, 900.0, 900.0])
    ct = Volume(grid=far, array=np.zeros(far.shape, dtype=np.int16))
    with pytest.raises(AnatomyError, match="CT"):
        volumes.ct_volumes(ct, small_lung, deployment.device_points(plans[0]))


def test_a_ct_in_the_patients_folder_is_found(tmp_path: Path) -> None:
    assert volumes.find_ct(tmp_path) is None
    (tmp_path / "ct.nrrd").touch()
    assert volumes.find_ct(tmp_path) == volumes.CtFile(path=tmp_path / "ct.nrrd")


def test_a_segmented_patient_remembers_its_ct(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = Grid.from_spacing((4, 5, 6), [1.0, 1.0, 2.0], [-3.0, 0.0, 7.0])
    ct = Volume(grid=grid, array=np.arange(120, dtype=np.int16).reshape(4, 5, 6))
    image, folder = tmp_path / "disk" / "scan.nii.gz", tmp_path / "patient"
    image.parent.mkdir()
    write_volume(image, ct)
    source = {"path": "../disk/scan.nii.gz", "series": None}
    SegmentationFolder(folder, grid, digest_of_ct(ct)).save(ct_source=source)
    found = shown_ct(None, folder)
    assert found is not None
    np.testing.assert_array_equal(found.read().array, ct.array)
    write_volume(image, Volume(grid=grid, array=ct.array + 1))
    with pytest.raises(FileError, match="is not the CT that was segmented"):
        found.read()
    image.unlink()
    assert shown_ct(None, folder) is None
    assert "no longer at" in capsys.readouterr().err


def test_rays_meet_the_wall_where_the_lumen_ends(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    poses = np.array(movie.camera_poses(plans[0], 100))
    lumen = movie.SmoothLumen(small_lung, poses[:, :3, 3])
    depths = small_lung.lumen_depth.lower_bound_mm(poses[:, :3, 3])
    n = int(np.argmax(depths))
    pose = poses[n]
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rays = np.cos(angles)[:, None] * pose[:3, 0] + np.sin(angles)[:, None] * pose[:3, 1]
    away = lumen.wall_distance(pose[:3, 3], rays)
    voxel = float(small_lung.grid.spacing_mm.max())
    assert away.min() == pytest.approx(depths[n], abs=1.2 * voxel)
    np.testing.assert_allclose(lumen.share(pose[:3, 3] + away[:, None] * rays), movie.HALF, atol=0.3)
    inwards = lumen.normals(pose[:3, 3] + away[:, None] * rays)
    assert ((inwards * rays).sum(axis=1) < -0.5).all()


def test_the_movie_has_its_pictures(small_lung: Lung, plans: tuple[Plan, ...], tmp_path: Path) -> None:
    path = movie.bronchoscopy_webp(plans[0], small_lung, tmp_path / "fly.webp", frames=3, pixels=48)
    with Image.open(path) as picture:
        assert (picture.format, picture.size, picture.n_frames) == ("WEBP", (48, 48), 3)
        first = np.asarray(picture.convert("RGB"), dtype=float)
        picture.seek(2)
        last = np.asarray(picture.convert("RGB"), dtype=float)
    assert first[24, 40].mean() > 40
    assert first[0, 0].mean() < 30
    assert np.abs(first - last).mean() > 2


def test_edges_of_the_page_grid_are_those_of_the_lung() -> None:
    grid = Grid.from_spacing((40, 50, 60), [2.0] * 3, [5.0, 6.0, 7.0])
    coarse, fine = volumes.page_grids(grid, np.array([[40.0, 50.0, 60.0]]))
    for made in (coarse, fine):
        low = made.lps(np.full(3, -0.5))
        high = made.lps(np.array(made.shape) - 0.5)
        assert (low >= grid.lps(np.full(3, -0.5)) - 1e-9).all()
        assert (high >= np.array([40.0, 50.0, 60.0])).all()
    np.testing.assert_allclose(coarse.lps(np.full(3, -0.5)), [4.0, 5.0, 6.0])
    assert np.prod(coarse.shape) <= 1.05 * volumes.COARSE_VOXELS


@pytest.mark.slow
def test_a_lung_without_nodules_and_fissures_has_fewer_surfaces(bare_lung: Any) -> None:
    bare = SimpleNamespace(**{**vars(bare_lung), "nodules": None})
    assert [each["key"] for each in meshes.structure_meshes(bare)] == ["lung", "vessel", "airway"]
