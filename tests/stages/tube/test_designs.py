"""Device files with other tubes than a straight outer and a curved inner one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.base.settings import parse, to_mapping
from anatomy.shafts import SlottedSegment
from stages.tube import BentPiece, ConcentricTubes, Tube, pieces_of_arcs, points_on_arcs

INNER = Tube(
    outer_diameter_mm=0.9,
    inner_diameter_mm=0.7,
    length_mm=400.0,
    curved_length_mm=40.0,
    precurvature_per_mm=0.02,
)
MIDDLE = Tube(outer_diameter_mm=1.2, inner_diameter_mm=1.0, length_mm=360.0)
OUTER = Tube(
    outer_diameter_mm=1.5,
    inner_diameter_mm=1.3,
    length_mm=330.0,
    curved_length_mm=20.0,
    precurvature_per_mm=0.01,
)
STRAIGHT = replace(OUTER, curved_length_mm=0.0, precurvature_per_mm=0.0)
THREE = ConcentricTubes(outer=OUTER, middle=MIDDLE, inner=INNER)


def test_only_one_arc_in_a_straight_tube_has_a_closed_form() -> None:
    pieces = (BentPiece(length_mm=20.0, precurvature_per_mm=0.02),)
    in_pieces = replace(INNER, curved_length_mm=0.0, precurvature_per_mm=0.0, bent_pieces=pieces)
    assert ConcentricTubes(inner=INNER).planar
    assert ConcentricTubes(outer=STRAIGHT, inner=INNER).planar
    assert not ConcentricTubes(outer=OUTER, inner=INNER).planar
    assert not ConcentricTubes(inner=in_pieces).planar
    assert not replace(THREE, outer=STRAIGHT).planar
    with pytest.raises(SettingsError, match="3 tubes, of which 2 are bent"):
        THREE.require_planar("A proof")


def test_tubes_are_named_from_the_outermost_and_nested_from_the_innermost() -> None:
    assert [name for name, _tube in THREE.named] == ["outer", "middle", "inner"]
    assert THREE.nested == (INNER, MIDDLE, OUTER) and THREE.outermost == OUTER


def test_a_middle_tube_is_kept_and_left_out_where_there_is_none() -> None:
    assert parse(ConcentricTubes, to_mapping(THREE), "three") == THREE
    assert "middle" not in to_mapping(ConcentricTubes(outer=STRAIGHT, inner=INNER))


@pytest.mark.parametrize(
    ("tubes", "words"),
    [
        ({"outer": None}, "left out where there is no tubes.outer"),
        ({"middle": replace(MIDDLE, outer_diameter_mm=1.35)}, "less than outer.inner_diameter_mm"),
        ({"middle": replace(MIDDLE, inner_diameter_mm=0.85)}, "less than middle.inner_diameter_mm"),
        ({"middle": replace(MIDDLE, length_mm=300.0)}, "at least outer.length_mm"),
        ({"middle": replace(MIDDLE, length_mm=500.0)}, "at least middle.length_mm"),
    ],
)
def test_tubes_that_do_not_nest_are_refused(tubes: dict[str, Tube | None], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        replace(THREE, **tubes)


def test_slots_of_tubes_that_are_twisted_are_refused() -> None:
    slots = (SlottedSegment(length_mm=300.0, stiffness_factor=0.1, strain_factor=0.8),)
    with pytest.raises(SettingsError, match="twisted"):
        ConcentricTubes(
            outer=replace(OUTER, slotted_segments=slots), inner=replace(INNER, slotted_segments=slots)
        )


def test_arcs_are_followed_without_turning() -> None:
    """Two quarter circles, the second of them a quarter turn about the tangent of the first."""
    radius = 10.0
    quarter = 0.5 * math.pi * radius
    arcs = np.array([[quarter, 0.0, 1.0 / radius, 0.5], [quarter, 0.5 * math.pi, 1.0 / radius, 0.4]])
    points = points_on_arcs(arcs, np.eye(4), 0.0, [0.0, quarter, 2.0 * quarter])
    expected = [[0.0, 0.0, 0.0], [radius, 0.0, radius], [2.0 * radius, radius, radius]]
    assert points == pytest.approx(np.array(expected), abs=1e-12)
    turned = points_on_arcs(arcs, np.eye(4), 0.5 * math.pi, [2.0 * quarter])
    assert turned[0] == pytest.approx([-radius, 2.0 * radius, radius], abs=1e-12)
    assert pieces_of_arcs(arcs, 0.3)[:, 1] == pytest.approx([0.3, 0.5 * math.pi])
