"""Steps of a scope for hands: they end at states of the motion, and match what the camera sees."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lungaccess.plans.plan import Plan
from lungaccess.plans.scope_steps import (
    handle_factor,
    handle_words,
    merged_states,
    motion_record,
    scope_steps,
)
from stages.scope import ScopeMotion

SECTION_MM = 14.0
TREE: Any = SimpleNamespace(
    points_lps=np.zeros((1, 3)), generation=np.array([3]), branch_of_point=np.array([0])
)


def motion(states: list[list[float]]) -> ScopeMotion:
    """The scope looks towards the feet, the top of its picture is the patient's front."""
    entry = np.eye(4)
    entry[:3, :3] = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).T
    return ScopeMotion(lps_from_entry=entry, states=np.array(states), bending_length_mm=SECTION_MM)


def test_up_is_towards_the_top_of_the_picture() -> None:
    """+x of the first tip is anterior: a positive bend leads to the front, 12 o'clock."""
    moving = motion([[0, 0, 0], [0, 0, 0.6], [12, 0, 0.6]])
    bend, advance = scope_steps(moving, TREE)
    assert moving.lps_from_tip[1, 3] < -5.0
    assert bend.text == (
        "The airway goes on towards 12 o'clock in the picture: stand still and bring the tip from straight "
        "to 34° up. Inserted: 0 mm."
    )
    assert "advance 12 mm with the tip 34° up" in advance.text


@pytest.mark.parametrize(
    ("twist", "side", "way"), [(1.2, -1.0, "clockwise"), (-1.2, 1.0, "counterclockwise")]
)
def test_a_turn_clockwise_brings_the_top_of_the_picture_to_the_right(
    twist: float, side: float, way: str
) -> None:
    """Looking to the feet with the front up, the patient's right is on the right of the picture."""
    moving = motion([[0, 0, 0], [0, twist, 0], [0, twist, 0.7], [5, twist, 0.7]])
    assert side * moving.lps_from_tip[0, 3] > 4.0
    first = scope_steps(moving, TREE)[0]
    way = "clockwise" if twist > 0.0 else "counterclockwise"
    assert f"turn the scope 69° {way} (seen from behind)" in first.text
    hour = "2 o'clock" if twist > 0.0 else "10 o'clock"
    assert f"towards {hour}" in first.text


def test_a_bend_down_goes_to_six_o_clock() -> None:
    steps = scope_steps(motion([[0, 0, 0], [0, 0, -0.6], [12, 0, -0.6]]), TREE)
    assert "towards 6 o'clock" in steps[0].text
    assert "from straight to 34° down" in steps[0].text


def test_small_turns_on_the_way_are_one_step() -> None:
    rows, bend = [[0.0, 0.3, 0.0]], 0.0
    for n in range(20):
        bend += 0.03
        rows += [[float(n), 0.3, bend], [float(n + 1), 0.3, bend]]
    steps = scope_steps(motion(rows), TREE)
    assert len(steps) == 1
    assert (steps[0].first_state, steps[0].last_state) == (0, len(rows) - 1)
    assert (steps[0].advance_mm, steps[0].inserted_mm, steps[0].twist_deg) == (20.0, 20.0, 0.0)
    assert steps[0].to_bend_deg == pytest.approx(np.degrees(0.6))


def test_turns_that_differ_are_not_merged() -> None:
    rows = np.array(
        [[0, 0, 0], [10, 0, 0], [10, 0, 0.5], [20, 0, 0.5], [20, 0, -0.5], [30, 0, -0.5]], dtype=float
    )
    assert merged_states(rows).tolist() == [0, 1, 2, 3, 4, 5]


def test_a_way_round_in_place_is_kept() -> None:
    """Twist first and bend then is another way than bend, twist back and bend: an obstacle lay between."""
    rows = np.array([[0, 0, 1.0], [0, 0, 0.0], [0, 3.0, 0.0], [0, 3.0, 1.0]], dtype=float)
    ends = merged_states(rows)
    assert len(ends) > 2


def test_twists_of_a_straight_tip_are_no_steps_of_their_own() -> None:
    rows = np.array([[n, (-1.0) ** n, 0.0] for n in range(8)], dtype=float)
    assert merged_states(rows).tolist() == [0, 7]


def test_the_handle_makes_up_for_the_tubes(toy_plan: Plan) -> None:
    """Section and tubes together are stiffer than the section alone."""
    factor = handle_factor(toy_plan)
    bend = float(np.degrees(toy_plan.scope.states[-1, 2]))
    assert 1.0 < factor < 5.0
    words = handle_words(toy_plan)
    if abs(bend) < 0.5:
        assert "leave it so" in words
    else:
        assert f"{factor:.2f} times" in words and f"{abs(bend * factor):.0f}°" in words


def test_programs_get_every_state(toy_plan: Plan, toy_lung: Any) -> None:
    record = motion_record(toy_plan, toy_lung)
    states = [[each["advance_mm"], each["twist_deg"], each["bend_deg"]] for each in record["states"]]
    assert np.allclose(np.array(states) * [1.0, np.pi / 180.0, np.pi / 180.0], toy_plan.scope.states)
    assert record["steps"][-1]["branch"] == toy_plan.scope.branches[-1]
    assert record["steps"][-1]["inserted_mm"] == toy_plan.scope.states[-1, 0]
    taken = [each["openings"][0]["branch"] for each in record["bifurcations"]]
    assert taken == toy_plan.scope.branches[1:].tolist()
    assert "take the one " in record["bifurcations"][0]["text"]
    assert "the left main bronchus (branch 1, generation 1)" in record["bifurcations"][0]["text"]
