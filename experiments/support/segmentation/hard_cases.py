"""The suite of wrong and hard inputs: what a segmentation must get right, warn of, or refuse."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from anatomy.lobes import LEFT_LOWER, RIGHT_LOWER, RIGHT_UPPER
from experiments.support.segmentation.hard_changes import (
    INF,
    abdomen,
    belly,
    blanket,
    blocked,
    contrast,
    curved,
    head,
    moved,
    pelvis,
    pet,
    pneumothorax,
    rings,
    scaled,
    scattered,
    shifted,
    solid,
    stomach,
    streaks,
    throat,
    with_lung_hu,
)
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

MISSING = "missing (in|at) the"
"""How lung is said to be missing."""


def _cases() -> list[HardCase]:
    axes = "front to back|upside down|mirrored|one lung"
    no_chest = "trachea|no lung|chest|bronch"
    found: list[HardCase] = []

    def add(
        group: str, name: str, make: Callable[[HardImage], HardImage], words: str = "", **more: Any
    ) -> None:
        found.append(HardCase(name=name, group=group, make=make, words=words, **more))

    add("axes", "as it is", lambda i: i, never=MISSING)
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
    add("pose", "tilted sideways by 12 degrees", lambda i: rotated(i, 12.0, (0, 2)), never=MISSING)
    add("pose", "tilted to the other side by 8 degrees", lambda i: rotated(i, -8.0, (0, 2)), never=MISSING)
    add("pose", "nodding by 15 degrees", lambda i: rotated(i, 15.0, (1, 2)), never=MISSING)
    add(
        "pose",
        "lying on the belly, on a table",
        lambda i: turned(tabled(i, prone=True), (0, 1, 2), (0, 1), header=True),
    )
    add("around", "table of foam", tabled)
    add("around", "table and arms", lambda i: tabled(i, arms=True))
    add("around", "table, arms and clothes", lambda i: tabled(i, arms=True, clothes=True))
    add("around", "blanket", blanket)
    add("around", "CT of a PET: table, arms, belly, 3 mm", pet, "thick|3.0 mm")
    add("around", "belly with gas below the chest", lambda i: belly(i, AIR_HU))
    add("around", "belly with stool below the chest", lambda i: belly(i, -700.0))
    add(
        "around",
        "stomach bubble below the diaphragm",
        lambda i: i.filled(ball(i, (50, -20, -110), (28, 25, 12)) & ~i.lung, AIR_HU),
    )
    for name, hu in (("gas", AIR_HU), ("stool", -700.0)):
        add(
            "part",
            f"abdomen with bases of the lungs, bowel with {name}",
            lambda i, h=hu: abdomen(i, h),
            no_chest,
            refuse=True,
        )
        add(
            "part",
            f"abdomen, bowel with {name}",
            lambda i, h=hu: abdomen(i, h, below=-112.0),
            no_chest,
            refuse=True,
        )
    add("part", "head", head, no_chest, refuse=True)
    add("part", "pelvis", pelvis, no_chest, refuse=True)
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
        add("shift", f"{shift:+d} HU", lambda i, s=shift: shifted(i, s), "HU")
    for shift in (-60, 60):
        add(
            "shift",
            f"{shift:+d} HU, scatter in the trachea",
            lambda i, s=shift: scattered(shifted(i, s)),
            "HU",
        )
    add("shift", "-60 HU, cut at -1024", lambda i: shifted(i, -60.0, clip=True), "HU")
    for extra in (20, 40, 60, 80):
        add("noise", f"{extra} HU more", lambda i, e=extra: noisy(i, e), "noise")
    add("noise", "40 HU, correlated over a voxel", lambda i: noisy(i, 40.0, 1.0), "noise")
    add(
        "noise",
        "low dose of a thin lung: 40 HU, lung at -950",
        lambda i: noisy(with_lung_hu(i, -90.0), 40.0),
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
    add("lung", "thin, -950 HU", lambda i: with_lung_hu(i, -90.0), "thin|dens")
    add("lung", "after breathing out, -700 HU", lambda i: with_lung_hu(i, 160.0), "dens")
    add("lung", "dense, -550 HU", lambda i: with_lung_hu(i, 310.0), "dens")
    add(
        "lung",
        "left one filled with fluid",
        lambda i: solid(i, LEFT_LUNG, FLUID_HU, airways=False),
        "one lung|no left lung",
        refuse=True,
    )
    add(
        "lung",
        "left one filled with fluid, accepted",
        lambda i: solid(i, LEFT_LUNG, FLUID_HU, airways=False),
        "one lung|no left lung",
        accepted=("one-lung",),
    )
    add(
        "lung",
        "right one taken out",
        lambda i: solid(i, RIGHT_LUNG, FLUID_HU, airways=False),
        "one lung|no right lung",
        refuse=True,
    )
    add(
        "lung",
        "right one taken out, accepted",
        lambda i: solid(i, RIGHT_LUNG, FLUID_HU, airways=False),
        "one lung|no right lung",
        accepted=("one-lung",),
    )
    add(
        "lung",
        "right lower lobe solid",
        lambda i: solid(i, (RIGHT_LOWER,), TISSUE_HU, airways=False),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "left lower lobe solid, airways open",
        lambda i: solid(i, (LEFT_LOWER,), TISSUE_HU, airways=True),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "right upper lobe solid, airways open",
        lambda i: solid(i, (RIGHT_UPPER,), TISSUE_HU, airways=True),
        "solid|missing",
        warn=True,
    )
    add(
        "lung",
        "fluid at the back of both",
        lambda i: i.filled(i.lung & (i.coordinates()[1] > 25.0), FLUID_HU),
        "missing at the back of the (left|right) lung",
        warn=True,
    )
    for side, lobes in (("both", (*RIGHT_LUNG, *LEFT_LUNG)), ("right", RIGHT_LUNG)):
        add(
            "lung",
            f"base solid: {side}",
            lambda i, k=lobes: i.filled(of_lobes(i, k) & (i.coordinates()[2] < -60.0), TISSUE_HU),
            "missing at the base of the right lung|missing in the lower part at the back of the right",
            warn=True,
        )
    add(
        "lung",
        "fluid at the back of the right one",
        lambda i: i.filled(of_lobes(i, RIGHT_LUNG) & (i.coordinates()[1] > 25.0), FLUID_HU),
        "missing",
        warn=True,
    )
    add("lung", "pneumothorax of 15 mm", lambda i: pneumothorax(i, 15.0), "gas|pneumothorax", warn=True)
    add("lung", "pneumothorax of 30 mm", lambda i: pneumothorax(i, 30.0), "gas|pneumothorax", warn=True)
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
    add("scan", "contrast medium", contrast)
    add("scan", "metal with streaks", streaks, "metal|noise")
    add("scan", "rings of 40 HU", lambda i: rings(i, 40.0), "noise|rings")
    add("scan", "breathing while scanned", moved, "blurred by breathing")
    found += [*_throats(), *_gas(), *_bronchi(), *_scales(), *_spines(), *_bases()]
    return found


def _throats() -> Iterator[HardCase]:
    """Yield chests with neck and head: open and closed glottis, upright and leaning, and much noise."""
    for share in (0.0, 0.3, 0.5, 0.56, 0.61, 0.66, 0.75, 0.9):
        for lean in (0.0, 25.0):
            yield HardCase(
                name=f"glottis of {share:.0%} of the trachea, neck leaning by {lean:g} mm",
                group="throat",
                make=lambda i, s=share, m=lean: throat(i, s, lean_mm=m),
                never=MISSING,
            )
    for extra in (20.0, 40.0):
        for share in (0.56, 0.66):
            yield HardCase(
                name=f"glottis of {share:.0%}, {extra:g} HU more noise",
                group="throat",
                make=lambda i, s=share, e=extra: noisy(throat(i, s), e),
                words="noise",
            )
    for mm in (2.0, 3.0, 5.0):
        yield HardCase(
            name=f"glottis of 61%, slices of {mm:g} mm",
            group="throat",
            make=lambda i, m=mm: resampled(throat(i, 0.61), (0.8, 0.8, m)),
            words="mm apart",
            thick=mm > 3.0,
        )


def _gas() -> Iterator[HardCase]:
    """Yield gas beside the lung, from pure air to that of a trachea which scatter raises."""
    for hu, scatter in ((-1000, 0), (-985, 0), (-975, 30), (-966, 57), (-945, 57)):
        for depth in (12.0, 20.0, 30.0):
            yield HardCase(
                name=f"pneumothorax of {depth:g} mm at {hu} HU, trachea at {-1000 + scatter}",
                group="gas",
                make=lambda i, h=hu, s=scatter, d=depth: pneumothorax(scattered(i, s), d, h),
                words="pneumothorax",
                warn=True,
            )
        for radius, fluid in ((28.0, 0.2), (28.0, 0.5), (38.0, 0.4)):
            yield HardCase(
                name=f"stomach of {radius:g} mm with {fluid:.0%} fluid, gas at {hu} HU",
                group="gas",
                make=lambda i, h=hu, s=scatter, r=radius, f=fluid: stomach(scattered(i, s), r, h, fluid=f),
                words="stomach|missing",
            )
    for extra in (20.0, 40.0, 60.0):
        yield HardCase(
            name=f"pneumothorax of 20 mm at -975 HU, {extra:g} HU more noise",
            group="gas",
            make=lambda i, e=extra: noisy(pneumothorax(scattered(i, 30), 20.0, -975), e),
            words="pneumothorax",
            warn=True,
        )
        yield HardCase(
            name=f"stomach of 38 mm, gas at -966 HU, {extra:g} HU more noise",
            group="gas",
            make=lambda i, e=extra: noisy(stomach(scattered(i, 57), 38.0, -966), e),
            words="stomach|missing|noise",
        )


def _bronchi() -> Iterator[HardCase]:
    """Yield main bronchi with a stretch of thin mucus or blur, which is no wall."""
    for hu in (-920.0, -882.0, -850.0, -800.0):
        for length in (6.0, 14.0, 25.0):
            for side, name in ((1.0, "left"), (-1.0, "right")):
                yield HardCase(
                    name=f"{length:g} mm of the {name} main bronchus at {hu:g} HU",
                    group="bronchus",
                    make=lambda i, h=hu, n=length, s=side: blocked(i, h, n, side=s),
                    words="main bronchus|stops early|airway ends",
                )


def _scales() -> Iterator[HardCase]:
    """Yield scales that are wrong by a factor, and great shifts."""
    for factor in (0.92, 0.96, 1.04, 1.07, 1.1):
        yield HardCase(
            name=f"differences from soft tissue {factor:g} times as great",
            group="scale",
            make=lambda i, f=factor: scaled(i, f),
            words="HU",
        )
    for shift in (-96.0, 96.0):
        yield HardCase(
            name=f"{shift:+.0f} HU", group="shift", make=lambda i, s=shift: shifted(i, s), words="HU"
        )


def _spines() -> Iterator[HardCase]:
    """Yield chests whose spine is curved to a side, to the back, or both."""
    for side, back in ((8.0, 0.0), (-8.0, 0.0), (15.0, 0.0), (-15.0, 0.0), (0.0, 10.0), (10.0, 8.0)):
        yield HardCase(
            name=f"spine curved by {side:g} mm to a side and {back:g} mm to the back",
            group="pose",
            make=lambda i, s=side, b=back: curved(i, s, b),
            words="cut off",
            never=MISSING,
        )


def _bases() -> Iterator[HardCase]:
    """Yield lungs of which the back of one base is solid, with open airways and without."""
    for lobes, name in ((RIGHT_LUNG, "right"), (LEFT_LUNG, "left")):
        for front in (5.0, 20.0):
            for airways in (True, False):
                yield HardCase(
                    name=f"{name} base solid behind {front:g} mm, airways {'open' if airways else 'gone'}",
                    group="lung",
                    make=lambda i, k=lobes, f=front, a=airways: i.filled(
                        of_lobes(i, k)
                        & (i.coordinates()[1] > f)
                        & (i.coordinates()[2] < -55.0)
                        & ~(a & i.lumen),
                        TISSUE_HU,
                    ),
                    words=MISSING,
                    warn=True,
                )


CASES: Mapping[str, HardCase] = MappingProxyType({f"{case.group}: {case.name}": case for case in _cases()})
