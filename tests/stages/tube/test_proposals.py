"""Proposed sequences and designs: what is said of them is true, and nothing better was left out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from stages.tube.following import deploy
from stages.tube.mechanics import TubeMechanics
from stages.tube.proposals import (
    DesignProposal,
    MakerLimits,
    SequenceComparison,
    evaluate_design,
    least_sweep_sequence,
    propose_designs,
)
from stages.tube.sequences import kuntz2015
from tests.stages.tube.pairs import WIDE

INNER, OUTER = WIDE.inner, WIDE.outer
LIMITS = MakerLimits(channel_diameter_mm=2.0)


class TestSequences:
    def test_they_are_sorted_and_end_at_one_place(self) -> None:
        found = least_sweep_sequence((INNER, OUTER), 0.3, (38.0, 20.0))
        sweeps = [each.lateral_sweep_mm for each in found.deployed]
        assert sweeps == sorted(sweeps) and len(sweeps) == 5
        assert found.best.sequence.name == "together" and sweeps[0] < 1e-9
        assert found.deployed[-1].sequence.name == "inner first"
        for each in found.deployed:
            assert np.allclose(each.final.base_from_tip, found.best.final.base_from_tip, atol=1e-9)
        assert found.refused == {}

    def test_finer_increments_sweep_no_more(self) -> None:
        found = least_sweep_sequence((INNER, OUTER), 0.0, (38.0, 20.0))
        by_name = {each.sequence.name: each.lateral_sweep_mm for each in found.deployed}
        alternating = [by_name[f"alternating by {mm} mm"] for mm in (2, 5, 10)]
        assert 0.0 < alternating[0] < alternating[1] < alternating[2] < by_name["inner first"]

    def test_what_a_sequence_cannot_do_is_said(self) -> None:
        found = least_sweep_sequence((INNER, OUTER), 0.0, (60.0, 40.0))
        assert list(found.refused) == ["inner first"]
        assert "difference of their lengths" in found.refused["inner first"]

    def test_a_snap_rules_a_sequence_out(self) -> None:
        """Turned before they are out, tubes do not snap; turned afterwards, they do."""
        curve = {"curved_length_mm": 40.0, "precurvature_per_mm": 0.008}
        tubes = (replace(INNER, **curve), replace(OUTER, **curve))
        found = least_sweep_sequence(tubes, (0.0, math.radians(300.0)), (40.0, 40.0))
        assert list(found.refused) == ["together, then turned in place"]
        assert "snap" in found.refused["together, then turned in place"]
        assert found.best.sequence.name != "together, then turned in place"

    def test_impossible_insertions_are_refused_at_once(self) -> None:
        with pytest.raises(SettingsError, match="0 <= outer <= inner"):
            least_sweep_sequence((INNER, OUTER), 0.0, (20.0, 40.0))

    def test_nothing_can_be_done(self) -> None:
        with pytest.raises(SettingsError, match="No sequence reaches"):
            _ = SequenceComparison(deployed=(), refused={"together": "snaps"}).best


@pytest.fixture(scope="module")
def designs() -> tuple[DesignProposal, ...]:
    return propose_designs(WIDE, 30.0, 50.0, 2.0, LIMITS)


class TestDesigns:
    def test_they_are_sorted_and_within_all_limits(self, designs: tuple[DesignProposal, ...]) -> None:
        sweeps = [each.lateral_sweep_mm for each in designs]
        assert sweeps == sorted(sweeps) and sweeps[-1] <= 2.0 and len(sweeps) > 10
        for each in designs:
            inner, outer = each.tubes.inner, each.tubes.outer
            assert inner.rest_strain <= WIDE.max_strain
            assert 20.0 <= inner.curved_length_mm <= 50.0
            assert outer.inner_diameter_mm >= inner.outer_diameter_mm + 0.15 - 1e-12
            assert outer.outer_diameter_mm <= 2.0 - 0.1 + 1e-12
            assert outer.outer_diameter_mm - outer.inner_diameter_mm >= 0.1 - 1e-12

    def test_the_mechanics_agree_with_what_is_said(self, designs: tuple[DesignProposal, ...]) -> None:
        for each in designs[:: len(designs) // 6]:
            mechanics = TubeMechanics((each.tubes.inner, each.tubes.outer))
            found = deploy(mechanics, kuntz2015(mechanics.tubes, 0.0, 30.0, 50.0), step_mm=0.5)
            tip = found.final.base_from_tip
            assert found.lateral_sweep_mm == pytest.approx(each.lateral_sweep_mm, abs=1e-3)
            assert np.hypot(*tip[:2, 3]) == pytest.approx(each.tip_offset_mm, abs=1e-6)
            assert math.cos(each.tip_angle_rad) == pytest.approx(tip[2, 2], abs=1e-9)

    def test_none_is_beaten_by_another_in_every_respect(self, designs: tuple[DesignProposal, ...]) -> None:
        values = np.array(
            [
                (
                    each.lateral_sweep_mm,
                    -each.tip_offset_mm,
                    each.tip_angle_rad,
                    each.tubes.inner.curved_length_mm,
                )
                for each in designs
            ]
        )
        clear = np.array([0.05, 0.05, 0.02, 0.0])
        for number, value in enumerate(values):
            others = np.delete(values, number, axis=0)
            assert not (others + clear < value + [0, 0, 0, 1e-9]).all(axis=1).any()

    def test_there_is_a_design_that_reaches_as_far_without_sweep(
        self, designs: tuple[DesignProposal, ...]
    ) -> None:
        """Its curve is as long as it is inserted."""
        present = evaluate_design(WIDE, 30.0, 50.0)
        assert present.lateral_sweep_mm > 2.0
        still = [each for each in designs if each.lateral_sweep_mm == 0.0]
        assert max(each.tip_offset_mm for each in still) > present.tip_offset_mm
        assert all(each.tubes.inner.curved_length_mm == 50.0 for each in still)

    def test_a_smaller_sweep_leaves_fewer_designs(self, designs: tuple[DesignProposal, ...]) -> None:
        few = propose_designs(WIDE, 30.0, 50.0, 0.5, LIMITS)
        assert 0 < len(few) < len(designs)
        assert few[-1].lateral_sweep_mm <= 0.5

    def test_the_longest_curve_is_respected(self) -> None:
        short = replace(LIMITS, longest_curve_mm=30.0)
        found = propose_designs(WIDE, 30.0, 50.0, 2.0, short)
        assert max(each.tubes.inner.curved_length_mm for each in found) == 30.0
        assert min(each.lateral_sweep_mm for each in found) > 0.0

    def test_a_thicker_channel_allows_a_thicker_wall(self, designs: tuple[DesignProposal, ...]) -> None:
        walls = {each.tubes.outer.outer_diameter_mm for each in designs}
        wide = propose_designs(WIDE, 30.0, 50.0, 2.0, MakerLimits(channel_diameter_mm=2.4))
        assert max(each.tubes.outer.outer_diameter_mm for each in wide) > max(walls)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((50.0, 30.0, 1.0), "0 <= outer <= inner"),
            ((0.0, 0.0, 1.0), "insertion above 0"),
            ((math.nan, 30.0, 1.0), "finite"),
            ((5.0, 50.0, 1.0), "difference of their lengths"),
            ((20.0, 30.0, math.nan), "largest sweep"),
        ],
    )
    def test_impossible_wishes(self, arguments: Any, message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            propose_designs(WIDE, *arguments, LIMITS)

    def test_an_outer_tube_that_does_not_fit(self) -> None:
        with pytest.raises(SettingsError, match="space for"):
            propose_designs(WIDE, 30.0, 50.0, 1.0, MakerLimits(channel_diameter_mm=1.8))

    def test_limits_are_checked(self) -> None:
        with pytest.raises(SettingsError, match="thinnest_wall_mm"):
            MakerLimits(channel_diameter_mm=2.0, thinnest_wall_mm=0.0)

    def test_a_straight_inner_tube_has_no_sweep_and_no_reach(self) -> None:
        straight = replace(WIDE, inner=replace(INNER, curved_length_mm=0.0, precurvature_per_mm=0.0))
        found = evaluate_design(straight, 30.0, 50.0)
        assert (found.lateral_sweep_mm, found.tip_offset_mm, found.tip_angle_rad) == (0.0, 0.0, 0.0)

    def test_the_bore_keeps_its_clearance(self) -> None:
        wide = propose_designs(WIDE, 30.0, 50.0, 2.0, replace(LIMITS, nesting_clearance_mm=0.2))
        assert all(each.tubes.outer.inner_diameter_mm == pytest.approx(1.7) for each in wide)
