"""NIfTI-1 and NIfTI-2 files: voxel type, grid in LPS, names of labels, and the stream of voxels.

The affine is read here and not by an image library, because libraries silently fall back to
another transform when the stored one is sheared, and to an invented one when none is stored.
"""

import re
import struct
from collections.abc import Iterator
from itertools import chain, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.typed import Float
from anatomy.grid import transform_points
from anatomy.io import image_header
from anatomy.io.frames import LPS_FROM, LPS_FROM_RAS, Frame
from anatomy.io.voxels import pieces

_VERSION_1: dict[str, tuple[int, str]] = {
    "dim": (40, "8h"), "datatype": (70, "2h"), "pixdim": (76, "8f"), "vox_offset": (108, "f"),
    "slope": (112, "2f"), "units": (123, "B"), "codes": (252, "2h"), "quatern": (256, "6f"),
    "srow": (280, "12f"), "intent": (68, "h"), "intent_name": (328, "16s"), "magic": (344, "4s"),
}  # fmt: skip
_VERSION_2: dict[str, tuple[int, str]] = {
    "dim": (16, "8q"), "datatype": (12, "2h"), "pixdim": (104, "8d"), "vox_offset": (168, "q"),
    "slope": (176, "2d"), "units": (500, "i"), "codes": (344, "2i"), "quatern": (352, "6d"),
    "srow": (400, "12d"), "intent": (504, "i"), "intent_name": (508, "16s"), "magic": (4, "4s"),
}  # fmt: skip
_LAYOUTS = {348: _VERSION_1, 540: _VERSION_2}
_MAGIC = {348: b"n+1\0", 540: b"n+2\0"}
_XFORM_CODES = range(6)
"""The standard knows these kinds of places: unknown, scanner, aligned, Talairach, MNI, another template."""
_DTYPES = {
    2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8",
}  # fmt: skip
_MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
_HEADER_BYTES = 540
_RAS_VECTORS, _LPS_VECTORS = 1006, 1007
"""Intent codes of fields: displacements with the axes of RAS, and vectors as ITK writes them."""


def begins_as_nifti(path: Path) -> bool:
    """Tell whether a file, compressed or not, begins with the header of a single-file NIfTI image."""
    try:
        start = next(pieces(path), b"")
    except (FileError, OSError):
        return False
    if len(start) < _HEADER_BYTES:
        return False
    sizes = {struct.unpack_from(order + "i", start)[0] for order in "<>"}
    return bool(sizes & _LAYOUTS.keys()) and (start[344:347] == b"n+1" or start[4:7] == b"n+2")


def open_nifti(
    path: Path, frame: Frame | None = None, components: int = 1
) -> tuple[image_header.ImageHeader, Iterator[bytes]]:
    """Read everything before the voxels, and return it with the bytes of the voxels.

    The frame is assumed if the file states none (both transform codes 0).  A displacement field of three
    components has five dimensions (ni, nj, nk, 1, 3).  Raises FileError if it is no NIfTI image of three
    dimensions with plain numbers, and FrameError if no frame is stated and none given, or the axes are not
    perpendicular.
    """
    stream = pieces(path)
    start = _at_least(b"", _HEADER_BYTES, stream)
    fields = _fields(start, path)
    offset = _data_offset(fields, path)
    start = _at_least(start, offset, stream)
    return _header(fields, start[:offset], path, frame, components), chain([start[offset:]], stream)


def _at_least(start: bytes, n_bytes: int, stream: Iterator[bytes]) -> bytes:
    while len(start) < n_bytes and (piece := next(stream, b"")):
        start += piece
    return start


def _header(
    fields: dict[str, tuple[Any, ...]], before_voxels: bytes, path: Path, frame: Frame | None, components: int
) -> image_header.ImageHeader:
    dtype, dim = _dtype(fields, path), fields["dim"]
    rank = dim[0] if 3 <= dim[0] <= 7 else 0
    sizes = dim[1:4] if rank and all(n == 1 for n in dim[4 : rank + 1]) else dim[1 : rank + 1]
    if components > 1:
        sizes = _sizes_of_field(fields, sizes, path, components)
    shape = image_header.image_shape(sizes, dtype.itemsize * components, path, path.stat().st_size)
    slope, intercept = _scale(fields["slope"], path)
    grid, is_reversed = image_header.right_handed_grid(shape, _lps_from_ijk(fields, path, shape, frame), path)
    return image_header.ImageHeader(
        grid=grid,
        is_reversed=is_reversed,
        dtype=dtype,
        slope=slope,
        intercept=intercept,
        labels=_labels(before_voxels[fields["size"][0] :], fields["order"][0]),
        components=components,
        vectors_are_ras=components > 1 and fields["intent"][0] == _RAS_VECTORS,
    )


def _sizes_of_field(
    fields: dict[str, tuple[Any, ...]], sizes: tuple[int, ...], path: Path, components: int
) -> tuple[int, ...]:
    """Return the three sizes of a field whose vectors have a known frame."""
    if len(sizes) != 5 or sizes[3:] != (1, components):
        raise image_header.not_of_components(path, f"the dimensions {sizes}, not {components}", components)
    code, name = fields["intent"][0], fields["intent_name"][0].rstrip(b"\0").decode("ascii", "replace")
    if code not in (_RAS_VECTORS, _LPS_VECTORS) or name.startswith("NREG"):
        raise FrameError(
            f"{path} has the intent code {code} and name {name!r}, which leave the frame of its vectors open",
            expected=f"{_LPS_VECTORS} without a name (LPS, as ITK and ANTs write), or {_RAS_VECTORS} (RAS)",
            remedy="Read the field with the program that wrote it, and save it by SimpleITK as .nrrd, in LPS",
        )
    return sizes[:3]


def _data_offset(fields: dict[str, tuple[Any, ...]], path: Path) -> int:
    """Return where the voxels begin; 0 stands for directly after the header and its four bytes."""
    stated, header_bytes = float(fields["vox_offset"][0]), int(fields["size"][0])
    if stated == 0:
        return header_bytes + 4
    most = image_header.MOST_HEADER_BYTES
    if not header_bytes <= stated <= most or stated != int(stated):
        raise FileError(
            f"{path} says that its voxels begin at byte {stated:g}",
            expected=f"a whole number from {header_bytes}, the length of the header, to {most}",
            remedy="Copy or export the file again",
        )
    return int(stated)


def _dtype(fields: dict[str, tuple[Any, ...]], path: Path) -> np.dtype[Any]:
    code, bits = fields["datatype"]
    stored: str = _DTYPES.get(code, "")
    if bits not in (0, 8 * int(stored[1:] or 0)) or not stored:
        raise FileError(
            f"{path} holds voxels of the NIfTI type {code} with {bits} bits",
            expected="whole or floating numbers, with as many bits as their type has",
            remedy="Save the image with another type of voxels",
        )
    order: str = fields["order"][0]
    return np.dtype(order + stored)


def _scale(stored: tuple[float, float], path: Path) -> tuple[float, float]:
    """Return slope and intercept; a slope of 0, or that is no number, stands for voxels as they are."""
    slope, intercept = stored
    if slope == 0 or not np.isfinite(slope):
        return 1.0, 0.0
    if not np.isfinite(intercept):
        raise FileError(
            f"{path} scales its voxels by {slope:g} and adds {intercept}",
            expected="two finite numbers",
            remedy="Export the file again",
        )
    return slope, intercept


def _fields(start: bytes, path: Path) -> dict[str, tuple[Any, ...]]:
    for order in "<>":
        size = struct.unpack_from(order + "i", start)[0] if len(start) >= 4 else 0
        if size in _LAYOUTS and len(start) >= size:
            layout = _LAYOUTS[size]
            fields = {
                name: struct.unpack_from(order + code, start, at) for name, (at, code) in layout.items()
            }
            if fields["magic"][0] == _MAGIC[size]:
                return fields | {"order": (order,), "size": (size,)}
    raise image_header.not_begun(path, "NIfTI", "a single-file NIfTI image (.nii or .nii.gz)")


def _lps_from_ijk(
    fields: dict[str, tuple[Any, ...]], path: Path, shape: tuple[int, int, int], frame: Frame | None
) -> Float:
    """Choose the stored transform: sform before qform, as image libraries do."""
    unit, (qform_code, sform_code) = fields["units"][0] & 7, fields["codes"]
    if unit not in _MM_PER_UNIT or qform_code not in _XFORM_CODES or sform_code not in _XFORM_CODES:
        raise FrameError(
            f"{path} states the unit {unit} and the codes {qform_code} of qform and {sform_code} of sform",
            expected=f"a unit of {sorted(_MM_PER_UNIT)} and codes from 0 to {_XFORM_CODES[-1]}",
            remedy="Export the file again",
        )
    scale = np.diag([_MM_PER_UNIT[unit]] * 3 + [1.0])
    if sform_code > 0:
        ras = np.vstack([np.array(fields["srow"], dtype=np.float64).reshape(3, 4), [0, 0, 0, 1]])
        if qform_code > 0:
            corners = list(product(*[(0, n - 1) for n in shape]))
            by_qform = transform_points(_qform(fields, path), corners)
            apart = np.abs(transform_points(ras, corners) - by_qform).max()
            if not apart <= 1.0:
                raise FrameError(
                    f"{path} states two places for the same voxels: sform and qform differ by {apart:.1f} mm",
                    expected="one place",
                    remedy="Set the code of the wrong transform to 0 in the header",
                )
    elif qform_code > 0:
        ras = _qform(fields, path)
    elif frame is not None:
        return LPS_FROM[frame] @ scale @ np.diag([*_pixdim(fields, path), 1.0])
    else:
        raise FrameError(
            f"{path} does not state its frame (qform and sform codes are 0)",
            expected="a NIfTI file with a qform or an sform",
            remedy="State the frame yourself (frame = 'ras' or 'lps'), or export the file again",
        )
    return np.asarray(LPS_FROM_RAS @ scale @ ras)


def _pixdim(fields: dict[str, tuple[Any, ...]], path: Path) -> Float:
    return image_header.require_lengths(fields["pixdim"][1:4], "pixdim", path)


def _qform(fields: dict[str, tuple[Any, ...]], path: Path) -> Float:
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
    matrix[:3, :3] = rotation * np.array([1.0, 1.0, handedness]) * _pixdim(fields, path)
    matrix[:3, 3] = offset
    return matrix


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
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        return {}
    try:
        root = ElementTree.fromstring(content.rstrip(b"\0 \n\r\t"))
    except ElementTree.ParseError:
        return {}
    named = [(label.get("Key", ""), (label.text or "").strip()) for label in root.iter("Label")]
    return {int(key): name for key, name in named if re.fullmatch(r"-?\d{1,9}", key) and name}
