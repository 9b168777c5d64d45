"""Steps of a scope for hands: they end at states of the motion, and match what the camera sees."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from anatomy.lung import Lung
from lungaccess.cli import terminal
from lungaccess.cli.plan_search import steps_table
from lungaccess.judging.checking.boxes import Environment, not_lumen
from lungaccess.plans.bifurcations import Hole
from lungaccess.plans.insertion import scope_insertion, scope_motion, with_simplest_motion
from lungaccess.plans.plan import Plan
from lungaccess.plans.scope_steps import (
    goes_on_words,
    handle_factor,
    handle_words,
    motion_record,
    steps_note,
    steps_of,
)
from lungaccess.showing.report.html.tables import instructions_section
from stages.scope import ScopeMotion, find_motions, prover_of
from tests.lungaccess.literal_steps import carried_out, least_room_mm, off, states_of_json, states_of_texts

SECTION_MM = 14.0
TREE: Any = SimpleNamespace(
    points_lps=np.zeros((1, 3)), generation=np.array([3]), branch_of_point=np.array([0])
)


def motion(states: list[list[float]]) -> ScopeMotion:
    """The scope looks towards the feet, the top of its picture is the patient's front."""
    entry = np.eye(4)
    entry[:3, :3] = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).T
    return ScopeMotion(lps_from_entry=entry, states=np.array(states), bending_length_mm=SECTION_MM)


def steps(moving: ScopeMotion, decimals: int = 0) -> tuple[Any, ...]:
    """Return the steps of a motion as it is written, with errors of 0.25 mm, 3 and 120 degrees allowed."""
    allowed = np.tile([0.25, np.radians(3.0), np.radians(120.0)], (len(moving.states) - 1, 1))

    def goes_on(state: int) -> str:
        return goes_on_words(Hole(place_lps=moving.tips[-1, :3, 3]).hour(moving.tips[state]))

    return steps_of(moving.written(decimals), TREE, allowed, goes_on)


def test_up_is_towards_the_top_of_the_picture() -> None:
    """+x of the first tip is anterior: a positive bend leads to the front, 12 o'clock."""
    moving = motion([[0, 0, 0], [0, 0, 0.6], [12, 0, 0.6]])
    bend, advance = steps(moving)
    assert moving.lps_from_tip[1, 3] < -5.0
    assert bend.text == (
        "The airway goes on towards 12 o'clock in the picture: bring the tip from straight to 34° up. "
        "There is room for an error of 0.2 mm, 3.0° of twist or 90° and more of bend."
    )
    assert "advance 12 mm, until 12 mm are inserted" in advance.text


@pytest.mark.parametrize(
    ("twist", "side", "way"), [(1.2, -1.0, "clockwise"), (-1.2, 1.0, "counterclockwise")]
)
def test_a_turn_clockwise_brings_the_top_of_the_picture_to_the_right(
    twist: float, side: float, way: str
) -> None:
    """Looking to the feet with the front up, the patient's right is on the right of the picture."""
    moving = motion([[0, 0, 0], [0, twist, 0], [0, twist, 0.7], [5, twist, 0.7]])
    assert side * moving.lps_from_tip[0, 3] > 4.0
    first = steps(moving)[0]
    assert f"turn the scope 69° {way} (seen from behind), to 69° {way}." in first.text
    hour = "2 o'clock" if twist > 0.0 else "10 o'clock"
    assert f"towards {hour}" in first.text


def test_a_bend_down_goes_to_six_o_clock() -> None:
    bend, _advance = steps(motion([[0, 0, 0], [0, 0, -0.6], [12, 0, -0.6]]))
    assert "towards 6 o'clock" in bend.text
    assert "from straight to 34° down" in bend.text


def test_numbers_are_those_that_are_written() -> None:
    rows = [[0, 0, 0], [0, 0.3, 0], [0, 0.3, -0.6], [7.26, 0.3, -0.6], [7.26, 0.3001, -0.6]]
    twist, bend, advance = steps(motion(rows), 1)
    assert (twist.to_twist_deg, bend.to_bend_deg, advance.inserted_mm) == (17.2, -34.3, 7.3)
    assert "turn the scope 17.2° clockwise" in twist.text and "to 34.3° down" in bend.text
    assert [each.state for each in (twist, bend, advance)] == [1, 2, 3]


def test_twist_and_bend_that_change_together_are_one_step() -> None:
    (both,) = steps(motion([[0, 0, 0], [0, -0.35, 0.35]]))
    assert both.action == (
        "turn the scope 20° counterclockwise (seen from behind), to 20° counterclockwise and evenly with it "
        "bring the tip from straight to 20° up"
    )


def test_room_for_less_than_is_written_is_said() -> None:
    moving = motion([[0, 0, 0], [5, 0, 0]])
    (only,) = steps_of(moving, TREE, np.array([[0.09, 0.001, 1.0]]), lambda _state: "straight ahead")
    assert "an error of less than 0.1 mm, less than 0.1° of twist or 57.2° of bend" in only.text


@pytest.fixture(scope="module")
def plans(small_plan: Plan, breathing_lung: Lung) -> list[Plan]:
    """A plan, and the same with motions to other tips as they are found and as they are made simple."""
    motions = find_motions(breathing_lung, small_plan.system.scope, reach_mm=60.0)
    order = np.argsort(motions.states.advance_mm[motions.state], kind="stable")
    found = [small_plan]
    for tip in order[[-1, len(order) // 2, len(order) // 3]].tolist():
        moving = motions.motion(tip)
        margin_mm = prover_of(breathing_lung, small_plan.system.scope).prove(moving)
        assert isinstance(margin_mm, float)
        nearest = int(breathing_lung.tree.nearest_point_index.query(moving.lps_from_tip[:3, 3])[1])
        scope = scope_insertion(moving, breathing_lung.tree, nearest, margin_mm)
        found.append(replace(small_plan, scope=scope))
        found.append(with_simplest_motion(found[-1], breathing_lung))
    return found


class TestCarriedOut:
    """What is written, carried out word for word by the check's own kinematics, is the motion of the plan."""

    def test_in_words_and_numbers(self, plans: list[Plan], breathing_lung: Lung) -> None:
        environment = Environment(breathing_lung)
        for plan in plans:
            record: Any = motion_record(plan, breathing_lung)
            texts = [each["text"] for each in record["steps"]]
            states = states_of_texts(texts)
            np.testing.assert_allclose(states, states_of_json(record["steps"]), atol=1e-12)
            carried = carried_out(record, states)
            mm, degrees = off(carried, plan.scope.lps_from_scope_tip)
            assert mm < 0.5 and degrees < 1.0
            needed = plan.system.scope.radius_mm + plan.system.scope.lumen_margin_mm
            boxes = environment.boxes(not_lumen, needed + 1.0)
            assert least_room_mm(carried, boxes, needed) >= 0.0

    def test_steps_that_are_not_proved_say_so(self, plans: list[Plan], breathing_lung: Lung) -> None:
        assert "not proved" not in steps_note(plans[0], breathing_lung)
        straight = plans[0].scope.states * [1.0, 1.0, 0.0]
        edited = replace(plans[0], scope=replace(plans[0].scope, states=straight))
        note = steps_note(edited, breathing_lung)
        assert note.startswith("These steps are not proved: the scope is not proved to be free of the wall")

    def test_terminal_and_page_say_the_same(
        self, plans: list[Plan], breathing_lung: Lung, wide_terminal: None
    ) -> None:
        record: Any = motion_record(plans[0], breathing_lung)
        said = states_of_texts(each["text"] for each in record["steps"])
        with terminal.console.capture() as printed:
            terminal.show([steps_table(plans[0], breathing_lung)])
        page = html.unescape(re.sub("<[^>]+>", " ", instructions_section(plans[0], breathing_lung)))
        for shown in (printed.get(), page):
            texts = re.sub(r"[\s│]+", " ", shown).split("The airway goes on")[1:]
            assert np.array_equal(states_of_texts(texts), said)

    def test_a_simple_motion_keeps_all_else_of_a_plan(self, plans: list[Plan], breathing_lung: Lung) -> None:
        before, after = plans[-2:]
        assert len(after.scope.states) < 0.7 * len(before.scope.states)
        assert replace(after, scope=before.scope).digest == before.digest
        assert np.array_equal(after.scope.lps_from_scope_tip, before.scope.lps_from_scope_tip)
        np.testing.assert_allclose(
            scope_motion(after).lps_from_tip, before.scope.lps_from_scope_tip, atol=1e-9
        )
        proved = prover_of(breathing_lung, after.system.scope).prove(scope_motion(after))
        assert proved == after.scope.min_lumen_margin_mm - after.system.scope.lumen_margin_mm


def test_the_handle_makes_up_for_the_tubes(toy_plan: Plan) -> None:
    """Section and tubes together are stiffer than the section alone."""
    factor = handle_factor(toy_plan)
    bend = float(np.degrees(toy_plan.scope.states[-1, 2]))
    assert 1.0 < factor < 5.0
    words = handle_words(toy_plan)
    if abs(bend) < 0.5:
        assert "leave it so" in words
    else:
        assert f"{factor:.2f} times" in words and f"{round(abs(bend * factor), 1):g}°" in words


def test_programs_get_every_state(toy_plan: Plan, toy_lung: Any) -> None:
    record = motion_record(toy_plan, toy_lung)
    states = [[each["advance_mm"], each["twist_deg"], each["bend_deg"]] for each in record["states"]]
    assert np.allclose(np.array(states) * [1.0, np.pi / 180.0, np.pi / 180.0], toy_plan.scope.states)
    assert record["steps"][-1]["branch"] == toy_plan.scope.branches[-1]
    assert record["steps"][-1]["inserted_mm"] == pytest.approx(toy_plan.scope.states[-1, 0], abs=0.1)
    taken = [each["openings"][0]["branch"] for each in record["bifurcations"]]
    assert taken == toy_plan.scope.branches[1:].tolist()
    assert "take the one " in record["bifurcations"][0]["text"]
    assert "the left main bronchus (branch 1, generation 1)" in record["bifurcations"][0]["text"]
