"""Wrong and hard inputs: none is silently wrong. The truth of every case is known."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.phantom import Phantom
from anatomy.plausibility import CHECKS, Finding, require_known_checks, require_plausible
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.coarse import CoarseCt
from anatomy.segmentation.input import Scale
from experiments.support.segmentation.hard_cases import CASES
from experiments.support.segmentation.hard_images import HardImage, phantom_image, turned
from experiments.support.segmentation.hard_runs import plain_tree, run

FAST = {name for name, case in CASES.items() if case.group == "scale" and case.refuse} | {
    "part: neck and tops of the lungs",
    "header: slices taken for coronal ones",
    "cut: all above the carina",
    "cut: sides, front and back",
    "cut: a lesion alone",
}
"""Each is refused in less than a second."""

SMALL = {
    "throat: glottis of 61% of the trachea, neck leaning by 25 mm",
    "bronchus: 14 mm of the left main bronchus at -882 HU",
}
"""Cases that need no slow job: each is of a group whose images no other test has."""


@pytest.fixture(scope="module")
def image(patient: Phantom) -> HardImage:
    return phantom_image(patient)


@pytest.fixture(scope="module")
def plain(image: HardImage) -> float:
    return plain_tree(image)


def test_the_suite_is_as_large_as_it_claims() -> None:
    assert len(CASES) >= 200
    assert len({case.group for case in CASES.values()}) >= 13
    assert len(FAST) >= 11


@pytest.mark.parametrize("name", sorted(FAST))
def test_what_is_no_chest_is_refused_in_its_own_words(name: str, image: HardImage) -> None:
    found = run(CASES[name], image, 1.0)
    assert found.verdict == "refused", found


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in SMALL else pytest.mark.slow)
        for name in sorted(set(CASES) - FAST)
    ],
)
def test_no_hard_input_is_silently_wrong(name: str, image: HardImage, plain: float) -> None:
    found = run(CASES[name], image, plain)
    case = CASES[name]
    expected = {"refused"} if case.refuse else {"warned"} if case.warn else {"right", "warned", "refused"}
    assert found.verdict in expected, found
    if not case.words:
        assert found.verdict == "right", found


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (0, 2, 1), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
@pytest.mark.parametrize("flips", [(), (0,), (1, 2), (0, 1), (0, 1, 2)])
def test_voxels_come_into_one_order_whatever_the_file_has(
    order: tuple[int, ...], flips: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(0)
    image = _small(rng)
    if _handed(order, flips) < 0:
        return
    stored = turned(image, order, flips, header=True)
    again = canonical(stored.ct)
    assert again.grid.is_close(image.grid)
    assert (again.array == image.ct.array).all()
    assert canonical(again) is again


def test_a_header_that_formats_round_differently_gives_the_same_bytes() -> None:
    image = _small(np.random.default_rng(0))
    stated = np.array(image.grid.lps_from_ijk)
    stated[:3, :3] = np.diag((0.7421879768371582, 0.7421879768371582, 2.5))
    rounded = stated.astype(np.float32).astype(np.float64)
    rounded[0, 1] = -1e-9
    grids = [
        canonical(Volume(grid=Grid(shape=image.grid.shape, lps_from_ijk=m), array=image.ct.array)).grid
        for m in (stated, rounded)
    ]
    assert grids[0].lps_from_ijk.tobytes() == grids[1].lps_from_ijk.tobytes()
    assert grids[0].is_close(Grid(shape=image.grid.shape, lps_from_ijk=stated))


def _small(rng: np.random.Generator) -> HardImage:
    hu = rng.integers(-1000, 100, (4, 5, 6)).astype(np.float32)
    grid = Grid.from_spacing(hu.shape, (0.7, 0.8, 1.5), (-3.0, 8.0, 40.0))
    none = np.zeros(hu.shape, dtype=np.uint8)
    return HardImage(hu=hu, lobes=none, lumen=none > 0, grid=grid, tree_lps=np.zeros((1, 3)))


def _handed(order: tuple[int, ...], flips: tuple[int, ...]) -> float:
    return float(np.linalg.det(np.eye(3)[list(order)])) * (-1.0) ** len(flips)


def test_a_failed_check_is_refused_until_it_is_accepted_by_name() -> None:
    failed = (
        Finding(name="sides", found="It is mirrored", remedy="Look at it"),
        Finding(name="one-lung", found="One lung", remedy="Look again"),
    )
    with pytest.raises(AnatomyError, match=r"mirrored; One lung.*--accept sides --accept one-lung"):
        require_plausible(failed, ())
    with pytest.raises(AnatomyError, match=r"^One lung.*add --accept one-lung\.$"):
        require_plausible(failed, ("sides",))
    assert require_plausible(failed, ("sides", "one-lung", "volume")) == ("sides", "one-lung")
    assert require_plausible((), ("sides",)) == ()
    require_known_checks(tuple(CHECKS))
    with pytest.raises(Exception, match="sidse.*no check"):
        require_known_checks(("sidse",))


def test_an_offset_is_taken_from_every_voxel_and_a_gain_from_what_lies_above_air(image: HardImage) -> None:
    ct = image.ct
    assert Scale().image(ct) is ct
    shifted = Volume(grid=ct.grid, array=ct.array + np.int16(57))
    assert (Scale(offset_hu=57.0).image(shifted).array == ct.array).all()
    stretched = Volume(grid=ct.grid, array=(ct.array + 1000.0) * 1.25 - 1072.0)
    assert np.abs(Scale(offset_hu=-72.0, gain=0.8).image(stretched).array - ct.array).max() <= 1


@pytest.mark.parametrize(("factor", "added"), [(1.0, -60.0), (1.0, 60.0), (1.08, 0.0), (0.93, 0.0)])
def test_soft_tissue_tells_a_gain_from_a_shift(image: HardImage, factor: float, added: float) -> None:
    hu = 30.0 + (image.hu - 30.0) * factor + added
    coarse = CoarseCt.of(image.with_hu(hu).ct)
    scale = Scale.of(coarse, 30.0 - 1030.0 * factor + added + 1000.0)
    assert scale.gain == pytest.approx(1.0 / factor, abs=0.012)
    assert scale.on(np.array(30.0 - 1030.0 * factor + added)) == pytest.approx(-1000.0)
