"""The synthetic patient: truth that agrees with itself, with anatomy and with its images."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import edt
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.typed import Float, Int16, UInt8
from anatomy.io import load_patient, read_volume
from anatomy.phantom import LABELS, LOBES, Centerlines, Phantom, make_phantom, write_phantom
from anatomy.tree import tree_from_mask
from tests.anatomy.phantom_lines import diameters_mm, lengths_mm

FULL = np.ones((3, 3, 3))
SIZES = pytest.mark.parametrize("size", ["small", pytest.param("adult", marks=pytest.mark.slow)])


@pytest.fixture(scope="module")
def small() -> Phantom:
    return make_phantom(seed=0, size="small")


@pytest.fixture(scope="module")
def adult() -> Phantom:
    return make_phantom(seed=0, spacing_mm=1.0)


@pytest.fixture(scope="module")
def airway(small: Phantom) -> Centerlines:
    return small.centerlines["airway"]


def _ends(lines: Centerlines) -> tuple[Float, Float]:
    return lines.points_lps[lines.branch_start[:-1]], lines.points_lps[lines.branch_start[1:] - 1]


def _directions(lines: Centerlines) -> Float:
    start, end = _ends(lines)
    return np.asarray((end - start) / np.linalg.norm(end - start, axis=1, keepdims=True))


def _turns_deg(lines: Centerlines) -> Float:
    heading = _directions(lines)
    cosine = (heading[1:] * heading[lines.branch_parent[1:]]).sum(axis=1)
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def _labels_at(patient: Phantom, points: Float) -> UInt8:
    ijk = np.rint(patient.grid.ijk(points)).astype(int)
    inside = ((ijk >= 0) & (ijk < patient.grid.shape)).all(axis=1)
    return np.asarray(patient.labels.array[tuple(ijk[inside].T)])


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_phantom(spacing_mm=0.0),
        lambda: make_phantom(spacing_mm=-1.0),
        lambda: make_phantom(spacing_mm=float("nan")),
        lambda: make_phantom(spacing_mm=float("inf")),
        lambda: make_phantom(spacing_mm=6.0),
        lambda: make_phantom(spacing_mm=2.5, size="small"),
        lambda: make_phantom(seed=-1),
        lambda: make_phantom(seed=1.5),  # type: ignore[arg-type]
        lambda: make_phantom(size="giant"),  # type: ignore[arg-type]
        lambda: make_phantom(noise_hu=-1.0),
        lambda: make_phantom(noise_hu=float("nan")),
    ],
)
def test_impossible_settings_are_refused(make: Callable[[], Phantom]) -> None:
    with pytest.raises(SettingsError, match="Expected"):
        make()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not() -> None:
    one, same, other = (make_phantom(seed=s, size="small", spacing_mm=1.75) for s in (3, 3, 4))
    for name in ("ct", "labels", "lobes"):
        assert getattr(one, name).array.tobytes("F") == getattr(same, name).array.tobytes("F")
    for kind, lines in one.centerlines.items():
        assert lines.points_lps.tobytes() == same.centerlines[kind].points_lps.tobytes()
        assert lines.radius_mm.tobytes() == same.centerlines[kind].radius_mm.tobytes()
    assert one.images.sources == same.images.sources != other.images.sources
    assert (one.labels.array != other.labels.array).mean() > 0.01


@pytest.mark.slow
def test_making_a_phantom_leaves_the_global_random_state_alone() -> None:
    np.random.seed(7)  # noqa: NPY002
    undisturbed = np.random.random(3)  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    make_phantom(size="small", spacing_mm=1.75)
    assert (np.random.random(3) == undisturbed).all()  # noqa: NPY002


def test_images_agree_with_labels(small: Phantom) -> None:
    images = small.images
    assert images.kind == "phantom"
    assert images.wall is not None and images.fissures is not None and images.nodules is not None
    for volume, names in (
        (images.lumen, ("lumen",)),
        (images.wall, ("wall",)),
        (images.vessels, ("artery", "vein")),
        (images.fissures, ("fissure",)),
        (images.nodules, ("nodule",)),
    ):
        assert volume.array.any()
        assert (volume.array == small.mask(*names)).all()
    assert set(np.unique(small.labels.array)) == set(LABELS.values()) - {LABELS["bulla"]}
    assert ((small.lobes.array > 0) == images.lung.array).all()
    assert images.lung.array[small.mask("lung", "fissure", "nodule")].all()


def test_left_is_left_and_up_is_up(small: Phantom, airway: Centerlines) -> None:
    x = small.grid.lps(np.argwhere(small.lobes.array > 0))[:, 0]
    lobe = small.lobes.array[small.lobes.array > 0]
    left = np.isin(lobe, [LOBES["left upper"], LOBES["left lower"]])
    assert x[left].min() > 0 > x[~left].max()
    heart = small.grid.lps(np.argwhere(small.mask("heart"))).mean(axis=0)
    assert heart[0] > 0 and heart[1] < 0
    bone = small.grid.lps(np.argwhere(small.mask("bone")))
    spine = bone[np.abs(bone[:, 0]) < 10].mean(axis=0)
    assert spine[1] > 0
    start, end = _ends(airway)
    assert start[0, 2] > end[0, 2]
    right, left_main = airway.names.index("right main bronchus"), airway.names.index("left main bronchus")
    assert end[right, 0] < 0 < end[left_main, 0]
    down = -_directions(airway)[:, 2]
    assert down[right] > down[left_main]
    assert lengths_mm(airway)[right] < lengths_mm(airway)[left_main]
    assert diameters_mm(airway)[right] > diameters_mm(airway)[left_main]


def test_two_lungs_that_do_not_touch(small: Phantom) -> None:
    assert ndimage.label(small.images.lung.array, FULL)[1] == 2
    sizes = np.bincount(small.lobes.array.ravel(order="K"))[1:]
    assert len(sizes) == 5
    assert sizes[:3].sum() > sizes[3:].sum()
    assert sizes[LOBES["right middle"] - 1] == sizes.min()


def test_a_fissure_lies_between_lobes_only(small: Phantom) -> None:
    lobes = small.lobes.array
    high = ndimage.grey_dilation(lobes, size=3)
    low = 255 - ndimage.grey_dilation(np.where(lobes > 0, 255 - lobes, 0), size=3)
    assert (high > low)[small.mask("fissure")].all()


def test_airways_are_one_piece_without_loops_to_other_branches(small: Phantom, airway: Centerlines) -> None:
    lumen = small.images.lumen.array
    assert ndimage.label(lumen)[1] == 1
    assert ndimage.label(~lumen, FULL)[1] == 1
    assert (_labels_at(small, airway.points_lps) == LABELS["lumen"]).all()
    assert lumen[:, :, -1].any()


def test_every_tree_is_connected_point_by_point(small: Phantom) -> None:
    for lines in small.centerlines.values():
        start, end = _ends(lines)
        assert (lines.branch_parent[1:] < np.arange(1, lines.n_branches)).all()
        assert np.abs(start[1:] - end[lines.branch_parent[1:]]).max() < 1e-9
        assert (np.bincount(lines.branch_parent[1:])[lines.branch_parent[1:]] >= 2).all()


def test_the_small_airway_has_a_carina_and_five_generations_in_the_mask(airway: Centerlines) -> None:
    assert (np.bincount(airway.generation)[:3] == [1, 2, 4]).all()
    assert airway.generation.max() >= 5
    assert (diameters_mm(airway)[airway.generation <= 3] > 3.9).all()
    assert (diameters_mm(airway)[airway.generation <= 3] > 4.3).sum() >= 8


def test_a_bronchoscope_of_4_2_mm_can_stand_in_three_generations(small: Phantom, airway: Centerlines) -> None:
    lumen = small.images.lumen.array
    depth = (
        ndimage.distance_transform_edt(lumen, sampling=small.grid.spacing_mm) - small.grid.spacing_mm[0] / 2
    )
    for branch in np.flatnonzero(airway.generation <= 2):
        line = airway.points_lps[airway.branch_start[branch] : airway.branch_start[branch + 1]]
        middle = np.rint(small.grid.ijk(line[len(line) // 2])).astype(int)
        near = depth[tuple(slice(c - 1, c + 2) for c in middle)]
        assert near.max() > 2.1


def test_the_tree_of_the_mask_is_the_tree_that_was_drawn(small: Phantom, airway: Centerlines) -> None:
    tree = tree_from_mask(small.images.lumen)
    assert np.abs(tree.carina_lps).max() < 4
    assert (np.bincount(tree.generation)[:4] == np.bincount(airway.generation)[:4]).all()
    assert tree.n_branches == pytest.approx(airway.n_branches, rel=0.3)


def test_diameters_fall_by_order_as_in_measured_lungs(airway: Centerlines) -> None:
    fall = np.polyfit(airway.generation, np.log(diameters_mm(airway)), 1)[0]
    assert -0.30 < fall < -0.12
    rise, at_zero = np.polyfit(airway.strahler_order, np.log(diameters_mm(airway)), 1)
    assert 1.2 < np.exp(rise) < 1.8
    fit = rise * airway.strahler_order + at_zero
    assert np.corrcoef(fit, np.log(diameters_mm(airway)))[0, 1] > 0.85
    child = np.arange(1, airway.n_branches)
    assert (diameters_mm(airway)[child] < diameters_mm(airway)[airway.branch_parent[child]]).all()


def test_lengths_and_angles_are_plausible(airway: Centerlines) -> None:
    grown = airway.generation > 4
    ratio = (lengths_mm(airway) / diameters_mm(airway))[grown]
    assert 2.5 < np.median(ratio) < 4.0
    turns = _turns_deg(airway)[airway.generation[1:] > 4]
    assert 25 < turns.mean() < 45


@SIZES
def test_walls_are_a_tenth_to_a_fifth_of_the_diameter(size: str, request: pytest.FixtureRequest) -> None:
    lines = request.getfixturevalue(size).centerlines["airway"]
    wall = lines.outer_radius_mm - lines.radius_mm
    assert wall.min() >= 0.5 - 1e-12
    wide = lines.radius_mm > 1.5
    assert ((wall / (2 * lines.radius_mm))[wide] > 0.095).all()
    assert ((wall / (2 * lines.radius_mm))[wide] < 0.205).all()


def test_an_artery_runs_beside_every_airway_in_the_lung(small: Phantom, airway: Centerlines) -> None:
    arteries = small.centerlines["artery"]
    in_lobe = np.repeat(airway.lobe > 0, np.diff(airway.branch_start))
    points, outside = airway.points_lps[in_lobe], airway.outer_radius_mm[in_lobe]
    distance, nearest = cKDTree(arteries.points_lps).query(points)
    gap = distance - outside - arteries.radius_mm[nearest]
    assert np.median(gap) < 1.5
    assert (gap < 4.0).mean() > 0.9
    segments = {name.replace("B", "A", 1) for name in airway.names if name[1:2] == "B"}
    assert segments <= set(arteries.names)
    ratio = arteries.radius_mm[nearest] / airway.radius_mm[in_lobe]
    assert 0.8 < np.median(ratio) < 1.2


def test_veins_keep_to_the_room_between(small: Phantom, airway: Centerlines) -> None:
    finder = cKDTree(airway.points_lps)
    away = {}
    for kind in ("artery", "vein"):
        lines = small.centerlines[kind]
        thin = (np.repeat(lines.lobe > 0, np.diff(lines.branch_start))) & (lines.radius_mm < 2)
        away[kind] = np.median(finder.query(lines.points_lps[thin])[0])
    assert away["vein"] > 1.3 * away["artery"]


def test_vessels_and_airways_do_not_overlap(small: Phantom, airway: Centerlines) -> None:
    finder = cKDTree(airway.points_lps)
    for kind in ("artery", "vein"):
        lines = small.centerlines[kind]
        codes = _labels_at(small, lines.points_lps)
        assert not np.isin(codes, [LABELS["lumen"], LABELS["wall"], LABELS["nodule"]]).any()
        distance, nearest = finder.query(lines.points_lps, k=8)
        gap = (distance - airway.outer_radius_mm[nearest]).min(axis=1) - lines.radius_mm
        assert gap.min() > -2 * small.grid.spacing_mm[0]
        assert (gap > -0.5 * small.grid.spacing_mm[0]).mean() > 0.99


def test_vessels_go_on_beyond_the_airways(small: Phantom, airway: Centerlines) -> None:
    depth = ndimage.distance_transform_edt(small.images.lung.array, sampling=small.grid.spacing_mm)

    def tip_depth(lines: Centerlines) -> float:
        tips = np.setdiff1d(np.arange(lines.n_branches), lines.branch_parent)
        ijk = np.rint(small.grid.ijk(lines.points_lps[lines.branch_start[tips + 1] - 1])).astype(int)
        return float(np.median(depth[tuple(ijk.T)]))

    assert tip_depth(small.centerlines["artery"]) < tip_depth(airway)
    for kind in ("artery", "vein"):
        assert small.centerlines[kind].n_branches > 1.5 * airway.n_branches
        assert small.centerlines[kind].radius_mm.min() < 1.2


@SIZES
def test_nodules_lie_free_in_the_outer_lung(size: str, request: pytest.FixtureRequest) -> None:
    patient: Phantom = request.getfixturevalue(size)
    scale = 0.7 if size == "small" else 1.0
    lung = np.array(patient.images.lung.array, order="F")
    depth = edt.edt(lung, anisotropy=tuple(patient.grid.spacing_mm))
    pieces, count = ndimage.label(patient.mask("nodule"))
    assert 3 <= count == len(patient.nodules) <= 6
    ijk = np.argwhere(patient.mask("nodule"))
    for nodule in patient.nodules:
        middle = tuple(np.rint(patient.grid.ijk(nodule.centre_lps)).astype(int))
        assert patient.lobes.array[middle] == nodule.lobe
        assert 3 <= nodule.radius_mm <= 8 * scale
        assert nodule.radius_mm + 4 * scale < depth[middle] < 31 * scale
        ball = pieces == pieces[middle]
        volume = ball.sum() * patient.grid.voxel_volume_mm3
        assert volume == pytest.approx(4 / 3 * np.pi * nodule.radius_mm**3, rel=0.12)
    assert (patient.lobes.array[tuple(ijk.T)] > 0).all()


def test_hounsfield_units_of_every_tissue(small: Phantom) -> None:
    ct = small.ct.array
    assert ct.dtype == np.int16

    def core(*names: str, depth: int = 2) -> Int16:
        values = ct[ndimage.binary_erosion(small.mask(*names), FULL, iterations=depth)]
        assert len(values) > 20
        return np.asarray(values)

    assert core("lumen").mean() == pytest.approx(-1000, abs=5)
    assert core("lung").mean() == pytest.approx(-860, abs=15)
    assert core("artery", "vein").mean() == pytest.approx(40, abs=8)
    assert core("soft_tissue").mean() == pytest.approx(20, abs=5)
    assert core("heart").std() == pytest.approx(18, abs=1)
    assert core("nodule", depth=1).mean() == pytest.approx(40, abs=15)
    wall = ct[small.mask("wall")].mean()
    assert core("lumen").mean() + 200 < wall < 40


def test_the_lung_is_denser_at_the_back(small: Phantom) -> None:
    deep = ndimage.binary_erosion(small.mask("lung"), FULL, iterations=2)
    y = small.grid.lps(np.argwhere(deep))[:, 1]
    assert np.polyfit(y, small.ct.array[deep], 1)[0] == pytest.approx(0.35, abs=0.05)


def test_a_written_phantom_is_read_back(tmp_path: Path) -> None:
    patient = make_phantom(seed=5, size="small", spacing_mm=1.75)
    folder = write_phantom(patient, tmp_path / "new" / "patient")
    images = load_patient(folder)
    assert images.name == patient.images.name
    assert images.breath_hold == "inspiration"
    for name in ("lumen", "wall", "vessels", "lung", "fissures", "nodules"):
        assert (getattr(images, name).array == getattr(patient.images, name).array).all()
    assert images.grid.is_close(patient.grid)
    for read, written in zip(images.targets_lps, patient.images.targets_lps, strict=True):
        assert (read == written).all()
    assert (read_volume(folder / "ct.nii.gz").array == patient.ct.array).all()
    truth = json.loads((folder / "truth.json").read_text())
    assert len(truth["centerlines"]["vein"]["branch_parent"]) == patient.centerlines["vein"].n_branches


def test_an_unwritable_folder_is_a_typed_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError):
        write_phantom(make_phantom(size="small", spacing_mm=1.75), tmp_path / "file" / "patient")


@pytest.mark.slow
def test_the_adult_has_eight_generations_of_adult_size(adult: Phantom) -> None:
    lines = adult.centerlines["airway"]
    assert (np.bincount(lines.generation)[:3] == [1, 2, 4]).all()
    assert lines.generation.max() >= 8
    assert 16 < diameters_mm(lines)[0] < 20
    assert 100 < lengths_mm(lines)[0] < 120
    litres = adult.images.lung.array.sum() * adult.grid.voxel_volume_mm3 / 1e6
    assert 4 < litres < 6.5
    assert ndimage.label(adult.images.lumen.array)[1] == 1
    named = [name for name in lines.names if name[1:2] == "B" and name[2:].replace("+", "").isdigit()]
    assert {"RB1", "RB6", "RB10", "LB1+2", "LB6", "LB10"} <= set(named)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_other_seeds_are_whole_too(seed: int) -> None:
    patient = make_phantom(seed=seed, size="small")
    assert ndimage.label(patient.images.lumen.array)[1] == 1
    assert ndimage.label(patient.images.lung.array, FULL)[1] == 2
    assert patient.centerlines["airway"].generation.max() >= 7
    for lines in patient.centerlines.values():
        assert lines.n_branches > 100
