"""Motion in a patient.toml: fields, transforms, landmarks, their frames and directions; what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from anatomy.base.errors import AnatomyError, FileError, FrameError, LungaccessError, SettingsError
from anatomy.base.settings import parse
from anatomy.grid import Grid
from anatomy.io.motion_files import MotionFile, read_landmarks, read_motion, read_vectors, write_vectors

MASKS = Grid.from_spacing((20, 16, 24), (2.0, 2.0, 2.0), (-10.0, 5.0, 100.0))


def field() -> tuple[Grid, np.ndarray]:
    grid = Grid.from_spacing((4, 5, 6), (3.0, 4.0, 5.0), (-10.0, 20.0, 30.0))
    return grid, np.random.default_rng(1).normal(size=(4, 5, 6, 3))


def read(folder: Path, **keys: object) -> object:
    stated = parse(MotionFile, {"masks_phase": 0.0, **keys}, "patient.toml")
    return read_motion(stated, folder, MASKS)


@pytest.mark.parametrize("suffix", ["nrrd", "mha", "nii.gz"])
def test_a_field_is_read_as_it_was_written(tmp_path: Path, suffix: str) -> None:
    grid, vectors = field()
    path = tmp_path / f"field.{suffix}"
    write_vectors(path, grid, vectors)
    found, read_back = read_vectors(path)
    assert found.is_close(grid)
    assert np.allclose(read_back, vectors, atol=1e-6)


@pytest.mark.parametrize("suffix", ["nrrd", "mha", "mhd", "nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
def test_a_tilted_field_is_that_which_simpleitk_reads(tmp_path: Path, suffix: str, compressed: bool) -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    image = SimpleITK.GetImageFromArray(field()[1].transpose(2, 1, 0, 3), isVector=True)
    image.SetDirection((turn * np.sign(np.linalg.det(turn))).ravel().tolist())
    image.SetOrigin((-20.0, 31.0, 7.5))
    image.SetSpacing((2.0, 3.0, 4.0))
    path = tmp_path / f"field.{suffix}"
    SimpleITK.WriteImage(image, str(path), useCompression=compressed)
    grid, vectors = read_vectors(path)
    known = SimpleITK.ReadImage(str(path))
    for index in ((0, 0, 0), (3, 0, 0), (0, 4, 0), (1, 2, 5)):
        assert np.allclose(grid.lps(index), known.TransformIndexToPhysicalPoint(index), atol=1e-4)
        assert np.array_equal(vectors[index], known[index])


def test_a_field_of_nrrd_may_have_its_vectors_on_the_last_axis(tmp_path: Path) -> None:
    grid, vectors = field()
    write_vectors(tmp_path / "field.nrrd", grid, vectors)
    head = "NRRD0004\ntype: double\ndimension: 4\nspace: left-posterior-superior\nsizes: 4 5 6 3\n"
    head += "space directions: (3,0,0) (0,4,0) (0,0,5) none\nendian: little\nencoding: raw\n"
    head += "kinds: domain domain domain vector\nspace origin: (-10,20,30)\n\n"
    (tmp_path / "last.nrrd").write_bytes(head.encode() + vectors.tobytes(order="F"))
    found, read_back = read_vectors(tmp_path / "last.nrrd")
    assert found.is_close(grid)
    assert np.array_equal(read_back, vectors)


@pytest.mark.parametrize(
    ("name", "old", "new", "error"),
    [
        ("a.nrrd", b"left-posterior-superior", b"right-anterior-superior", FrameError),
        ("a.nrrd", b"kinds:", b"measurement frame: (-1,0,0) (0,-1,0) (0,0,1)\nkinds:", FrameError),
        ("a.nrrd", b"sizes: 3 4 5 6", b"sizes: 3 4 5 7", FileError),
        ("a.mha", b"DimSize = 4 5 6", b"DimSize = 4 5 900000", FileError),
        ("a.mha", b"ElementNumberOfChannels = 3", b"ElementNumberOfChannels = 2", FileError),
        ("a.nii", (1007).to_bytes(2, "little"), (1005).to_bytes(2, "little"), FrameError),
    ],
)
def test_a_field_that_promises_too_much_or_another_frame_is_refused(
    tmp_path: Path, name: str, old: bytes, new: bytes, error: type[LungaccessError]
) -> None:
    path = tmp_path / name
    write_vectors(path, *field())
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(error):
        read_vectors(path)


def test_a_field_of_niftyreg_is_refused_because_its_vectors_are_ras(tmp_path: Path) -> None:
    path = tmp_path / "field.nii"
    write_vectors(path, *field())
    content = bytearray(path.read_bytes())
    content[328:338] = b"NREG_TRANS"
    path.write_bytes(bytes(content))
    with pytest.raises(FrameError, match="NREG_TRANS"):
        read_vectors(path)


def test_the_vectors_of_a_left_handed_file_stay_with_their_voxels(tmp_path: Path) -> None:
    grid, vectors = field()
    image = SimpleITK.GetImageFromArray(vectors[::-1].transpose(2, 1, 0, 3), isVector=True)
    image.SetSpacing((3.0, 4.0, 5.0))
    image.SetOrigin(grid.lps((3, 0, 0)).tolist())
    image.SetDirection((-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    SimpleITK.WriteImage(image, str(tmp_path / "field.mha"))
    found, read_back = read_vectors(tmp_path / "field.mha")
    assert found.is_close(grid)
    assert np.array_equal(read_back, vectors)


def test_displacements_of_nifti_that_are_ras_on_disk_become_lps(tmp_path: Path) -> None:
    grid, vectors = field()
    path = tmp_path / "field.nii"
    write_vectors(path, grid, vectors)
    content = bytearray(path.read_bytes())
    content[68:70] = (1006).to_bytes(2, "little")  # NIFTI_INTENT_DISPVECT
    path.write_bytes(bytes(content))
    assert np.allclose(read_vectors(path)[1], vectors * [-1.0, -1.0, 1.0], atol=1e-6)


def test_a_transform_is_evaluated_over_the_masks(tmp_path: Path) -> None:
    affine = SimpleITK.AffineTransform(3)
    matrix = np.array([[1.0, 0.02, 0.0], [0.0, 1.05, 0.0], [0.01, 0.0, 1.1]])
    affine.SetMatrix(matrix.ravel().tolist())
    affine.SetTranslation((1.0, -2.0, -8.0))
    SimpleITK.WriteTransform(affine, str(tmp_path / "ee_to_ei.tfm"))
    source = read(tmp_path, file="ee_to_ei.tfm", maps_from="end-exhale")
    at = source.grid.lps(np.moveaxis(np.indices(source.grid.shape), 0, -1))
    assert np.allclose(source.vectors, at @ matrix.T + [1.0, -2.0, -8.0] - at)
    assert source.grid.contains(MASKS.lps([(0, 0, 0), (19, 15, 23)])).all()


@pytest.mark.parametrize(("frame", "sign"), [("lps", 1.0), ("ras", -1.0)])
def test_landmarks_are_six_columns_with_a_stated_frame(tmp_path: Path, frame: str, sign: float) -> None:
    path = tmp_path / "pairs.csv"
    path.write_text("x_ee,y_ee,z_ee,x_ei,y_ei,z_ei\n# from 4DCT\n1,2,3,4,5,6\n7,8,9,10,11,12\n")
    exhale, inhale = read_landmarks(path, frame)
    assert np.array_equal(exhale, [[sign, 2 * sign, 3], [7 * sign, 8 * sign, 9]])
    assert np.array_equal(inhale[0], [4 * sign, 5 * sign, 6])
    with pytest.raises(FrameError, match='frame = "lps"'):
        read(tmp_path, file="pairs.csv")
    path.write_text("1,2,3,4,5\n")
    with pytest.raises(FileError, match="Line 1 of .*six finite numbers"):
        read_landmarks(path, frame)


@pytest.mark.parametrize(
    ("keys", "error", "words"),
    [
        ({"file": "field.nrrd", "masks_phase": None}, SettingsError, "Write masks_phase = 0.0"),
        ({"file": "field.nrrd"}, SettingsError, 'Write maps_from = "end-exhale"'),
        ({}, SettingsError, "names nothing"),
        ({"file": "field.nrrd", "population": True}, SettingsError, "more than one motion"),
        ({"end_exhale": "a.nii"}, SettingsError, "end_exhale and end_inhale"),
        ({"file": "none.nrrd", "maps_from": "end-exhale"}, FileError, "There is no file"),
        ({"file": "field.xyz", "maps_from": "end-exhale"}, FileError, "of an unknown kind"),
        ({"file": "scalar.mha", "maps_from": "end-exhale"}, FileError, "1 numbers a voxel"),
        ({"file": "nan.mha", "maps_from": "end-exhale"}, AnatomyError, "not finite"),
        ({"file": "broken.tfm", "maps_from": "end-exhale"}, FileError, "cannot be read"),
    ],
)
def test_what_is_missing_or_wrong_is_said(
    tmp_path: Path, keys: dict[str, object], error: type[LungaccessError], words: str
) -> None:
    grid, vectors = field()
    write_vectors(tmp_path / "field.nrrd", grid, vectors)
    vectors[0, 0, 0] = np.nan
    write_vectors(tmp_path / "nan.mha", grid, vectors)
    SimpleITK.WriteImage(SimpleITK.Image(4, 4, 4, SimpleITK.sitkFloat32), str(tmp_path / "scalar.mha"))
    (tmp_path / "field.xyz").write_text("")
    (tmp_path / "broken.tfm").write_text("#Insight Transform File V1.0\nTransform: Nothing\n")
    with pytest.raises(error, match=words):
        read(tmp_path, **keys)


def test_a_phase_that_is_none_is_refused() -> None:
    with pytest.raises(SettingsError, match="at least 0 and at most 1"):
        parse(MotionFile, {"masks_phase": 1.5}, "patient.toml")


@pytest.mark.slow
def test_two_masks_are_registered(tmp_path: Path) -> None:
    from anatomy.grid import Volume
    from anatomy.io import write_volume

    grid = Grid.from_spacing((30, 24, 34), (4.0, 4.0, 4.0), (-60.0, -48.0, -70.0))
    points = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))
    for name, longer in (("ee", 0.0), ("ei", 10.0)):
        z = (points[..., 2] - 40.0) / (80.0 + longer) * 80.0 + 40.0
        ball = (points[..., 0] / 40.0) ** 2 + (points[..., 1] / 30.0) ** 2 + (z / 45.0) ** 2 < 1.0
        write_volume(tmp_path / f"{name}.nii.gz", Volume(grid=grid, array=np.asfortranarray(ball)))
    source = read(tmp_path, end_exhale="ee.nii.gz", end_inhale="ei.nii.gz")
    base = np.rint(source.grid.ijk((0.0, 0.0, -40.0))).astype(int)
    # The lowest part goes to the feet by about 10 mm, the middle by less, the top not at all.
    assert -13.0 < source.vectors[tuple(base)][2] < -6.0
    top = np.rint(source.grid.ijk((0.0, 0.0, 38.0))).astype(int)
    assert abs(source.vectors[tuple(top)][2]) < 3.0
