"""Sequences of joint motions, what they sweep, and where tubes snap."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.margins import Margins
from stages.tube import Equilibrium, TubeMechanics, kernels, tube_constants
from stages.tube.device import BentPiece, Tube
from stages.tube.following import DeployedSequence, SnapError, deploy, motion_by_step
from stages.tube.sequences import Sequence, alternating, inner_first, joint_steps, kuntz2015, together
from tests.stages.tube.pairs import WIDE

INNER, OUTER = WIDE.inner, WIDE.outer
NUMBERS = tube_constants(WIDE, Margins())
MECHANICS = TubeMechanics((INNER, OUTER))


def pair(curvature_per_mm: float, curved_mm: float = 40.0) -> tuple[Tube, Tube]:
    """Two tubes of the same precurvature."""
    curve = {"curved_length_mm": curved_mm, "precurvature_per_mm": curvature_per_mm}
    return (
        Tube(outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=660.0, **curve),
        Tube(outer_diameter_mm=1.9, inner_diameter_mm=1.65, length_mm=640.0, **curve),
    )


def tips(sequence: Sequence, tubes: Any) -> np.ndarray:
    return sequence.beta_mm + [tube.length_mm for tube in tubes]


class TestWaypoints:
    def test_kuntz_turns_inserts_both_then_the_inner(self) -> None:
        made = kuntz2015((INNER, OUTER), 0.4, 20.0, 50.0)
        assert made.moves == ("turn", "insert all tubes", "insert the inner tube")
        assert tips(made, (INNER, OUTER)).tolist() == [[0, 0], [0, 0], [20, 20], [50, 20]]
        assert made.base_angles_rad.tolist() == [[0, 0], [0.4, 0.4], [0.4, 0.4], [0.4, 0.4]]

    def test_kuntz_with_relative_rotation(self) -> None:
        assert kuntz2015((INNER, OUTER), (0.1, 2.0), 20.0, 50.0).base_angles_rad[-1].tolist() == [0.1, 2.0]

    def test_all_tubes_with_the_same_insertion_need_one_move(self) -> None:
        assert kuntz2015((INNER, OUTER), 0.0, 20.0, 20.0).moves == ("turn", "insert all tubes")

    def test_inner_first(self) -> None:
        made = inner_first((INNER, OUTER), 0.0, (30.0, 10.0))
        assert tips(made, (INNER, OUTER)).tolist() == [[0, 0], [0, 0], [30, 0], [30, 10]]
        assert made.moves[1:] == ("insert the inner tube", "insert the outer tube")

    def test_alternating_keeps_the_inner_ahead_and_ends_at_the_same_place(self) -> None:
        made = alternating((INNER, OUTER), 0.0, (17.0, 12.0), increment_mm=5.0)
        found = tips(made, (INNER, OUTER))
        assert found[-1].tolist() == [17.0, 12.0]
        assert (np.diff(found, axis=1) <= 0.0).all()
        assert np.abs(np.diff(found, axis=0)).max() == 5.0
        assert ((np.diff(found, axis=0) > 0.0).sum(axis=1) <= 1).all(), "one tube at a time"

    def test_then_turn_adds_one_move_in_place(self) -> None:
        made = together((INNER, OUTER), 0.0, (30.0, 10.0)).then_turn((0.0, 1.0))
        assert (made.beta_mm[-1] == made.beta_mm[-2]).all()
        assert made.base_angles_rad[-1].tolist() == [0.0, 1.0]
        assert made.moves[-1] == "turn in place"

    def test_three_tubes(self) -> None:
        third = Tube(outer_diameter_mm=2.4, inner_diameter_mm=2.1, length_mm=600.0)
        made = together((INNER, OUTER, third), 0.0, (50.0, 30.0, 10.0))
        assert tips(made, (INNER, OUTER, third))[2:].tolist() == [[10] * 3, [30, 30, 10], [50, 30, 10]]
        assert made.moves[2] == "insert tube 1 and 2 (from the inside)"

    @pytest.mark.parametrize(
        ("insertions", "message"),
        [
            ((10.0, 20.0), "0 <= outer <= inner"),
            ((-1.0, -2.0), "0 <= outer <= inner"),
            ((math.nan, 1.0), "finite"),
            ((10.0,), "one finite length for each"),
            ((50.0, 5.0), "difference of their lengths, 40 mm"),
            ((700.0, 700.0), "at most the lengths of the tubes"),
        ],
    )
    def test_impossible_insertions(self, insertions: Any, message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            together((INNER, OUTER), 0.0, insertions)

    def test_other_impossible_sequences(self) -> None:
        with pytest.raises(SettingsError, match="difference of their lengths"):
            inner_first((INNER, OUTER), 0.0, (60.0, 40.0))
        with pytest.raises(SettingsError, match="two tubes"):
            kuntz2015((INNER,), 0.0, 1.0, 2.0)
        with pytest.raises(SettingsError, match="increment"):
            alternating((INNER, OUTER), 0.0, (20.0, 10.0), increment_mm=0.0)
        with pytest.raises(SettingsError, match="one angle"):
            together((INNER, OUTER), (0.0, 1.0, 2.0), (20.0, 10.0))
        with pytest.raises(SettingsError, match="one angle"):
            together((INNER, OUTER), 0.0, (20.0, 10.0)).then_turn((0.0, 1.0, 2.0))
        with pytest.raises(SettingsError, match="not finite"):
            together((INNER, OUTER), math.inf, (20.0, 10.0))
        with pytest.raises(SettingsError, match="one move less"):
            Sequence(name="x", moves=(), base_angles_rad=np.zeros((2, 1)), beta_mm=np.zeros((2, 1)))

    def test_results_cannot_be_written_to(self) -> None:
        with pytest.raises(ValueError, match="read-only"):
            kuntz2015((INNER, OUTER), 0.0, 1.0, 2.0).beta_mm[0, 0] = 1.0


class TestSteps:
    def test_steps_are_small_and_meet_every_waypoint(self) -> None:
        made = together((INNER, OUTER), (0.0, 2.0), (55.3, 31.7)).then_turn(3.0)
        angles, beta, move = joint_steps(made, (INNER, OUTER), step_mm=0.7, step_rad=0.1)
        assert np.abs(np.diff(beta, axis=0)).max() <= 0.7 + 1e-9
        assert np.abs(np.diff(angles, axis=0)).max() <= 0.1 + 1e-9
        ends = [np.flatnonzero(move == number)[-1] for number in range(len(made.moves))]
        assert np.allclose(beta[ends], made.beta_mm[1:]) and np.allclose(
            angles[ends], made.base_angles_rad[1:]
        )

    def test_a_step_is_where_the_curve_leaves_scope_and_outer_tube(self) -> None:
        longer = Tube(
            outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=700.0, curved_length_mm=40.0,
            precurvature_per_mm=0.025,
        )  # fmt: skip
        made = kuntz2015((longer, OUTER), 0.0, 13.3, 57.7)
        _, beta, _ = joint_steps(made, (longer, OUTER), step_mm=5.0, step_rad=1.0)
        for inner in (40.0, 13.3 + 40.0):
            assert np.abs(beta[:, 0] + 700.0 - inner).min() < 1e-9

    def test_flush_tips_stay_in_order_whatever_the_rounding(self) -> None:
        inner, outer = pair(0.0045)
        made = together((inner, outer), 0.0, (33.3, 15.1))
        _, beta, _ = joint_steps(made, (inner, outer), step_mm=0.37, step_rad=1.0)
        ends = beta + [inner.length_mm, outer.length_mm]
        assert (ends[:, 0] >= ends[:, 1]).all() and (beta <= 0.0).all() and (ends >= 0.0).all()

    def test_impossible_steps(self) -> None:
        made = kuntz2015((INNER, OUTER), 0.0, 10.0, 20.0)
        with pytest.raises(SettingsError, match="above 0"):
            joint_steps(made, (INNER, OUTER), step_mm=0.0, step_rad=1.0)
        with pytest.raises(SettingsError, match="2 tubes"):
            joint_steps(made, (INNER,), step_mm=1.0, step_rad=1.0)


class TestSweepOfStraightOuterTube:
    """The planner's closed form is the reference."""

    @settings(max_examples=25, deadline=None)
    @given(inner=st.floats(1.0, 60.0), share=st.floats(0.0, 1.0), rotation=st.floats(-4.0, 4.0))
    def test_agrees_with_the_closed_form(self, inner: float, share: float, rotation: float) -> None:
        outer = max(share * inner, inner - 40.0)
        found = deploy(MECHANICS, kuntz2015((INNER, OUTER), rotation, outer, inner), step_mm=0.5)
        assert found.lateral_sweep_mm == pytest.approx(kernels.lateral_sweep(NUMBERS, outer, inner), abs=1e-3)
        assert found.least_determinant == pytest.approx(1.0)

    @pytest.mark.parametrize(("outer", "inner"), [(0.0, 40.0), (20.0, 40.0), (40.0, 40.0), (10.0, 25.0)])
    def test_nothing_sweeps_within_the_curved_length(self, outer: float, inner: float) -> None:
        found = deploy(MECHANICS, kuntz2015((INNER, OUTER), 1.0, outer, inner))
        assert found.lateral_sweep_mm < 1e-9
        assert found.follow_the_leader_error_mm < 1e-9

    def test_each_step_is_the_shape_in_closed_form(self) -> None:
        found = deploy(MECHANICS, kuntz2015((INNER, OUTER), 0.5 * math.pi, 20.0, 55.0), step_mm=5.0)
        for step in found.steps[1:]:
            inner, outer = (step.beta_mm + MECHANICS.lengths_mm).tolist()
            if inner == 0.0:
                continue
            aside, ahead = kernels.planar_point(NUMBERS, outer, inner, inner)
            turn = float(step.base_angles_rad[0]) - 0.5 * math.pi
            expected = [aside * math.cos(turn), aside * math.sin(turn), ahead]
            assert np.allclose(step.base_from_tip[:3, 3], expected, atol=1e-6)

    def test_the_inner_first_sweeps_what_the_outer_straightens(self) -> None:
        """Inner tube at its own curvature, then its first 20 mm at the shared one."""
        found = deploy(MECHANICS, inner_first((INNER, OUTER), 0.0, (38.0, 20.0)))
        before = kernels.planar_point(NUMBERS, 0.0, 38.0, 38.0)
        after = kernels.planar_point(NUMBERS, 20.0, 38.0, 38.0)
        assert found.lateral_sweep_mm == pytest.approx(math.dist(before, after), abs=1e-6)


class TestFollowTheLeader:
    def test_against_a_dense_search(self) -> None:
        found = deploy(MECHANICS, kuntz2015((INNER, OUTER), 0.0, 15.0, 52.0), step_mm=4.0)
        track = found.final.backbone(np.arange(0.0, 52.0, 0.005))
        for number in (5, len(found.steps) // 2, len(found.steps) - 4):
            step = found.steps[number]
            body = step.backbone(np.linspace(0.0, step.length_mm, 60))
            nearest = np.linalg.norm(body[:, None] - track[None], axis=2).min(axis=1)
            assert found.follow_the_leader_by_step_mm[number] == pytest.approx(nearest.max(), abs=2e-3)

    def test_it_never_exceeds_the_sweep_and_ends_at_zero(self) -> None:
        mechanics = TubeMechanics(pair(0.0045))
        found = deploy(mechanics, kuntz2015(mechanics.tubes, (0.0, 2.0), 35.0, 50.0))
        assert (found.follow_the_leader_by_step_mm <= found.lateral_sweep_by_step_mm).all()
        assert found.lateral_sweep_by_step_mm[-1] == 0.0
        assert 0.0 < found.follow_the_leader_error_mm <= found.lateral_sweep_mm

    def test_a_body_longer_than_in_the_end_is_compared_with_the_final_tip(self) -> None:
        straight = Tube(outer_diameter_mm=1.0, inner_diameter_mm=0.8, length_mm=100.0)
        mechanics = TubeMechanics((straight,))
        out_and_back = Sequence(
            name="out and back", moves=("out", "back"), base_angles_rad=np.zeros((3, 1)),
            beta_mm=np.array([[-100.0], [-70.0], [-80.0]]),
        )  # fmt: skip
        found = deploy(mechanics, out_and_back)
        assert found.lateral_sweep_mm == pytest.approx(10.0)
        assert found.follow_the_leader_error_mm == pytest.approx(10.0)

    def test_a_whole_turn_of_a_curved_tube_sweeps_its_double_offset(self) -> None:
        mechanics = TubeMechanics((INNER,))
        found = deploy(mechanics, together((INNER,), 0.0, (30.0,)).then_turn(2.0 * math.pi), step_rad=0.05)
        offset = (1.0 - math.cos(0.75)) / 0.025
        assert found.lateral_sweep_mm == pytest.approx(2.0 * offset, rel=1e-3)


def fold_of(mechanics: TubeMechanics, beta: np.ndarray) -> float:
    """The relative base angle at which the branch from 0 ends: the top of base over tip angle."""
    between = np.linspace(0.0, math.pi, 3001)
    base = [mechanics.given_tip_angles((0.0, angle), beta).base_angles_rad for angle in between]
    return float(np.ptp(base, axis=1).max())


class TestSnapping:
    @pytest.mark.parametrize("curvature", [0.006, 0.0065, 0.008])
    def test_a_pair_that_snaps_is_found_out_where_its_branch_ends(self, curvature: float) -> None:
        mechanics = TubeMechanics(pair(curvature))
        sequence = kuntz2015(mechanics.tubes, 0.0, 40.0, 40.0).then_turn((0.0, 2.0 * math.pi))
        with pytest.raises(SnapError, match="turn in place") as caught:
            deploy(mechanics, sequence)
        error = caught.value
        expected = fold_of(mechanics, sequence.beta_mm[-1])
        assert expected > math.pi
        assert np.ptp(error.base_angles_rad) == pytest.approx(expected, abs=2e-3)
        assert error.insertions_mm == pytest.approx([40.0, 40.0])
        assert error.last.stable and error.last.least_determinant < 0.05
        assert isinstance(error, LungaccessError) and error.move == "turn in place"

    @pytest.mark.parametrize("step_rad", [0.05, 0.5])
    def test_the_step_does_not_decide_whether_it_is_found(self, step_rad: float) -> None:
        """At 0.006 / mm the tubes snap a little: a coarse step would jump over it."""
        mechanics = TubeMechanics(pair(0.006))
        sequence = kuntz2015(mechanics.tubes, 0.0, 40.0, 40.0).then_turn((0.0, 2.0 * math.pi))
        with pytest.raises(SnapError):
            deploy(mechanics, sequence, step_rad=step_rad)

    @pytest.mark.parametrize("curvature", [0.003, 0.0045, 0.0052])
    def test_a_pair_that_does_not_snap_turns_all_round(self, curvature: float) -> None:
        mechanics = TubeMechanics(pair(curvature))
        sequence = kuntz2015(mechanics.tubes, 0.0, 40.0, 40.0).then_turn((0.0, 2.0 * math.pi))
        found = deploy(mechanics, sequence)
        assert all(step.stable for step in found.steps)
        assert found.final.tip_angles_rad == pytest.approx([0.0, 2.0 * math.pi], abs=1e-9)
        between = [float(np.diff(step.tip_angles_rad)[0]) for step in found.steps]
        assert (np.diff(between) > -1e-9).all(), "the tips turn in one direction"

    def test_there_and_back_again(self) -> None:
        mechanics = TubeMechanics(pair(0.0052))
        sequence = kuntz2015(mechanics.tubes, 0.0, 40.0, 40.0).then_turn((0.0, 5.0)).then_turn((0.0, 1.0))
        there = mechanics.given_base_angles((0.0, 1.0), sequence.beta_mm[-1])
        found = deploy(mechanics, sequence).final
        assert found.tip_angles_rad == pytest.approx(there.tip_angles_rad.tolist(), abs=1e-8)

    def test_a_snap_while_inserting(self) -> None:
        """A tube bent to one side and then to the other turns over as its rear part comes out."""
        inner = Tube(
            outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=680.0,
            bent_pieces=(
                BentPiece(length_mm=34.0, precurvature_per_mm=0.041),
                BentPiece(length_mm=24.0, precurvature_per_mm=0.018, direction_deg=195.0),
            ),
        )  # fmt: skip
        outer = Tube(
            outer_diameter_mm=1.9, inner_diameter_mm=1.65, length_mm=640.0, curved_length_mm=39.0,
            precurvature_per_mm=0.022,
        )  # fmt: skip
        mechanics = TubeMechanics((inner, outer))
        with pytest.raises(SnapError, match="insert all tubes") as caught:
            deploy(mechanics, kuntz2015(mechanics.tubes, (0.0, math.radians(75.0)), 60.0, 80.0))
        assert 24.0 < caught.value.insertions_mm[0] < 58.0
        assert caught.value.last.least_determinant < 0.05

    def test_an_unstable_beginning_is_refused(self) -> None:
        """Were the solver to find no other equilibrium than that of opposed tubes."""
        tubes, beta = pair(0.0125), np.array([-620.0, -600.0])
        opposed = TubeMechanics(tubes).given_tip_angles((0.0, math.pi), beta)

        class FindsOnlyThis(TubeMechanics):
            def given_base_angles(self, *_: Any, **__: Any) -> Equilibrium:
                return opposed

        start = Sequence(
            name="opposed", moves=("turn",), base_angles_rad=np.array([[0.0, math.pi], [0.0, 3.5]]),
            beta_mm=np.array([beta, beta]),
        )  # fmt: skip
        with pytest.raises(SnapError, match="no stable equilibrium"):
            deploy(FindsOnlyThis(tubes), start)
        assert deploy(TubeMechanics(tubes), start).final.stable

    def test_a_branch_that_loses_stability_ends(self) -> None:
        """Were the solver to stay on the branch of opposed tubes, beyond where it is stable."""

        class StaysOpposed(TubeMechanics):
            def given_base_angles(self, base: Any, beta: Any, **_: Any) -> Equilibrium:
                return self.given_tip_angles(base, beta)

        mechanics = StaysOpposed(pair(0.0125))
        with pytest.raises(SnapError, match="stability is lost") as caught:
            deploy(mechanics, kuntz2015(mechanics.tubes, (0.0, math.pi), 40.0, 40.0))
        assert caught.value.move == "insert all tubes"
        before, after = caught.value.last, caught.value.insertions_mm - mechanics.lengths_mm
        assert before.stable and not mechanics.given_tip_angles((0.0, math.pi), after).stable
        assert np.abs(before.beta_mm - after).max() < 1e-3


def test_three_tubes_are_followed() -> None:
    inner, middle = pair(0.004)
    outer = Tube(
        outer_diameter_mm=2.4, inner_diameter_mm=2.1, length_mm=600.0, curved_length_mm=30.0,
        precurvature_per_mm=0.003,
    )  # fmt: skip
    mechanics = TubeMechanics((inner, middle, outer))
    found = deploy(mechanics, together(mechanics.tubes, (0.0, 1.5, 3.0), (60.0, 45.0, 25.0)), step_mm=3.0)
    assert isinstance(found, DeployedSequence)
    assert all(step.stable for step in found.steps)
    assert np.allclose(found.final.base_angles_rad, (0.0, 1.5, 3.0), atol=1e-8)
    assert len(found.steps) == len(found.move) == len(found.lateral_sweep_by_step_mm)


def test_the_same_twice() -> None:
    mechanics = TubeMechanics(pair(0.0045))
    sequence = kuntz2015(mechanics.tubes, (0.0, 2.0), 35.0, 50.0)
    first, second = deploy(mechanics, sequence), deploy(mechanics, sequence)
    assert (first.lateral_sweep_by_step_mm == second.lateral_sweep_by_step_mm).all()
    assert (first.final.base_from_tip == second.final.base_from_tip).all()


def test_motion_of_one_step_is_none() -> None:
    step = MECHANICS.given_base_angles((0.0, 0.0), (-640.0, -620.0))
    sweep, error = motion_by_step([step])
    assert sweep.tolist() == [0.0] and error.tolist() == [0.0]
