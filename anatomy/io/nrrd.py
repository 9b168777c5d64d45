"""NRRD files with their data attached: the text header, and the stream of voxels.

The header is read here and not by an image library, because such libraries are native code that crashes on
damaged text, and return damaged voxels without a word.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.typed import Float
from anatomy.io import image_header
from anatomy.io.frames import LPS_FROM, LPS_FROM_RAS, Frame
from anatomy.io.voxels import pieces

_LPS_FROM_LAS = np.diag([1.0, -1.0, 1.0, 1.0])
_LPS_WORDS = ("left-posterior-superior", "lps")
_LPS_FROM_SPACE: Mapping[str, Float] = {
    **dict.fromkeys(_LPS_WORDS, np.eye(4)),
    "right-anterior-superior": LPS_FROM_RAS, "ras": LPS_FROM_RAS,
    "left-anterior-superior": _LPS_FROM_LAS, "las": _LPS_FROM_LAS,
}  # fmt: skip
_DTYPES = {
    "signed char": "i1", "int8": "i1", "int8_t": "i1",
    "uchar": "u1", "unsigned char": "u1", "uint8": "u1", "uint8_t": "u1",
    "short": "i2", "short int": "i2", "signed short": "i2", "signed short int": "i2", "int16": "i2",
    "int16_t": "i2",
    "ushort": "u2", "unsigned short": "u2", "unsigned short int": "u2", "uint16": "u2", "uint16_t": "u2",
    "int": "i4", "signed int": "i4", "int32": "i4", "int32_t": "i4",
    "uint": "u4", "unsigned int": "u4", "uint32": "u4", "uint32_t": "u4",
    "longlong": "i8", "long long": "i8", "long long int": "i8", "signed long long": "i8", "int64": "i8",
    "signed long long int": "i8", "int64_t": "i8",
    "ulonglong": "u8", "unsigned long long": "u8", "unsigned long long int": "u8", "uint64": "u8",
    "uint64_t": "u8",
    "float": "f4", "double": "f8",
}  # fmt: skip
_MM = ("mm", "millimeter", "millimeters", "millimetre", "millimetres")
_PLAIN = {
    "space units": tuple(" ".join([f'"{unit}"'] * 3) for unit in _MM),
    "units": tuple(" ".join([f'"{unit}"'] * 3) for unit in ("", *_MM)),
    "space dimension": ("3",),
    **dict.fromkeys(("axis mins", "axismins", "axis maxs", "axismaxs"), ("nan nan nan",)),
}
"""Fields that may be missing, and the values with which the others mean what is read here."""
_NUMBER = r"\s*([-+0-9.eE]{1,40})\s*"
_VECTOR = re.compile(rf"\({_NUMBER},{_NUMBER},{_NUMBER}\)")


def open_nrrd(
    path: Path, frame: Frame | None, components: int = 1
) -> tuple[image_header.ImageHeader, Iterator[bytes]]:
    """Read the header of a file, and return it with the bytes of the voxels.

    `components` is how many numbers a voxel must have; those of a displacement field stand on the first axis
    or on the last, which has no direction.  Raises FileError if it is no NRRD file of three dimensions, or
    its data lie in another file or in an unknown encoding, and FrameError if it states no frame and none is
    given, its axes are not perpendicular, or vectors may not be LPS.
    """
    fields, keys, offset = _text(path)
    dtype = _dtype(fields, path)
    sizes = tuple(int(n) for n in fields.get("sizes", "").split()[:8])
    stated = {"dimension": (f"{len(sizes)}",)} | {
        name: plain for name, plain in _PLAIN.items() if components == 1 or name.startswith("space")
    }
    image_header.require_plain_fields(fields, stated, path)
    is_first = False
    if components > 1:
        is_first = _is_first_axis(fields, sizes, path, components)
        # Vectors of another frame are refused: programs turn axes to LPS, but not all of them turn vectors.
        space = fields.get("space", "").lower()
        measured = _vectors(fields.get("measurement frame", "(1,0,0) (0,1,0) (0,0,1)"))
        if space not in _LPS_WORDS or measured != np.eye(3).tolist():
            raise FrameError(
                f"{path} states the space {space!r} and the measurement frame {measured}, in which the frame "
                "of its vectors is not certain",
                expected="space: left-posterior-superior, without another measurement frame",
                remedy="Write the field with ITK, SimpleITK or 3D Slicer",
            )
        sizes = sizes[1:] if is_first else sizes[:-1]
    shape = image_header.image_shape(sizes, dtype.itemsize * components, path, path.stat().st_size)
    grid, is_reversed = image_header.right_handed_grid(shape, _lps_from_ijk(fields, path, frame), path)
    header = image_header.ImageHeader(
        grid=grid,
        is_reversed=is_reversed,
        dtype=dtype,
        labels=_labels(keys),
        components=components,
        components_first=is_first,
    )
    return header, pieces(path, offset, compressed=_encoding(fields, path) != "raw")


def _is_first_axis(fields: Mapping[str, str], sizes: tuple[int, ...], path: Path, components: int) -> bool:
    """Tell whether the numbers of a vector stand on the first axis and not on the last."""
    axes = re.findall(r"none|\([^)]*\)", fields.get("space directions", "")[:1000])
    without = [n for n, axis in enumerate(axes) if axis == "none"]
    if len(sizes) != 4 or len(axes) != 4 or without not in ([0], [3]) or sizes[without[0]] != components:
        stated = f"the sizes {sizes} and the directions {' '.join(axes)[:120] or 'missing'}, not {components}"
        raise image_header.not_of_components(path, stated, components)
    return without == [0]


def _text(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Return the `field: value` and the `key:=value` lines, and where the data begin."""
    with path.open("rb") as stream:
        start = stream.read(image_header.MOST_HEADER_BYTES)
    end = re.search(rb"\r?\n\r?\n", start)
    if not start.startswith(b"NRRD") or end is None:
        raise image_header.not_begun(path, "NRRD", "a complete .nrrd file")
    pairs: list[tuple[str, str]] = []
    keys: dict[str, str] = {}
    for line in start[: end.start()].decode("utf-8", errors="replace").splitlines()[1:]:
        match = re.match(r"([^#:][^:]*)(:=|: )(.*)", line)
        if match and match[2] == ":=":
            keys[match[1]] = match[3]
        elif match:
            pairs.append((match[1].lower(), match[3].strip()))
    fields = image_header.fields_once(pairs, path)
    if "data file" in fields or "datafile" in fields:
        raise FileError(
            f"{path} keeps its data in another file",
            expected="header and data in one file",
            remedy="Save it as .nrrd instead of .nhdr",
        )
    return fields, keys, end.end()


def _dtype(fields: Mapping[str, str], path: Path) -> np.dtype[np.generic]:
    code = _DTYPES.get(fields.get("type", "").lower())
    order = {"little": "<", "big": ">"}.get(fields.get("endian", "").lower())
    if code is None or (order is None and code[1] != "1"):
        raise FileError(
            f"{path} holds voxels of the type {fields.get('type', 'missing')!r}, "
            f"endian {fields.get('endian', 'missing')!r}",
            expected="whole or floating numbers, little or big endian",
            remedy="Save the image with another type of voxels",
        )
    return np.dtype((order or "<") + code)


def _encoding(fields: Mapping[str, str], path: Path) -> str:
    encoding = fields.get("encoding", "missing").lower()
    skips = [fields[name] for name in ("line skip", "byte skip", "lineskip", "byteskip") if name in fields]
    if encoding not in ("raw", "gzip", "gz") or any(skip != "0" for skip in skips):
        raise FileError(
            f"{path} stores its voxels in the encoding {encoding!r}" + (", with a skip" if skips else ""),
            expected="raw or gzip, directly after the header",
            remedy="Save the image again, as 3D Slicer or ITK do",
        )
    return encoding


def _lps_from_ijk(fields: Mapping[str, str], path: Path, frame: Frame | None) -> Float:
    space = fields.get("space", "").lower()
    lps_from_space = _LPS_FROM_SPACE.get(space)
    if lps_from_space is None:
        if frame is None:
            raise FrameError(
                f"{path} does not state its frame (space: {space or 'missing'})",
                expected="space: left-posterior-superior or right-anterior-superior",
                remedy="State the frame yourself (frame = 'ras' or 'lps'), or export the file again",
            )
        lps_from_space = LPS_FROM[frame]
    matrix = np.eye(4)
    directions = _vectors(fields.get("space directions", ""))
    spacings = fields.get("spacings", "").split()
    if len(directions) == 3:
        matrix[:3, :3] = np.transpose(directions)
    elif "space directions" not in fields and len(spacings) == 3:
        matrix[:3, :3] = np.diag(image_header.require_lengths([float(s) for s in spacings], "spacings", path))
    else:
        raise FrameError(
            f"{path} does not state the directions of its axes",
            expected="space directions of three vectors",
            remedy="Export the file again",
        )
    origin = _vectors(fields.get("space origin", "(0,0,0)"))
    if len(origin) != 1:
        raise FrameError(
            f"{path} has no readable space origin", expected="three numbers", remedy="Export the file again"
        )
    matrix[:3, 3] = origin[0]
    return np.asarray(lps_from_space @ matrix)


def _vectors(text: str) -> list[list[float]]:
    return [[float(number) for number in vector] for vector in _VECTOR.findall(text[:1000])]


def _labels(keys: Mapping[str, str]) -> dict[int, str]:
    """Return the segments of a .seg.nrrd file: label value to name."""
    labels: dict[int, str] = {}
    for key, value in keys.items():
        match = re.fullmatch(r"(Segment\d+)_LabelValue", key)
        name = keys.get(f"{match[1]}_Name", "").strip() if match else ""
        if name and re.fullmatch(r"\d{1,9}", value.strip()):
            labels[int(value)] = name
    return labels
