"""Masks from the values of an image, which are one label, named labels, or fractions; else refused."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Array, Mask
from anatomy.base.words import percent
from anatomy.io.voxels import require_numbers

PARTS: Mapping[str, int] = {"lung": 5, "lobes": 5, "fissures": 5, "nodules": 100}
"""Roles whose labels, from 1 to this one, are parts of one mask: lungs or lobes, fissures, nodules, of which
more than this are soft edges in bytes."""
TOPS = (1.0, 100.0, 255.0)
"""Fractions are stored as such, in percent or in bytes."""
SWING = 0.5
"""Splines through a mask of 0 and 1 swing beyond both by less than this."""
BETWEEN, MOST_BETWEEN = (0.1, 0.9), 0.2
"""Fractions of a mask lie between these values at its surface alone: in less than this share of an image;
a cost map or a CT has them everywhere."""
FEW, MANY = 16, 4096
"""An image of labels has few values where they are not named; no more than the second number are listed."""


def mask_of(
    values: Array, name: str, *, voxel_mm3: float, role: str = "", labels: Sequence[int] = ()
) -> tuple[Mask, tuple[str, ...]]:
    """Return the mask that the values of an image stand for, and what has to be said of it.

    Args:
        name: The file, for messages.
        role: What the mask shows, see `PARTS`; empty for a mask of one label.
        labels: The labels that count; if there are none, the image has to be a mask by itself: of two values,
            or fractions, of which those of at least a half count.

    Raises:
        AnatomyError: If a value is not a number, several labels occur and none is named, or the values are
            those of no mask.
    """
    require_numbers(values, name)
    if labels:
        require_label_values(values, name)
        missing = [label for label in labels if not (values == label).any()]
        return select(values, labels), tuple(f"{name} has no voxel of the label {n}." for n in missing)
    found = _values_in(values)
    low, high = found[0], found[-1]
    if not np.isfinite((low, high)).all():
        raise _no_mask(name, low, high)
    if len(found) <= 2:
        return _of_two(values, name, low, high)
    if low >= 0 and high <= PARTS.get(role, 0) and (found == np.rint(found)).all():
        return np.asarray(values != 0), ()
    # The value of a whole voxel of an image of fractions; 0 if it is none.
    top = float(high) if low >= 0 and high in TOPS[1:] and len(found) > FEW else 0.0
    if low >= -SWING and high <= 1.0 + SWING and (found != np.rint(found)).any():
        top = TOPS[0]
    if top:
        return _of_fractions(values, name, top, voxel_mm3)
    if (found == np.rint(found)).all() and low >= 0:
        shown = ", ".join(f"{value:g}" for value in found[found != 0][:9])
        raise AnatomyError(
            f"{name} holds the labels {shown}{' and more' if len(found) > 10 else ''}, and it is not said "
            f"which of them count{f' as {role}' if role else ''}",
            expected="a mask of one value beside the background, or the label by its value or name",
            remedy=f"Name the label or labels, as in {name}#{found[found != 0][0]:g} or {name}#1,2; if it "
            "is a mask that was interpolated, resample it as labels are, by the nearest neighbour",
        )
    raise _no_mask(name, low, high)


def select(values: Array, labels: Sequence[int]) -> Mask:
    """Return where `values` is one of `labels`."""
    mask = values == labels[0]
    for label in labels[1:]:
        mask |= values == label
    return np.asarray(mask)


def parse_labels(text: str) -> tuple[int, ...] | None:
    """Return the labels that a text such as 1 or 1,2 names; None if it is no list of whole numbers."""
    parts = text.split(",")
    return tuple(int(part) for part in parts) if all(part.isdecimal() for part in parts) else None


def file_and_label(path: Path) -> tuple[Path, str]:
    """Return the file and the label that `file#label` names; the label is empty if the path names a file."""
    name, _mark, label = path.name.rpartition("#")
    return (path, "") if not name or path.exists() else (path.with_name(name), label)


def is_whole(values: Array) -> bool:
    """Tell whether all values are whole numbers."""
    return values.dtype.kind != "f" or all(bool((plane == np.rint(plane)).all()) for plane in values.T)


def require_label_values(values: Array, name: str) -> None:
    """Raise AnatomyError if values are no labels: not whole, as those of labels that were interpolated."""
    require_numbers(values, name)
    if not is_whole(values):
        raise AnatomyError(
            f"{name} holds values that are no whole numbers, as interpolated labels have them",
            expected="labels, which are whole numbers",
            remedy="Resample labels by the nearest neighbour; between two labels lies no third one",
        )


def _of_two(values: Array, name: str, low: float, high: float) -> tuple[Mask, tuple[str, ...]]:
    """Return the mask of an image of two values; the background is 0, or what its faces show most."""
    if low in (0, high) and high == np.rint(high):
        return np.asarray(values > 0), ()
    background = low
    if low != 0:
        faces = [np.moveaxis(values, axis, 0)[end] for axis in range(3) for end in (0, -1)]
        background = high if np.mean([np.mean(face == high) for face in faces]) > 0.5 else low
    mark = high if background == low else low
    said = (
        f"{name} holds {low:g} and {high:g} alone: {mark:g} is taken as the mask, {background:g} as nothing."
    )
    return np.asarray(values == mark), (said,)


def _of_fractions(values: Array, name: str, top: float, voxel_mm3: float) -> tuple[Mask, tuple[str, ...]]:
    low, high = (share * top for share in BETWEEN)
    between = sum(int(np.count_nonzero((plane > low) & (plane < high))) for plane in values.T)
    if between > MOST_BETWEEN * values.size:
        raise AnatomyError(
            f"{name} holds values between {low:g} and {high:g} in {percent(between / values.size)} of its "
            "voxels: it is a map or an image, and no mask",
            expected="a mask, whose values lie between only at its surface",
            remedy="Give the mask itself, or threshold this image where you know what its values mean",
        )
    mask = np.asarray(values >= 0.5 * top)
    volumes = [float(np.count_nonzero(each)) * voxel_mm3 / 1000.0 for each in (mask, values)]
    return mask, (
        f"{name} holds fractions, as a mask that was interpolated, or probabilities: the voxels of at "
        f"least a half count, {volumes[0]:.1f} ml, where {volumes[1]:.1f} ml are not zero. What is thin may "
        "be lost or widened: resample masks as labels are, by the nearest neighbour.",
    )


def _values_in(values: Array) -> Array:
    """Return the values that occur, in order, as float64; the least and the greatest of very many."""
    found = np.zeros(0)
    for plane in values.T:
        found = np.union1d(found, np.unique(plane))
        if len(found) > MANY:
            return np.asarray([values.min(), *found[1:-1].tolist(), values.max()], dtype=np.float64)
    return found.astype(np.float64)


def _no_mask(name: str, low: float, high: float) -> AnatomyError:
    return AnatomyError(
        f"{name} holds values from {low:g} to {high:g}: they are those of no mask",
        expected="one label, a label map whose label is named, two values, or fractions from 0 to 1, in "
        "percent or in bytes",
        remedy="Give the mask itself; a mask that was interpolated is resampled as labels are, by the "
        "nearest neighbour",
    )
