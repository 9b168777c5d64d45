from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from anatomy.base.errors import AnatomyError, FileError, FrameError
from anatomy.grid import Grid, Volume
from anatomy.io import read_mask, read_volume, write_volume

WRITTEN = ["a.nii", "a.nii.gz", "a.nrrd"]
OTHERS = ["a.seg.nrrd", "a.mha", "a.mhd"]

NIFTI_CODES = slice(252, 256)
NIFTI_SROW = slice(280, 328)


def to_itk(volume: Volume) -> SimpleITK.Image:
    image = SimpleITK.GetImageFromArray(np.asarray(volume.array).T)
    image.SetSpacing(volume.grid.spacing_mm.tolist())
    image.SetOrigin(volume.grid.lps_from_ijk[:3, 3].tolist())
    image.SetDirection((volume.grid.lps_from_ijk[:3, :3] / volume.grid.spacing_mm).ravel().tolist())
    return image


def patched(path: Path, *patches: tuple[slice, bytes]) -> Path:
    """Overwrite bytes of a file."""
    content = bytearray(path.read_bytes())
    for where, new in patches:
        content[where] = new
    path.write_bytes(content)
    return path


def written(path: Path, volume: Volume, *patches: tuple[slice, bytes]) -> Path:
    write_volume(path, volume)
    return patched(path, *patches)


def sform(rows: np.ndarray) -> bytes:
    return struct.pack("<12f", *np.asarray(rows)[:3].ravel())


def ras_rows(grid: Grid) -> np.ndarray:
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ grid.lps_from_ijk


@pytest.mark.parametrize("name", WRITTEN)
def test_left_stays_left_in_what_is_written(tmp_path, landmark, require_landmark, name):
    write_volume(tmp_path / name, landmark)
    back = read_volume(tmp_path / name)
    require_landmark(back)
    assert back.array.dtype == landmark.array.dtype
    assert (back.array == landmark.array).all()
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", WRITTEN[:2] + OTHERS)
def test_left_stays_left_in_what_itk_wrote(tmp_path, landmark, require_landmark, name, compressed):
    SimpleITK.WriteImage(to_itk(landmark), str(tmp_path / name), useCompression=compressed)
    require_landmark(read_volume(tmp_path / name))
    assert read_mask(tmp_path / name).array.sum() == 1


@pytest.mark.parametrize("name", WRITTEN)
def test_itk_understands_what_is_written(tmp_path, landmark, name):
    write_volume(tmp_path / name, landmark)
    image = SimpleITK.ReadImage(str(tmp_path / name))
    marked = np.argwhere(landmark.array)[0]
    there = image.TransformIndexToPhysicalPoint(marked.tolist())
    assert there == pytest.approx(landmark.grid.lps(marked), abs=1e-4)
    assert image.GetPixel(marked.tolist()) == 700


@pytest.mark.parametrize("space", ["right-anterior-superior", "RAS"])
def test_nrrd_in_ras_is_flipped(tmp_path, landmark, space):
    path = written(tmp_path / "a.nrrd", landmark)
    path.write_bytes(path.read_bytes().replace(b"left-posterior-superior", space.encode()))
    first = landmark.grid.lps([0, 0, 0])
    assert read_volume(path).grid.lps([0, 0, 0]) == pytest.approx([-1, -1, 1] * first)


def test_nrrd_in_a_left_handed_space_keeps_its_places(tmp_path, landmark):
    path = written(tmp_path / "a.nrrd", landmark)
    path.write_bytes(path.read_bytes().replace(b"left-posterior", b"left-anterior"))
    back = read_volume(path)
    (found,) = back.grid.lps(np.argwhere(back.array == 700))
    (stored,) = landmark.grid.lps(np.argwhere(landmark.array == 700))
    assert found == pytest.approx([1, -1, 1] * stored)


def test_nrrd_without_a_space_is_refused_unless_told(tmp_path, landmark):
    path = written(tmp_path / "a.nrrd", landmark)
    content = path.read_bytes().replace(b"space: left-posterior-superior", b"space dimension: 3")
    path.write_bytes(content)
    with pytest.raises(FrameError, match="does not state its frame"):
        read_volume(path)
    first = landmark.grid.lps([0, 0, 0])
    assert read_volume(path, frame="lps").grid.lps([0, 0, 0]) == pytest.approx(first)
    assert read_volume(path, frame="ras").grid.lps([0, 0, 0]) == pytest.approx([-1, -1, 1] * first)


def test_a_stated_space_wins_over_the_told_one(tmp_path, landmark, require_landmark):
    write_volume(tmp_path / "a.nrrd", landmark)
    require_landmark(read_volume(tmp_path / "a.nrrd", frame="ras"))


def test_nifti_without_transforms_is_refused_unless_told(tmp_path, landmark):
    path = written(tmp_path / "a.nii", landmark, (NIFTI_CODES, bytes(4)))
    with pytest.raises(FrameError, match="does not state its frame"):
        read_volume(path)
    assert read_volume(path, frame="lps").grid.lps([1, 1, 1]) == pytest.approx([5, 4, 2])
    assert read_volume(path, frame="ras").grid.lps([1, 1, 1]) == pytest.approx([-5, -4, 2])


@pytest.mark.parametrize("codes", [(1, 0), (0, 1), (1, 1)])
def test_either_nifti_transform_gives_the_same_grid(tmp_path, landmark, codes):
    turned = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix() @ landmark.grid.lps_from_ijk[:3, :3]
    matrix = landmark.grid.lps_from_ijk.copy()
    matrix[:3, :3] = turned
    volume = Volume(grid=Grid(shape=landmark.grid.shape, lps_from_ijk=matrix), array=landmark.array)
    path = written(tmp_path / "a.nii", volume, (NIFTI_CODES, struct.pack("<2h", *codes)))
    assert np.abs(read_volume(path).grid.lps_from_ijk - matrix).max() < 1e-4


def test_nifti_transforms_that_contradict_each_other_are_refused(tmp_path, landmark):
    rows = ras_rows(landmark.grid)
    rows[0, 3] += 3
    path = written(tmp_path / "a.nii", landmark, (NIFTI_SROW, sform(rows)))
    with pytest.raises(FrameError, match=r"differ by 3\.0 mm"):
        read_volume(path)


def test_a_sheared_nifti_is_refused(tmp_path, landmark):
    rows = ras_rows(landmark.grid)
    rows[0, 1] = 0.8
    only_sform = (NIFTI_CODES, struct.pack("<2h", 0, 1))
    path = written(tmp_path / "a.nii", landmark, (NIFTI_SROW, sform(rows)), only_sform)
    with pytest.raises(FrameError, match=r"a\.nii: .*not orthonormal"):
        read_volume(path)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("name", WRITTEN[:2] + OTHERS)
def test_an_image_stored_with_left_handed_axes_is_no_mirror_image(
    tmp_path, landmark, require_landmark, name, axis
):
    """Voxels reversed along one axis, and a matrix that says so."""
    image = SimpleITK.Flip(to_itk(landmark), [n == axis for n in range(3)])
    assert np.linalg.det(np.reshape(image.GetDirection(), (3, 3))) < 0
    SimpleITK.WriteImage(image, str(tmp_path / name))
    back = read_volume(tmp_path / name)
    require_landmark(back)
    assert back.array.flags.f_contiguous and np.linalg.det(back.grid.lps_from_ijk[:3, :3]) > 0
    (same,) = back.grid.lps(np.argwhere(read_mask(tmp_path / name).array))
    assert same == pytest.approx(back.grid.lps(np.argwhere(back.array)[0]))
    if axis == 0:
        assert back.grid.is_close(landmark.grid) and (back.array == landmark.array).all()


@pytest.mark.parametrize("codes", [(0, 1), (1, 0), (1, 1)])
def test_nifti_transforms_with_left_handed_axes_agree(tmp_path, landmark, require_landmark, codes):
    """qfac, the sign of the third axis, stands in the first pixdim."""
    path = tmp_path / "a.nii"
    SimpleITK.WriteImage(SimpleITK.Flip(to_itk(landmark), [False, True, False]), str(path))
    require_landmark(read_volume(patched(path, (NIFTI_CODES, struct.pack("<2h", *codes)))))


@pytest.mark.parametrize("name", ["a.nrrd", "a.mha"])
def test_sheared_itk_images_are_refused(tmp_path, landmark, name):
    SimpleITK.WriteImage(to_itk(landmark), str(tmp_path / name))
    content = (tmp_path / name).read_bytes()
    content = content.replace(b"(5,0,0)", b"(5,0.8,0)")
    content = content.replace(b"TransformMatrix = 1 0 0 0 1", b"TransformMatrix = 1 0.2 0 0 1")
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FrameError, match=r"orthonormal|of length 1") as caught:
        read_volume(tmp_path / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("keep", [3, 100, 347, 400, 0.4, 0.9, -1])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.nrrd", "a.mha"])
def test_a_truncated_file_is_refused(tmp_path, grid, name, keep):
    noise = np.random.default_rng(0).integers(-1000, 1000, grid.shape).astype(np.int16)
    path = tmp_path / name
    SimpleITK.WriteImage(to_itk(Volume(grid=grid, array=noise)), str(path), useCompression=name != "a.nii")
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content)) if isinstance(keep, float) else keep])
    for read in (read_volume, read_mask):
        with pytest.raises(FileError, match=name):
            read(path)


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nrrd", "a.mha"])
def test_flipped_bits_in_compressed_data_are_noticed(tmp_path, grid, name):
    noise = np.random.default_rng(0).integers(-1000, 1000, grid.shape).astype(np.int16)
    path = tmp_path / name
    SimpleITK.WriteImage(to_itk(Volume(grid=grid, array=noise)), str(path), useCompression=True)
    middle = path.stat().st_size * 2 // 3
    patched(path, (slice(middle, middle + 1), bytes([path.read_bytes()[middle] ^ 0xFF])))
    with pytest.raises(FileError, match=name):
        read_volume(path)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.nrrd", "a.mha", "a.txt"])
def test_other_bytes_and_endings_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"this is not an image" * 100)
    with pytest.raises(FileError, match=name):
        read_volume(tmp_path / name)


def test_a_missing_file_and_an_unwritable_name_are_refused(tmp_path, landmark):
    with pytest.raises(FileError, match="no file"):
        read_volume(tmp_path / "a.nii")
    with pytest.raises(FileError, match="ending"):
        write_volume(tmp_path / "a.png", landmark)
    with pytest.raises(FileError, match="cannot be written"):
        write_volume(tmp_path / "missing" / "a.nii", landmark)


@pytest.mark.parametrize("name", ["a.nii.gz", "a.nrrd", "a.mha"])
def test_nan_in_a_mask_is_refused(tmp_path, grid, name):
    values = np.zeros(grid.shape, dtype=np.float32)
    values[3, 2, 1] = np.nan
    SimpleITK.WriteImage(to_itk(Volume(grid=grid, array=values)), str(tmp_path / name))
    with pytest.raises(AnatomyError, match="NaN"):
        read_mask(tmp_path / name)


def test_four_dimensions_and_colours_are_refused(tmp_path):
    image = SimpleITK.GetImageFromArray(np.zeros((4, 4, 4, 3), np.uint8), isVector=True)
    for name in ("a.nii", "a.nrrd", "a.mha"):
        SimpleITK.WriteImage(image, str(tmp_path / name))
        with pytest.raises(FileError, match=name):
            read_volume(tmp_path / name)


def test_scale_big_endian_and_units_of_nifti(tmp_path, landmark, require_landmark):
    path = written(tmp_path / "a.nii", landmark, (slice(112, 120), struct.pack("<2f", 2, -100)))
    volume = read_volume(path)
    require_landmark(volume)
    assert (volume.array.max(), volume.array.min()) == (1300, -100)
    with pytest.warns(UserWarning, match="-100 and 1300 alone: 1300 is taken"):
        assert (read_mask(path).array == (volume.array == 1300)).all()
    metres = written(tmp_path / "m.nii", landmark, (slice(123, 124), b"\x01"))
    assert read_volume(metres).grid.spacing_mm == pytest.approx([5000, 4000, 2000])


@pytest.mark.parametrize("dtype", ["u1", "i1", "i2", "u2", "i4", "u4", "f4", "f8"])
def test_every_number_type_survives(tmp_path, grid, dtype):
    values = (np.arange(np.prod(grid.shape)).reshape(grid.shape) % 100).astype(dtype)
    for name in WRITTEN:
        write_volume(tmp_path / name, Volume(grid=grid, array=values))
        back = read_volume(tmp_path / name)
        assert back.array.dtype == np.dtype(dtype)
        assert (back.array == values).all()
        assert back.array.flags.f_contiguous and not back.array.flags.writeable


def test_a_gzip_file_of_several_members_is_read_whole(tmp_path, landmark, require_landmark):
    path = written(tmp_path / "a.nii", landmark)
    content = path.read_bytes()
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(content[:700]) + gzip.compress(content[700:]))
    require_landmark(read_volume(tmp_path / "b.nii.gz"))


def test_masks_are_written_as_zero_and_one(tmp_path, masks):
    write_volume(tmp_path / "a.nii.gz", masks["lumen"])
    assert read_volume(tmp_path / "a.nii.gz").array.dtype == np.uint8
    assert (read_mask(tmp_path / "a.nii.gz").array == masks["lumen"].array).all()


def test_an_itk_volume_outlives_its_image(tmp_path, grid):
    values = np.random.default_rng(1).integers(0, 9, grid.shape).astype(np.int32)
    SimpleITK.WriteImage(to_itk(Volume(grid=grid, array=values)), str(tmp_path / "a.mha"))
    volume = read_volume(tmp_path / "a.mha")
    for _ in range(20):  # reuse the memory, if it was given back
        SimpleITK.Image(list(grid.shape), SimpleITK.sitkInt32) + 5
    assert (volume.array == values).all()


@given(
    seed=st.integers(0, 2**32 - 1),
    spacing=st.tuples(*[st.floats(0.2, 5)] * 3),
    origin=st.tuples(*[st.floats(-1500, 1500)] * 3),
    shape=st.tuples(*[st.integers(1, 6)] * 3),
    name=st.sampled_from(WRITTEN),
)
@hypothesis_settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_rigid_grid_survives_the_disk(tmp_path, seed, spacing, origin, shape, name):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=seed % 2**31).as_matrix() * spacing
    matrix[:3, 3] = origin
    grid = Grid(shape=shape, lps_from_ijk=matrix)
    values = np.random.default_rng(seed).integers(-1024, 3000, shape).astype(np.int16)
    write_volume(tmp_path / name, Volume(grid=grid, array=values))
    back = read_volume(tmp_path / name)
    assert back.grid.is_close(grid, 1e-3)
    assert (back.array == values).all()
    image = SimpleITK.ReadImage(str(tmp_path / name))
    last = [n - 1 for n in shape]
    assert np.abs(np.array(image.TransformIndexToPhysicalPoint(last)) - back.grid.lps(last)).max() < 2e-3


@pytest.mark.parametrize(
    ("at", "code", "value", "problem"),
    [
        (80, "<f", -2.0, "pixdim -2"), (84, "<f", 0.0, "pixdim"), (88, "<f", float("nan"), "pixdim"),
        (123, "<B", 5, "unit 5"), (252, "<h", 77, "codes 77"), (344, "<4s", b"ni1\0", "NIfTI header"),
    ],
)  # fmt: skip
def test_nifti_fields_beyond_the_standard_are_refused(tmp_path, landmark, at, code, value, problem):
    write_volume(tmp_path / "a.nii", landmark)
    header = bytearray((tmp_path / "a.nii").read_bytes())
    struct.pack_into("<hh", header, 252, 1, 0)
    (tmp_path / "a.nii").write_bytes(header)
    read_volume(tmp_path / "a.nii")
    struct.pack_into(code, header, at, value)
    (tmp_path / "a.nii").write_bytes(header)
    with pytest.raises((FileError, FrameError), match=problem):
        read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize(
    ("name", "old", "new", "problem"),
    [
        ("a.nrrd", b"type:", b'space units: "cm" "cm" "cm"\ntype:', "space units"),
        ("a.nrrd", b"type:", b"type: float\ntype:", "type = float"),
        ("a.nrrd", b"dimension: 3", b"dimension: 4", "dimension = 4"),
        ("a.mha", b"DimSize", b"DistanceUnits = cm\nDimSize", "DistanceUnits = cm"),
        ("a.mha", b"DimSize", b"ElementToIntensityFunctionSlope = 2\nDimSize", "Slope = 2"),
        ("a.mha", b"ElementSpacing = ", b"ElementSpacing = -", "ElementSpacing -"),
        ("a.mha", b"TransformMatrix = 1 ", b"TransformMatrix = 2 ", "2 1 1 long"),
        ("a.mha", b"DimSize", b"Offset = 1 2 3\nDimSize", "Offset = "),
    ],
)
def test_fields_of_text_headers_beyond_the_standard_are_refused(tmp_path, landmark, name, old, new, problem):
    SimpleITK.WriteImage(to_itk(landmark), str(tmp_path / name))
    content = (tmp_path / name).read_bytes()
    assert old in content
    (tmp_path / name).write_bytes(content.replace(old, new, 1))
    with pytest.raises((FileError, FrameError), match=problem):
        read_volume(tmp_path / name)
