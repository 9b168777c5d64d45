"""Images with known truth for the suite of wrong and hard inputs, and what is done to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Float32, Mask, UInt8
from anatomy.grid import Grid, Volume
from anatomy.phantom import Phantom
from anatomy.segmentation.canonical import towards_lps

AIR_HU, FOAM_HU, SHELL_HU, TISSUE_HU, FLUID_HU = -1000.0, -930.0, -150.0, 40.0, 15.0
"""Air, foam and shell of a table, muscle, and fluid in the pleura."""


@frozen_record
class HardImage:
    """A CT and the truth about it, arrays `(ni, nj, nk)` on one grid.

    `lobes` are 1 to 5, 0 outside the lungs; `tree_lps` `(N, 3)` are points on the centrelines of the airways.
    """

    hu: Float32
    lobes: UInt8
    lumen: Mask
    grid: Grid
    tree_lps: Float

    @property
    def lung(self) -> Mask:
        """Both lungs."""
        return np.asarray(self.lobes > 0)

    @property
    def ct(self) -> Volume:
        """The image as a scanner stores it."""
        return Volume(grid=self.grid, array=np.clip(np.rint(self.hu), -2048, 3071).astype(np.int16))

    def with_hu(self, hu: Array) -> HardImage:
        """Return the image with other values."""
        return replace(self, hu=np.asarray(hu, dtype=np.float32))

    def filled(self, where: Mask, hu: float, *, noise_hu: float = 15.0, lung: bool = False) -> HardImage:
        """Return the image with `hu` in some voxels, which are no lung any more unless `lung`."""
        noise = np.random.default_rng(1).normal(0.0, noise_hu, self.hu.shape).astype(np.float32)
        lobes = self.lobes if lung else np.where(where, np.uint8(0), self.lobes)
        made = np.where(where, np.float32(hu) + noise, self.hu)
        return replace(self, hu=made, lobes=lobes, lumen=self.lumen & ~where)

    def coordinates(self) -> tuple[Float, Float, Float]:
        """Return x, y, z in LPS mm, each broadcastable to the image; the axes must be along LPS."""
        first, sides = self.grid.lps_from_ijk[:3, 3], np.diag(self.grid.lps_from_ijk)[:3]
        x, y, z = (first[a] + sides[a] * np.arange(self.hu.shape[a]) for a in range(3))
        return x[:, None, None], y[None, :, None], z[None, None, :]


def phantom_image(phantom: Phantom) -> HardImage:
    """Return the CT of a phantom with its truth."""
    return HardImage(
        hu=phantom.ct.array.astype(np.float32),
        lobes=phantom.lobes.array,
        lumen=phantom.images.lumen.array,
        grid=phantom.grid,
        tree_lps=phantom.centerlines["airway"].points_lps,
    )


def upright(image: HardImage) -> HardImage:
    """Return the image in the order of voxels that segmentations are made in."""
    order, flipped = towards_lps(image.grid.lps_from_ijk[:3, :3])
    flips = [order[axis] for axis in range(3) if flipped[axis]]
    return turned(image, order, flips, header=True)


def turned(image: HardImage, order: Sequence[int], flips: Sequence[int], *, header: bool) -> HardImage:
    """Return the voxels in another order of axes; the header follows, or stays what it was."""
    axes = [*order]
    matrix, shape = image.grid.lps_from_ijk.copy(), [image.grid.shape[a] for a in axes]
    first = [image.grid.shape[a] - 1 if a in flips else 0 for a in range(3)]
    signs = np.array([-1.0 if a in flips else 1.0 for a in range(3)])
    if header:
        matrix[:3, 3] = image.grid.lps(first)
        matrix[:3, :3] = (matrix[:3, :3] * signs)[:, axes]

    def of(array: Array) -> Array:
        return np.asfortranarray(np.flip(array, tuple(flips)).transpose(axes))

    grid = Grid(shape=(shape[0], shape[1], shape[2]), lps_from_ijk=matrix)
    return replace(image, hu=of(image.hu), lobes=of(image.lobes), lumen=of(image.lumen), grid=grid)


def rotated(image: HardImage, degrees: float, plane: tuple[int, int]) -> HardImage:
    """Return a patient who lies askew: turned about the middle of the image."""
    angle = np.deg2rad(degrees)
    rotation = np.eye(3)
    a, b = plane
    rotation[[a, b], [a, b]] = np.cos(angle)
    rotation[a, b], rotation[b, a] = -np.sin(angle), np.sin(angle)
    middle = 0.5 * (np.array(image.hu.shape) - 1)
    offset = middle - rotation @ middle

    def of(array: Array, degree: int, fill: float) -> Array:
        return np.asarray(ndimage.affine_transform(array, rotation, offset, order=degree, cval=fill))

    centre = image.grid.lps(middle)
    return replace(
        image,
        hu=of(image.hu, 3, AIR_HU),
        lobes=of(image.lobes, 0, 0),
        lumen=of(image.lumen.astype(np.uint8), 0, 0) > 0,
        tree_lps=(image.tree_lps - centre) @ rotation + centre,
    )


def cropped(image: HardImage, low_lps: Sequence[float], high_lps: Sequence[float]) -> HardImage:
    """Return the part of an image between two corners in LPS mm; infinite ones leave a side as it is."""
    first, last = image.grid.lps((0, 0, 0)), image.grid.lps(np.array(image.grid.shape) - 1)
    ends = image.grid.ijk(np.clip([low_lps, high_lps], first, last))
    low, high = np.floor(ends[0]).astype(int), np.ceil(ends[1]).astype(int) + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return replace(
        image,
        hu=image.hu[box],
        lobes=image.lobes[box],
        lumen=image.lumen[box],
        grid=image.grid.crop(low, high),
    )


def padded(image: HardImage, low_mm: Sequence[float], high_mm: Sequence[float]) -> HardImage:
    """Return the image with air around it."""
    low, high = (np.rint(np.array(mm) / image.grid.spacing_mm).astype(int) for mm in (low_mm, high_mm))
    pads = [(int(a), int(b)) for a, b in zip(low, high, strict=True)]
    noise = np.random.default_rng(2).normal(AIR_HU, 15.0, np.add(image.hu.shape, low + high))
    noise[tuple(slice(a, a + n) for (a, _), n in zip(pads, image.hu.shape, strict=True))] = image.hu
    return replace(
        image,
        hu=noise.astype(np.float32),
        lobes=np.pad(image.lobes, pads),
        lumen=np.pad(image.lumen, pads),
        grid=image.grid.crop(-low, np.array(image.grid.shape) + high),
    )


def resampled(image: HardImage, spacing_mm: Sequence[float]) -> HardImage:
    """Return the image on other voxels: means over larger ones, linear interpolation over smaller ones."""
    factor = np.array(spacing_mm) / image.grid.spacing_mm
    shape = np.floor((np.array(image.hu.shape) - 1) / factor).astype(int) + 1
    matrix = image.grid.lps_from_ijk.copy()
    matrix[:3, :3] = matrix[:3, :3] * factor
    width = np.where(factor > 1.0, factor, 1.0)
    hu = image.hu
    for axis in range(3):
        if width[axis] > 1.0:
            hu = ndimage.uniform_filter1d(hu, int(round(width[axis])), axis=axis)
    places = [np.arange(n) * f for n, f in zip(shape, factor, strict=True)]
    grid = np.meshgrid(*places, indexing="ij")
    nearest = tuple(np.clip(np.rint(g).astype(int), 0, n - 1) for g, n in zip(grid, hu.shape, strict=True))
    return replace(
        image,
        hu=ndimage.map_coordinates(hu, grid, order=1, mode="nearest").astype(np.float32),
        lobes=image.lobes[nearest],
        lumen=image.lumen[nearest],
        grid=Grid(shape=(int(shape[0]), int(shape[1]), int(shape[2])), lps_from_ijk=matrix),
    )


def noisy(image: HardImage, deviation_hu: float, sigma_voxels: float = 0.0) -> HardImage:
    """Return the image with more noise, which may be correlated."""
    noise = np.random.default_rng(0).standard_normal(image.hu.shape).astype(np.float32)
    if sigma_voxels:
        noise = ndimage.gaussian_filter(noise, sigma_voxels, mode="wrap")
    return image.with_hu(image.hu + noise * np.float32(deviation_hu / noise.std()))


def ball(image: HardImage, centre: Sequence[float], radius_mm: float | Sequence[float]) -> Mask:
    """Return the voxels in a ball or ellipsoid, LPS mm."""
    radii = np.broadcast_to(np.asarray(radius_mm, dtype=np.float64), 3)
    parts = zip(image.coordinates(), centre, radii, strict=True)
    return np.asarray(sum(((x - c) / r) ** 2 for x, c, r in parts) <= 1.0)


def tabled(image: HardImage, *, arms: bool = False, clothes: bool = False, prone: bool = False) -> HardImage:
    """Return the patient on a table of foam in a thin shell, in a wider field of view."""
    sign = -1.0 if prone else 1.0
    edge = float((sign * image.coordinates()[1]).max())
    ends = ((70.0, 25.0, 0.0), (70.0, 70.0, 0.0))
    wide = padded(image, *((ends[0], ends[1]) if not prone else ((70.0, 70.0, 0.0), (70.0, 25.0, 0.0))))
    x, y, z = wide.coordinates()
    under = sign * y - edge
    made, air = wide, (wide.hu < -800.0) & ~wide.lung & ~wide.lumen
    for rim, value in ((0.0, SHELL_HU), (3.0, FOAM_HU)):
        inside = (np.abs(x) < 150.0 - rim) & (under > rim) & (under < 45.0 - rim) & (z < np.inf)
        made = made.filled(inside & air, value)
    if arms:
        for side in (-1.0, 1.0):
            apart = np.hypot(x - side * 140.0, y)
            made = made.filled((apart < 28.0) & (z < np.inf), TISSUE_HU)
            made = made.filled((apart < 9.0) & (z < np.inf), 500.0)
    if clothes:
        near = ndimage.distance_transform_edt(made.hu < -500.0, sampling=made.grid.spacing_mm)
        near = ndimage.distance_transform_edt(near < 8.0, sampling=made.grid.spacing_mm)
        made = made.filled((near > 6.0) & (near < 9.0) & air & (sign * y < 40.0), -700.0)
    return made
