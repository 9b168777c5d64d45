"""What is said about noise, slices, metal, and lung that is missing or solid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from anatomy.base.typed import Mask
from anatomy.grid import Grid, Volume
from anatomy.phantom import Phantom
from anatomy.segmentation.gate import midline, missing_lung, solid_tissue
from anatomy.segmentation.scan_warnings import noise_hu, scan_warnings

CARINA = np.zeros(3)


def _tissue(noise: float, spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> tuple[Volume, Mask]:
    shape = (60, 60, 60)
    values = 40.0 + noise * np.random.default_rng(0).standard_normal(shape)
    values[:20] = -860.0
    grid = Grid.from_spacing(shape, spacing_mm, (0.0, 0.0, 0.0))
    return Volume(grid=grid, array=values.astype(np.int16)), np.ones(shape, dtype=bool)


@pytest.mark.parametrize("noise", [5.0, 20.0, 45.0, 80.0])
def test_noise_is_measured_in_soft_tissue(noise: float) -> None:
    ct, near = _tissue(noise)
    assert noise_hu(ct, near) == pytest.approx(noise, rel=0.1)
    said = " ".join(scan_warnings(ct, near))
    assert ("The noise is" in said) == (noise > 30.0)


def test_correlated_noise_counts_by_what_averaging_leaves_of_it() -> None:
    """Noise that is smooth over a voxel: 20 HU hide more than 20 HU that are not."""
    ct, near = _tissue(0.0)
    noise = gaussian_filter(np.random.default_rng(1).standard_normal(ct.grid.shape), 1.0)
    values = ct.array + np.rint(20.0 / noise.std() * noise)
    correlated = noise_hu(Volume(grid=ct.grid, array=values.astype(np.int16)), near)
    assert 23.0 < correlated < 40.0


def test_no_noise_is_claimed_where_there_is_no_tissue() -> None:
    ct, near = _tissue(0.0)
    air = Volume(grid=ct.grid, array=np.full(ct.grid.shape, -900, dtype=np.int16))
    assert noise_hu(air, near) == 0.0


def test_slices_and_metal_are_warned_of() -> None:
    assert scan_warnings(*_tissue(10.0)) == ()
    ct, near = _tissue(10.0, (0.8, 0.8, 2.0))
    (slices,) = scan_warnings(ct, near)
    assert "2.0 mm apart" in slices and "understated" in slices
    ct, near = _tissue(10.0)
    values = np.array(ct.array)
    values[30:36, 30:36, 30:36] = 3071
    (metal,) = scan_warnings(Volume(grid=ct.grid, array=values), near)
    assert metal.startswith("0.2 ml of metal")


@pytest.mark.parametrize(
    ("lobe", "place"),
    [
        (1, "upper part of the right lung"),
        (3, "lower part at the back of the right lung"),
        (4, "upper part of the left lung"),
        (5, "lower part at the back of the left lung"),
    ],
)
def test_a_lobe_that_is_missing_is_named(patient: Phantom, lobe: int, place: str) -> None:
    lobes = patient.lobes.array
    left, right = lobes >= 4, (lobes > 0) & (lobes < 4)
    assert missing_lung(left, right, patient.grid, CARINA) == ()
    gone = lobes == lobe
    (warning,) = missing_lung(left & ~gone, right & ~gone, patient.grid, CARINA)
    assert place in warning and "understated" in warning


def test_what_is_missing_on_both_sides_alike_is_told_by_its_extent(patient: Phantom) -> None:
    lobes, points = patient.lobes.array, np.indices(patient.lobes.array.shape).reshape(3, -1).T
    _, y, z = patient.grid.lps(points).T
    for place, gone in (("back", y > 25.0), ("base", z < -60.0)):
        kept = lobes * ~gone.reshape(lobes.shape)
        said = " ".join(missing_lung(kept >= 4, (kept > 0) & (kept < 4), patient.grid, CARINA))
        assert f"missing at the {place} of the left lung" in said and f"{place} of the right lung" in said


@pytest.mark.parametrize("side", [0, 1])
def test_a_base_that_is_solid_behind_is_told_by_the_other_one(patient: Phantom, side: int) -> None:
    lobes, points = patient.lobes.array, np.indices(patient.lobes.array.shape).reshape(3, -1).T
    _, y, z = patient.grid.lps(points).T
    lungs = [lobes >= 4, (lobes > 0) & (lobes < 4)]
    lungs[side] = lungs[side] & ~((y > 15.0) & (z < -55.0)).reshape(lobes.shape)
    (warning,) = missing_lung(lungs[0], lungs[1], patient.grid, CARINA)
    assert f"missing at the base of the {('left', 'right')[side]} lung" in warning


@pytest.mark.parametrize(("lean_mm", "bow_mm"), [(25.0, 0.0), (0.0, -25.0), (-10.0, 20.0)])
def test_a_chest_that_leans_or_has_a_curved_spine_misses_nothing(
    patient: Phantom, lean_mm: float, bow_mm: float
) -> None:
    grid = patient.grid.crop([-30, 0, 0], [patient.grid.shape[0] + 30, *patient.grid.shape[1:]])
    height = np.linspace(-1.0, 1.0, grid.shape[2])
    moved = np.rint((lean_mm * height + bow_mm * (1.0 - height**2)) / grid.spacing_mm[0]).astype(int)
    wide = np.pad(patient.lobes.array, ((30, 30), (0, 0), (0, 0)))
    bent = np.stack([np.roll(wide[:, :, k], n, axis=0) for k, n in enumerate(moved)], axis=2)
    carina = CARINA + [moved[int(np.rint(grid.ijk(CARINA)[2]))] * grid.spacing_mm[0], 0.0, 0.0]
    assert missing_lung(bent >= 4, (bent > 0) & (bent < 4), grid, carina) == ()
    gone = bent * (bent != 4)
    (warning,) = missing_lung(gone >= 4, (gone > 0) & (gone < 4), grid, carina)
    assert "upper part of the left lung" in warning
    voxels = np.argwhere(bent > 0)
    off_mm = midline(grid.lps(voxels), carina) - moved[voxels[:, 2]] * grid.spacing_mm[0]
    assert np.ptp(off_mm) < 8.0


def test_a_mass_is_warned_of_and_vessels_are_not(patient: Phantom) -> None:
    lung = patient.images.lung.array
    assert solid_tissue(patient.ct, lung) == ()
    inside = np.argwhere(patient.lobes.array == 3)
    middle = inside[np.argmin(np.linalg.norm(inside - inside.mean(axis=0), axis=1))]
    apart = np.linalg.norm(
        (np.moveaxis(np.indices(lung.shape), 0, -1) - middle) * patient.grid.spacing_mm, axis=-1
    )
    values = np.where(apart < 18.0, 40, patient.ct.array).astype(np.int16)
    (warning,) = solid_tissue(Volume(grid=patient.grid, array=values), lung | (apart < 18.0))
    stated_ml = float(warning.split(" ml")[0])
    assert stated_ml == pytest.approx(24.4, rel=0.25)
