"""Strain on the way through a bent channel, slots, and tubes that straighten a bent tip."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from stages.tube import SlottedSegment, channel_curvature_limit, opposite_slots, straightening, transit_strain
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


def strain_by_walk(tubes: ConcentricTubes, pieces: Any, inserted: tuple[float, float]) -> list[float]:
    """Push each tube millimetre by millimetre to its place, and look at each millimetre of it."""
    bends = np.concatenate([np.full(round(length), abs(kappa)) for length, _, kappa in pieces])[::-1]
    worst = []
    for tube, last in zip((tubes.outer, tubes.inner), inserted, strict=True):
        slots = tube.slotted_segments
        most = tubes.overlap_curvature_per_mm * tube.radius_mm if tube is tubes.outer else 0.0
        if slots and tube is tubes.outer:
            most *= slots[0].strain_factor
        for at in range(-len(bends), round(last)):
            for part in range(round(tube.length_mm)):
                behind = part - at - 1
                middle = part + 0.5
                kappa = float(bends[behind]) if 0 <= behind < len(bends) else 0.0
                if not 0 <= behind < len(bends):
                    continue
                rest = tube.precurvature_per_mm if middle < tube.curved_length_mm else 0.0
                inside = [s for s in slots if s.from_tip_mm < middle < s.from_tip_mm + s.length_mm]
                most = max(
                    most, (kappa + rest) * tube.radius_mm * (inside[0].strain_factor if inside else 1.0)
                )
        worst.append(most)
    return worst


@pytest.mark.parametrize("tubes", [PLAIN, slotted(strain=0.5), slotted(strain=0.7, length=70.0)])
def test_transit_strain_is_that_of_a_tube_pushed_step_by_step(tubes: ConcentricTubes) -> None:
    pieces = [(20.0, 0.3, 0.06), (30.0, 0.0, 0.0), (15.0, -0.5, -0.03)]
    found = transit_strain(tubes, pieces, (10.0, 25.0))
    assert found == pytest.approx(strain_by_walk(tubes, pieces, (10.0, 25.0)), abs=1e-12)


def test_only_what_passes_a_bend_is_strained_by_it() -> None:
    """Slots over the first 70 mm: a bend farther behind the tip meets plain tube, one at the tip does not."""
    tubes = slotted(strain=0.5, length=75.0)
    near, far = [(60.0, 0.0, 0.0), (10.0, 0.0, 0.05)], [(10.0, 0.0, 0.05), (60.0, 0.0, 0.0)]
    assert transit_strain(tubes, near, (20.0, 20.0))[0] == pytest.approx(0.05 * 0.95 * 0.5)
    assert transit_strain(tubes, far, (20.0, 20.0))[0] == pytest.approx(0.05 * 0.95)


def test_limit_of_the_channel_is_where_the_strain_reaches_its_limit() -> None:
    for tubes in (PLAIN, slotted(strain=0.5), slotted(strain=0.7, length=90.0)):
        for behind in (0.0, 20.0, 150.0):
            most = float(channel_curvature_limit(tubes, [behind])[0])
            pieces = [(5.0, 0.0, most), (max(behind - 5.0, 1e-9), 0.0, 0.0)]
            strain = transit_strain(tubes, pieces, (60.0, 60.0)).max()
            assert strain <= tubes.max_strain + 1e-9
            if behind > 5.0:
                assert strain == pytest.approx(tubes.max_strain)
    assert (np.diff(channel_curvature_limit(slotted(length=90.0), np.arange(0.0, 200.0, 10.0))) <= 0.0).all()


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


def test_factors_of_slots_follow_from_the_bridges_by_integration() -> None:
    """Second moments of the bridges as sums over a thin ring, stretches in series."""
    bridge, share = 40.0, 0.9
    phi = (np.arange(720_000) + 0.5) * 2.0 * math.pi / 720_000
    neutral = np.abs(np.sin(phi)) < math.sin(math.radians(bridge / 2))
    square = np.abs(np.cos(phi)) < math.sin(math.radians(bridge / 2))
    whole, soft, stiff = (float((np.sin(phi[of]) ** 2).sum()) for of in (phi > 0.0, neutral, square))
    compliance = 1.0 - share + 0.5 * share * (whole / soft + whole / stiff)
    strain = np.abs(np.sin(phi[neutral])).max() * (whole / soft) / compliance
    assert opposite_slots(bridge, share) == pytest.approx((1.0 / compliance, strain), rel=1e-4)
    factors = opposite_slots(bridge, share)
    assert factors[0] <= 0.04 and factors[1] <= 0.75, "the presets say no less"
