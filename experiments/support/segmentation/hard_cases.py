"""The suite of wrong and hard inputs: what a segmentation must get right, warn of, or refuse."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from scipy import ndimage

from anatomy.lobes import LEFT_LOWER, RIGHT_LOWER, RIGHT_UPPER
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
    rotated,
    tabled,
    turned,
)
from experiments.support.segmentation.hard_runs import LEFT_LUNG, RIGHT_LUNG, HardCase, of_lobes

INF = np.inf


def _solid(image: HardImage, lobes: tuple[int, ...], hu: float, *, airways: bool) -> HardImage:
    """Fill lobes; their airways stay open, or are filled as well."""
    return image.filled(of_lobes(image, lobes) & ~(image.lumen if airways else False), hu)


def _lung_hu(image: HardImage, shift: float) -> HardImage:
    lung = ndimage.gaussian_filter((image.lung & ~image.lumen).astype(np.float32), 0.6)
    share = np.clip((-300.0 - image.hu) / 400.0, 0.0, 1.0) * lung
    return image.with_hu(image.hu + shift * share)


def _pneumothorax(image: HardImage, depth_mm: float) -> HardImage:
    right = of_lobes(image, RIGHT_LUNG)
    depth = ndimage.distance_transform_edt(right, sampling=image.grid.spacing_mm)
    x, y, z = image.coordinates()
    return image.filled(right & (depth < depth_mm) & (x < -35.0) & (z > -60.0) & (y < 40.0), AIR_HU)


def _abdomen(image: HardImage, hu: float, *, below: float = -55.0) -> HardImage:
    """Return the image below a height, with 200 mm of abdomen that holds bowel of some HU."""
    part = cropped(image, (-INF, -INF, -INF), (INF, INF, below))
    return _belly(part, hu)


def _belly(part: HardImage, hu: float) -> HardImage:
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


def _head(image: HardImage) -> HardImage:
    empty = image.filled(np.ones(image.hu.shape, bool), AIR_HU)
    made = empty.filled(ball(empty, (0, 0, -20), (70, 74, 90)), TISSUE_HU)
    made = made.filled(
        ball(empty, (0, 0, -10), (64, 68, 84)) & ~ball(empty, (0, 0, -10), (58, 62, 78)), 900.0
    )
    for x0, y0, z0, r in ((-22, -45, -40, 14), (22, -45, -40, 14), (0, -40, -45, 10), (0, -20, -85, 11)):
        made = made.filled(ball(empty, (x0, y0, z0), (r, r, 1.6 * r)), AIR_HU)
    return made


def _without_chest(image: HardImage) -> HardImage:
    x, y, z = image.coordinates()
    return image.filled(((x / 100.0) ** 2 + (y / 70.0) ** 2 < 1.0) & (z < INF), TISSUE_HU)


def _pelvis(image: HardImage) -> HardImage:
    made = _without_chest(image)
    _, _, z = made.coordinates()
    x, y, _ = made.coordinates()
    return made.filled((np.hypot(x, y - 40.0) < 13.0) & (np.abs(z) < 45.0), AIR_HU)


def _streaks(image: HardImage) -> HardImage:
    metal = ball(image, (30.0, 20.0, -40.0), 6.0)
    x, y, z = image.coordinates()
    angle = np.arctan2(y - 20.0, x - 30.0)
    streak = 350.0 * np.sign(np.sin(13.0 * angle)) * (np.abs(z + 40.0) < 6.0)
    return image.with_hu(image.hu + streak).filled(metal, 3071.0)


def _rings(image: HardImage, height_hu: float) -> HardImage:
    x, y, z = image.coordinates()
    return image.with_hu(image.hu + height_hu * np.sin(2.0 * np.hypot(x, y)) * (z < INF))


def _moved(image: HardImage) -> HardImage:
    """Return an image of a patient who breathed: two positions 8 mm apart, mixed."""
    steps = round(8.0 / float(image.grid.spacing_mm[2]))
    return image.with_hu(0.5 * (image.hu + np.roll(image.hu, steps, axis=2)))


def _contrast(image: HardImage) -> HardImage:
    heart = ball(image, (17.0, -19.0, -55.0), (36.0, 26.0, 32.0)) & (image.hu > 0.0)
    return image.filled(heart, 320.0)


def _blanket(image: HardImage) -> HardImage:
    return tabled(image, clothes=True)


def _pet(image: HardImage) -> HardImage:
    return resampled(_belly(tabled(image, arms=True), AIR_HU), (1.4, 1.4, 3.0))


def _shifted(image: HardImage, shift: float, *, clip: bool = False) -> HardImage:
    return image.with_hu(np.maximum(image.hu + shift, -1024.0 if clip else -2000.0))


def _cases() -> list[HardCase]:
    axes = "front to back|upside down|mirrored|one lung"
    no_chest = "trachea|no lung|chest|bronch"
    found: list[HardCase] = []

    def add(
        group: str, name: str, make: Callable[[HardImage], HardImage], words: str = "", **more: bool
    ) -> None:
        found.append(HardCase(name=name, group=group, make=make, words=words, **more))

    add("axes", "as it is", lambda i: i)
    for name, order, flips in (
        ("turned by 180 degrees about the body", (0, 1, 2), (0, 1)),
        ("turned by 180 degrees, head first to feet first", (0, 1, 2), (1, 2)),
        ("turned by 90 degrees about the body", (1, 0, 2), (0,)),
        ("stored as coronal slices", (0, 2, 1), (1,)),
        ("stored as sagittal slices", (1, 2, 0), ()),
    ):
        add("axes", f"{name}, header right", lambda i, o=order, f=flips: turned(i, o, f, header=True))
    for name, order, flips in (
        ("mirrored left to right", (0, 1, 2), (0,)),
        ("mirrored front to back", (0, 1, 2), (1,)),
        ("mirrored top to bottom", (0, 1, 2), (2,)),
        ("turned by 180 degrees about the body", (0, 1, 2), (0, 1)),
        ("turned by 180 degrees from side to side", (0, 1, 2), (0, 2)),
        ("turned by 180 degrees, nodding", (0, 1, 2), (1, 2)),
        ("slices taken for coronal ones", (0, 2, 1), ()),
        ("slices taken for sagittal ones", (2, 1, 0), ()),
        ("rows and columns exchanged", (1, 0, 2), ()),
    ):
        add(
            "header",
            name,
            lambda i, o=order, f=flips: turned(i, o, f, header=False),
            f"{axes}|{no_chest}",
            refuse=True,
        )
    add("pose", "rolled by 10 degrees", lambda i: rotated(i, 10.0, (0, 1)))
    add("pose", "rolled by 25 degrees", lambda i: rotated(i, 25.0, (0, 1)))
    add("pose", "tilted sideways by 12 degrees", lambda i: rotated(i, 12.0, (0, 2)))
    add("pose", "nodding by 15 degrees", lambda i: rotated(i, 15.0, (1, 2)))
    add(
        "pose",
        "lying on the belly, on a table",
        lambda i: turned(tabled(i, prone=True), (0, 1, 2), (0, 1), header=True),
    )
    add("around", "table of foam", tabled)
    add("around", "table and arms", lambda i: tabled(i, arms=True))
    add("around", "table, arms and clothes", lambda i: tabled(i, arms=True, clothes=True))
    add("around", "blanket", _blanket)
    add("around", "CT of a PET: table, arms, belly, 3 mm", _pet, "thick|3.0 mm")
    add("around", "belly with gas below the chest", lambda i: _belly(i, AIR_HU))
    add("around", "belly with stool below the chest", lambda i: _belly(i, -700.0))
    add(
        "around",
        "stomach bubble below the diaphragm",
        lambda i: i.filled(ball(i, (50, -20, -110), (28, 25, 12)) & ~i.lung, AIR_HU),
    )
    for name, hu in (("gas", AIR_HU), ("stool", -700.0)):
        add(
            "part",
            f"abdomen with bases of the lungs, bowel with {name}",
            lambda i, h=hu: _abdomen(i, h),
            no_chest,
            refuse=True,
        )
        add(
            "part",
            f"abdomen, bowel with {name}",
            lambda i, h=hu: _abdomen(i, h, below=-112.0),
            no_chest,
            refuse=True,
        )
    add("part", "head", _head, no_chest, refuse=True)
    add("part", "pelvis", _pelvis, no_chest, refuse=True)
    add(
        "part",
        "neck and tops of the lungs",
        lambda i: padded(cropped(i, (-INF, -INF, 25.0), (INF, INF, INF)), (0, 0, 0), (0, 0, 60)),
        f"{no_chest}|cut|small",
        refuse=True,
    )
    add("scale", "no offset of 1024", lambda i: i.with_hu(i.hu + 1024.0), "offset", refuse=True)
    add(
        "scale",
        "offset twice",
        lambda i: i.with_hu(np.maximum(i.hu - 1000.0, -1024.0)),
        f"tissue|{no_chest}",
        refuse=True,
    )
    add("scale", "inverted", lambda i: i.with_hu(-i.hu), f"air|offset|tissue|{no_chest}", refuse=True)
    add(
        "scale",
        "grey levels 0 to 255",
        lambda i: i.with_hu(np.clip((i.hu + 1350.0) / 1500.0 * 255.0, 0, 255)),
        "offset",
        refuse=True,
    )
    add(
        "scale",
        "grey levels -1000 to 0",
        lambda i: i.with_hu(np.clip(i.hu, -1000, 0)),
        "HU|tissue|shift|scale",
        refuse=False,
    )
    add("scale", "half of every value", lambda i: i.with_hu(i.hu * 0.5 - 0.0), f"air|HU|{no_chest}")
    add(
        "scale",
        "MR: tissue bright, air 0",
        lambda i: i.with_hu(np.clip(i.hu + 1000.0, 0, 1100) * 0.4),
        "offset",
        refuse=True,
    )
    add(
        "scale",
        "PET: uptake 0 to 20",
        lambda i: i.with_hu(np.clip(i.hu + 1000.0, 0, 1000) * 0.02),
        "offset",
        refuse=True,
    )
    for shift in (-60, -30, -15, 15, 30, 60):
        add("shift", f"{shift:+d} HU", lambda i, s=shift: _shifted(i, s), "HU")
    add("shift", "-60 HU, cut at -1024", lambda i: _shifted(i, -60.0, clip=True), "HU")
    for extra in (20, 40, 60, 80):
        add("noise", f"{extra} HU more", lambda i, e=extra: noisy(i, e), "noise")
    add("noise", "40 HU, correlated over a voxel", lambda i: noisy(i, 40.0, 1.0), "noise")
    add(
        "noise",
        "low dose of a thin lung: 40 HU, lung at -950",
        lambda i: noisy(_lung_hu(i, -90.0), 40.0),
        "noise|thin",
    )
    for mm, plane in ((0.7, 0.7), (1.0, 1.0), (2.0, 0.8), (2.5, 0.8), (3.0, 0.8), (5.0, 0.8)):
        add(
            "slices",
            f"{mm:g} mm, pixels of {plane:g} mm",
            lambda i, m=mm, p=plane: resampled(i, (p, p, m)),
            "mm apart|slices",
            thick=mm > 3,
        )
    add("cut", "sides of the lungs", lambda i: cropped(i, (-75, -INF, -INF), (75, INF, INF)), "cut off")
    add(
        "cut",
        "sides, front and back",
        lambda i: cropped(i, (-75, -45, -INF), (75, 45, INF)),
        "cut off|100 mm",
    )
    add("cut", "upper half of the trachea", lambda i: cropped(i, (-INF, -INF, -INF), (INF, INF, 30)), "cut")
    add(
        "cut",
        "all above the carina",
        lambda i: cropped(i, (-INF, -INF, -INF), (INF, INF, -3)),
        f"{no_chest}|cut",
    )
    add(
        "cut", "lower third of the lungs", lambda i: cropped(i, (-INF, -INF, -55), (INF, INF, INF)), "cut off"
    )
    add(
        "cut",
        "one side",
        lambda i: cropped(i, (-12, -INF, -INF), (INF, INF, INF)),
        "one lung|cut off",
        refuse=True,
    )
    add(
        "cut",
        "one side, accepted",
        lambda i: cropped(i, (-12, -INF, -INF), (INF, INF, INF)),
        "one lung|cut off",
        accepted=("one-lung",),
    )
    add("cut", "a lesion alone", lambda i: cropped(i, (-INF, -50, -60), (-12, 55, 45)), no_chest, refuse=True)
    add("lung", "thin, -950 HU", lambda i: _lung_hu(i, -90.0), "thin|dens")
    add("lung", "after breathing out, -700 HU", lambda i: _lung_hu(i, 160.0), "dens")
    add("lung", "dense, -550 HU", lambda i: _lung_hu(i, 310.0), "dens")
    add(
        "lung",
        "left one filled with fluid",
        lambda i: _solid(i, LEFT_LUNG, FLUID_HU, airways=False),
        "one lung|no left lung",
        refuse=True,
    )
    add(
        "lung",
        "left one filled with fluid, accepted",
        lambda i: _solid(i, LEFT_LUNG, FLUID_HU, airways=False),
        "one lung|no left lung",
        accepted=("one-lung",),
    )
    add(
        "lung",
        "right one taken out",
        lambda i: _solid(i, RIGHT_LUNG, FLUID_HU, airways=False),
        "one lung|no right lung",
        refuse=True,
    )
    add(
        "lung",
        "right one taken out, accepted",
        lambda i: _solid(i, RIGHT_LUNG, FLUID_HU, airways=False),
        "one lung|no right lung",
        accepted=("one-lung",),
    )
    add(
        "lung",
        "right lower lobe solid",
        lambda i: _solid(i, (RIGHT_LOWER,), TISSUE_HU, airways=False),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "left lower lobe solid, airways open",
        lambda i: _solid(i, (LEFT_LOWER,), TISSUE_HU, airways=True),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "right upper lobe solid, airways open",
        lambda i: _solid(i, (RIGHT_UPPER,), TISSUE_HU, airways=True),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "fluid at the back of both",
        lambda i: i.filled(i.lung & (i.coordinates()[1] > 25.0), FLUID_HU),
    )
    add(
        "lung",
        "fluid at the back of the right one",
        lambda i: i.filled(of_lobes(i, RIGHT_LUNG) & (i.coordinates()[1] > 25.0), FLUID_HU),
        "missing",
        warn=True,
    )
    add("lung", "pneumothorax of 15 mm", lambda i: _pneumothorax(i, 15.0), "gas|pneumothorax", warn=True)
    add("lung", "pneumothorax of 30 mm", lambda i: _pneumothorax(i, 30.0), "gas|pneumothorax", warn=True)
    add(
        "lung",
        "bulla of 50 mm",
        lambda i: i.filled(ball(i, (-50, -10, 20), 25.0) & i.lung, -990.0, lung=True),
        "gas|bulla",
        warn=True,
    )
    add(
        "lung",
        "mass of 60 mm",
        lambda i: i.filled(ball(i, (50, -5, 10), 30.0) & i.lung, TISSUE_HU, lung=True),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "nodule of 20 mm",
        lambda i: i.filled(ball(i, (-50, 0, 10), 10.0) & i.lung, TISSUE_HU, lung=True),
    )
    add("scan", "contrast medium", _contrast)
    add("scan", "metal with streaks", _streaks, "metal|noise")
    add("scan", "rings of 40 HU", lambda i: _rings(i, 40.0), "noise|rings")
    add("scan", "breathing while scanned", _moved, "blurred by breathing")
    return found


CASES: Mapping[str, HardCase] = MappingProxyType({f"{case.group}: {case.name}": case for case in _cases()})
