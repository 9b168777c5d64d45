"""An atlas that is made again where masks were corrected is the one that is made anew."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.build import build_lung
from anatomy.corrections import TISSUE, VESSEL, with_corrections
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from lungaccess.planning.coupled import Atlas
from lungaccess.planning.coupled.atlas import _within_reach_of_change

SYSTEM = la.load_system("ultrathin")


def made(lung: Lung, before: Atlas | None = None, system: la.System = SYSTEM) -> Atlas:
    return la.build_atlas(lung, system, rotations=8, stop_spacing_mm=4.0, before=before)


def assert_same(one: Atlas, other: Atlas) -> None:
    for record, again in ((one.motions, other.motions), (one.deployments, other.deployments)):
        for each in fields(record):
            value = getattr(record, each.name)
            if isinstance(value, np.ndarray):
                assert np.array_equal(value, getattr(again, each.name)), each.name
    assert one.deployments.refused == other.deployments.refused


@pytest.fixture(scope="module")
def first(small_lung: Lung) -> Atlas:
    return made(small_lung)


def corrected(phantom: Phantom, at_lps: np.ndarray, code: int, radius: int = 4) -> Lung:
    images = phantom.images
    values = np.zeros(images.grid.shape, dtype=np.uint8, order="F")
    low = np.maximum(images.grid.voxels(at_lps) - radius, 0)
    values[tuple(slice(int(a), int(a) + 2 * radius) for a in low)] = code
    return build_lung(with_corrections(images, Volume(grid=images.grid, array=values)))


@pytest.mark.parametrize("entry", [0.1, 0.5, 0.9])
def test_a_painted_vessel_changes_what_is_near_it_alone(
    small_phantom: Phantom, first: Atlas, entry: float
) -> None:
    place = first.deployments.positions[int(entry * first.deployments.count)]
    lung = corrected(small_phantom, place, VESSEL)
    again = made(lung, first)
    assert again.motions is first.motions
    anew = made(lung)
    assert_same(again, anew)
    assert anew.deployments.count < first.deployments.count, "the vessel is in the way of some"
    assert 0 < np.count_nonzero(_within_reach_of_change(first, lung, first.motions)) < first.motions.count
    assert_same(made(replace(first.lung), again), first)


def test_where_the_airway_was_corrected_all_is_made_anew(small_phantom: Phantom, first: Atlas) -> None:
    tree = first.lung.tree
    end = tree.points_lps[tree.branch_points(tree.n_branches - 1)[-1]]
    lung = corrected(small_phantom, end, TISSUE, 2)
    again = made(lung, first)
    assert again.motions is not first.motions
    assert_same(again, made(lung))


def test_an_atlas_of_other_devices_is_not_used(first: Atlas) -> None:
    other = la.load_system("lung-default")
    assert_same(made(first.lung, first, other), made(first.lung, system=other))
