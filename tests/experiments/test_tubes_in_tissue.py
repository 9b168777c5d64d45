"""Tubes in tissue: limits, the closed form of a beam on an elastic foundation, and CasADi by other means."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.shafts import SlottedSegment
from experiments.support.needle_load.tissue import LUNG_N_MM2, held_shape
from stages.tube import derive_loaded
from stages.tube.device import Tube
from stages.tube.mechanics import TubeMechanics
from tests.stages.tube.test_loading import THIN, TWISTED, deployments

SLOTS = SlottedSegment(length_mm=380.0, stiffness_factor=0.04, strain_factor=0.75)
TIGHT = Tube(
    outer_diameter_mm=1.23, inner_diameter_mm=1.05, length_mm=680.0, curved_length_mm=40.0,
    precurvature_per_mm=0.045, slotted_segments=(SLOTS,),
)  # fmt: skip
SHEATH = Tube(outer_diameter_mm=1.6, inner_diameter_mm=1.38, length_mm=640.0, slotted_segments=(SLOTS,))
WIRE = Tube(outer_diameter_mm=0.8, inner_diameter_mm=0.0, length_mm=830.0)
BETA = np.array([40.0 - TIGHT.length_mm, 10.0 - SHEATH.length_mm])
BASE = np.array([0.4, 0.0])
MECHANICS = TubeMechanics([TIGHT, SHEATH], needle=WIRE)


def held(tissue: float, needle: float = 40.0, **values: Any) -> Any:
    return held_shape(MECHANICS, BASE, BETA, needle_mm=needle, tissue_n_mm2=tissue, **values)


def test_without_tissue_the_shape_is_the_free_one_and_in_stiff_tissue_that_without_a_needle() -> None:
    free = MECHANICS.given_base_angles(BASE, BETA, needle_mm=40.0).base_from_tip
    assert held(0.0).base_from_tip[:3, 3] == pytest.approx(free[:3, 3], abs=1e-7)
    before = MECHANICS.given_base_angles(BASE, BETA, needle_mm=0.0).base_from_tip
    off = [np.linalg.norm(held(tissue).base_from_tip[:3, 3] - before[:3, 3]) for tissue in (1e2, 1e4, 1e6)]
    assert off[2] < 0.1 * off[1] < 0.02 * off[0]
    assert off[2] < 2e-3


def test_before_the_tissue_begins_nothing_holds_the_tubes() -> None:
    later = held(1e-2, tissue_from_mm=40.0)
    assert later.base_from_tip == pytest.approx(held(0.0).base_from_tip, abs=1e-7)
    middle = held(1e-2, tissue_from_mm=20.0).sideways_mm[-1]
    assert held(1e-2).sideways_mm[-1] < middle < later.sideways_mm[-1]


def test_small_bends_are_those_of_a_beam_on_an_elastic_foundation() -> None:
    # y'''' + 4 b^4 y = 0 with y = y' = 0 at the plate; at the tip no force, and the moment of the lost bend.
    bend, tissue = 1e-4, 0.01
    tube = Tube(
        outer_diameter_mm=1.2,
        inner_diameter_mm=1.0,
        length_mm=60.0,
        curved_length_mm=60.0,
        precurvature_per_mm=bend,
    )
    needle = Tube(outer_diameter_mm=0.8, inner_diameter_mm=0.0, length_mm=60.0)
    stiff = tube.bending_stiffness_n_mm2 + needle.bending_stiffness_n_mm2
    lost = bend * needle.bending_stiffness_n_mm2 / stiff
    roots = (tissue / stiff) ** 0.25 * np.exp(0.25j * np.pi * np.array([1, 3, 5, 7]))
    rows = [roots**0, roots, roots**2 * np.exp(60.0 * roots), roots**3 * np.exp(60.0 * roots)]
    weights = np.linalg.solve(np.array(rows), np.array([0.0, 0.0, lost, 0.0]))
    found = held_shape(
        TubeMechanics([tube], needle=needle),
        [0.0],
        [0.0],
        needle_mm=60.0,
        tissue_n_mm2=tissue,
        element_mm=0.25,
    )
    wanted = np.real(np.exp(np.outer(found.arc_lengths_mm, roots)) @ weights)
    assert found.sideways_mm == pytest.approx(np.abs(wanted), abs=1e-6)
    assert wanted.max() > 0.01
    assert found.tissue_n_per_mm == pytest.approx(tissue * np.abs(wanted).max(), rel=1e-4)


@pytest.mark.parametrize("tissue", [0.0, *LUNG_N_MM2])
def test_the_strong_form_in_casadi_agrees_to_a_micrometre(tissue: float) -> None:
    for tubes, needle, base, beta, at, begin in (
        ((TIGHT, SHEATH), WIRE, BASE, BETA, 33.0, 12.0),
        (TWISTED, THIN, *(each[0] for each in deployments(TWISTED, 1)), 500.0, 0.0),
    ):
        derived = derive_loaded(tubes, needle, base, beta, at, tissue_n_mm2=tissue, tissue_from_mm=begin)
        mechanics = TubeMechanics(tubes, needle=needle)
        found = held_shape(mechanics, base, beta, needle_mm=at, tissue_n_mm2=tissue, tissue_from_mm=begin)
        assert found.base_from_tip == pytest.approx(derived.base_from_tip, abs=1e-3)
        points = [
            np.interp(found.arc_lengths_mm, derived.arc_lengths_mm, axis) for axis in derived.points_mm.T
        ]
        assert np.linalg.norm(found.points_mm - np.transpose(points), axis=1).max() < 0.02  # Chords of 1 mm.
        if tissue == 0.0:
            free = mechanics.given_base_angles(base, beta, needle_mm=at)
            assert free.base_from_tip[:3, 3] == pytest.approx(derived.base_from_tip[:3, 3], abs=1e-6)
            assert free.tip_angles_rad == pytest.approx(derived.tip_angles_rad, abs=1e-8)


def test_tissue_moves_no_tube_as_far_as_a_needle_does_without_tissue() -> None:
    """The mean square is bounded by energy; that of single points holds for these."""
    base, beta = deployments(TWISTED, 6)
    mechanics = TubeMechanics(TWISTED, needle=THIN)
    for angles, rear in zip(base, beta, strict=True):
        shapes = [
            held_shape(mechanics, angles, rear, needle_mm=500.0, tissue_n_mm2=tissue, element_mm=1.0)
            for tissue in (0.0, *LUNG_N_MM2, 1.0)
        ]
        most = [float(shape.sideways_mm.max()) for shape in shapes]
        assert most == sorted(most, reverse=True)


@pytest.mark.parametrize("wrong", [{"tissue_n_mm2": -1.0}, {"tissue_n_mm2": 0.1, "element_mm": 0.0}])
def test_impossible_tissue_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SettingsError, match="Tissue of"):
        held_shape(MECHANICS, BASE, BETA, needle_mm=40.0, **wrong)


def test_tubes_in_the_scope_have_no_shape_in_tissue() -> None:
    with pytest.raises(SettingsError, match="No tube"):
        held_shape(MECHANICS, BASE, [-680.0, -640.0], needle_mm=0.0, tissue_n_mm2=1e-3)
