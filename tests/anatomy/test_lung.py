"""What a lung answers, and that it does not change; on real anatomy, that it is anatomy."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.build import build_lung
from anatomy.fields import distance_field
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BITS, FIELD_BITS, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from tests.anatomy import toys
from tests.anatomy.boxes import boxes_mm
from tests.anatomy.toys import toy


@pytest.fixture(scope="module")
def lung() -> Lung:
    return build_lung(toy())


def test_masks_are_the_bits_of_the_labels(lung: Lung) -> None:
    for name, bit in BITS.items():
        mask = lung.mask(name)
        assert mask.array.dtype == np.bool_
        assert mask.array.flags.f_contiguous
        assert mask.array.any()
        assert (mask.array == ((lung.labels & bit) != 0)).all()
    assert lung.nodules is not None
    assert lung.mask("nodule") is lung.nodules


def test_structures_that_are_not_there_are_named(lung: Lung) -> None:
    with pytest.raises(AnatomyError, match=r"no structure 'heart'.*airway, vessel.*nodule"):
        lung.mask("heart")
    with pytest.raises(AnatomyError, match=r"Toy has no nodule mask.*target point"):
        replace(lung, nodules=None).mask("nodule")


def test_the_label_at_a_point_is_that_of_its_voxel(lung: Lung) -> None:
    assert lung.label_at(np.array([0.0, 0.0, 60.0])) & (AIRWAY | LUMEN) == AIRWAY | LUMEN
    assert lung.label_at(np.array(toys.VESSEL[0])) == VESSEL
    assert lung.label_at(np.array(toys.NODULE)) == 0
    assert lung.label_at(np.array([0.0, 0.0, -60.0])) == OUTSIDE
    assert lung.label_at(np.array([0.0, 1e6, 0.0])) == OUTSIDE
    rng = np.random.default_rng(0)
    for ijk in rng.integers(0, lung.grid.shape, (50, 3)):
        point = lung.grid.lps(ijk + rng.uniform(-0.49, 0.49, 3))
        assert lung.label_at(point) == lung.labels[tuple(ijk)]


def test_exact_clearance_is_the_distance_to_the_boxes(lung: Lung) -> None:
    vessel = lung.mask("vessel").array
    surface = vessel & ~ndimage.binary_erosion(vessel)
    points = np.array(toys.NODULE) + np.random.default_rng(0).uniform(-15, 15, (40, 3))
    found = lung.exact_clearance_mm(points, VESSEL, cap_mm=100.0)
    outside = ~np.array([lung.label_at(point) & VESSEL != 0 for point in points])
    np.testing.assert_allclose(found[outside], boxes_mm(surface, lung.grid, points)[outside], atol=1e-9)
    assert not found[~outside].any()
    capped = lung.exact_clearance_mm(points, VESSEL, cap_mm=6.0)
    np.testing.assert_array_equal(capped, np.minimum(found, 6.0))
    assert lung.least_clearance_mm(points, "vessel", VESSEL, cap_mm=100.0) == found.min()
    bound = lung.fields["vessel"].lower_bound_mm(points).min()
    assert lung.least_clearance_mm(points, "vessel", VESSEL, cap_mm=0.9 * bound) == bound


def test_the_wall_of_an_exempt_branch_does_not_count(lung: Lung) -> None:
    branch = int(lung.tree.branch_of_point[lung.tree.nearest_point((30.0, 0.0, -30.0))])
    near = np.array([30.0, 12.0, -30.0])
    assert lung.exact_clearance_mm(near, AIRWAY, cap_mm=20.0)[0] < 6.0
    spared = lung.exact_clearance_mm(near, AIRWAY, cap_mm=20.0, exempt_branch=branch)[0]
    others = lung.mask("airway").array & ((lung.labels >> 5) != branch + 1)
    assert spared == pytest.approx(min(boxes_mm(others, lung.grid, near[None])[0], 20.0))


def test_the_obstacle_field_has_fissures_if_asked_and_there(lung: Lung) -> None:
    assert lung.obstacle_field(with_fissures=True) is lung.fields["obstacle_fissure"]
    assert lung.obstacle_field(with_fissures=False) is lung.fields["obstacle"]
    bare = replace(lung, fields={k: v for k, v in lung.fields.items() if "fissure" not in k})
    assert not bare.has_fissures
    assert bare.obstacle_field(with_fissures=True) is lung.fields["obstacle"]


def test_a_lung_does_not_change(lung: Lung) -> None:
    with pytest.raises(FrozenInstanceError):
        lung.name = "other"  # type: ignore[misc]
    with pytest.raises(TypeError):
        lung.sources["airway.nii.gz"] = "0"  # type: ignore[index]
    with pytest.raises(TypeError):
        del lung.fields["airway"]  # type: ignore[attr-defined]
    for array in (lung.labels, lung.geometry, lung.fields["airway"].corners, lung.starts[0]):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


def test_later_changes_of_what_a_lung_was_made_from_do_not_reach_it(lung: Lung) -> None:
    fields, sources = dict(lung.fields), dict(lung.sources)
    other = replace(lung, fields=fields, sources=sources)
    fields.clear()
    sources.clear()
    assert "airway" in other.fields
    assert other.sources


def test_labels_and_fields_must_fit_the_grid(lung: Lung) -> None:
    with pytest.raises(GridMismatchError, match="does not fit the labels of Toy"):
        replace(lung, labels=np.zeros((3, 4, 5), dtype=np.uint16))
    small = Grid.from_spacing((2, 2, 2), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    wrong = distance_field("vessel", np.zeros(small.shape, dtype=bool), small)
    with pytest.raises(GridMismatchError, match="does not fit the vessel field of Toy"):
        replace(lung, fields={**lung.fields, "vessel": wrong})


@pytest.fixture(scope="module")
def patient1(data_dir: Path) -> Lung:
    from anatomy.io import load_patient

    return build_lung(load_patient(data_dir / "med-rad" / "Patient1"))


def _at(lung: Lung, points: np.ndarray) -> np.ndarray:
    return np.array([lung.label_at(point) for point in points])


@pytest.mark.slow
@pytest.mark.data
class TestPatient1:
    """UNC Med-RAD, LIDC-IDRI 297: the lungs touch along the anterior junction line."""

    def test_bronchi_lie_in_the_lung_and_the_airway_in_its_lumen(self, patient1: Lung) -> None:
        tree = patient1.tree
        labels = _at(patient1, tree.points_lps)
        in_lumen = (labels & LUMEN) != 0
        gaps = sum(gap.length_mm > 0 for gap in tree.report.gaps_bridged)
        assert (~in_lumen).sum() <= 12 * gaps
        tips = tree.points_lps[[tree.branch_points(int(b))[-1] for b in tree.leaf_branches]]
        around = tips + np.array([[0, 0, 3.0], [0, 0, -3.0], [0, 3.0, 0], [0, -3.0, 0]])[:, None]
        in_lung = (_at(patient1, around.reshape(-1, 3)) & OUTSIDE) == 0
        assert in_lung.mean() > 0.9

    def test_left_is_left(self, patient1: Lung) -> None:
        tree = patient1.tree
        main = [int(b) for b in tree.children(0)]
        ends = tree.points_lps[[tree.branch_points(b)[-1] for b in main]]
        x = ends[:, 0] - tree.carina_lps[0]
        assert x.max() > 15.0
        assert x.min() < -5.0
        # The left main bronchus is the longer one, and the trachea comes from above.
        left, right = main[int(np.argmax(x))], main[int(np.argmin(x))]
        assert tree.branch_length_mm[left] > tree.branch_length_mm[right]
        assert tree.points_lps[0, 2] > tree.carina_lps[2] + 30.0

    def test_a_septum_keeps_the_lungs_apart(self, patient1: Lung) -> None:
        assert any("a septum of" in text for text in patient1.warnings)
        free = (patient1.labels & OBSTACLES) == 0
        parts, _count = ndimage.label(free)
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        first, second = np.argsort(sizes)[:-3:-1]
        assert sizes[second] > 0.5 * sizes[first]
        x = [patient1.grid.lps(c)[0] for c in ndimage.center_of_mass(free, parts, [first, second])]
        assert min(x) < patient1.tree.carina_lps[0] - 30.0
        assert max(x) > patient1.tree.carina_lps[0] + 30.0

    def test_bounds_are_never_above_the_exact_distance(self, patient1: Lung) -> None:
        rng = np.random.default_rng(0)
        free = np.argwhere((patient1.labels & OBSTACLES) == 0)
        airway = np.argwhere((patient1.labels & AIRWAY) != 0)
        ijk = [
            rng.choice(free, 800) + rng.uniform(-0.5, 0.5, (800, 3)),
            rng.choice(airway, 600) + rng.uniform(-12.0, 12.0, (600, 3)),
            rng.uniform(0, np.array(patient1.grid.shape) - 1, (600, 3)),
        ]
        points = patient1.grid.lps(np.concatenate(ijk))
        points = points[patient1.grid.contains(points)]
        assert len(points) > 1900
        diagonal = float(np.linalg.norm(patient1.grid.spacing_mm))
        cap = 10.0
        for name, bits in FIELD_BITS.items():
            bound = patient1.fields[name].lower_bound_mm(points)
            exact = patient1.exact_clearance_mm(points, bits, cap_mm=cap)
            known = exact < cap
            assert known.sum() > 100, name
            assert (bound <= exact + 1e-9)[known].all(), name
            assert (bound >= exact - diagonal - 0.005).all(), name

    def test_starts_are_at_the_airway_and_the_target_is_in_the_lung(self, patient1: Lung) -> None:
        assert len(patient1.starts) == 5
        at_wall = np.array([start[:3, 3] for start in patient1.starts])
        assert patient1.exact_clearance_mm(at_wall, AIRWAY, cap_mm=20.0).max() < 5.0
        (target,) = patient1.targets_lps
        assert patient1.label_at(target) & (OUTSIDE | AIRWAY) == 0
        nodule = patient1.mask("nodule").array
        assert boxes_mm(nodule, patient1.grid, target[None])[0] < 2.0
