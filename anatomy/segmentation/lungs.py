"""Both lungs in a CT of the chest: filled, apart from each other, without trachea and main bronchi."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, Int, Int32, Mask
from anatomy.grid import Grid, Volume, freeze_arrays
from anatomy.morphology import bounds, closed, grown_by_one, largest_piece, near, window, without_holes
from anatomy.segmentation.central_airway import CentralAirway, central_airways
from anatomy.segmentation.coarse import CoarseCt
from anatomy.segmentation.input import GREATEST_OFFSET_HU, Scale, air_in_hu, air_offset_hu, offset_around_hu
from anatomy.segmentation.labels import LEFT, RIGHT, sides_from_right
from anatomy.segmentation.lung_pieces import gas_pockets, lung_pieces, notches, outside_air

Progress = Callable[[str], None]

FIRST_THRESHOLD_HU = -500.0
"""Half-way between air and tissue: lungs of any CT are below it."""
TISSUE_HU = (-150.0, 250.0)
"""Soft tissue: its median is one side of the threshold, that of the lung the other."""

CLOSING_MM = 5.0
"""Ball of the closing: vessels, bronchi and notches of up to 10 mm across become lung."""
WALL_MM = 2.0
"""Tissue this close to the lumen of trachea and main bronchi is their wall, not lung."""


@frozen_record
class Lungs:
    """Both lungs of a CT.

    Args:
        left, right ((ni, nj, nk) bool): The patient's left and right lung on the grid of the CT, filled:
            vessels and small airways belong to them, trachea and main bronchi with their walls do not.  They
            share no voxel.
        trachea_seed_ijk ((3,) int64): A voxel in the air of the trachea.
        central_airway ((ni, nj, nk) bool): Lumen of trachea and main bronchi, roughly.
        threshold_hu: What was taken for lung lies below.
        scale: How the values of the CT become Hounsfield units.
    """

    left: Mask
    right: Mask
    trachea_seed_ijk: Int
    central_airway: Mask
    threshold_hu: float
    scale: Scale = Scale()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze_arrays(self, "left", "right", "trachea_seed_ijk", "central_airway")

    @property
    def mask(self) -> Mask:
        """Both lungs."""
        return self.left | self.right


def segment_lungs(
    ct: Volume, *, ex_vivo: bool = False, seed_lps: ArrayLike | None = None, progress: Progress | None = None
) -> Lungs:
    """Segment both lungs of a CT in Hounsfield units by region growing and closing.

    With `ex_vivo` the image shows an inflated lung in air, not a patient.  A point in the trachea, ex vivo in
    the main bronchus, `(3,)` LPS mm, is found by itself if it is not given.  Raises AnatomyError if there is
    no trachea or no lung.
    """
    tell = progress or (lambda _step: None)
    tell("lungs: coarse image")
    coarse = CoarseCt.of(ct)
    seed = None if seed_lps is None else np.asarray(seed_lps, dtype=np.float64)
    added: tuple[Mask | None, Mask | None]
    scale = Scale()
    gas = None
    if ex_vivo:
        from anatomy.segmentation.lung_pieces import coarse_lung_ex_vivo

        threshold, airway, sides, warnings = coarse_lung_ex_vivo(coarse, seed)
        added = (None, None)
    else:
        tell("lungs: trachea")
        coarse, outside, scale, airways = _in_hounsfield(coarse, seed)
        ct = scale.image(ct)
        tell("lungs: left and right")
        threshold = _lung_threshold(coarse.hu, outside)
        airway, tissue = _airway_and_lung(coarse, outside, airways, threshold)
        gas, tissue = gas_pockets(coarse, tissue, air_in_hu(coarse, airway.grown))
        sides, warnings = _coarse_sides(coarse, tissue, airway)
        warnings = (*scale.warnings(), *warnings)
        if gas.any():
            place = ", ".join(f"{x:.0f}" for x in coarse.grid.lps(np.argwhere(gas).mean(axis=0)))
            said = (
                f"{np.count_nonzero(gas) * coarse.voxel_ml:.0f} ml of gas without tissue lie in the lungs, "
                f"about LPS ({place}) mm: a pneumothorax, a bulla, or stomach or bowel beside the lung. It "
                "is no lung, and no needle is steered in it; a lung beside a pneumothorax lies elsewhere "
                "once it is drained."
            )
            warnings = (*warnings, said)
        tell("lungs: nodules on the pleura")
        added = notches(coarse, sides == RIGHT, sides == LEFT, CLOSING_MM)
    tell("lungs: boundary")
    right, left = (
        _fine_lung(ct, coarse, sides == side, notch, airway, threshold, gas)
        for side, notch in zip((RIGHT, LEFT), added, strict=True)
    )
    return _parted(ct, coarse, airway, right, left, threshold, scale, (*airway.warnings, *warnings))


def lungs_given(ct: Volume, left: Mask, right: Mask, *, seed_lps: ArrayLike | None = None) -> Lungs:
    """Make `Lungs` of masks from elsewhere: closed and filled like our own, and with our own trachea.

    Raises AnatomyError if there is no trachea.
    """
    seed = None if seed_lps is None else np.asarray(seed_lps, dtype=np.float64)
    coarse, _, scale, airways = _in_hounsfield(CoarseCt.of(ct), seed)
    ct, airway = scale.image(ct), next(airways)
    main = _on_ct(coarse, near(airway.main, WALL_MM, coarse.spacing_mm))
    left, right = (_filled(side, ct.grid) & ~main for side in (left, right))
    said = (*scale.warnings(), *airway.warnings)
    return _parted(ct, coarse, airway, right, left, FIRST_THRESHOLD_HU, scale, said)


def _filled(mask: Mask, grid: Grid) -> Mask:
    box = window(*bounds(mask, np.ceil(2.0 * CLOSING_MM / grid.spacing_mm).astype(np.int64)))
    filled = np.array(mask, order="F")
    if mask.any():
        filled[box] = without_holes(closed(np.asfortranarray(mask[box]), CLOSING_MM, grid.spacing_mm))
    return filled


def _on_ct(coarse: CoarseCt, mask: Mask) -> Mask:
    whole = np.zeros(coarse.fine_shape, dtype=np.bool_, order="F")
    low, high = coarse.box_in_ct(mask, 0.0)
    whole[window(low, high)] = coarse.to_ct(mask, low, high)
    return whole


def _lung_threshold(hu: Float32, outside: Mask) -> float:
    """Return the middle between the median of the lung and that of soft tissue, in HU."""
    lung = hu[(hu < FIRST_THRESHOLD_HU) & ~outside]
    tissue = hu[(hu > TISSUE_HU[0]) & (hu < TISSUE_HU[1])]
    if not lung.size or not tissue.size:
        raise AnatomyError(
            "The image holds no air inside a body",
            expected="a CT of the chest with both lungs",
            remedy="Choose the series of the chest; for an inflated lung outside a body use --ex-vivo",
        )
    middle = 0.5 * (float(np.median(lung)) + float(np.median(tissue)))
    # The middle between lung and tissue of healthy and of dense lungs lies in this range.
    return float(np.clip(middle, -600.0, -300.0))


def _in_hounsfield(
    coarse: CoarseCt, seed: Float | None
) -> tuple[CoarseCt, Mask, Scale, Iterator[CentralAirway]]:
    """Return the coarse CT in Hounsfield units, the air around the patient, how its values became them, and
    what may be its `central_airways`.

    Raises AnatomyError if there is no trachea.
    """
    outside = outside_air(coarse.hu, coarse.hu < FIRST_THRESHOLD_HU)
    airways = central_airways(coarse, outside, seed)
    try:
        first = next(airways)
        offset = air_offset_hu(coarse, first.grown)
        airways = chain([first], airways)
    except AnatomyError:
        # A shift can hide the trachea from the thresholds it is searched with.
        offset = offset_around_hu(coarse) or 0.0
        if abs(offset) <= GREATEST_OFFSET_HU:
            raise
    scale = Scale.of(coarse, offset)
    if offset:
        coarse = replace(coarse, hu=np.asfortranarray(scale.on(coarse.hu)))
        outside = outside_air(coarse.hu, coarse.hu < FIRST_THRESHOLD_HU)
        airways = central_airways(coarse, outside, seed)
    return coarse, outside, scale, airways


def _airway_and_lung(
    coarse: CoarseCt, outside: Mask, airways: Iterator[CentralAirway], threshold: float
) -> tuple[CentralAirway, Mask]:
    """Return the first central airway that divides and has lungs at it, else the first with lungs."""
    found: list[tuple[CentralAirway, Mask]] = []
    failed: AnatomyError | None = None
    for airway in airways:
        air = (coarse.hu < threshold) & ~outside & ~grown_by_one(airway.grown)
        try:
            found.append((airway, lung_pieces(coarse, air, airway.grown)))
        except AnatomyError as error:
            failed = failed or error
            continue
        if not airway.warnings:
            return found[-1]
    if not found and failed is not None:
        raise failed
    return found[0]


def _coarse_sides(coarse: CoarseCt, tissue: Mask, airway: CentralAirway) -> tuple[Int32, tuple[str, ...]]:
    """Label the right lung 1 and the left lung 2 on coarse voxels; a single one by its side."""
    sides = sides_from_right(tissue, coarse)
    if sides is not None:
        return sides, ()
    centre = float(np.argwhere(tissue)[:, 0].mean())
    side, name = (RIGHT, "right") if centre < airway.seed[0] else (LEFT, "left")
    warning = f"Only one lung was found, or the two could not be told apart; it is taken as the {name} one."
    return np.asfortranarray(tissue * np.int32(side)), (warning,)


def _fine_lung(
    ct: Volume,
    coarse: CoarseCt,
    side: Mask,
    notch: Mask | None,
    airway: CentralAirway,
    threshold: float,
    gas: Mask | None,
) -> Mask:
    """Return one lung on the voxels of the CT: region below the threshold and notches, closed and filled.

    The region may reach one coarse voxel beyond `side`; not so ex vivo, where `notch` is None and the lung
    has air around it.
    """
    lung = np.zeros(ct.grid.shape, dtype=np.bool_, order="F")
    if not side.any():
        return lung
    low, high = coarse.box_in_ct(side, 2.0 * CLOSING_MM)
    box = window(low, high)
    beside = coarse.to_ct(side if notch is None else grown_by_one(side), low, high)
    airways = coarse.to_ct(airway.grown, low, high)
    region = np.asfortranarray(ct.array[box] < threshold)
    region &= beside & ~airways
    if notch is not None:
        region |= coarse.to_ct(notch, low, high)
    region = largest_piece(region)
    filled = without_holes(closed(region, CLOSING_MM, ct.grid.spacing_mm))
    filled &= ~coarse.to_ct(near(airway.main, WALL_MM, coarse.spacing_mm), low, high)
    if gas is not None and gas.any():
        filled &= ~coarse.to_ct(gas, low, high)
    lung[box] = largest_piece(filled)
    return lung


def _parted(
    ct: Volume, coarse: CoarseCt, airway: CentralAirway, right: Mask, left: Mask, threshold: float,
    scale: Scale, said: tuple[str, ...],
) -> Lungs:  # fmt: skip
    """Return the lungs; what both closings filled is of neither: it is the pleura between them."""
    both = right & left
    left, right = left & ~both, right & ~both
    return Lungs(
        left=left,
        right=right,
        trachea_seed_ijk=coarse.ct_voxel(airway.seed),
        central_airway=_on_ct(coarse, airway.main) & (ct.array < threshold),
        threshold_hu=threshold,
        scale=scale,
        warnings=(*said, *_truncation(left | right, ct.grid)),
    )


def _truncation(lung: Mask, grid: Grid) -> tuple[str, ...]:
    """Warn of each face of the image that cuts the lung off."""
    names = (("right", "left"), ("front", "back"), ("lower end", "upper end"))
    found = []
    for axis in range(3):
        direction = grid.lps_from_ijk[:3, axis]
        along = int(np.argmax(np.abs(direction)))
        for end in (0, -1):
            face = lung[tuple(end if a == axis else slice(None) for a in range(3))]
            area_cm2 = np.count_nonzero(face) * grid.voxel_volume_mm3
            area_cm2 /= 100.0 * float(grid.spacing_mm[axis])
            if area_cm2 > 0:
                name = names[along][int((end == -1) == (direction[along] > 0))]
                found.append(f"The lung is cut off at the {name} of the image, over {area_cm2:.1f} cm2.")
    return tuple(found)
