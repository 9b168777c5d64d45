from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import FileError, FrameError
from anatomy.io import parse_point, read_points, read_pose

numbers = st.floats(-1e4, 1e4)


def test_the_two_frames_differ_by_left_right_and_front_back():
    assert parse_point("ras:10,-20,30").tolist() == [-10, 20, 30]
    assert parse_point("lps:10,-20,30").tolist() == [10, -20, 30]
    assert parse_point(" RAS: 1.5, 2, 3e1 ").tolist() == [-1.5, -2, 30]


@given(numbers, numbers, numbers)
def test_a_point_means_the_same_in_both_frames(x, y, z):
    assert parse_point(f"ras:{x!r},{y!r},{z!r}").tolist() == parse_point(f"lps:{-x!r},{-y!r},{z!r}").tolist()


@pytest.mark.parametrize(
    "text",
    ["1,2,3", "", "xyz:1,2,3", "ras:1,2", "ras:1,2,3,4", "lps:1,two,3", "lps:1,nan,3", "ras:inf,0,0", ":1,2"],
)
def test_a_point_without_frame_or_numbers_is_refused(text):
    with pytest.raises(FrameError, match="ras:x,y,z or lps:x,y,z"):
        parse_point(text)


def write_pose(path, matrix):
    np.savetxt(path, matrix)
    return path


def test_a_pose_is_flipped_on_the_left_only(tmp_path):
    ras = np.array([[0, 0, 1, 10], [1, 0, 0, 20], [0, 1, 0, 30], [0, 0, 0, 1]], dtype=float)
    pose = read_pose(write_pose(tmp_path / "start1.txt", ras), "ras")
    assert pose[:3, 3].tolist() == [-10, -20, 30]
    assert pose[:3, 2].tolist() == [-1, 0, 0]  # insertion to the patient's right in RAS +x is LPS -x
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("diagonal", [(-1, 1, 1, 1), (2, 2, 2, 1), (1, 1, 1, 2)])
def test_a_mirrored_or_scaled_pose_is_refused(tmp_path, diagonal):
    with pytest.raises(FrameError, match="rigid"):
        read_pose(write_pose(tmp_path / "start1.txt", np.diag(diagonal)), "ras")


@pytest.mark.parametrize("content", ["1 2 3\n", "", "1 0 0 0\n0 1 0\n", "a b c d\n", "nan 0 0 0\n" * 4])
def test_a_text_that_is_no_pose_is_refused(tmp_path, content):
    (tmp_path / "start1.txt").write_text(content)
    with pytest.raises(FileError, match="start1.txt"):
        read_pose(tmp_path / "start1.txt", "ras")


def test_points_come_one_or_many(tmp_path):
    path = tmp_path / "target.txt"
    path.write_text("1\n2\n3\n")
    assert read_points(path, "ras").tolist() == [[-1, -2, 3]]
    path.write_text("1 2 3\n4 5 6\n")
    assert read_points(path, "lps").tolist() == [[1, 2, 3], [4, 5, 6]]
    path.write_text("1 2\n")
    with pytest.raises(FileError, match="2 numbers"):
        read_points(path, "ras")
