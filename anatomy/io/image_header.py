"""What the header of an image file says, whatever its format, and whether the file can hold it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import FileError, FrameError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.io.frames import MOST_COORDINATE_MM

MOST_IMAGE_BYTES = 1 << 32
"""Most stored voxels of one image: four times a chest of 1024 x 1024 x 500 voxels of 16 bits."""
MOST_HEADER_BYTES = 1 << 22
"""Longest header: those of real images, with segment names and label tables, have some ten thousand bytes."""

ONE_NUMBER = (
    "one image of three dimensions with one number a voxel",
    "Split the file into one image for each time, channel or overlapping segment",
)
A_FIELD = (
    "a displacement field: three dimensions, three numbers a voxel",
    "Export the displacement field, not the deformed image",
)
"""What is expected of an image or a field, and the remedy."""


@frozen_record
class ImageHeader:
    """What is needed to read the voxels of a file.

    Args:
        is_reversed: Whether the file counts the first index the other way; see `right_handed_grid`.
        dtype: dtype of the voxels on disk, with byte order.
        slope, intercept: The value of a voxel is `slope * stored + intercept`.
        labels: Names of label values, empty if there are none.
        components: Numbers a voxel: 1, or 3 for a displacement field.
        components_first: Whether the numbers of a voxel follow each other in the file, instead of one image
            after the other.
        vectors_are_ras: Whether vectors have the axes of RAS instead of LPS.
    """

    grid: Grid
    is_reversed: bool
    dtype: np.dtype[Any]
    slope: float = 1.0
    intercept: float = 0.0
    labels: Mapping[int, str] = field(default_factory=dict)
    components: int = 1
    components_first: bool = False
    vectors_are_ras: bool = False

    @property
    def is_scaled(self) -> bool:
        """Whether stored numbers differ from values."""
        return (self.slope, self.intercept) != (1.0, 0.0)

    @property
    def n_values(self) -> int:
        """Number of stored numbers."""
        ni, nj, nk = self.grid.shape
        return ni * nj * nk * self.components


def image_shape(sizes: tuple[int, ...], itemsize: int, path: Path, stored_bytes: int) -> tuple[int, int, int]:
    """Return the shape of an image of three dimensions that a file of `stored_bytes` can hold.

    `itemsize` is the number of bytes of a voxel.  Raises FileError if there are not three positive sizes, or
    the file is too short for them, or they are absurd.
    """
    if len(sizes) != 3 or min(sizes) < 1:
        raise FileError(
            f"{path} has the dimensions {sizes[:8]}", expected=ONE_NUMBER[0], remedy=ONE_NUMBER[1]
        )
    promised = sizes[0] * sizes[1] * sizes[2] * itemsize
    if promised > MOST_IMAGE_BYTES:
        raise FileError(
            f"{path} says that it holds {' x '.join(str(n) for n in sizes)} voxels",
            expected=f"at most {MOST_IMAGE_BYTES >> 30} GiB of voxels",
            remedy="Crop the image to the chest, or copy the file again if its header is damaged",
        )
    # No stream of the deflate method becomes more than 1032 times as large.
    if promised > stored_bytes * 1032:
        raise truncated(path, f"{stored_bytes} bytes cannot hold {promised // itemsize} voxels")
    return sizes[0], sizes[1], sizes[2]


def not_of_components(path: Path, found: int | str, components: int) -> FileError:
    """Make the error for an image that has not as many numbers a voxel as it must have."""
    expected, remedy = ONE_NUMBER if components == 1 else A_FIELD
    return FileError(f"{path} has {found} numbers a voxel", expected=expected, remedy=remedy)


def truncated(path: Path, why: str, what: str = "truncated") -> FileError:
    """Make the error for a file that ends too early, or is damaged."""
    return FileError(
        f"{path} is {what}: {why}", expected="a complete file", remedy="Copy or download the file again"
    )


def not_begun(path: Path, format_name: str, expected: str) -> FileError:
    """Make the error for a file that does not begin as its name says."""
    return FileError(
        f"{path} does not begin with a {format_name} header",
        expected=expected,
        remedy="Copy or export the file again",
    )


def require_lengths(values: Sequence[float], name: str, path: Path) -> Float:
    """Return the distances of voxels, or of vectors' ends, that a header states, as `(n,)` float64.

    Raises FrameError if one is not positive: programs differ in what they then read.
    """
    stated = np.array(values, dtype=np.float64)
    if not (stated > 0.0).all():
        raise FrameError(
            f"{path} states the {name} {' '.join(f'{value:g}' for value in stated)}",
            expected="positive distances, as the standard of the format asks for",
            remedy="Export the image again, or correct the header: turned axes belong into its directions",
        )
    return stated


def require_directions(vectors: Float, name: str, path: Path) -> None:
    """Raise FrameError unless vectors that are directions, the columns of `(3, n)`, have the length 1."""
    lengths = np.linalg.norm(vectors, axis=0)
    # A direction may be so much longer or shorter than 1: some programs write three digits.
    if not (np.abs(lengths - 1.0) <= 1e-2).all():
        raise FrameError(
            f"{path} states a {name} whose vectors are {' '.join(f'{length:g}' for length in lengths)} long",
            expected="directions of length 1",
            remedy="Export the image again; the distance of voxels belongs into a field of its own",
        )


def require_plain_fields(fields: Mapping[str, str], plain: Mapping[str, tuple[str, ...]], path: Path) -> None:
    """Raise FileError if a header states another value of a field than those that are read as they stand.

    `plain` holds the values of each field in lower case; a field may be missing.
    """
    odd = {key: fields[key] for key in plain if key in fields and fields[key].lower() not in plain[key]}
    if odd:
        raise FileError(
            f"{path} says {', '.join(f'{key} = {value[:40]}' for key, value in odd.items())}",
            expected="; ".join(f"{key} = {' or '.join(plain[key])}" for key in odd),
            remedy="Save the image again, as 3D Slicer or ITK do, in millimetres",
        )


def fields_once(pairs: Iterable[tuple[str, str]], path: Path) -> dict[str, str]:
    """Return the fields of a header by their names; FileError if one is stated twice, with two values."""
    fields: dict[str, str] = {}
    for name, value in pairs:
        if fields.setdefault(name, value) != value:
            raise FileError(
                f"{path} says {name} = {fields[name][:40]} and {name} = {value[:40]}",
                expected="each field of the header once",
                remedy="Remove the wrong one of the two lines, or export the image again",
            )
    return fields


def named_grid(shape: tuple[int, int, int], lps_from_ijk: Float, path: Path) -> Grid:
    """Make a grid; a `FrameError` names the file it came from.

    Raises FrameError if the matrix is none of a grid, or a corner lies absurdly far away.
    """
    try:
        grid = Grid(shape=shape, lps_from_ijk=lps_from_ijk)
    except FrameError as error:
        raise FrameError(f"{path}: {error.found}", expected=error.expected, remedy=error.remedy) from error
    farthest = float(np.abs(grid.lps([[0, 0, 0], [n - 1 for n in shape]])).max())
    if not farthest <= MOST_COORDINATE_MM:
        raise FrameError(
            f"{path} places voxels {farthest:.3g} mm from the origin",
            expected=f"coordinates of at most {MOST_COORDINATE_MM:.0f} mm",
            remedy="Copy or export the file again; its units may be wrong",
        )
    return grid


def right_handed_grid(shape: tuple[int, int, int], lps_from_ijk: Float, path: Path) -> tuple[Grid, bool]:
    """Make the grid of a file, with the first index counted the other way if its axes are left-handed.

    Many programs store images so; nothing is mirrored as long as voxels and matrix agree.  Also returned is
    whether the voxels must be reversed along their first axis.
    """
    if not np.linalg.det(lps_from_ijk[:3, :3]) < 0.0:
        return named_grid(shape, lps_from_ijk, path), False
    reversed_from_stored = np.diag([-1.0, 1.0, 1.0, 1.0])
    reversed_from_stored[0, 3] = shape[0] - 1
    return named_grid(shape, lps_from_ijk @ reversed_from_stored, path), True
