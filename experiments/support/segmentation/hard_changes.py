"""What makes an image hard: organs that are solid or gone, other parts of the body, and faults of a scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Array
from experiments.support.segmentation.hard_images import (
    AIR_HU,
    FLUID_HU,
    TISSUE_HU,
    HardImage,
    ball,
    cropped,
    noisy,
    padded,
    resampled,
    tabled,
)
from experiments.support.segmentation.hard_runs import RIGHT_LUNG, of_lobes

INF = np.inf


def solid(image: HardImage, lobes: tuple[int, ...], hu: float, *, airways: bool) -> HardImage:
    """Fill lobes; their airways stay open, or are filled as well."""
    return image.filled(of_lobes(image, lobes) & ~(image.lumen if airways else False), hu)


def with_lung_hu(image: HardImage, shift: float) -> HardImage:
    lung = ndimage.gaussian_filter((image.lung & ~image.lumen).astype(np.float32), 0.6)
    share = np.clip((-300.0 - image.hu) / 400.0, 0.0, 1.0) * lung
    return image.with_hu(image.hu + shift * share)


def pneumothorax(image: HardImage, depth_mm: float, hu: float = AIR_HU) -> HardImage:
    right = of_lobes(image, RIGHT_LUNG)
    depth = ndimage.distance_transform_edt(right, sampling=image.grid.spacing_mm)
    x, y, z = image.coordinates()
    return image.filled(right & (depth < depth_mm) & (x < -35.0) & (z > -60.0) & (y < 40.0), hu)


def abdomen(image: HardImage, hu: float, *, below: float = -55.0) -> HardImage:
    """Return the image below a height, with 200 mm of abdomen that holds bowel of some HU."""
    part = cropped(image, (-INF, -INF, -INF), (INF, INF, below))
    return belly(part, hu)


def belly(part: HardImage, hu: float) -> HardImage:
    floor = float(part.coordinates()[2].min())
    tall = padded(part, (0.0, 0.0, 150.0), (0.0, 0.0, 0.0))
    x, y, z = tall.coordinates()
    body = ((x / 106.0) ** 2 + (y / 75.0) ** 2 < 1.0) & (z < floor)
    tall = tall.filled(body, TISSUE_HU)
    column = (np.hypot(x - 20.0, y + 20.0) < 9.0) & (z < floor - 15.0) & (z > floor - 135.0)
    made = tall.filled(column, AIR_HU)
    for x0, height in ((-60.0, 25.0), (60.0, 35.0), (0.0, 110.0)):
        loop = ball(tall, (x0, -25.0, floor - height - 25.0), (35.0, 30.0, 42.0 if x0 else 20.0))
        made = made.filled(loop & (z < floor - 4.0), hu, noise_hu=15.0 if hu < -950 else 150.0)
    return made


def throat(image: HardImage, glottis: float, *, lean_mm: float = 0.0) -> HardImage:
    """Return the image with neck and head: the trachea goes on through a glottis to pharynx and mouth.

    The slit of the glottis has a share of the trachea's cross-section; the neck leans forward by a length.
    """
    tall = padded(image, (0.0, 0.0, 0.0), (0.0, 0.0, 110.0))
    x, y, z = tall.coordinates()
    up = z - float(image.coordinates()[2].max())
    top = image.lumen[:, :, -1]
    middle = image.grid.lps([*np.argwhere(top).mean(axis=0), 0.0])
    radius = float(np.sqrt(top.sum() * np.prod(image.grid.spacing_mm[:2]) / np.pi))
    x, y = x - middle[0], y - middle[1] + lean_mm * np.maximum(up, 0.0) / 110.0
    body = ((x / 60.0) ** 2 + ((y + 5.0) / 65.0) ** 2 < 1.0) & (up > -1.0)
    made = tall.filled(body & (tall.hu < -500.0) & (up > 0.0), TISSUE_HU)
    for first, last, wide, deep in (
        (0.0, 22.0, 1.0, 1.0),
        (22.0, 28.0, glottis, 1.0),
        (28.0, 42.0, 1.15, 1.15),
        (42.0, 95.0, 1.7, 1.0),
    ):
        tube = (x / (max(wide, 1e-6) * radius)) ** 2 + (y / (deep * radius)) ** 2 < 1.0
        made = made.filled(tube & (up > first) & (up <= last), AIR_HU)
    mouth = (x / 24.0) ** 2 + ((y + 32.0) / 32.0) ** 2 + ((up - 75.0) / 13.0) ** 2 < 1.0
    made = made.filled(mouth, AIR_HU)
    blurred = ndimage.gaussian_filter(made.hu, 0.6 / image.grid.spacing_mm)
    return noisy(made.with_hu(np.where(up > 0.0, blurred, made.hu)), 12.0)


def stomach(
    image: HardImage, radius_mm: float, hu: float, *, fluid: float = 0.5, place: float = 0.0
) -> HardImage:
    """Return the image with a stomach in place of the base of the left lung, filled with gas over fluid.

    `fluid` is the share of its depth that fluid fills from the back; it lies higher by `place` mm.
    """
    centre = (45.0, -10.0, -75.0 + place)
    wall, inner = (
        ball(image, centre, (1.1 * radius_mm + w, radius_mm + w, radius_mm + w)) for w in (3.0, 0.0)
    )
    made = image.filled(wall & ~of_lobes(image, RIGHT_LUNG) & ~image.lumen, TISSUE_HU)
    y = image.coordinates()[1]
    inner &= wall & ~of_lobes(image, RIGHT_LUNG) & ~image.lumen
    level = centre[1] + radius_mm * (1.0 - 2.0 * fluid)
    return made.filled(inner & (y > level), FLUID_HU).filled(inner & (y <= level), hu)


def scaled(image: HardImage, gain: float) -> HardImage:
    """Return an image whose values are too far from soft tissue, or too near, by a factor."""
    return image.with_hu(20.0 + (image.hu - 20.0) * gain)


def blocked(image: HardImage, hu: float, length_mm: float, *, side: float = 1.0) -> HardImage:
    """Return an image whose left main bronchus, or right one for -1, holds air of some HU over a length."""
    x, y, z = image.coordinates()
    along = (side * x > 9.0) & (side * x < 9.0 + length_mm) & (z < 5.0) & (z > -40.0) & (y < INF)
    return image.with_hu(np.where(image.lumen & along & (image.hu < hu), np.float32(hu), image.hu))


def curved(image: HardImage, side_mm: float, back_mm: float) -> HardImage:
    """Return a chest whose spine is curved to a side and to the back: sections are moved along its height."""
    height = np.linspace(-1.0, 1.0, image.hu.shape[2])
    bow = 1.0 - height**2

    def of(array: Array, fill: float) -> Array:
        made = np.empty_like(array)
        for k in range(array.shape[2]):
            moves = np.rint(bow[k] * np.array([side_mm, back_mm]) / image.grid.spacing_mm[:2]).astype(int)
            made[:, :, k] = ndimage.shift(array[:, :, k], moves, order=0, cval=fill)
        return made

    z = (image.tree_lps[:, 2] - image.grid.lps((0, 0, 0))[2]) / (image.grid.spacing_mm[2] * (len(height) - 1))
    tree = image.tree_lps + (1.0 - (2.0 * z - 1.0) ** 2)[:, None] * np.array([side_mm, back_mm, 0.0])
    return replace(
        image, hu=of(image.hu, AIR_HU), lobes=of(image.lobes, 0), lumen=of(image.lumen, 0), tree_lps=tree
    )


def head(image: HardImage) -> HardImage:
    empty = image.filled(np.ones(image.hu.shape, bool), AIR_HU)
    made = empty.filled(ball(empty, (0, 0, -20), (70, 74, 90)), TISSUE_HU)
    made = made.filled(
        ball(empty, (0, 0, -10), (64, 68, 84)) & ~ball(empty, (0, 0, -10), (58, 62, 78)), 900.0
    )
    for x0, y0, z0, r in ((-22, -45, -40, 14), (22, -45, -40, 14), (0, -40, -45, 10), (0, -20, -85, 11)):
        made = made.filled(ball(empty, (x0, y0, z0), (r, r, 1.6 * r)), AIR_HU)
    return made


def without_chest(image: HardImage) -> HardImage:
    x, y, z = image.coordinates()
    return image.filled(((x / 100.0) ** 2 + (y / 70.0) ** 2 < 1.0) & (z < INF), TISSUE_HU)


def pelvis(image: HardImage) -> HardImage:
    made = without_chest(image)
    _, _, z = made.coordinates()
    x, y, _ = made.coordinates()
    return made.filled((np.hypot(x, y - 40.0) < 13.0) & (np.abs(z) < 45.0), AIR_HU)


def streaks(image: HardImage) -> HardImage:
    metal = ball(image, (30.0, 20.0, -40.0), 6.0)
    x, y, z = image.coordinates()
    angle = np.arctan2(y - 20.0, x - 30.0)
    streak = 350.0 * np.sign(np.sin(13.0 * angle)) * (np.abs(z + 40.0) < 6.0)
    return image.with_hu(image.hu + streak).filled(metal, 3071.0)


def rings(image: HardImage, height_hu: float) -> HardImage:
    x, y, z = image.coordinates()
    return image.with_hu(image.hu + height_hu * np.sin(2.0 * np.hypot(x, y)) * (z < INF))


def moved(image: HardImage) -> HardImage:
    """Return an image of a patient who breathed: two positions 8 mm apart, mixed."""
    steps = round(8.0 / float(image.grid.spacing_mm[2]))
    return image.with_hu(0.5 * (image.hu + np.roll(image.hu, steps, axis=2)))


def contrast(image: HardImage) -> HardImage:
    heart = ball(image, (17.0, -19.0, -55.0), (36.0, 26.0, 32.0)) & (image.hu > 0.0)
    return image.filled(heart, 320.0)


def blanket(image: HardImage) -> HardImage:
    return tabled(image, clothes=True)


def pet(image: HardImage) -> HardImage:
    return resampled(belly(tabled(image, arms=True), AIR_HU), (1.4, 1.4, 3.0))


def scattered(image: HardImage, added_hu: float = 35.0) -> HardImage:
    """Return an image in which scatter raises the air in the airways, as in real CTs."""
    return image.with_hu(image.hu + added_hu * image.lumen)


def shifted(image: HardImage, shift: float, *, clip: bool = False) -> HardImage:
    return image.with_hu(np.maximum(image.hu + shift, -1024.0 if clip else -2000.0))
