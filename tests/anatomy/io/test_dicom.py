from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.uid import generate_uid
from scipy.spatial.transform import Rotation

from anatomy.base.errors import FileError, FrameError
from anatomy.grid import Grid, Volume
from anatomy.io import list_series, read_dicom
from tests.anatomy.io.series import write_series


def edit_slices(folder: Path, edit) -> None:
    for path in sorted(folder.glob("*.dcm")):
        header = pydicom.dcmread(path)
        edit(header)
        header.save_as(path)


def test_left_stays_left_and_values_are_hounsfield_units(tmp_path, landmark, require_landmark):
    write_series(tmp_path, landmark)
    volume = read_dicom(tmp_path)
    require_landmark(volume)
    assert (volume.array == landmark.array).all()
    assert volume.grid.is_close(landmark.grid, 1e-6)


def test_an_oblique_feet_first_series_keeps_its_place(tmp_path, landmark):
    matrix = landmark.grid.lps_from_ijk.copy()
    turn = Rotation.from_euler("xyz", [180, 10, 25], degrees=True).as_matrix()
    matrix[:3, :3] = turn @ matrix[:3, :3]
    turned = Volume(grid=Grid(shape=landmark.grid.shape, lps_from_ijk=matrix), array=landmark.array)
    write_series(tmp_path, turned)
    volume = read_dicom(tmp_path)
    marked = np.argwhere(volume.array == 700)[0]
    expected = turned.grid.lps(np.argwhere(landmark.array == 700)[0])
    assert volume.grid.lps(marked) == pytest.approx(expected, abs=1e-6)


def test_two_series_need_a_choice(tmp_path, landmark, require_landmark):
    first = write_series(tmp_path, landmark, 1)
    second = write_series(tmp_path, Volume(grid=landmark.grid, array=landmark.array * 2), 2)
    assert {info.uid for info in list_series(tmp_path)} == {first, second}
    assert [len(info.paths) for info in list_series(tmp_path)] == [8, 8]
    with pytest.raises(FileError, match="holds 2 series") as caught:
        read_dicom(tmp_path)
    assert first in str(caught.value) and second in str(caught.value)
    require_landmark(read_dicom(tmp_path, first))
    assert read_dicom(tmp_path, second).array.max() == 1400
    with pytest.raises(FileError, match=r"none of which is 1\.2\.3"):
        read_dicom(tmp_path, "1.2.3")


def test_a_missing_slice_is_noticed(tmp_path, landmark):
    write_series(tmp_path, landmark)
    heights = {float(pydicom.dcmread(p).ImagePositionPatient[2]): p for p in tmp_path.glob("*.dcm")}
    sorted(heights.items())[3][1].unlink()
    with pytest.raises(FileError, match=r"misses slices between the heights 27\.00 and 31\.00"):
        read_dicom(tmp_path)


def test_a_doubled_slice_is_noticed(tmp_path, landmark):
    write_series(tmp_path, landmark)
    twin = pydicom.dcmread(tmp_path / "1-0.dcm")
    twin.SOPInstanceUID = twin.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    twin.save_as(tmp_path / "twin.dcm")
    with pytest.raises(FileError, match="two slices at the height"):
        read_dicom(tmp_path)


@pytest.mark.parametrize(
    ("moved", "error", "words"),
    [
        pytest.param(lambda y, z: (y, z + 0.02 * (z - 23) ** 2), FileError, "mm apart", id="uneven spacing"),
        pytest.param(
            lambda y, z: (y + np.tan(np.radians(12)) * (z - 23), z),
            FrameError,
            r"tilted by 12\.00 degrees",
            id="tilted gantry",
        ),
    ],
)
def test_slices_that_are_no_grid_are_noticed(tmp_path, landmark, moved, error, words):
    write_series(tmp_path, landmark)

    def move(header):
        x, y, z = (float(v) for v in header.ImagePositionPatient)
        header.ImagePositionPatient = [x, *moved(y, z)]

    edit_slices(tmp_path, move)
    with pytest.raises(error, match=words):
        read_dicom(tmp_path)


def test_rounded_positions_are_accepted(tmp_path, landmark, require_landmark):
    write_series(tmp_path, landmark)
    jitter = iter([0.004, -0.003, 0.002, -0.004, 0.003, 0.0, -0.002, 0.001])

    def rounded(header):
        x, y, z = (float(v) for v in header.ImagePositionPatient)
        header.ImagePositionPatient = [x, y, z + next(jitter)]

    edit_slices(tmp_path, rounded)
    require_landmark(read_dicom(tmp_path))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"Modality": "MR"}, "modality MR"),
        ({"RescaleIntercept": None}, "without RescaleIntercept"),
        ({"NumberOfFrames": 8}, "enhanced"),
    ],
)
def test_what_is_no_ct_in_hounsfield_units_is_refused(tmp_path, landmark, change, problem):
    write_series(tmp_path, landmark, **change)
    with pytest.raises(FileError, match=problem):
        read_dicom(tmp_path)


def test_slices_of_two_scales_are_refused(tmp_path, landmark):
    write_series(tmp_path, landmark)
    header = pydicom.dcmread(tmp_path / "1-3.dcm")
    header.RescaleSlope = 2
    header.save_as(tmp_path / "1-3.dcm")
    with pytest.raises(FileError, match="RescaleSlope differ"):
        read_dicom(tmp_path)


def test_a_truncated_slice_is_refused(tmp_path, landmark):
    write_series(tmp_path, landmark)
    path = tmp_path / "1-3.dcm"
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(FileError, match=r"1-3\.dcm"):
        read_dicom(tmp_path)


@pytest.mark.parametrize("damage", ["empty", "zeros", "no preamble", "cut in the header", "no pixels"])
@pytest.mark.parametrize("ending", [".dcm", "", ".113.7"])
def test_dead_slices_at_an_end_are_named(tmp_path, landmark, damage, ending):
    write_series(tmp_path, landmark)
    by_height = sorted(tmp_path.glob("*.dcm"), key=lambda p: pydicom.dcmread(p).ImagePositionPatient[2])
    for n, path in enumerate(by_height):
        path.rename(tmp_path / f"IM{n:04d}{ending}")
    last = tmp_path / f"IM0007{ending}"
    whole = last.read_bytes()
    header = pydicom.dcmread(last)
    header.PixelData = bytes(len(header.PixelData))
    header.save_as(tmp_path / "black")
    cut, black = whole[: whole.index(b"Lung 1.0")], (tmp_path / "black").read_bytes()
    dead = {
        "empty": b"", "zeros": bytes(len(whole)), "no preamble": whole[132:], "cut in the header": cut,
        "no pixels": black,
    }  # fmt: skip
    (tmp_path / "black").unlink()
    last.write_bytes(dead[damage])
    with pytest.raises(FileError, match=last.name):
        read_dicom(tmp_path)


def test_notes_beside_a_series_are_left_alone(tmp_path, landmark, require_landmark):
    write_series(tmp_path, landmark)
    for name in ("notes.txt", "._1-0.dcm", "LICENSE", "DICOMDIR"):
        (tmp_path / name).write_text("no slice")
    require_landmark(read_dicom(tmp_path))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"PixelSpacing": [-1.0, -1.0]}, "PixelSpacing -1 -1"),
        ({"ImageOrientationPatient": [2.0, 0.0, 0.0, 0.0, 1.0, 0.0]}, "2 1 long"),
        ({"RescaleType": "OD"}, "RescaleType OD"),
    ],
)
def test_numbers_beyond_the_standard_are_refused(tmp_path, landmark, change, problem):
    write_series(tmp_path, landmark, **change)
    with pytest.raises((FileError, FrameError), match=problem):
        read_dicom(tmp_path)


def test_folders_without_dicom_are_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(FileError, match="no DICOM images"):
        read_dicom(tmp_path)
    with pytest.raises(FileError, match="no folder"):
        read_dicom(tmp_path / "missing")
