"""From images to a lung: labels, branches, fields, warnings, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from anatomy import build
from anatomy.base.errors import AnatomyError
from anatomy.build import build_lung, lung_key
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from anatomy.plausibility import warnings_of_findings
from anatomy.structures import (
    AIRWAY,
    BRANCH_SHIFT,
    FIELD_BITS,
    FISSURE,
    LUMEN,
    MAX_BRANCHES,
    OBSTACLES,
    OUTSIDE,
    VESSEL,
)
from tests.anatomy import toys
from tests.anatomy.boxes import boxes_mm
from tests.anatomy.toys import toy


@pytest.fixture(scope="module")
def lung() -> Lung:
    return build_lung(toy())


def _cut(lung: Lung, mask: np.ndarray) -> np.ndarray:
    """Return a mask of the toy's grid on the lung's grid, False beyond."""
    first = np.rint(toys.grid().ijk(lung.grid.lps((0, 0, 0)))).astype(int)
    padded = np.pad(mask, 20)
    return padded[tuple(slice(20 + a, 20 + a + n) for a, n in zip(first, lung.grid.shape, strict=True))]


def _border(shape: tuple[int, ...]) -> np.ndarray:
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    return border


def _without_septum(warnings: tuple[str, ...]) -> bool:
    return not any("septum" in warning for warning in warnings)


def test_every_structure_gets_its_bit(lung: Lung) -> None:
    images = toy()
    lumen, wall = images.lumen.array, images.wall.array
    expected = {
        "lumen": lumen,
        "airway": lumen | wall,
        "vessel": images.vessels.array & ~lumen,
        "fissure": images.fissures.array & ~lumen & ~wall,
        "nodule": images.nodules.array,
    }
    for name, mask in expected.items():
        assert (lung.mask(name).array == _cut(lung, mask)).all(), name
    inside = images.lung.array | lumen | wall | images.vessels.array | images.nodules.array
    outside = ~_cut(lung, inside) | _border(lung.grid.shape)
    assert (lung.mask("outside").array == outside).all()
    assert _without_septum(lung.warnings)


def test_the_working_grid_holds_all_tissue_and_two_voxels_more(lung: Lung) -> None:
    tissue = toy().lung.array | toy().lumen.array
    voxels = np.argwhere(tissue)
    low = np.rint(lung.grid.ijk(toys.grid().lps(voxels.min(axis=0)))).astype(int)
    high = np.rint(lung.grid.ijk(toys.grid().lps(voxels.max(axis=0)))).astype(int)
    assert low.tolist() == [2, 2, 2]
    assert (np.array(lung.grid.shape) - 1 - high).tolist() == [2, 2, 2]


def test_airway_voxels_carry_the_branch_they_belong_to(lung: Lung) -> None:
    branch = (lung.labels.astype(int) >> BRANCH_SHIFT) - 1
    airway = (lung.labels & AIRWAY) != 0
    assert (branch[airway] >= 0).all()
    assert (branch[airway] < lung.tree.n_branches).all()
    assert (branch[~airway] == -1).all()
    # Well away from the carina the drawn tubes are the branches, wall included.
    points = lung.grid.lps(np.argwhere(airway))
    found = branch[airway]
    assert (found[points[:, 2] > 15.0] == 0).all()
    left, right = found[points[:, 0] > 15.0], found[points[:, 0] < -15.0]
    assert len(set(left)) == len(set(right)) == 1
    assert {left[0], right[0]} == {1, 2}


def test_fields_measure_to_their_structures(lung: Lung) -> None:
    rng = np.random.default_rng(0)
    points = lung.grid.lps(rng.uniform(0, np.array(lung.grid.shape) - 1, (300, 3)))
    diagonal = float(np.linalg.norm(lung.grid.spacing_mm))
    for name, bits in FIELD_BITS.items():
        bound = lung.fields[name].lower_bound_mm(points)
        true = lung.exact_clearance_mm(points, bits, cap_mm=12.0)
        assert (bound <= true + 1e-9)[true < 12.0].all(), name
        assert (bound >= true - diagonal - 0.005).all(), name


def test_united_fields_are_the_least_of_their_parts(lung: Lung) -> None:
    corners = {name: field.corners for name, field in lung.fields.items()}
    parts = np.minimum.reduce([corners[name] for name in ("airway", "vessel", "pleura")])
    assert (corners["obstacle"] == parts).all()
    assert (corners["obstacle_fissure"] == np.minimum(parts, corners["fissure"])).all()


def test_lumen_depth_is_the_distance_to_what_is_not_lumen(lung: Lung) -> None:
    rng = np.random.default_rng(1)
    lumen = lung.mask("lumen")
    points = lung.grid.lps(rng.choice(np.argwhere(lumen.array), 60) + rng.uniform(-0.5, 0.5, (60, 3)))
    depth = lung.lumen_depth.lower_bound_mm(points)
    near = ~lumen.array
    near[1:-1, 1:-1, 1:-1] &= np.logical_or.reduce(
        [np.roll(lumen.array, s, a) for a in range(3) for s in (-1, 1)]
    )[1:-1, 1:-1, 1:-1]
    true = boxes_mm(near & ~_border(near.shape), lung.grid, points)
    assert (depth <= true + 1e-9).all()
    assert (depth >= true - np.linalg.norm(lung.grid.spacing_mm) - 0.005).all()
    assert depth.max() > 4.0
    not_lumen = lung.grid.lps(rng.choice(np.argwhere(~lumen.array), 200))
    assert not lung.lumen_depth.lower_bound_mm(not_lumen).any()


def test_what_came_with_the_patient_stays_with_it(lung: Lung) -> None:
    images = toy()
    assert (lung.name, lung.kind, lung.breath_hold) == ("Toy", "masks", "inspiration")
    assert lung.sources == images.sources
    assert lung.warnings == (*images.warnings, *warnings_of_findings(lung.findings))
    assert lung.key == lung_key(images.sources)
    np.testing.assert_array_equal(lung.starts[0], images.starts[0])
    np.testing.assert_array_equal(lung.targets_lps[0], images.targets_lps[0])
    assert lung.cost is not None
    at_nodule = np.rint(lung.grid.ijk(toys.NODULE)).astype(int)
    assert lung.cost.array[tuple(at_nodule)] == 0.25


def test_lumen_wins_over_vessel_and_is_counted() -> None:
    vessels = toy().vessels.array | toys.ball((0.0, 0.0, 40.0), 3.0)
    count = int((vessels & toy().lumen.array).sum())
    assert count > 10
    lung = build_lung(toy(vessels=vessels))
    assert any(f"{count} voxels were both airway lumen and vessel" in text for text in lung.warnings)
    assert not ((lung.labels & LUMEN) != 0)[(lung.labels & VESSEL) != 0].any()
    assert (lung.labels & VESSEL).any()


def test_a_wall_may_be_a_vessel_too() -> None:
    """Which of the two is there decides nothing: both are forbidden."""
    vessels = toys.capsule(*toys.VESSEL, toys.VESSEL_RADIUS_MM) | toy().wall.array
    lung = build_lung(toy(vessels=vessels))
    wall = lung.mask("airway").array & ~lung.mask("lumen").array
    assert ((lung.labels[wall] & VESSEL) != 0).all()
    assert not any("both airway lumen and vessel" in text for text in lung.warnings)


def test_without_a_wall_mask_the_airway_is_the_lumen_and_says_so() -> None:
    lung = build_lung(toy(wall=None))
    assert (lung.mask("airway").array == lung.mask("lumen").array).all()
    assert any("No airway wall mask" in text for text in lung.warnings)


def test_without_fissures_there_are_no_fissure_fields() -> None:
    lung = build_lung(toy(fissures=None))
    assert not lung.has_fissures
    assert set(lung.fields) == {"airway", "vessel", "pleura", "obstacle"}
    assert not (lung.labels & FISSURE).any()


def test_an_empty_fissure_mask_is_a_patient_without_fissures_in_the_way() -> None:
    lung = build_lung(toy(fissures=np.zeros(toys.grid().shape, dtype=bool)))
    assert lung.has_fissures
    assert (lung.fields["obstacle"].corners == lung.fields["obstacle_fissure"].corners).all()


def test_touching_lungs_are_kept_apart_and_the_user_is_told() -> None:
    lung = toy().lung.array | toys.capsule(toys.LEFT_LUNG, toys.RIGHT_LUNG, 9.0)
    built = build_lung(toy(lung=lung))
    (text,) = (text for text in built.warnings if "septum" in text)
    added = _cut(built, lung) & built.mask("outside").array
    assert f"septum of {int(added.sum())} voxels" in text
    middle = built.grid.lps(np.argwhere(added))
    assert np.abs(middle[:, 0]).max() < 20.0
    assert np.ptp(middle[:, 0]) < 10.0


def test_one_lung_is_a_warning() -> None:
    lung = toy().lung.array.copy()
    lung[toys.grid().lps(np.stack(np.indices(lung.shape), axis=-1))[..., 0] < 0.0] = False
    built = build_lung(toy(lung=lung))
    assert any("could not be split into two lungs" in text for text in built.warnings)


@pytest.mark.parametrize(
    ("role", "said"), [("lung", "The lung mask of Toy"), ("lumen", "The airway lumen mask of Toy")]
)
def test_empty_masks_are_refused(role: str, said: str) -> None:
    with pytest.raises(AnatomyError, match=said) as caught:
        build_lung(toy(**{role: np.zeros(toys.grid().shape, dtype=bool)}))
    assert caught.value.remedy


def _cropped(low: tuple[int, int, int], high: tuple[int, int, int]) -> Any:
    """Return the toy on a part of its grid."""
    images = toy()
    window = tuple(slice(a, n - b) for a, b, n in zip(low, high, images.grid.shape, strict=True))
    grid = images.grid.crop(low, np.array(images.grid.shape) - high)
    names = ("lumen", "wall", "vessels", "lung", "fissures", "nodules", "cost")
    parts = {
        name: Volume(grid=grid, array=np.asfortranarray(getattr(images, name).array[window]))
        for name in names
    }
    return toy(grid=grid, **parts)


def test_a_lung_cut_off_by_the_image_ends_there() -> None:
    images = _cropped((14, 6, 12), (14, 6, 0))
    for axis in range(3):
        assert images.lung.array.take(0, axis=axis).any()
    lung = build_lung(images)
    assert ((lung.labels & OUTSIDE) != 0)[_border(lung.grid.shape)].all()
    assert lung.grid.shape[1] == images.grid.shape[1] + 4
    i, _j, k = np.rint(images.grid.ijk(toys.LEFT_LUNG))
    at_image_face = images.grid.lps((i, -0.5, k))
    assert lung.label_at(at_image_face - (0.0, 0.01, 0.0)) & OUTSIDE
    inside = at_image_face + (0.0, 0.4, 0.0)
    assert lung.exact_clearance_mm(inside, OUTSIDE, cap_mm=5.0)[0] == pytest.approx(0.4)
    assert lung.fields["pleura"].lower_bound_mm(inside)[0] <= 0.4


def test_what_runs_off_the_grid_ends_in_outside() -> None:
    """A vessel or nodule beyond the box of the lungs must not make the end of the grid passable."""
    nodule = toys.ball((40.0, 0.0, -74.0), 9.0)
    vessel = toys.capsule((68.0, 0.0, -30.0), (75.0, 0.0, -30.0), 4.0)
    lung = build_lung(toy(nodules=nodule, vessels=vessel))
    border = _border(lung.grid.shape)
    assert (lung.mask("nodule").array & border).any()
    assert (lung.mask("vessel").array & border).any()
    assert ((lung.labels & OUTSIDE) != 0)[border].all()
    low = lung.grid.lps(np.argwhere(lung.mask("nodule").array & border)[0])
    points = low + np.linspace(0.0, 6.0, 30)[:, None] * (0.0, 0.0, 1.0)
    bound = lung.fields["obstacle"].lower_bound_mm(points)
    assert (bound <= lung.exact_clearance_mm(points, OBSTACLES, cap_mm=20.0) + 1e-9).all()


def test_labels_cannot_number_more_branches_than_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_BRANCHES << BRANCH_SHIFT <= np.iinfo(np.uint16).max < (MAX_BRANCHES + 1) << BRANCH_SHIFT
    monkeypatch.setattr(build.structures, "MAX_BRANCHES", 2)
    with pytest.raises(AnatomyError, match="has 3 branches"):
        build_lung(toy())


def test_arrays_are_replaced_by_what_is_kept() -> None:
    """A cache hands back mapped files; nothing must hold on to the first copy."""
    kept: dict[str, np.ndarray] = {}

    def keep(name: str, array: np.ndarray) -> np.ndarray:
        kept[name] = array.copy(order="F")
        return kept[name]

    lung = build_lung(toy(), keep=keep)
    fields = {f"fields.{name}.corners" for name in FIELD_BITS}
    assert set(kept) == {"labels", "lumen_depth.corners", "nodules.array", "cost.array", *fields}
    assert np.shares_memory(lung.labels, kept["labels"])
    assert np.shares_memory(lung.lumen_depth.corners, kept["lumen_depth.corners"])
    assert lung.nodules is not None and np.shares_memory(lung.nodules.array, kept["nodules.array"])
    for name, field in lung.fields.items():
        assert np.shares_memory(field.corners, kept[f"fields.{name}.corners"])


def test_progress_names_the_steps() -> None:
    steps: list[str] = []
    build_lung(toy(), progress=steps.append)
    assert steps[:2] == ["airway tree", "labels"]
    assert "clearance to fissure" in steps


def test_the_key_depends_on_contents_and_processing(monkeypatch: pytest.MonkeyPatch) -> None:
    one = lung_key({"a": "1", "b": "2"})
    assert one == lung_key({"b": "2", "a": "1"})
    others = {one, lung_key({"a": "1", "b": "3"}), lung_key({"a": "1", "c": "2"}), lung_key({"a": "1"})}
    monkeypatch.setattr(build, "FORMAT", build.FORMAT + 1)
    assert len(others | {lung_key({"a": "1", "b": "2"})}) == 5


def test_a_rotated_patient_is_the_same_patient(lung: Lung) -> None:
    """Axes in another order, as in sagittal images, change no clearance."""
    images = toy()
    axes = [1, 2, 0]
    matrix = images.grid.lps_from_ijk.copy()
    matrix[:3, :3] = matrix[:3, axes]
    grid = Grid(shape=tuple(np.take(images.grid.shape, axes)), lps_from_ijk=matrix)
    names = ("lumen", "wall", "vessels", "lung", "fissures", "nodules", "cost")
    turned = {
        name: Volume(grid=grid, array=np.asfortranarray(getattr(images, name).array.transpose(axes)))
        for name in names
    }
    other = build_lung(toy(grid=grid, **turned))
    points = lung.grid.lps(np.random.default_rng(3).uniform(0, np.array(lung.grid.shape) - 1, (200, 3)))
    for name in FIELD_BITS:
        np.testing.assert_allclose(
            other.fields[name].lower_bound_mm(points), lung.fields[name].lower_bound_mm(points), atol=0.02
        )


def test_the_phantom_becomes_what_was_drawn(small_phantom: Phantom, small_lung: Lung) -> None:
    assert _without_septum(small_lung.warnings)
    assert small_lung.has_fissures
    for line, name in (("airway", "lumen"), ("artery", "vessel"), ("vein", "vessel")):
        points = small_phantom.centerlines[line].points_lps
        bits = {"lumen": LUMEN, "vessel": VESSEL}[name]
        inside = small_lung.grid.contains(points)
        hit = [small_lung.label_at(point) & bits != 0 for point in points[inside][::7]]
        assert np.mean(hit) > 0.9, line
    for nodule in small_phantom.nodules:
        assert small_lung.label_at(nodule.centre_lps) & OUTSIDE == 0
