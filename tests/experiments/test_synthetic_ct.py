"""A CT rendered from masks: tissue where the masks say, truth on its grid, noise as asked, the same bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.grid import Grid, Volume
from anatomy.patient import PatientImages
from experiments.support.segmentation.slices import thickened
from experiments.support.segmentation.synthetic_ct import CtLook, render_ct

SILENT = CtLook(noise_hu=0.0, texture_hu=0.0, spacing_mm=1.0)


def ball(points: np.ndarray, centre: tuple[float, float, float], radius: float) -> np.ndarray:
    return np.linalg.norm(points - centre, axis=-1) <= radius


def patient(spacing: tuple[float, float, float] = (0.8, 0.8, 1.0)) -> PatientImages:
    """A ball of lung with a vessel along k, an airway beside it and a fissure."""
    shape = tuple(int(60 / s) for s in spacing)
    grid = Grid.from_spacing(shape, spacing, (-30.0, -30.0, -30.0))
    points = grid.lps(np.stack(np.indices(shape), axis=-1))
    x, y = points[..., 0], points[..., 1]
    lung = ball(points, (0, 0, 0), 24.0)
    vessel = (np.hypot(x - 8, y) <= 3.0) & lung
    lumen = (np.hypot(x + 8, y) <= 3.0) & lung
    fissure = (np.abs(y - 10) <= 1.5) & lung
    masks = {"lung": lung, "vessels": vessel, "lumen": lumen, "fissures": fissure}
    volumes = {name: Volume(grid=grid, array=mask) for name, mask in masks.items()}
    return PatientImages(name="ball", kind="masks", grid=grid, **volumes)


def hu_at(made: Volume, lps: tuple[float, float, float]) -> int:
    return int(made.array[tuple(np.rint(made.grid.ijk(lps)).astype(int))])


class TestTissues:
    def test_what_the_masks_say(self) -> None:
        made = render_ct(patient(), SILENT)
        expected = {
            (8.0, 0.0, 0.0): 40.0,
            (-8.0, 0.0, 0.0): -990.0,
            (0.0, -12.0, 0.0): -865.0,
            (0.0, 30.0, 0.0): 40.0,
            (0.0, 42.0, 0.0): -90.0,
            (0.0, 53.0, 0.0): -1000.0,
        }
        assert {place: hu_at(made.ct, place) for place in expected} == pytest.approx(expected, abs=12.0)

    def test_contrast_medium(self) -> None:
        made = render_ct(patient(), replace(SILENT, vessel_hu=350.0))
        assert hu_at(made.ct, (8.0, 0.0, 0.0)) == pytest.approx(350.0, abs=12.0)

    def test_walls_and_fissures_are_seen(self) -> None:
        made = render_ct(patient(), SILENT)
        assert -840 < hu_at(made.ct, (0.0, 10.0, 0.0)) < -300
        assert hu_at(made.ct, (-11.4, 0.0, 0.0)) > -700

    def test_partly_covered_voxels_are_between(self) -> None:
        made = render_ct(patient(), replace(SILENT, psf_mm=0.0))
        values = made.ct.array[made.lung]
        assert ((values > -700) & (values < -100)).any()


class TestTruth:
    @pytest.mark.parametrize(("spacing_mm", "within"), [(0.7, 0.06), (1.0, 0.06), (1.5, 0.15)])
    def test_volumes_are_kept(self, spacing_mm: float, within: float) -> None:
        images = patient()
        made = render_ct(images, replace(SILENT, spacing_mm=spacing_mm))
        for name in ("lung", "vessels", "lumen"):
            given = getattr(images, name)
            true_mm3 = given.array.sum() * given.grid.voxel_volume_mm3
            assert getattr(made, name).sum() * spacing_mm**3 == pytest.approx(true_mm3, rel=within)
        assert not (made.wall & (made.lumen | made.vessels)).any()

    def test_positions_are_kept(self) -> None:
        images = patient((0.6, 0.9, 1.1))
        made = render_ct(images, SILENT)
        for name in ("vessels", "lumen"):
            given = getattr(images, name)
            expected = given.grid.lps(np.argwhere(given.array)).mean(axis=0)
            assert made.ct.grid.lps(np.argwhere(getattr(made, name))).mean(axis=0) == pytest.approx(
                expected, abs=0.25
            )

    def test_the_mediastinum_is_no_lung(self) -> None:
        images = patient()
        points = images.grid.lps(np.stack(np.indices(images.grid.shape), axis=-1))
        wide = (np.hypot(points[..., 0] + 8, points[..., 1]) <= 7.0) & images.lung.array
        made = render_ct(replace(images, lumen=Volume(grid=images.grid, array=wide)), SILENT)
        assert not (made.lung & made.lumen).any()
        assert hu_at(made.ct, (0.7, 0.0, 0.0)) > -300


class TestNoise:
    def test_its_size_and_the_dose(self) -> None:
        silent = render_ct(patient(), SILENT).ct.array.astype(float)
        for dose, expected in ((1.0, 25.0), (0.25, 50.0)):
            noisy = render_ct(patient(), replace(SILENT, noise_hu=25.0, dose=dose)).ct.array
            inside = silent > -500  # air is cut at -1024 HU
            assert (noisy - silent)[inside].std() == pytest.approx(expected, rel=0.05)

    def test_texture_is_in_the_lung_alone(self) -> None:
        silent, made = render_ct(patient(), SILENT), render_ct(patient(), replace(SILENT, texture_hu=20.0))
        change = made.ct.array.astype(float) - silent.ct.array
        tissue = made.lung & (silent.ct.array < -850)
        assert change[tissue].std() > 8.0
        assert change[silent.ct.array > 20].std() < 1.0

    def test_same_seed_same_bits(self) -> None:
        look = replace(SILENT, noise_hu=25.0, texture_hu=20.0, seed=4)
        first = render_ct(patient(), look).ct.array
        assert (render_ct(patient(), look).ct.array == first).all()
        assert (render_ct(patient(), replace(look, seed=5)).ct.array != first).any()


class TestRefusals:
    def test_no_lung(self) -> None:
        images = patient()
        empty = Volume(grid=images.grid, array=np.zeros(images.grid.shape, dtype=bool))
        with pytest.raises(AnatomyError, match="empty"):
            render_ct(replace(images, lung=empty))

    @pytest.mark.parametrize(
        "wrong", [{"dose": 0.0}, {"spacing_mm": -1.0}, {"noise_hu": float("nan")}, {"psf_mm": -0.1}]
    )
    def test_impossible_looks(self, wrong: dict[str, float]) -> None:
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            CtLook(**wrong)


def test_thicker_slices_are_means_at_their_middle() -> None:
    grid = Grid.from_spacing((2, 3, 10), (0.8, 0.8, 1.0), (0.0, 0.0, 5.0))
    ct = Volume(grid=grid, array=np.broadcast_to(100 * np.arange(10, dtype=np.int16), grid.shape).copy())
    thick = thickened(ct, 2.5)
    assert thick.grid.shape == (2, 3, 4)
    assert thick.grid.spacing_mm[2] == pytest.approx(2.5)
    assert thick.grid.lps((0, 0, 0)) == pytest.approx((0.0, 0.0, 5.75))
    np.testing.assert_array_equal(thick.array[0, 0], [80, 320, 580, 820])
