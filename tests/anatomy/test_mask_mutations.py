"""No mutation of meaning is silent: the lung is the same, or a warning or an error says what is wrong."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError, LungaccessError
from anatomy.build import build_lung
from anatomy.grid import Volume
from anatomy.io.patients import load_patient
from anatomy.mask_findings import mask_findings
from anatomy.patient import PatientImages
from anatomy.phantom import Phantom, make_phantom
from anatomy.plausibility import FITS, REFUSED, require_plausible, with_accepted
from anatomy.sides import coarse_sides, points_of_sides
from anatomy.tree import tree_from_mask
from tests.anatomy.mask_mutations import KINDS, ROLES, Masks, Mutation, drawn, write

MANY = int(os.environ.get("LUNGACCESS_MUTATIONS", "1000"))
"""So many mutations are drawn in the slow test."""


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return make_phantom(seed=3, size="small")


@pytest.fixture(scope="module")
def masks(phantom: Phantom) -> Masks:
    return {role: getattr(phantom.images, role) for role in ROLES}


class Checked:
    """The masks of a patient as they were read, and what a user is told of them."""

    def __init__(self, images: PatientImages, tree: AirwayTree) -> None:
        sides = coarse_sides(images.lung.array & ~images.lumen.array, images.grid)
        nowhere = np.zeros((0, 3))
        points = (nowhere, nowhere) if sides is None else points_of_sides(*sides, images.grid)
        self.images, self.tree, self.findings = images, tree, mask_findings(images, tree, points)
        self.words = {*images.warnings, *(each.found for each in self.findings if each.verdict != FITS)}


@pytest.fixture(scope="module")
def whole(masks: Masks, tmp_path_factory: pytest.TempPathFactory) -> Checked:
    images = load_patient(write(tmp_path_factory.mktemp("whole"), masks))
    return Checked(images, tree_from_mask(images.lumen))


def _are_same(one: Volume | None, other: Volume | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.grid.is_close(other.grid) and np.array_equal(one.array, other.array)


def outcome(whole: Checked, mutation: Mutation, folder: Path) -> str:
    """Return how a mutation ends: refused, warned, same, or silent."""
    try:
        images = load_patient(write(folder, mutation.masks))
        has_tree = _are_same(images.lumen, whole.images.lumen)
        found = Checked(images, whole.tree if has_tree else tree_from_mask(images.lumen))
    except LungaccessError:
        return "refused"
    if any(each.verdict == REFUSED for each in found.findings):
        return "refused"
    if all(_are_same(getattr(images, role), getattr(whole.images, role)) for role in ROLES):
        return "same"
    return "warned" if found.words - whole.words else "silent"


def test_masks_of_a_phantom_are_usual_in_every_figure(whole: Checked) -> None:
    assert {each.verdict for each in whole.findings} == {FITS}
    assert len(whole.findings) >= 20


@pytest.mark.parametrize(
    ("kind", "role"),
    [
        ("interpolated", "lumen"), ("rescaled", "nodules"), ("divided", "vessels"), ("shifted", "vessels"),
        ("mirrored", "lung"), ("widened", "lumen"), ("without_part", "vessels"), ("swapped", "wall"),
        ("copied", "vessels"),
    ],
)  # fmt: skip
def test_no_mutation_is_silent(kind: str, role: str, whole: Checked, masks: Masks, tmp_path: Path) -> None:
    mutate = next(each for each in KINDS if each.__name__ == kind)
    mutation = mutate(masks, role, np.random.default_rng(5))
    found = outcome(whole, mutation, tmp_path)
    assert found != "silent", mutation.name
    if mutation.is_same:
        assert found == "same", mutation.name


@pytest.mark.slow
def test_no_drawn_mutation_is_silent(whole: Checked, masks: Masks, tmp_path: Path) -> None:
    rng = np.random.default_rng(51)
    ended: dict[str, list[str]] = {}
    for n in range(MANY):
        mutation = drawn(masks, rng)
        ended.setdefault(outcome(whole, mutation, tmp_path / str(n % 2)), []).append(mutation.name)
    assert "silent" not in ended, {name: len(each) for name, each in ended.items()} | {
        "silent": ended["silent"]
    }


def test_a_gap_in_a_main_bronchus_is_named_with_what_lies_behind(masks: Masks, phantom: Phantom) -> None:
    cut = masks["lumen"].array.copy()
    cut[106:112] = False
    images = replace(phantom.images, lumen=Volume(grid=masks["lumen"].grid, array=cut))
    lung = build_lung(images)
    gap = next(each for each in lung.findings if each.name == "gap")
    assert gap.verdict == REFUSED
    assert "at LPS (23.8, 2.7, -19.4) mm" in gap.found
    assert "left" in gap.found
    assert "gap" in lung.mask_words
    with pytest.raises(AnatomyError, match="--accept gap"):
        require_plausible(lung.findings, ())
    assert require_plausible(with_accepted(lung.findings, ("gap",)), ()) == ("gap",)
