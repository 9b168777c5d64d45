"""Nodules of known shape drawn into the CT of a phantom: solid, part-solid, at the pleura, at a vessel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, Mask
from anatomy.grid import Grid, Volume
from anatomy.morphology import distance_mm
from anatomy.phantom import Phantom

KINDS = ("solid", "part-solid", "non-solid", "pleural", "diaphragm", "vascular")
"""The kinds of nodules that are drawn."""
SOLID_HU, GLASS_HU = 30.0, -620.0
"""Solid nodules, and ground glass."""
LOBULATION, SPICULES = 0.12, 6
"""Relative change of the radius with direction, and the number of thin spikes of solid nodules."""
BLUR_MM = 0.6
"""Point spread of the phantom's CT."""
AROUND_MM = 36.0
"""Half the side of the part of the CT that is kept."""


@frozen_record
class NoduleCase:
    """A part of a CT with one nodule, its truth, the lungs without it, and the clicked point, LPS mm."""

    ct: Volume
    truth: Mask
    lungs: Mask
    click_lps: Float


class Places:
    """Where nodules of each kind may lie in a phantom without noise; distances are made once."""

    def __init__(self, phantom: Phantom) -> None:
        self.phantom, grid = phantom, phantom.grid
        lung = phantom.lobes.array > 0
        self._depth = distance_mm(lung, grid.spacing_mm)
        tubes = distance_mm(phantom.mask("lumen", "wall", "artery", "vein"), grid.spacing_mm)
        self._free = distance_mm(tubes < 2.0, grid.spacing_mm)
        vessels = distance_mm(phantom.mask("artery", "vein"), grid.spacing_mm)
        self._vessel = distance_mm(vessels < 1.0, grid.spacing_mm)
        self._soft = phantom.mask("heart", "soft_tissue", "mediastinum")
        x, y = (grid.lps_from_ijk[a, 3] + grid.spacing_mm[a] * np.arange(grid.shape[a]) for a in (0, 1))
        self._lateral = (np.abs(x)[:, None, None] > 45.0) | (y[None, :, None] > 20.0)

    def centre_lps(self, kind: str, radius: float, rng: np.random.Generator) -> Float:
        """Choose the centre of a nodule by its kind, LPS mm."""
        if kind in ("pleural", "diaphragm"):
            fits = (self._depth > 0.2 * radius) & (self._depth < 0.6 * radius) & (self._free > radius + 3.0)
            # Tissue lies under a place on the dome within its depth and a little more.
            under = np.zeros_like(self._soft)
            steps = int(np.ceil((0.9 * radius + 2.0) / self.phantom.grid.spacing_mm[2]))
            under[:, :, steps:] = self._soft[:, :, :-steps]
            fits &= under if kind == "diaphragm" else ~under & self._lateral
        elif kind == "vascular":
            fits = (self._depth > radius + 5.0) & (self._depth < 40.0)
            fits &= (self._vessel > 0.5 * radius) & (self._vessel < radius)
        else:
            fits = (self._depth > 1.2 * radius + 4.0) & (self._free > radius + 2.0)
        places = np.flatnonzero(fits.ravel(order="F"))
        chosen = int(places[rng.integers(len(places))])
        return self.phantom.grid.lps(np.unravel_index(chosen, fits.shape, order="F"))


def nodule_case(
    places: Places, kind: str, diameter_mm: float, slice_mm: float, noise_hu: float, seed: int
) -> NoduleCase:
    """Draw a nodule into the noiseless CT of a phantom, and average over slices of `slice_mm`."""
    rng = np.random.default_rng([seed, KINDS.index(kind), int(10 * diameter_mm)])
    radius = 0.5 * diameter_mm
    phantom, grid = places.phantom, places.phantom.grid
    centre = places.centre_lps(kind, radius, rng)
    reach = np.ceil(AROUND_MM / grid.spacing_mm).astype(int)
    middle = np.rint(grid.ijk(centre)).astype(int)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, grid.shape)
    box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    part = grid.crop(low, high)
    lps = part.lps(np.stack(np.meshgrid(*map(np.arange, part.shape), indexing="ij"), axis=-1)) - centre
    inside = _depth(lps, radius, rng)
    lung = phantom.lobes.array[box] > 0
    truth = (inside > 0.0) & lung
    sides = grid.spacing_mm
    share = np.clip(inside / sides[0] + 0.5, 0.0, 1.0) * lung
    if kind in ("solid", "pleural", "vascular", "diaphragm"):
        share = np.maximum(share, _spicules(lps, radius, rng) * lung)
    hu = phantom.ct.array[box].astype(np.float32)
    blurred = ndimage.gaussian_filter(share.astype(np.float32), BLUR_MM / sides)
    hu = _towards(hu, blurred, GLASS_HU if kind in ("part-solid", "non-solid") else SOLID_HU)
    if kind == "part-solid":
        core = np.clip((_depth(lps - 0.15 * radius, 0.55 * radius, rng)) / sides[0] + 0.5, 0.0, 1.0) * lung
        hu = _towards(hu, ndimage.gaussian_filter(core.astype(np.float32), BLUR_MM / sides), SOLID_HU)
    # Segmentations leave the nodule at the wall out of the lung.
    left_out = truth if kind in ("pleural", "diaphragm") else np.zeros_like(truth)
    step = max(1, round(slice_mm / sides[2]))
    count = truth.shape[2] // step
    matrix = part.lps_from_ijk.copy()
    matrix[:3, 3] = part.lps((0.0, 0.0, 0.5 * (step - 1)))
    matrix[:3, 2] *= step
    shape = (truth.shape[0], truth.shape[1], count)

    def thick(array: np.ndarray) -> Float32:
        return array[:, :, : count * step].reshape(*shape, step).mean(axis=-1, dtype=np.float32)

    hu = thick(hu) + noise_hu * rng.standard_normal(shape).astype(np.float32)
    thick_grid = Grid(shape=shape, lps_from_ijk=matrix)
    mask = thick(truth) >= 0.5
    deep = ndimage.distance_transform_edt(mask, sampling=thick_grid.spacing_mm)
    candidates = np.argwhere(deep >= 0.4 * deep.max())
    click = thick_grid.lps(candidates[rng.integers(len(candidates))])
    return NoduleCase(
        ct=Volume(grid=thick_grid, array=np.asfortranarray(np.rint(hu).astype(np.int16))),
        truth=mask,
        lungs=thick(lung & ~left_out) >= 0.5,
        click_lps=click,
    )


def _towards(hu: Float32, share: Float32, value: float) -> Float32:
    return hu + share * (np.maximum(hu, value) - hu)


def _depth(lps: Float, radius: float, rng: np.random.Generator) -> Float:
    """Return how deep points lie inside a lobulated ball, mm; negative outside."""
    apart = np.linalg.norm(lps, axis=-1)
    unit = lps / np.maximum(apart, 1e-6)[..., None]
    bumps = sum(
        rng.normal() * np.cos(frequency * (unit @ _direction(rng)) * np.pi + rng.uniform(0, 2 * np.pi))
        for frequency in (0.7, 1.0, 1.6)
    )
    stretch = 1.0 + 0.25 * rng.uniform() * (unit @ _direction(rng)) ** 2
    return radius * stretch * (1.0 + LOBULATION / 1.7 * bumps) - apart


def _spicules(lps: Float, radius: float, rng: np.random.Generator) -> Float:
    """Return the share of voxels within thin spikes that run outwards from the surface."""
    found = np.zeros(lps.shape[:3])
    for _ in range(SPICULES):
        axis, length = _direction(rng), radius * rng.uniform(1.2, 2.0)
        along = lps @ axis
        across = np.linalg.norm(lps - along[..., None] * axis, axis=-1)
        width = np.where((along > 0.0) & (along < length), 0.7 * (1.0 - along / length) + 0.2, 0.0)
        found = np.maximum(found, np.clip((width - across) / 0.7 + 0.5, 0.0, 1.0) * (width > 0.0))
    return found


def _direction(rng: np.random.Generator) -> Float:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


def dice(first: Mask, second: Mask) -> float:
    """Return the Dice coefficient of two masks."""
    return 2.0 * np.count_nonzero(first & second) / (np.count_nonzero(first) + np.count_nonzero(second))
