"""Mutations of meaning: masks of a phantom changed as a stranger's export changes them, files and all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Array
from anatomy.grid import Grid, Volume
from anatomy.io.images import write_volume

ROLES = ("lumen", "wall", "vessels", "lung", "fissures", "nodules")
NEEDED = ("lumen", "vessels", "lung")
Masks = dict[str, Volume]


@dataclass(frozen=True)
class Mutation:
    """What was done, to which masks, and whether the lung must come out the same."""

    name: str
    masks: Masks
    is_same: bool = False


def interpolated(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Shift a mask by half a voxel with linear interpolation, as resampling does, and keep the fractions."""
    step = rng.uniform(0.2, 0.5, 3)
    soft = ndimage.shift(masks[role].array.astype(np.float32), step, order=1)
    return _with(masks, role, soft, f"interpolate {role}")


def rescaled(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Write other values: another label, bytes, another background, or a background that is nearly zero."""
    mask = masks[role].array > 0
    low, high = [(0, 7), (0, 255), (-1, 1), (1, 2), (1e-6, 0.95)][int(rng.integers(5))]
    kind = np.float32 if isinstance(low, float) else np.int16
    return _with(
        masks, role, np.where(mask, high, low).astype(kind), f"relabel {role} {low} {high}", same=True
    )


def divided(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Give a part of a mask a label of its own."""
    mask = (masks[role].array > 0).astype(np.uint8)
    half = np.arange(mask.shape[2]) < mask.shape[2] // 2
    return _with(masks, role, mask * np.where(half, 1, 9).astype(np.uint8), f"divide {role}")


def shifted(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Move a mask by 40 to 80 mm along an axis, as a header with another origin does."""
    axis, size = int(rng.integers(3)), float(rng.uniform(40.0, 80.0) * rng.choice((-1, 1)))
    grid = masks[role].grid
    matrix = grid.lps_from_ijk.copy()
    matrix[axis, 3] += size
    moved = Volume(grid=Grid(shape=grid.shape, lps_from_ijk=matrix), array=masks[role].array)
    return Mutation(name=f"shift {role} {size:.0f} mm along {axis}", masks={**masks, role: moved})


def mirrored(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Exchange left and right of all masks, or the ends of one of them."""
    if role == "lung":
        flipped = {
            name: Volume(grid=each.grid, array=np.asfortranarray(each.array[::-1]))
            for name, each in masks.items()
        }
        return Mutation(name="mirror all", masks=flipped)
    return _with(masks, role, np.asfortranarray(masks[role].array[:, :, ::-1]), f"turn {role} upside down")


def widened(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Grow a mask by 6 mm."""
    mask, steps = masks[role].array > 0, round(6.0 / float(masks[role].grid.spacing_mm.min()))
    return _with(masks, role, ndimage.binary_dilation(mask, iterations=steps), f"dilate {role}")


def without_part(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Leave out what lies in half of the image, along z or across."""
    axis = int(rng.choice((0, 2)))
    kept = (masks[role].array > 0).copy()
    np.moveaxis(kept, axis, 0)[: kept.shape[axis] // 2] = False
    return _with(masks, role, kept, f"drop half of {role} along {axis}")


def swapped(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Exchange the roles of two masks."""
    other = str(rng.choice([each for each in masks if each != role]))
    return Mutation(name=f"swap {role} {other}", masks={**masks, role: masks[other], other: masks[role]})


def copied(masks: Masks, role: str, rng: np.random.Generator) -> Mutation:
    """Put a copy of another mask in the place of one."""
    other = str(rng.choice([each for each in masks if each != role]))
    return Mutation(name=f"{role} is a copy of {other}", masks={**masks, role: masks[other]})


KINDS: tuple[Callable[[Masks, str, np.random.Generator], Mutation], ...] = (
    interpolated, rescaled, divided, shifted, mirrored, widened, without_part, swapped, copied,
)  # fmt: skip


def _with(masks: Masks, role: str, array: Array, name: str, *, same: bool = False) -> Mutation:
    changed = replace(masks[role], array=np.asfortranarray(array))
    return Mutation(name=name, masks={**masks, role: changed}, is_same=same)


def drawn(masks: Mapping[str, Volume], rng: np.random.Generator) -> Mutation:
    """Draw a mutation of a role."""
    kind = KINDS[int(rng.integers(len(KINDS)))]
    return kind(dict(masks), str(rng.choice(list(masks))), rng)


def write(
    folder: Path,
    masks: Mapping[str, Volume],
    others: Mapping[str, Volume] | None = None,
    targets_lps: Sequence[Array] = (),
) -> Path:
    """Write masks as a patient folder; those that `others` has too lie in the folder `whole` beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    keys = {"nodules": "nodule"}
    lines = [f"targets = {['lps:' + ','.join(map(repr, point.tolist())) for point in targets_lps]}"]
    for role, mask in masks.items():
        file = f"{role}.nii"
        if others and others.get(role) is mask:
            file = f"../whole/{file}"
        else:
            write_volume(folder / file, mask)
        lines.append(f'{keys.get(role, role)} = "{file}"')
    (folder / "patient.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
