"""Limits of a bent channel, slots, and tubes that straighten a bent tip."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from anatomy.base.errors import SettingsError
from anatomy.shafts import SlottedSegment
from stages.tube import straightening
from stages.tube.device import ConcentricTubes, Tube

OUTER = Tube(outer_diameter_mm=1.9, inner_diameter_mm=1.65, length_mm=640.0)
INNER = Tube(
    outer_diameter_mm=1.5,
    inner_diameter_mm=1.3,
    length_mm=680.0,
    curved_length_mm=40.0,
    precurvature_per_mm=0.025,
)
PLAIN = ConcentricTubes(outer=OUTER, inner=INNER, max_strain=0.08)


def slotted(stiffness: float = 0.04, strain: float = 0.5, length: float = 400.0, begin: float = 0.0) -> Any:
    segment = SlottedSegment(
        from_tip_mm=begin, length_mm=length, stiffness_factor=stiffness, strain_factor=strain
    )
    return replace(
        PLAIN,
        outer=replace(OUTER, slotted_segments=(segment,)),
        inner=replace(INNER, slotted_segments=(segment,)),
    )


def test_a_channel_that_strain_forbids_is_refused_with_the_value_that_it_allows() -> None:
    most = min(0.08 / 0.95, 0.08 / 0.75 - 0.025)
    assert PLAIN.channel_curvature_per_mm == pytest.approx(most)
    assert replace(PLAIN, max_channel_curvature_per_mm=0.08).channel_curvature_per_mm == 0.08
    with pytest.raises(SettingsError, match=r"at most 0\.08167.*inner tube"):
        replace(PLAIN, max_channel_curvature_per_mm=0.082)
    assert replace(slotted(strain=0.7), max_channel_curvature_per_mm=0.12).channel_curvature_per_mm == 0.12


@pytest.mark.parametrize(
    ("begin", "length", "words"), [(0.0, 700.0, "slotted_segments"), (0.0, 40.0, "same stiffness_factor")]
)
def test_impossible_slots_are_refused(begin: float, length: float, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        slotted(begin=begin, length=length)


def test_slots_of_one_tube_alone_are_refused() -> None:
    with pytest.raises(SettingsError, match="same stiffness_factor for both"):
        replace(PLAIN, outer=slotted().outer)


def test_slots_of_both_tubes_leave_their_shape() -> None:
    assert slotted().overlap_curvature_per_mm == PLAIN.overlap_curvature_per_mm


def test_tubes_straighten_a_section_by_their_share_of_the_stiffness() -> None:
    both = OUTER.bending_stiffness_n_mm2 + INNER.bending_stiffness_n_mm2
    assert straightening(PLAIN, (0.0, 30.0), 15.0, 1000.0) == pytest.approx(both / 1000.0)
    assert straightening(slotted(0.04), (0.0, 30.0), 15.0, 1000.0) == pytest.approx(0.04 * both / 1000.0)
    short = slotted(0.04, length=70.0)
    assert straightening(short, (0.0, 54.0), 15.0, 1000.0) == pytest.approx(0.04 * both / 1000.0)
    # With 56 mm inserted, a millimetre of plain inner tube lies in the section.
    stiff = INNER.bending_stiffness_n_mm2 + 0.04 * OUTER.bending_stiffness_n_mm2
    assert straightening(short, (0.0, 56.0), 15.0, 1000.0) == pytest.approx(stiff / 1000.0)


def test_the_stiffest_part_of_the_needle_that_passes_the_section_counts() -> None:
    soft = SlottedSegment(length_mm=100.0, stiffness_factor=0.1, strain_factor=1.0)
    needle = Tube(outer_diameter_mm=0.8, inner_diameter_mm=0.0, length_mm=800.0, slotted_segments=(soft,))
    alone = straightening(PLAIN, (0.0, 30.0), 15.0, 1000.0)
    for out, share in ((50.0, 0.1), (60.0, 1.0)):
        found = straightening(PLAIN, (0.0, 30.0), 15.0, 1000.0, needle=needle, needle_out_mm=out)
        assert found - alone == pytest.approx(1e-3 * share * needle.bending_stiffness_n_mm2)
