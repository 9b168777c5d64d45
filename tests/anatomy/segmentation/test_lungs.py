"""Lungs against the truth of the synthetic patient, under what scanners and patients do to images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import ndimage

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Grid, Volume
from anatomy.io import read_volume
from anatomy.morphology import closed, distance_mm, without_holes
from anatomy.phantom import LABELS, Phantom, make_phantom
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.central_airway import central_airways
from anatomy.segmentation.coarse import CoarseCt
from anatomy.segmentation.lung_pieces import gas_pockets
from anatomy.segmentation.lungs import CLOSING_MM, Lungs, lungs_given, segment_lungs

LEAST_DICE = 0.98


@pytest.fixture(scope="module")
def patient() -> Phantom:
    """The synthetic patient in its coarsest voxels: nearly every test segments it anew."""
    return make_phantom(seed=3, size="small", spacing_mm=1.75)


@pytest.fixture(scope="module")
def lungs(patient: Phantom) -> Lungs:
    return segment_lungs(patient.ct)


def dice(a: Mask, b: Mask) -> float:
    return float(2 * np.count_nonzero(a & b) / (np.count_nonzero(a) + np.count_nonzero(b)))


def _with(patient: Phantom, hu: Array) -> Volume:
    return Volume(grid=patient.ct.grid, array=np.asarray(hu).astype(np.int16))


def _distance_from(centre: ArrayLike, grid: Grid) -> Float:
    """Distance of every voxel from a voxel, mm."""
    offsets = np.moveaxis(np.indices(grid.shape), 0, -1) - np.asarray(centre)
    return np.asarray(np.linalg.norm(offsets * grid.spacing_mm, axis=-1))


def _sides(patient: Phantom) -> tuple[Mask, Mask]:
    """Left and right lung of the truth: LPS x grows to the left, and the trachea stands between."""
    lung = patient.images.lung.array
    x = patient.ct.grid.lps(np.argwhere(lung))[:, 0]
    left = np.zeros_like(lung)
    left[tuple(np.argwhere(lung)[x > 0].T)] = True
    return left, lung & ~left


def test_both_lungs_are_found_on_their_sides(patient: Phantom, lungs: Lungs) -> None:
    left, right = _sides(patient)
    assert dice(lungs.left, left) >= LEAST_DICE
    assert dice(lungs.right, right) >= LEAST_DICE
    assert not (lungs.left & lungs.right).any()
    assert lungs.warnings == ()


def test_each_lung_is_one_piece_without_holes(lungs: Lungs) -> None:
    for lung in (lungs.left, lungs.right):
        assert ndimage.label(lung)[1] == 1
        assert (without_holes(np.asfortranarray(lung)) == lung).all()


def test_vessels_and_small_airways_belong_to_the_lung(patient: Phantom, lungs: Lungs) -> None:
    inside = patient.images.lung.array
    spacing = patient.ct.grid.spacing_mm
    assert lungs.mask[patient.labels.array == LABELS["nodule"]].all()
    for name in ("artery", "vein", "lumen"):
        structure = inside & (patient.labels.array == LABELS[name])
        # What is wider than the ball of the closing, at the hilum, may stay outside.
        wide = lungs.central_airway if name == "lumen" else distance_mm(structure, spacing) > 0.6 * CLOSING_MM
        narrow = structure & (distance_mm(~wide, spacing) > 2.0 * CLOSING_MM)
        assert np.count_nonzero(narrow & lungs.mask) >= 0.95 * np.count_nonzero(narrow) > 0, name


def test_trachea_and_main_bronchi_are_apart_and_hold_the_seed(patient: Phantom, lungs: Lungs) -> None:
    assert not (lungs.mask & lungs.central_airway).any()
    assert patient.labels.array[tuple(lungs.trachea_seed_ijk)] == LABELS["lumen"]
    truth = patient.labels.array == LABELS["lumen"]
    assert np.count_nonzero(lungs.central_airway & truth) > 0.9 * np.count_nonzero(lungs.central_airway)
    airway = patient.centerlines["airway"]
    main = np.flatnonzero(airway.generation <= 1)
    middles = [airway.points_lps[(airway.branch_start[b] + airway.branch_start[b + 1]) // 2] for b in main]
    at = np.rint(patient.ct.grid.ijk(np.array(middles))).astype(int)
    assert lungs.central_airway[tuple(at.T)].all()


def test_arrays_cannot_be_changed(lungs: Lungs) -> None:
    with pytest.raises(ValueError, match="read-only"):
        lungs.left[0, 0, 0] = True


@pytest.mark.slow
def test_the_result_is_repeatable(patient: Phantom, lungs: Lungs) -> None:
    again = segment_lungs(patient.ct)
    assert (again.left == lungs.left).all()
    assert (again.right == lungs.right).all()
    assert (again.central_airway == lungs.central_airway).all()


_ORDERS = [(2, 0, 1), *(pytest.param(each, marks=pytest.mark.slow) for each in ((0, 1, 2), (1, 2, 0)))]


@pytest.mark.slow
@pytest.mark.parametrize("order", _ORDERS)
def test_the_way_voxels_are_stored_does_not_matter(
    patient: Phantom, lungs: Lungs, order: tuple[int, int, int]
) -> None:
    grid = patient.ct.grid
    matrix = grid.lps_from_ijk.copy()
    matrix[:3, 3] = grid.lps((grid.shape[0] - 1, grid.shape[1] - 1, 0))
    matrix[:3, :2] *= -1
    stored = Grid(shape=tuple(grid.shape[a] for a in order), lps_from_ijk=matrix[:, [*order, 3]])
    array = patient.ct.array[::-1, ::-1].transpose(order).copy()
    turned = segment_lungs(canonical(Volume(grid=stored, array=array)))
    assert (turned.left == lungs.left).all() and (turned.right == lungs.right).all()


@pytest.mark.slow
def test_low_dose_noise_does_not_matter(patient: Phantom) -> None:
    noise = np.random.default_rng(0).normal(0.0, 100.0, patient.ct.array.shape)
    noisy = segment_lungs(_with(patient, np.clip(patient.ct.array + noise, -1024, 3071)))
    assert dice(noisy.mask, patient.images.lung.array) >= LEAST_DICE


@pytest.mark.slow
def test_a_field_of_view_that_cuts_the_lungs_is_segmented_and_warned_of(patient: Phantom) -> None:
    truth = patient.images.lung.array
    hits = [np.flatnonzero(truth.any(axis=axes)) for axes in ((1, 2), (0, 2))]
    low = [int(hit[0]) + 6 for hit in hits]
    high = [int(hit[-1]) - 6 for hit in hits]
    box = (slice(low[0], high[0]), slice(low[1], high[1]), slice(None))
    grid = patient.ct.grid.crop((*low, 0), (*high, truth.shape[2]))
    cut = segment_lungs(Volume(grid=grid, array=patient.ct.array[box].copy()))
    assert dice(cut.mask, truth[box]) >= LEAST_DICE
    sides = ("right", "left", "front", "back")
    assert all(any(f"cut off at the {side}" in warning for warning in cut.warnings) for side in sides)


@pytest.mark.slow
def test_a_scan_that_ends_within_the_lung_is_warned_of(patient: Phantom) -> None:
    truth = patient.images.lung.array
    levels = np.flatnonzero(truth.any(axis=(0, 1)))
    start = int(levels[0] + 0.3 * len(levels))
    grid = patient.ct.grid.crop((0, 0, start), patient.ct.grid.shape)
    cut = segment_lungs(Volume(grid=grid, array=patient.ct.array[:, :, start:].copy()))
    assert dice(cut.mask, truth[:, :, start:]) >= LEAST_DICE
    assert any("lower end" in warning for warning in cut.warnings)


@pytest.mark.slow
def test_lungs_that_touch_are_parted(patient: Phantom) -> None:
    left, right = _sides(patient)
    hu = np.array(patient.ct.array)
    box = np.argwhere(left), np.argwhere(right)
    # A bridge of lung tissue in front of the mediastinum, as along an anterior junction line.
    k = int(np.median(box[0][:, 2]))
    front = int(max(part[part[:, 2] == k][:, 1].min() for part in box)) + 4
    across = slice(int(box[1][:, 0].max()) - 40, int(box[0][:, 0].min()) + 40)
    hu[across, front : front + 6, k - 6 : k + 6] = -850
    parted = segment_lungs(_with(patient, hu))
    assert not (parted.left & parted.right).any()
    assert dice(parted.left, left) > 0.97
    assert dice(parted.right, right) > 0.97


@pytest.mark.slow
def test_a_nodule_on_the_pleura_stays_inside(patient: Phantom, lungs: Lungs) -> None:
    require_nodule_inside(patient, lungs, 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("radius_mm", [4.0, 8.0])
def test_a_nodule_on_the_pleura_stays_inside_in_fine_voxels(small_phantom: Phantom, radius_mm: float) -> None:
    require_nodule_inside(small_phantom, segment_lungs(small_phantom.ct), radius_mm)


def require_nodule_inside(patient: Phantom, lungs: Lungs, radius_mm: float) -> None:
    """Segment the lungs with a nodule on the pleura; `lungs` are those without it."""
    grid = patient.ct.grid
    depth = distance_mm(lungs.left, grid.spacing_mm)
    middle = int(np.median(np.argwhere(lungs.left)[:, 2]))
    rim = np.argwhere((depth > 2.0) & (depth < 3.0))
    rim = rim[rim[:, 2] == middle]
    centre = rim[np.argmax(grid.lps(rim)[:, 0])]
    apart = _distance_from(centre, grid)
    ball = (apart <= radius_mm) & lungs.left
    with_nodule = segment_lungs(_with(patient, np.where(apart <= radius_mm, 40, patient.ct.array)))
    assert np.count_nonzero(with_nodule.left & ball) >= 0.8 * np.count_nonzero(ball)
    beyond = with_nodule.mask & ~lungs.mask
    assert np.count_nonzero(beyond) < 0.05 * np.count_nonzero(ball) + 50


def test_a_head_has_no_lungs() -> None:
    grid = Grid.from_spacing((100, 100, 100), (2.0, 2.0, 2.0), (-100, -100, 0))
    hu = np.where(_distance_from((50, 50, 50), grid) < 80.0, 40, -1000).astype(np.int16)
    hu[48:53, 20:26, 30:70] = -1000  # nose and sinuses
    with pytest.raises(AnatomyError, match="No trachea was found|holds no"):
        segment_lungs(Volume(grid=grid, array=hu))


def test_a_neck_without_lungs_is_refused() -> None:
    grid = Grid.from_spacing((100, 100, 100), (2.0, 2.0, 2.0), (-100, -100, 0))
    i, j, _ = np.indices(grid.shape)
    hu = np.where(np.hypot(i - 50, j - 50) < 35, 40, -1000)
    hu[np.hypot(i - 50, j - 40) < 4] = -1000
    with pytest.raises(AnatomyError, match="no lung"):
        segment_lungs(Volume(grid=grid, array=hu.astype(np.int16)))


def test_a_given_seed_must_lie_in_air(patient: Phantom, lungs: Lungs) -> None:
    inside = patient.ct.grid.lps(lungs.trachea_seed_ijk)
    seeded = segment_lungs(patient.ct, seed_lps=inside)
    assert dice(seeded.mask, lungs.mask) > 0.999
    with pytest.raises(AnatomyError, match="HU"):
        segment_lungs(patient.ct, seed_lps=inside + (0.0, 30.0, 0.0))
    with pytest.raises(AnatomyError, match="outside the image"):
        segment_lungs(patient.ct, seed_lps=inside + (0.0, 900.0, 0.0))


def test_a_seed_in_a_lobar_bronchus_leads_to_the_trachea(patient: Phantom) -> None:
    coarse = CoarseCt.of(patient.ct)
    airway = patient.centerlines["airway"]
    lobar = np.flatnonzero(airway.generation == 2)
    start, end = (airway.branch_start[lobar[0] + n] for n in (0, 1))
    outside = np.zeros(coarse.hu.shape, dtype=bool, order="F")
    found = next(central_airways(coarse, outside, airway.points_lps[(start + end) // 2]))
    assert found.main[tuple(found.seed)]
    assert coarse.grid.lps(found.seed)[2] > 10.0  # above the carina, which is the origin
    assert abs(coarse.grid.lps(found.seed)[0]) < 5.0


def test_an_inflated_lung_outside_a_body(patient: Phantom) -> None:
    _, right = _sides(patient)
    noise = np.random.default_rng(0).normal(-1000.0, 15.0, right.shape)
    alone = segment_lungs(_with(patient, np.where(right, patient.ct.array, noise)), ex_vivo=True)
    assert dice(alone.right, right) > 0.95
    assert not alone.left.any()
    assert any("side is unknown" in warning for warning in alone.warnings)
    with pytest.raises(AnatomyError, match="ex-vivo"):
        segment_lungs(_with(patient, np.full(right.shape, -1000)), ex_vivo=True)


def test_a_patient_is_no_lung_in_air(patient: Phantom) -> None:
    low, high = (30, 30, 0), tuple(n - 30 for n in patient.ct.grid.shape[:2])
    box = (slice(low[0], high[0]), slice(low[1], high[1]), slice(None))
    grid = patient.ct.grid.crop(low, (*high, patient.ct.grid.shape[2]))
    with pytest.raises(AnatomyError, match="leave out --ex-vivo"):
        segment_lungs(Volume(grid=grid, array=patient.ct.array[box].copy()), ex_vivo=True)


def test_given_lungs_are_filled_and_lose_the_trachea(patient: Phantom, lungs: Lungs) -> None:
    left, right = _sides(patient)
    hollow = [side & (patient.ct.array < -500) | (side & lungs.central_airway) for side in (left, right)]
    given = lungs_given(patient.ct, *hollow)
    assert dice(given.mask, lungs.mask) > 0.98
    assert not (given.mask & given.central_airway).any()


def test_closing_fills_gaps_narrower_than_the_ball_alone() -> None:
    spacing = (1.0, 1.0, 1.0)
    two = np.zeros((40, 60, 40), dtype=bool, order="F")
    two[5:35, 5:20, 5:35] = True
    for gap, joined in ((8, True), (12, False)):
        parts = two.copy(order="F")
        parts[5:35, 20 + gap : 50, 5:35] = True
        filled = closed(parts, 5.0, spacing)
        assert (filled & parts == parts).all()
        assert bool(filled[20, 20 + gap // 2, 20]) is joined


def test_coarse_blocks_know_their_place() -> None:
    rng = np.random.default_rng(1)
    grid = Grid.from_spacing((17, 22, 13), (0.7, 0.5, 1.5), (3.0, -8.0, 40.0))
    coarse = CoarseCt.of(Volume(grid=grid, array=rng.integers(-1000, 100, grid.shape).astype(np.int16)))
    assert coarse.step == (2, 3, 1)
    low, high = np.array([1, 2, 3]), np.array([16, 21, 12])
    centres = grid.lps(np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1))
    blocks = np.stack([np.indices(coarse.hu.shape)[axis] for axis in range(3)])
    for axis in range(3):
        found = coarse.to_ct(blocks[axis], low, high)
        place = np.floor(coarse.grid.ijk(centres)[..., axis] + 0.5 + 1e-9)
        # The last block holds fewer voxels than its size says.
        assert (found == np.minimum(place, coarse.hu.shape[axis] - 1)).all()
    for block in np.ndindex(3, 4, 5):
        voxel = coarse.ct_voxel(np.array(block))
        assert np.abs(grid.lps(voxel) - coarse.grid.lps(block)).max() <= max(grid.spacing_mm)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "air_l", "right_l"), [("lidc-0314", 2.7, (0.8, 1.1)), ("chest-cta", 3.8, (2.0, 2.6))]
)
def test_real_lungs_have_their_volume(
    data_dir: Path, name: str, air_l: float, right_l: tuple[float, float]
) -> None:
    ct = read_volume(data_dir / "ct" / name / "ct.nii.gz")
    lungs = segment_lungs(ct)
    litre = ct.grid.voxel_volume_mm3 * 1e-6
    air = np.count_nonzero(lungs.mask & (ct.array < -500)) * litre
    assert air == pytest.approx(air_l, abs=0.1)
    assert right_l[0] < np.count_nonzero(lungs.right) * litre < right_l[1]
    assert ct.array[tuple(lungs.trachea_seed_ijk)] < -900
    assert not (lungs.mask & lungs.central_airway).any()


@pytest.mark.parametrize(("gas_hu", "air_hu"), [(-1000.0, -1000.0), (-966.0, -943.0), (-945.0, -943.0)])
def test_gas_is_told_from_lung_by_the_air_of_the_trachea(gas_hu: float, air_hu: float) -> None:
    coarse, apart = _block(-860.0)
    bubble = apart < 20.0
    hu = np.where(bubble, np.float32(gas_hu), coarse.hu)
    gas, lung = gas_pockets(replace(coarse, hu=np.asfortranarray(hu)), apart < 60.0, air_hu)
    assert gas[apart < 17.0].all() and not gas[apart > 23.0].any()
    assert (lung == ((apart < 60.0) & ~gas)).all()
    alone = bubble | ((apart > 40.0) & (apart < 60.0))
    assert not gas_pockets(replace(coarse, hu=np.asfortranarray(hu)), alone, air_hu)[1][apart < 30.0].any()


def test_emphysema_is_no_gas_where_scatter_raises_the_air() -> None:
    coarse, apart = _block(-950.0)
    gas, lung = gas_pockets(coarse, apart < 60.0, -943.0)
    assert not gas.any() and (lung == (apart < 60.0)).all()


def _block(hu: float) -> tuple[CoarseCt, Float]:
    """Return a block of lung and the distance of each voxel from its middle."""
    shape, rng = (90, 90, 90), np.random.default_rng(0)
    grid = Grid.from_spacing(shape, (1.5, 1.5, 1.5), (0, 0, 0))
    apart = np.linalg.norm(np.moveaxis(np.indices(shape), 0, -1) - 44.5, axis=-1) * 1.5
    values = np.asfortranarray(rng.normal(hu, 20.0, shape).astype(np.float32))
    whole = (1, 1, 1)
    return CoarseCt(hu=values, grid=grid, fine_shape=shape, step=whole), apart
