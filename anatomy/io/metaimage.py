"""MetaImage files (.mha, .mhd): the text header, read here as in `anatomy.io.nrrd`, and the voxels."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.typed import Float
from anatomy.io import image_header
from anatomy.io.voxels import pieces

_DTYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4",
    "MET_UINT": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
_PLAIN = {
    "BinaryData": ("true",), "HeaderSize": ("0",), "DistanceUnits": ("mm", "?"),
    "ElementToIntensityFunctionSlope": ("1", "1.0"), "ElementToIntensityFunctionOffset": ("0", "0.0"),
}  # fmt: skip
"""Fields that may be missing, and the only values that are read."""


def open_metaimage(path: Path, components: int = 1) -> tuple[image_header.ImageHeader, Iterator[bytes]]:
    """Read the header of a file, and return it with the bytes of the voxels; the frame is LPS by definition.

    `components` is how many numbers a voxel must have.  Raises FileError if it is no MetaImage of three
    dimensions, or its data lie elsewhere than in one plain file beside it, and FrameError if its axes are not
    perpendicular.
    """
    fields, offset = _text(path)
    image_header.require_plain_fields(fields, _PLAIN, path)
    known = {"NDims": ("3",), "ElementType": _DTYPES}
    odd = {key: fields.get(key, "missing") for key, held in known.items() if fields.get(key) not in held}
    if odd:
        raise FileError(
            f"{path} says {', '.join(f'{key} = {value[:40]}' for key, value in odd.items())}",
            expected="one image of three dimensions, stored as binary data",
            remedy="Save the image again, as 3D Slicer or ITK do",
        )
    channels = fields.get("ElementNumberOfChannels", "1")
    if channels != str(components):
        raise image_header.not_of_components(path, channels[:40], components)
    big_endian = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "false"))
    order = ">" if big_endian.lower() in ("true", "1") else "<"
    dtype = np.dtype(order + _DTYPES[fields["ElementType"]])
    data_path, at = _data_file(fields, path, offset)
    sizes = tuple(int(n) for n in fields.get("DimSize", "").split()[:8])
    shape = image_header.image_shape(sizes, dtype.itemsize * components, path, data_path.stat().st_size)
    grid, is_reversed = image_header.right_handed_grid(shape, _lps_from_ijk(fields, path), path)
    compressed = fields.get("CompressedData", "false").lower() == "true"
    header = image_header.ImageHeader(
        grid=grid,
        is_reversed=is_reversed,
        dtype=dtype,
        components=components,
        components_first=components > 1,
    )
    return header, pieces(data_path, at, compressed=compressed)


def _text(path: Path) -> tuple[dict[str, str], int]:
    """Return the fields, and where the data begin if they follow."""
    with path.open("rb") as stream:
        start = stream.read(image_header.MOST_HEADER_BYTES)
    end = re.search(rb"^ElementDataFile *= *([^\r\n]*?) *(\r?\n|\Z)", start, re.MULTILINE)
    if end is None:
        raise image_header.not_begun(path, "MetaImage", "a .mha or .mhd file")
    lines = start[: end.end()].decode("utf-8-sig", errors="replace").splitlines()
    parts = (line.partition("=") for line in lines if line.strip())
    pairs = ((key.strip(), value.strip()) for key, _, value in parts)
    return image_header.fields_once(pairs, path), end.end()


def _data_file(fields: Mapping[str, str], path: Path, offset: int) -> tuple[Path, int]:
    name = fields["ElementDataFile"]
    if name.upper() == "LOCAL":
        return path, offset
    if not name or name in (".", "..", "LIST") or re.search(r"[%/\\\0]|^LIST\b", name):
        raise FileError(
            f"{path} keeps its data in {name[:80]!r}",
            expected="LOCAL, or the plain name of one file in the same folder",
            remedy="Save the image as .mha, with header and data in one file",
        )
    beside = path.with_name(name)
    if not beside.is_file():
        raise FileError(
            f"{path} keeps its data in {name[:80]!r}, which is not there",
            expected="both files in one folder",
            remedy="Copy that file, too",
        )
    return beside, 0


def _lps_from_ijk(fields: Mapping[str, str], path: Path) -> Float:
    """Return the matrix: each row of TransformMatrix is the direction of an axis."""

    def numbers(names: tuple[str, ...], count: int, default: str) -> Float:
        text = next((fields[name] for name in names if name in fields), default)
        values = [float(number) for number in text.split()[: count + 1]]
        if len(values) != count:
            raise FrameError(
                f"{path} has no readable {names[0]}",
                expected=f"{count} numbers",
                remedy="Export the file again",
            )
        return np.array(values)

    matrix = np.eye(4)
    directions = numbers(("TransformMatrix", "Rotation", "Orientation"), 9, "1 0 0 0 1 0 0 0 1").reshape(3, 3)
    image_header.require_directions(directions.T, "TransformMatrix", path)
    spacing = numbers(("ElementSpacing", "ElementSize"), 3, "").tolist()
    matrix[:3, :3] = directions.T * image_header.require_lengths(spacing, "ElementSpacing", path)
    matrix[:3, 3] = numbers(("Offset", "Position", "Origin"), 3, "0 0 0")
    return matrix
