"""Nodules outlined from a point: solid, ground glass, at a vessel, at the pleura; and what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Mask
from anatomy.grid import Grid, Volume
from anatomy.nodule_size import nodule_size
from anatomy.segmentation.nodules import nodule_from_contours, stout_warnings
from anatomy.segmentation.outlining import outline_nodule
from experiments.support.segmentation.nodule_cases import dice

GRID = Grid.from_spacing((64, 64, 40), (1.0, 1.0, 1.6), (-32.0, -32.0, -32.0))
MM = GRID.lps(np.stack(np.meshgrid(*map(np.arange, GRID.shape), indexing="ij"), axis=-1))
LUNG_HU, GLASS_HU, SOLID_HU, NOISE_HU = -860.0, -600.0, 30.0, 25.0


def _ball(centre: tuple[float, float, float], radius: float) -> Mask:
    return np.asarray(np.linalg.norm(MM - centre, axis=-1) <= radius)


def _ct(*parts: tuple[Mask, float]) -> Volume:
    """A lung with noise in which each part has its HU, blurred like a CT."""
    from scipy.ndimage import gaussian_filter

    hu = np.full(GRID.shape, LUNG_HU)
    for mask, value in parts:
        hu[mask] = value
    hu = gaussian_filter(hu, 0.6 / GRID.spacing_mm)
    hu += NOISE_HU * np.random.default_rng(3).standard_normal(hu.shape)
    return Volume(grid=GRID, array=np.asfortranarray(hu.astype(np.int16)))


EVERYWHERE = np.ones(GRID.shape, dtype=np.bool_, order="F")
VESSEL = np.asarray(np.hypot(MM[..., 0] - 7.0, MM[..., 1]) <= 2.5)
WALL = np.asarray(MM[..., 0] - 0.004 * (MM[..., 1] ** 2 + MM[..., 2] ** 2) <= -12.0)
"""A chest wall that bulges into the lung, like a diaphragm."""


@pytest.mark.parametrize("radius", [4.0, 8.0, 13.0])
@pytest.mark.parametrize("value", [SOLID_HU, GLASS_HU, 400.0])
def test_a_ball_is_outlined(radius: float, value: float) -> None:
    ball = _ball((0.0, 0.0, 0.0), radius)
    found = outline_nodule(_ct((ball, value)), EVERYWHERE, (1.0, -1.0, 1.5))
    assert dice(found, ball) > (0.85 if radius < 5.0 else 0.92)


def test_ground_glass_around_a_core_belongs_to_the_nodule() -> None:
    ball = _ball((0.0, 0.0, 0.0), 12.0)
    ct = _ct((ball, GLASS_HU), (_ball((2.0, 0.0, 0.0), 6.0), SOLID_HU))
    assert dice(outline_nodule(ct, EVERYWHERE, (2.0, 0.0, 0.0)), ball) > 0.9


def test_a_vessel_that_touches_the_nodule_stays_outside() -> None:
    ball = _ball((0.0, 0.0, 0.0), 7.0)
    found = outline_nodule(_ct((ball | VESSEL, SOLID_HU)), EVERYWHERE, (0.0, 0.0, 0.0))
    assert dice(found, ball) > 0.85


def test_a_nodule_left_out_of_the_lung_ends_at_the_pleura() -> None:
    ball = _ball((-8.0, 0.0, 0.0), 7.0) & ~WALL
    lungs = np.asfortranarray(~WALL & ~ball)
    found = outline_nodule(_ct((ball | WALL, SOLID_HU)), lungs, (-8.0, 0.0, 0.0))
    assert dice(found, ball) > 0.8


@pytest.mark.parametrize(
    ("parts", "point", "what"),
    [
        ((), (0.0, 0.0, 0.0), "denser than the lung"),
        (((VESSEL, SOLID_HU),), (7.0, 0.0, 0.0), "told from a vessel"),
        ((), (500.0, 0.0, 0.0), "in the image"),
    ],
)
def test_what_is_no_nodule_is_refused(
    parts: tuple[tuple[Mask, float], ...], point: tuple[float, float, float], what: str
) -> None:
    with pytest.raises(AnatomyError, match=what):
        outline_nodule(_ct(*parts), EVERYWHERE, point)


def test_the_chest_wall_is_no_nodule() -> None:
    with pytest.raises(AnatomyError, match="chest wall"):
        outline_nodule(_ct((WALL, SOLID_HU)), np.asfortranarray(~WALL), (-20.0, 0.0, 0.0))


def test_without_lung_there_is_none() -> None:
    with pytest.raises(AnatomyError, match="in a lung"):
        outline_nodule(_ct(), ~EVERYWHERE, (0.0, 0.0, 0.0))


def test_the_size_of_a_box_is_that_of_its_sides() -> None:
    voxels = np.argwhere(np.ones((10, 5, 3)))
    size = nodule_size(voxels, Grid.from_spacing((10, 5, 3), (1.0, 1.0, 2.0), (0.0, 0.0, 0.0)))
    assert size.volume_ml == pytest.approx(0.3)
    assert size.long_axis_mm == pytest.approx(np.hypot(9.0, 4.0) + 1.0, abs=0.01)
    assert 5.0 < size.perpendicular_mm < 9.0


def test_stout_tissue_without_a_way_to_the_hilum_is_told() -> None:
    lungs = np.asfortranarray(MM[..., 2] > -25.0)
    blob, tube = _ball((-15.0, 0.0, 0.0), 6.0), VESSEL & (np.abs(MM[..., 2]) < 20.0)
    (warning,) = stout_warnings(blob | tube, lungs, GRID)
    assert "--nodule lps:-15,0,0" in warning
    # What reaches out of the lungs has a way to the hilum.
    assert not stout_warnings(tube | _ball((-15.0, 0.0, -24.0), 6.0), lungs, GRID)


@pytest.mark.data
@pytest.mark.parametrize(("name", "least"), [("lidc-0314", 0.85), ("lidc-0001", 0.83)])
def test_real_nodules_are_outlined_like_readers_do(data_dir: Path, name: str, least: float) -> None:
    from anatomy.io import read_volume
    from anatomy.segmentation.canonical import canonical

    folder = data_dir / "ct" / name
    ct = canonical(read_volume(folder / "ct.nii.gz"))
    truth = nodule_from_contours(folder / "nodule_contours.json", ct.grid)
    centre = ct.grid.lps(np.argwhere(truth).mean(axis=0))
    # Both lie in the lung; air and tissue around them stand for its mask.
    lungs = np.asfortranarray(ct.array < -400) | truth
    assert dice(outline_nodule(ct, lungs, centre), truth) > least
