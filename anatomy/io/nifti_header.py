"""The header of a NIfTI-1 or NIfTI-2 file: voxel type, grid in LPS, names of labels.

The affine is read here and not by an image library, because libraries silently fall back to
another transform when the stored one is sheared, and to an invented one when none is stored.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import field
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from anatomy.errors import FileError, FrameError
from anatomy.grid import Grid, transform_points
from anatomy.io.frames import LPS_FROM, LPS_FROM_RAS, Frame
from anatomy.records import frozen_record
from anatomy.typed import Float

_VERSION_1: dict[str, tuple[int, str]] = {
    "dim": (40, "8h"), "datatype": (70, "h"), "pixdim": (76, "8f"), "vox_offset": (108, "f"),
    "slope": (112, "2f"), "units": (123, "B"), "codes": (252, "2h"), "quatern": (256, "6f"),
    "srow": (280, "12f"),
}  # fmt: skip
_VERSION_2: dict[str, tuple[int, str]] = {
    "dim": (16, "8q"), "datatype": (12, "h"), "pixdim": (104, "8d"), "vox_offset": (168, "q"),
    "slope": (176, "2d"), "units": (500, "i"), "codes": (344, "2i"), "quatern": (352, "6d"),
    "srow": (400, "12d"),
}  # fmt: skip
_LAYOUTS = {348: _VERSION_1, 540: _VERSION_2}
_DTYPES = {
    2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8",
}  # fmt: skip
_MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
_TRANSFORM_TOLERANCE_MM = 1.0


@frozen_record
class NiftiHeader:
    """What is needed to read the voxels of a file.

    Parameters
    ----------
    grid : Grid
    is_reversed : bool
        Whether the file counts the first index the other way; see `right_handed_grid`.
    dtype : dtype of the voxels on disk, with byte order
    data_offset : int
        Bytes before the first voxel.
    slope, intercept : float
        The value of a voxel is `slope * stored + intercept`.
    labels : mapping of int to str
        Names of label values from the header extension, empty if there are none.
    """

    grid: Grid
    is_reversed: bool
    dtype: np.dtype[Any]
    data_offset: int
    slope: float
    intercept: float
    labels: Mapping[int, str] = field(default_factory=dict)

    @property
    def is_scaled(self) -> bool:
        """Whether stored numbers differ from values."""
        return (self.slope, self.intercept) != (1.0, 0.0)


def is_header(start: bytes) -> bool:
    """Tell whether bytes begin with the header of a single-file NIfTI image."""
    sizes = {struct.unpack_from(order + "i", start)[0] for order in "<>"}
    return bool(sizes & _LAYOUTS.keys()) and (start[344:347] == b"n+1" or start[4:7] == b"n+2")


def data_offset(start: bytes, path: Path) -> int:
    """Return where the voxels begin, from the first 540 bytes of a file."""
    return int(_fields(start, path)["vox_offset"][0])


def parse_header(start: bytes, path: Path, frame: Frame | None = None) -> NiftiHeader:
    """Understand the bytes before the voxels.

    Parameters
    ----------
    start : bytes
        The file from its first byte to at least the first voxel.
    path : Path
        For messages.
    frame : "ras" or "lps", optional
        The frame to assume if the file states none (both transform codes 0).

    Raises
    ------
    FileError
        If it is no NIfTI image of three dimensions with plain numbers.
    FrameError
        If no frame is stated and none given, or the axes are not perpendicular.
    """
    fields = _fields(start, path)
    shape = _shape(fields["dim"], path)
    code = fields["datatype"][0]
    if code not in _DTYPES:
        raise FileError(
            f"{path} holds voxels of the NIfTI type {code}",
            expected="whole or floating numbers",
            remedy="Save the image with another type of voxels",
        )
    slope, intercept = fields["slope"]
    if slope == 0 or not np.isfinite([slope, intercept]).all():
        slope, intercept = 1.0, 0.0
    offset = int(fields["vox_offset"][0])
    grid, is_reversed = right_handed_grid(shape, _lps_from_ijk(fields, path, shape, frame), path)
    return NiftiHeader(
        grid=grid,
        is_reversed=is_reversed,
        dtype=np.dtype(fields["order"][0] + _DTYPES[code]),
        data_offset=offset,
        slope=slope,
        intercept=intercept,
        labels=_labels(start[fields["size"][0] : offset], fields["order"][0]),
    )


def named_grid(shape: tuple[int, int, int], lps_from_ijk: Float, path: Path) -> Grid:
    """Make a grid; a `FrameError` names the file it came from."""
    try:
        return Grid(shape=shape, lps_from_ijk=lps_from_ijk)
    except FrameError as error:
        raise FrameError(f"{path}: {error.found}", expected=error.expected, remedy=error.remedy) from error


def right_handed_grid(shape: tuple[int, int, int], lps_from_ijk: Float, path: Path) -> tuple[Grid, bool]:
    """Make the grid of a file, with the first index counted the other way if its axes are left-handed.

    Many programs store images so; nothing is mirrored as long as voxels and matrix agree.

    Returns
    -------
    tuple of (Grid, bool)
        The right-handed grid, and whether the voxels must be reversed along their first axis.
    """
    if not np.linalg.det(lps_from_ijk[:3, :3]) < 0.0:
        return named_grid(shape, lps_from_ijk, path), False
    reversed_from_stored = np.diag([-1.0, 1.0, 1.0, 1.0])
    reversed_from_stored[0, 3] = shape[0] - 1
    return named_grid(shape, lps_from_ijk @ reversed_from_stored, path), True


def _fields(start: bytes, path: Path) -> dict[str, tuple[Any, ...]]:
    for order in "<>":
        size = struct.unpack_from(order + "i", start)[0] if len(start) >= 4 else 0
        if size in _LAYOUTS and len(start) >= size:
            layout = _LAYOUTS[size]
            fields = {
                name: struct.unpack_from(order + code, start, at) for name, (at, code) in layout.items()
            }
            return fields | {"order": (order,), "size": (size,)}
    raise FileError(
        f"{path} does not begin with a NIfTI header",
        expected="a single-file NIfTI image (.nii or .nii.gz)",
        remedy="Copy or export the file again",
    )


def _shape(dim: tuple[int, ...], path: Path) -> tuple[int, int, int]:
    rank = dim[0]
    if not 3 <= rank <= 7 or any(n != 1 for n in dim[4 : rank + 1]) or any(n < 1 for n in dim[1:4]):
        raise FileError(
            f"{path} has the dimensions {dim[1 : max(rank, 0) + 1]}",
            expected="one image of three dimensions",
            remedy="Split the file into one image for each time or channel",
        )
    return dim[1], dim[2], dim[3]


def _lps_from_ijk(
    fields: dict[str, tuple[Any, ...]], path: Path, shape: tuple[int, int, int], frame: Frame | None
) -> Float:
    """Choose the stored transform: sform before qform, as image libraries do."""
    scale = np.diag([_MM_PER_UNIT.get(fields["units"][0] & 7, 1.0)] * 3 + [1.0])
    qform_code, sform_code = fields["codes"]
    if sform_code > 0:
        rows = np.array(fields["srow"], dtype=np.float64).reshape(3, 4)
        ras = np.vstack([rows, [0, 0, 0, 1]])
        if qform_code > 0:
            _require_agreement(ras, _qform(fields), shape, path)
    elif qform_code > 0:
        ras = _qform(fields)
    elif frame is not None:
        return LPS_FROM[frame] @ scale @ np.diag([*np.abs(fields["pixdim"][1:4]), 1.0])
    else:
        raise FrameError(
            f"{path} does not state its frame (qform and sform codes are 0)",
            expected="a NIfTI file with a qform or an sform",
            remedy="State the frame yourself (frame = 'ras' or 'lps'), or export the file again",
        )
    return np.asarray(LPS_FROM_RAS @ scale @ ras)


def _qform(fields: dict[str, tuple[Any, ...]]) -> Float:
    """Build the 4x4 matrix of the quaternion form, RAS."""
    b, c, d, *offset = fields["quatern"]
    a = np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))
    rotation = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    handedness = -1.0 if fields["pixdim"][0] < 0 else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array([1.0, 1.0, handedness]) * np.array(fields["pixdim"][1:4])
    matrix[:3, 3] = offset
    return matrix


def _require_agreement(sform: Float, qform: Float, shape: tuple[int, int, int], path: Path) -> None:
    corners = list(product(*[(0, n - 1) for n in shape]))
    apart = np.abs(transform_points(sform, corners) - transform_points(qform, corners)).max()
    if not apart <= _TRANSFORM_TOLERANCE_MM:
        raise FrameError(
            f"{path} states two places for the same voxels: sform and qform differ by {apart:.1f} mm",
            expected="one place",
            remedy="Set the code of the wrong transform to 0 in the header",
        )


def _labels(extension_block: bytes, order: str) -> dict[int, str]:
    """Find the names of labels in the header extensions (XML, as in CIFTI label tables)."""
    if not extension_block or extension_block[0] == 0:
        return {}
    labels: dict[int, str] = {}
    at = 4
    while at + 8 <= len(extension_block):
        size = struct.unpack_from(order + "i", extension_block, at)[0]
        if size < 8:
            break
        labels |= _labels_in_xml(extension_block[at + 8 : at + size])
        at += size
    return labels


def _labels_in_xml(content: bytes) -> dict[int, str]:
    try:
        root = ElementTree.fromstring(content.rstrip(b"\0 \n\r\t"))
    except ElementTree.ParseError:
        return {}
    named = [(label.get("Key", ""), (label.text or "").strip()) for label in root.iter("Label")]
    return {int(key): name for key, name in named if key.lstrip("-").isdigit() and name}
