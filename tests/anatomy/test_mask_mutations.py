"""No mutation of meaning is silent: the lung is the same, or a warning or an error says what is wrong."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, LungaccessError
from anatomy.base.typed import Array, Float
from anatomy.build import build_lung
from anatomy.grid import Volume
from anatomy.io.patients import load_patient
from anatomy.mask_findings import mask_findings
from anatomy.morphology import bounds, components, window
from anatomy.patient import PatientImages
from anatomy.phantom import Phantom, make_phantom
from anatomy.plausibility import DOUBTFUL, FITS, REFUSED, require_plausible, with_accepted
from anatomy.sides import coarse_sides, points_of_sides
from anatomy.tree import tree_from_mask
from tests.anatomy.mask_mutations import KINDS, ROLES, Masks, Mutation, drawn, write

MANY = int(os.environ.get("LUNGACCESS_MUTATIONS", "200"))
"""So many mutations of each of four phantoms and a patient are drawn in the slow tests, 1,000 in all."""
SAME_PLACE_MM = 1.0
"""Nodules whose middles are as near are the same targets, and lungs that differ by less are the same."""
NOWHERE = (np.zeros((0, 3)), np.zeros((0, 3)))


class Checked:
    """The masks of a patient as they were read, and what a user is told of them.

    What depends on masks alone that are as those of `whole` is taken from there.
    """

    def __init__(self, images: PatientImages, folder: Path, whole: Checked | None = None) -> None:
        self.tree: AirwayTree
        self.points: tuple[Float, Float]
        self.images, self.folder = images, folder
        self.changed = [
            role
            for role in ROLES
            if whole and not _are_same(getattr(images, role), getattr(whole.images, role))
        ]
        changed = set(self.changed if whole else ROLES)
        self.tree = whole.tree if whole and "lumen" not in changed else tree_from_mask(images.lumen)
        if whole and not changed & {"lumen", "lung"}:
            self.points = whole.points
        else:
            sides = coarse_sides(images.lung.array & ~images.lumen.array, images.grid)
            self.points = NOWHERE if sides is None else points_of_sides(*sides, images.grid)
        self.findings = mask_findings(images, self.tree, self.points)
        told = [*images.warnings, *(each.found for each in self.findings if each.verdict != FITS)]
        # The same warning with other numbers is no new one.
        self.words = {re.sub(r"-?\d+(?:\.\d+)?", "#", each) for each in told}
        self.masks = masks_of(images)


def masks_of(images: PatientImages) -> Masks:
    return {role: mask for role in ROLES if (mask := getattr(images, role)) is not None}


def checked(images: PatientImages, folder: Path) -> Checked:
    """Write the masks of a patient into the folder `whole`, and read them again."""
    images = load_patient(write(folder / "whole", masks_of(images), targets_lps=images.targets_lps))
    return Checked(images, folder)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return make_phantom(seed=3, size="small")


@pytest.fixture(scope="module")
def whole(phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Checked:
    return checked(phantom.images, tmp_path_factory.mktemp("phantom"))


def _are_same(one: Volume | None, other: Volume | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.grid.is_close(other.grid) and np.array_equal(one.array, other.array)


def _middles(nodules: Volume) -> Array:
    voxels, part = components(nodules.array)
    middles = [nodules.grid.lps(voxels[part == n].mean(axis=0)) for n in range(part.max(initial=-1) + 1)]
    return np.array(sorted(middles, key=tuple)).reshape(-1, 3)


def _beyond(nodules: Volume, lung: Volume) -> Array:
    """Return where nodules lie farther from the lungs than `SAME_PLACE_MM`."""
    beyond = np.asarray(nodules.array & ~lung.array)
    if beyond.any():
        # Whether the lungs are so near is seen in a box: that of the whole thorax takes minutes.
        box = window(*bounds(beyond, np.ceil(SAME_PLACE_MM / lung.grid.spacing_mm).astype(np.int64) + 1))
        far = ndimage.distance_transform_edt(~lung.array[box], lung.grid.spacing_mm)
        # Where a box holds no lung at all, all of it is far.
        beyond[box] &= (far > SAME_PLACE_MM) | ~lung.array[box].any()
    return beyond


def _are_in_place(one: PatientImages, other: PatientImages) -> bool:
    """Tell whether nodules have the same middles, which are the targets, and make the same the lung."""
    if one.nodules is None or other.nodules is None:
        return one.nodules is other.nodules
    if not np.array_equal(_beyond(one.nodules, one.lung), _beyond(other.nodules, other.lung)):
        return False
    middles = _middles(one.nodules), _middles(other.nodules)
    return middles[0].shape == middles[1].shape and bool(
        (np.linalg.norm(middles[0] - middles[1], axis=1) < SAME_PLACE_MM).all()
    )


def outcome(whole: Checked, mutation: Mutation) -> str:
    """Return how a mutation ends: refused, warned, same, in place (nodules of another size), or silent."""
    folder = whole.folder / "changed"
    try:
        images = load_patient(write(folder, mutation.masks, whole.masks, whole.images.targets_lps))
        found = Checked(images, folder, whole)
    except LungaccessError:
        return "refused"
    if any(each.verdict == REFUSED for each in found.findings):
        return "refused"
    if not found.changed:
        return "same"
    if found.words - whole.words:
        return "warned"
    is_in_place = found.changed == ["nodules"] and _are_in_place(images, whole.images)
    return "in place" if is_in_place else "silent"


def test_masks_of_a_phantom_are_usual_in_every_figure(whole: Checked) -> None:
    assert {each.verdict for each in whole.findings} == {FITS}
    assert len(whole.findings) >= 20


def test_nodules_beyond_the_lungs_are_told(whole: Checked) -> None:
    """They count as lung, so that a mask of nodules which is too wide would open the chest wall."""
    lung, nodules = whole.images.lung, whole.images.nodules
    assert nodules is not None
    images = replace(whole.images, lung=replace(lung, array=lung.array & ~nodules.array))
    findings = mask_findings(images, whole.tree, NOWHERE)
    assert [each.verdict for each in findings if "beyond the lungs" in each.found] == [DOUBTFUL]


def test_a_leak_of_the_airway_into_the_lung_is_told(whole: Checked) -> None:
    lumen, grid = whole.images.lumen.array, whole.images.grid
    far = np.argmax(np.linalg.norm(whole.tree.points_lps - whole.tree.carina_lps, axis=1))
    ball = np.linalg.norm(
        grid.lps(np.indices(grid.shape).reshape(3, -1).T) - whole.tree.points_lps[far], axis=1
    )
    leak = lumen | (ball.reshape(grid.shape) < 9.0) & whole.images.lung.array
    images = replace(whole.images, lumen=Volume(grid=grid, array=np.asfortranarray(leak)))
    findings = mask_findings(images, tree_from_mask(images.lumen), whole.points)
    assert [each.verdict for each in findings if "as wide as the one it leaves" in each.found] == [DOUBTFUL]


def test_slices_at_twice_their_distance_are_told(whole: Checked, tmp_path: Path) -> None:
    stretched = {
        role: replace(
            mask, grid=replace(mask.grid, lps_from_ijk=mask.grid.lps_from_ijk @ np.diag([1.0, 1.0, 2.0, 1.0]))
        )
        for role, mask in whole.masks.items()
    }
    found = Checked(load_patient(write(tmp_path, stretched)), tmp_path)
    assert [each.verdict for each in found.findings if "times as tall" in each.found] == [DOUBTFUL]


def test_an_airway_that_is_cut_below_is_told(whole: Checked) -> None:
    lumen = whole.images.lumen
    kept = lumen.array.copy()
    kept[:, :, : kept.shape[2] // 3] = False
    cut = replace(lumen, array=kept)
    findings = mask_findings(replace(whole.images, lumen=cut), tree_from_mask(cut), whole.points)
    assert [each.verdict for each in findings if "ends below" in each.found] == [DOUBTFUL]


def test_vessels_in_the_place_of_fissures_are_told(whole: Checked) -> None:
    findings = mask_findings(replace(whole.images, fissures=whole.images.vessels), whole.tree, whole.points)
    assert [each.verdict for each in findings if "fissures are thick" in each.found] == [DOUBTFUL]


def test_two_nodules_of_one_label_are_told(whole: Checked) -> None:
    nodules = whole.images.nodules
    assert nodules is not None
    labels = replace(nodules, array=np.asfortranarray(nodules.array * np.uint16(7)))
    findings = mask_findings(replace(whole.images, nodule_labels=labels), whole.tree, whole.points)
    assert [each.verdict for each in findings if "have the same label" in each.found] == [DOUBTFUL]


def _require_none_silent(whole: Checked, mutations: Iterable[Mutation]) -> None:
    ended: dict[str, list[str]] = {}
    for mutation in mutations:
        found = outcome(whole, mutation)
        wrong = found == "silent" or (mutation.is_same and found != "same")
        ended.setdefault("wrong" if wrong else found, []).append(mutation.name)
    assert "wrong" not in ended, {name: len(each) for name, each in ended.items()} | {"wrong": ended["wrong"]}


@pytest.mark.parametrize(
    ("kind", "role"),
    [
        ("interpolated", "lumen"), ("rescaled", "nodules"), ("divided", "vessels"), ("shifted", "vessels"),
        ("mirrored", "lung"), ("widened", "lumen"), ("widened", "lung"), ("widened", "nodules"),
        ("without_part", "vessels"), ("without_part", "wall"), ("without_part", "fissures"),
        ("without_part", "nodules"), ("swapped", "wall"), ("copied", "vessels"),
    ],
)  # fmt: skip
def test_no_mutation_is_silent(kind: str, role: str, whole: Checked) -> None:
    mutate = next(each for each in KINDS if each.__name__ == kind)
    _require_none_silent(whole, [mutate(whole.masks, role, np.random.default_rng(5))])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 8, 11, 21])
def test_no_drawn_mutation_of_a_phantom_is_silent(seed: int, tmp_path: Path) -> None:
    whole, rng = checked(make_phantom(seed=seed, size="small").images, tmp_path), np.random.default_rng(seed)
    _require_none_silent(whole, (drawn(whole.masks, rng) for _ in range(MANY)))


@pytest.mark.slow
@pytest.mark.data
def test_no_drawn_mutation_of_a_patient_is_silent(data_dir: Path, tmp_path: Path) -> None:
    whole = checked(load_patient(data_dir / "med-rad" / "Patient1"), tmp_path)
    rng = np.random.default_rng(1)
    _require_none_silent(whole, (drawn(whole.masks, rng) for _ in range(MANY)))


def test_a_gap_in_a_main_bronchus_is_named_with_what_lies_behind(phantom: Phantom) -> None:
    cut = phantom.images.lumen.array.copy()
    cut[106:112] = False
    images = replace(phantom.images, lumen=Volume(grid=phantom.images.grid, array=cut))
    lung = build_lung(images)
    gap = next(each for each in lung.findings if each.name == "gap")
    assert gap.verdict == REFUSED
    assert "at LPS (23.8, 2.7, -19.4) mm" in gap.found
    assert "left" in gap.found
    assert "gap" in lung.mask_words
    with pytest.raises(AnatomyError, match="--accept gap"):
        require_plausible(lung.findings, ())
    assert require_plausible(with_accepted(lung.findings, ("gap",)), ()) == ("gap",)
