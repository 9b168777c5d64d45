"""The distribution of a resting tip: its frame, its choices, and what makes it wide."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy import poses
from stages.scope.resting import RestingShaft, WallContact
from stages.scope.tip_spread import choices, off_pose, spread_of_tip
from tests.stages.scope.lumens import motion_of, sampled, scope_of, torus

STATES = [(0.0, 0.0, 0.2), (65.0, 0.0, 0.2), (65.0, 1.0, 0.2)]


@pytest.fixture(scope="module")
def shaft() -> RestingShaft:
    lumen = sampled(torus(40.0, 4.0, 20.0), (-12.0, -8.0, -5.0), (60.0, 8.0, 90.0), 0.5)
    return RestingShaft(lumen, scope_of(), WallContact())


def test_a_tip_off_a_pose_is_stated_in_its_frame() -> None:
    pose = poses.pose([1.0, 2.0, 3.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    angle = np.radians(10.0)
    tip = poses.pose([1.0, 2.0, 5.0], [0.0, np.cos(angle), np.sin(angle)], [1.0, 0.0, 0.0])
    # +x of the pose is the world's z: the tip lies 2 mm along it, and looks 10 degrees towards it, about +y.
    assert off_pose(pose, tip) == pytest.approx([2.0, 0.0, 0.0, 0.0, 10.0])


def test_choices_keep_the_stated_ranges() -> None:
    contact = WallContact(wall_stiffness_range=4.0, scope_stiffness_range=1.0, max_friction=0.3)
    made = [each for group in choices(contact) for each in group]
    assert {each.stiffer for each in made} == {1.0}
    assert 0.25 <= min(each.wall_stiffer for each in made) < max(each.wall_stiffer for each in made) <= 4.0
    assert 0.0 <= min(each.friction for each in made) < max(each.friction for each in made) <= 0.3


def test_without_ranges_the_tip_has_a_bias_and_no_spread(shaft: RestingShaft) -> None:
    motion = motion_of(STATES)
    known = WallContact(wall_stiffness_range=1.0, scope_stiffness_range=1.0, max_friction=0.0)
    found = spread_of_tip(shaft, motion, known, motion.lps_from_tip)
    off = off_pose(motion.lps_from_tip, found.nominal.lps_from_scope_tip)
    assert np.append(found.bias_mm, found.bias_deg) == pytest.approx(off, abs=0.05)
    assert max(found.patient_mm, found.attempt_mm, found.patient_deg, found.attempt_deg) < 0.05
    assert found.held_share == 1.0


def test_about_its_own_pose_a_tip_has_spread_and_hardly_a_bias(shaft: RestingShaft) -> None:
    motion = motion_of(STATES)
    free = spread_of_tip(shaft, motion, WallContact(), motion.lps_from_tip)
    own = spread_of_tip(shaft, motion, WallContact(), free.nominal.lps_from_scope_tip)
    assert np.linalg.norm(own.bias_deg) < 0.5 * np.linalg.norm(free.bias_deg)
    assert own.patient_mm > 0.0
    assert own.attempt_mm > 0.0
    assert own.wall_force_n.max() >= own.nominal.wall_force_n > 0.0
