"""Fissures are sheets, not noise or tubes; bronchi and fissures together say where each lobe is."""

from __future__ import annotations

from statistics import NormalDist
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from anatomy.grid import Grid
from anatomy.lobes import (
    LEAST_CHANCE,
    LEFT_LOWER,
    LEFT_UPPER,
    RIGHT_LOWER,
    RIGHT_MIDDLE,
    RIGHT_UPPER,
    SEEN,
    UNKNOWN,
)
from anatomy.segmentation.fissures import Cubic, fissureness
from anatomy.segmentation.kernels.flooding import diffuse, flood
from anatomy.segmentation.lobar_bronchi import Regions, lobes_of_branches
from anatomy.segmentation.lobes import (
    BAND_GROWTH,
    BAND_MM,
    BAND_UNSEEN_MM,
    LEAST_CONFIDENCE,
    LEAST_ENDS,
    WIDEST_SHARE,
    _bands,
    _LungParts,
    lobes_given,
)

SHAPE = (40, 50, 60)


@pytest.mark.parametrize("spacing", [(0.7, 0.8, 1.0), (0.5, 1.5, 2.5)])
def test_cubic_voxels_keep_a_gradient_and_find_the_same_place_again(spacing: tuple[float, ...]) -> None:
    grid = Grid.from_spacing((41, 33, 20), spacing, (5.0, -3.0, 9.0))
    cubic = Cubic.over(grid)
    places = np.moveaxis(np.indices(grid.shape), 0, -1)
    height = grid.lps(places.reshape(-1, 3))[:, 2].reshape(grid.shape).astype(np.float32)
    made = cubic.mean(height)
    assert made.shape == cubic.shape
    assert np.abs(cubic.back(made) - height)[:, :, 2:-2].max() <= 0.5 * max(spacing[2], 1.0) + 1e-3
    voxel = (20, 10, 12)
    marked = np.zeros(grid.shape, dtype=bool)
    marked[voxel[0] - 1 : voxel[0] + 2, voxel[1] - 1 : voxel[1] + 2, voxel[2]] = True
    k, j, i = cubic.index(grid.lps(np.array([voxel])))[0]
    assert cubic.sampled(marked)[k, j, i]


@pytest.fixture(scope="module")
def noisy_lung() -> np.ndarray:
    rng = np.random.default_rng(1)
    return (-860.0 + 20.0 * rng.standard_normal(SHAPE)).astype(np.float32)


def test_a_sheet_is_seen_and_noise_and_tubes_are_not(noisy_lung: np.ndarray) -> None:
    """A tilted sheet of 100 HU, as a fissure has at 1 mm, and a tube of 200 HU."""
    k, j, i = np.indices(SHAPE)
    offset = (k - 20 - 0.4 * (j - 25)) / np.hypot(1.0, 0.4)
    hu = noisy_lung + 100.0 * np.exp(-0.5 * offset**2)
    hu += 200.0 * np.exp(-0.5 * ((k - 33) ** 2 + (i - 30) ** 2) / 1.5**2)
    lung = np.zeros(SHAPE, dtype=bool)
    lung[2:-2, 2:-2, 2:-2] = True
    found = fissureness(hu.astype(np.float32), lung, np.zeros(SHAPE, dtype=bool))
    sheet = found.looked & (np.abs(offset) < 0.5)
    assert found.seen[sheet].mean() > 0.95
    assert not found.seen[np.abs(offset) > 4].any()
    assert not fissureness(noisy_lung, lung, ~lung).seen.any()


def test_a_flood_goes_round_a_wall_if_that_costs_less() -> None:
    labels, cost = np.zeros((1, 3, 9), dtype=np.int32), np.ones((1, 3, 9), dtype=np.float32)
    labels[0, 0, 0], labels[0, 0, 8], cost[0, :, 2] = 1, 2, 50.0
    flood(labels, cost)
    assert (labels[0, :, :2] == 1).all() and (labels[0, :, 3:] == 2).all()
    labels = np.full((1, 3, 9), -1, dtype=np.int32)
    labels[0, 0] = 0
    labels[0, 0, 0] = 7
    flood(labels, cost)
    assert (labels[0, 0] == 7).all() and (labels[0, 1] == -1).all()


def test_shares_fall_evenly_between_two_fixed_ends() -> None:
    share = np.zeros((3, 3, 13), dtype=np.float32)
    share[1, 1, 1] = 1.0
    along = np.zeros(share.shape, dtype=np.float32)
    along[1, 1, 1:11] = 1.0
    nothing = np.zeros_like(along)
    free = np.ravel_multi_index((1, 1, np.arange(2, 11)), share.shape)
    diffuse(share, free, along, nothing, nothing, 200, np.float32(1.5))
    assert share[1, 1, 1:12] == pytest.approx(np.linspace(1.0, 0.0, 11), abs=1e-4)


def regions(
    volume: list[float],
    places: list[list[float]],
    fissures: list[tuple[int, int]],
    named: tuple[int, ...] = (0,) * 7,
) -> Regions:
    """Regions of a main bronchus 0 that divides into 1 and 2; 3 and 4 are branches of 1, 5 and 6 of 2."""
    parent = [-1, 0, 0, 1, 1, 2, 2]
    below = np.eye(7, dtype=bool)
    for branch in range(6, 0, -1):
        below[parent[branch]] |= below[branch]
    faces, likelihood = np.zeros((2, 7, 7))
    for one, other in ((3, 4), (5, 6), (4, 5)):
        faces[one, other] = faces[other, one] = 200.0
    for one, other in fissures:
        likelihood[one, other] = likelihood[other, one] = 160.0
    size = np.array(volume)
    used = size > 0
    return Regions(
        volume=size, moment=size[:, None] * np.array(places), likelihood=likelihood, faces=faces,
        below=below,
        used=used,
        named=np.array(named),
    )  # fmt: skip


PLACES = [[0.0, 0, 0], [0, 0, 50], [0, 0, -50], [0, 0, 90], [0, 0, 50], [0, -40, -20], [0, 40, -60]]
VOLUME = [0.0, 10, 10, 300, 200, 300, 300]


def test_the_parting_is_where_the_fissure_is() -> None:
    lobes = (LEFT_UPPER, LEFT_LOWER)
    between = lobes_of_branches(regions(VOLUME, PLACES, [(4, 5)]), lobes)
    assert between[3:].tolist() == [LEFT_UPPER, LEFT_UPPER, LEFT_LOWER, LEFT_LOWER]
    inside = lobes_of_branches(regions(VOLUME, PLACES, [(5, 6)]), lobes)
    assert inside[3:].tolist() == [LEFT_UPPER, LEFT_UPPER, LEFT_UPPER, LEFT_LOWER]


def test_the_middle_lobe_lies_in_front_and_leading_branches_have_no_lobe() -> None:
    lobes = (RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER)
    found = lobes_of_branches(regions(VOLUME, PLACES, [(4, 5), (5, 6)]), lobes)
    assert found[[0, 2]].tolist() == [0, 0]
    assert found[3:].tolist() == [RIGHT_UPPER, RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER]


def test_without_fissures_usual_shares_decide() -> None:
    found = lobes_of_branches(regions(VOLUME, PLACES, []), (LEFT_UPPER, LEFT_LOWER))
    assert found[3:].tolist() == [LEFT_UPPER, LEFT_UPPER, LEFT_LOWER, LEFT_LOWER]


def test_a_lobe_with_one_bronchus_is_preferred_to_usual_shares() -> None:
    """Branch 5 is large for a middle lobe, and hangs on the same bronchus as 6: it stays with it."""
    volume = [0.0, 10, 10, 300, 300, 180, 160]
    fissures = regions(volume, PLACES, [(3, 4), (4, 5)])
    found = lobes_of_branches(fissures, (RIGHT_UPPER, RIGHT_MIDDLE, RIGHT_LOWER))
    assert found[5] == found[6] and len({*found[3:].tolist()} - {0}) == 3


def test_too_few_bronchi_give_no_lobes() -> None:
    one = regions([0.0, 0, 0, 300, 0, 0, 0], PLACES, [])
    assert not lobes_of_branches(one, (LEFT_UPPER, LEFT_LOWER)).any()


def test_names_of_bronchi_decide_where_no_fissure_is_seen_and_give_way_to_one_that_is() -> None:
    """Usual shares and one bronchus a lobe put branch 5 into the lower lobe, its name into the upper one."""
    named = (0, 0, 0, LEFT_UPPER, LEFT_UPPER, LEFT_UPPER, LEFT_LOWER)
    lobes = (LEFT_UPPER, LEFT_LOWER)
    unnamed = lobes_of_branches(regions(VOLUME, PLACES, []), lobes)
    found = lobes_of_branches(regions(VOLUME, PLACES, [], named), lobes)
    assert unnamed[5] == LEFT_LOWER and found[3:].tolist() == list(named[3:])
    seen = lobes_of_branches(regions(VOLUME, PLACES, [(4, 5)], named), lobes)
    assert seen[3:].tolist() == [LEFT_UPPER, LEFT_UPPER, LEFT_LOWER, LEFT_LOWER]


def lungs_of(lobes: np.ndarray, right: np.ndarray) -> Any:
    return SimpleNamespace(left=~right, right=right, mask=np.ones(lobes.shape, dtype=bool))


def test_corrected_lobes_have_fissures_between_them_and_a_lung_without_lobes_has_none_known() -> None:
    lobes = np.zeros((4, 4, 4), dtype=np.uint8)
    lobes[:2], lobes[2:] = LEFT_UPPER, LEFT_LOWER
    made = lobes_given(lobes, None, lungs_of(lobes, np.zeros(lobes.shape, dtype=bool)))
    assert (made["fissures"][1:3] == SEEN).all() and not made["fissures"][[0, 3]].any()
    own = np.ones_like(lobes)
    assert lobes_given(lobes, own, lungs_of(lobes, lobes > 9))["fissures"] is own
    right = np.zeros(lobes.shape, dtype=bool)
    right[:, :2] = True
    half = lobes_given(np.where(right, np.uint8(0), lobes), None, lungs_of(lobes, right))["fissures"]
    assert (half[right] == UNKNOWN).all() and (half[1:3, 2:] == SEEN).all() and not half[0, 2:].any()


def test_a_band_is_wider_where_its_fissure_is_not_seen_and_has_the_chances_of_a_normal_error() -> None:
    lobes = np.full((120, 30, 120), LEFT_LOWER, dtype=np.uint8)
    lobes[60:] = LEFT_UPPER
    near = np.zeros(lobes.shape, dtype=bool)
    near[58:62, :, :20] = True
    widest_mm = WIDEST_SHARE * lobes.size ** (1 / 3)
    for share, more_mm in ((1.0, 0.0), (0.5, 0.5 * BAND_UNSEEN_MM)):
        found = _bands(lobes, near, {"left oblique fissure": share})
        heights = [int(np.count_nonzero(found[:, 15, i])) for i in (5, 20, 23, 110)]
        widths_mm = [
            BAND_MM + more_mm,
            BAND_MM + BAND_GROWTH + more_mm,
            BAND_MM + 2.0 * BAND_GROWTH + more_mm,
        ]
        # Voxels count whose middles lie in the band, those of each side for themselves.
        assert heights == [2 * int(np.floor(width + 0.5)) for width in (*widths_mm, widest_mm)]
    for away in (0, 4, 9):
        beyond = round(100.0 * NormalDist().cdf(-1.96 * (away + 0.5) / widest_mm))
        assert found[60 + away, 15, 110] == found[59 - away, 15, 110] == beyond
    assert found.max() < 50 and found[found > 0].min() >= LEAST_CHANCE
    assert not _bands(np.full((9, 9, 9), LEFT_LOWER, dtype=np.uint8), near[:9, :9, :9], {}).any()


@pytest.mark.parametrize(
    ("ends", "confidence", "sure"),
    [(LEAST_ENDS, 0.99, True), (LEAST_ENDS - 1, 0.99, False), (LEAST_ENDS, LEAST_CONFIDENCE - 0.01, False)],
)
def test_names_are_sure_with_as_many_ends_as_segments(ends: int, confidence: float, sure: bool) -> None:
    """A trunk with so many ends in the lung, and more of them outside of it that do not count."""
    count = 1 + ends + 5
    inside = np.arange(count) <= ends
    parts = _LungParts.__new__(_LungParts)
    parts._inside = inside
    parts._tree = SimpleNamespace(
        n_branches=count,
        branch_of_point=np.arange(count),
        branch_parent=np.array([-1] + [0] * (count - 1)),
        bronchi=SimpleNamespace(confidence=np.where(inside, confidence, 1.0)),
    )  # type: ignore[assignment]
    assert parts.has_sure_names == sure
