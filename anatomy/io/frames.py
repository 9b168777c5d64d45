"""Points and poses from text, flipped to LPS millimetres at this border only."""

import warnings
from io import StringIO
from pathlib import Path
from typing import Literal

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.files import DAMAGE, read_text, reason
from anatomy.base.typed import Float
from anatomy.grid import ORTHONORMAL_TOLERANCE, read_only, transform_points

Frame = Literal["ras", "lps"]

MOST_COORDINATE_MM = 1e5
"""Farthest place from the origin: no scanner or tracker has a frame of 100 m."""
LPS_FROM_RAS: Float = read_only(np.diag([-1.0, -1.0, 1.0, 1.0]))
LPS_FROM: dict[str, Float] = {"lps": read_only(np.eye(4)), "ras": LPS_FROM_RAS}


def parse_point(text: str) -> Float:
    """Read a point with a stated frame, `ras:x,y,z` or `lps:x,y,z`, in mm.

    Returns:
        (3,) float64, LPS mm.

    Raises:
        FrameError: If the frame is missing or unknown, or there are not three finite numbers.

    Examples:
        >>> parse_point("ras:10,-20,30").tolist()
        [-10.0, 20.0, 30.0]
    """
    frame, separator, numbers = text.strip().partition(":")
    frame = frame.strip().lower()
    if not separator or frame not in LPS_FROM:
        raise _point_error(text, "does not state its frame" if not separator else "has an unknown frame")
    try:
        values = [float(number) for number in numbers.split(",")]
    except ValueError as error:
        raise _point_error(text, "does not hold three numbers") from error
    if len(values) != 3 or not (np.abs(values) <= MOST_COORDINATE_MM).all():
        raise _point_error(text, f"does not hold three finite numbers up to {MOST_COORDINATE_MM:.0f}")
    return transform_points(LPS_FROM[frame], values)


def _point_error(text: str, problem: str) -> FrameError:
    return FrameError(
        f"The point {text!r} {problem}",
        expected="ras:x,y,z or lps:x,y,z in millimetres",
        remedy="3D Slicer shows RAS coordinates, DICOM and ITK use LPS",
    )


def read_pose(path: str | Path, frame: Frame | None) -> Float:
    """Read a 4x4 pose `lps_from_tip`, LPS mm, from 16 numbers; +z is the direction of insertion.

    The file cannot state the frame of its numbers: that is given, and None is refused.  Raises FileError if
    the file does not hold 4x4 finite numbers, and FrameError if the frame is not stated, or the matrix is not
    a right-handed rigid pose.
    """
    matrix = _numbers(path)
    if frame is None:
        raise FrameError(
            f"{path} does not state the frame of its numbers, and --frame is not given",
            expected="--frame ras or --frame lps",
            remedy="3D Slicer shows and saves RAS coordinates, DICOM and ITK use LPS",
        )
    if matrix.shape != (4, 4):
        raise FileError(
            f"{path} holds an array of shape {matrix.shape}",
            expected="a 4x4 pose",
            remedy="Write four lines of four numbers",
        )
    rotation = matrix[:3, :3]
    off = max(np.abs(rotation.T @ rotation - np.eye(3)).max(), np.abs(matrix[3] - [0, 0, 0, 1]).max())
    if not (off <= ORTHONORMAL_TOLERANCE and np.linalg.det(rotation) > 0):
        raise FrameError(
            f"{path} does not hold a right-handed rigid pose (off by {off:.2g})",
            expected="a rotation with determinant +1, and 0 0 0 1 as the last row",
            remedy="Check that the matrix is neither transposed, scaled nor mirrored",
        )
    return np.asarray(LPS_FROM[frame] @ matrix)


def read_points(path: str | Path, frame: Frame) -> Float:
    """Read points from a text file of three numbers a point; return `(N, 3)` float64, LPS mm.

    Raises FileError if the file does not hold a multiple of three finite numbers.
    """
    values = _numbers(path).ravel()
    if values.size == 0 or values.size % 3:
        raise FileError(
            f"{path} holds {values.size} numbers",
            expected="three numbers (x, y, z in mm) for each point",
            remedy="Write one point a line",
        )
    return transform_points(LPS_FROM[frame], values.reshape(-1, 3))


def _numbers(path: str | Path) -> Float:
    text = read_text(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # A file without numbers is refused by those who ask.
            values = np.loadtxt(StringIO(text), dtype=np.float64, ndmin=2)
    except DAMAGE as error:
        raise FileError(
            f"{path} does not hold a table of numbers: {reason(error)}",
            expected="numbers apart by spaces, the same count in each line",
            remedy="`lungaccess template pose` prints a pose that can be read",
        ) from error
    if not (np.abs(values) <= MOST_COORDINATE_MM).all():
        raise FileError(
            f"{path} holds the number {values[~(np.abs(values) <= MOST_COORDINATE_MM)][0]:g}",
            expected=f"finite numbers in mm, up to {MOST_COORDINATE_MM:.0f}",
            remedy="Correct the numbers in the file",
        )
    return values
