"""Simplified motions: the same tip by fewer changes, proved; and how far their steps may err."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.lung import Lung
from lungaccess.judging.checking.boxes import Environment, not_lumen
from lungaccess.judging.checking.scope import least_gap_mm, motion_of
from lungaccess.problem.system import load_system
from stages.scope import MotionProver, ScopeMotion, find_motions, prover_of
from stages.scope.simplifying import legs_of

SCOPE = load_system("ultrathin").scope
COUNT = 6
SAME = 1e-9
"""A tip is where it was to so many mm and rad."""


@pytest.fixture(scope="module")
def prover(small_lung: Lung) -> MotionProver:
    return prover_of(small_lung, SCOPE)


@pytest.fixture(scope="module")
def given(small_lung: Lung) -> list[ScopeMotion]:
    """The motions that advance farthest, and some between."""
    motions = find_motions(small_lung, SCOPE, reach_mm=60.0)
    order = np.argsort(motions.states.advance_mm[motions.state], kind="stable")
    chosen = order[np.linspace(0.4 * len(order), len(order) - 1, COUNT).astype(int)]
    return [motions.motion(int(tip)) for tip in chosen]


@pytest.fixture(scope="module")
def simple(prover: MotionProver, given: list[ScopeMotion]) -> list[ScopeMotion]:
    return [simplest(prover, motion) for motion in given]


def simplest(prover: MotionProver, motion: ScopeMotion, **changed: float) -> ScopeMotion:
    limit = {"max_curvature_per_mm": 1.0 / SCOPE.min_bending_radius_mm, **changed}
    return prover.simplest(motion, end_bends_rad=SCOPE.bends_rad, **limit)


def changes(motion: ScopeMotion) -> int:
    return int((np.diff(motion.states[:, 1:], axis=0) != 0.0).any(axis=1).sum())


def test_a_simple_motion_ends_in_the_same_pose_and_is_proved(
    prover: MotionProver, given: list[ScopeMotion], simple: list[ScopeMotion]
) -> None:
    for before, after in zip(given, simple, strict=True):
        np.testing.assert_allclose(after.lps_from_tip, before.lps_from_tip, atol=SAME)
        assert isinstance(prover.prove(after), float)


def test_changes_and_twists_become_fewer(given: list[ScopeMotion], simple: list[ScopeMotion]) -> None:
    assert all(changes(b) <= changes(a) for a, b in zip(given, simple, strict=True))
    assert sum(map(changes, simple)) < 0.7 * sum(map(changes, given))


def test_each_step_does_one_thing(given: list[ScopeMotion], simple: list[ScopeMotion]) -> None:
    found = [after for before, after in zip(given, simple, strict=True) if after is not before]
    assert len(found) >= COUNT - 1
    for motion in found:
        assert ((np.diff(motion.states, axis=0) != 0.0).sum(axis=1) == 1).all()


def test_the_same_motion_gives_the_same_result(
    prover: MotionProver, given: list[ScopeMotion], simple: list[ScopeMotion]
) -> None:
    assert np.array_equal(simplest(prover, given[-1]).states, simple[-1].states)


def test_what_passes_the_channel_bounds_the_curvature(prover: MotionProver, given: list[ScopeMotion]) -> None:
    limit = given[-1].max_curvature_per_mm
    assert simplest(prover, given[-1], max_curvature_per_mm=limit).max_curvature_per_mm <= limit * (1 + 1e-12)


def test_a_motion_that_is_not_proved_comes_back(prover: MotionProver, given: list[ScopeMotion]) -> None:
    aside = given[-1].lps_from_entry + np.array([[0, 0, 0, 40.0], *np.zeros((3, 4))])
    astray = replace(given[-1], lps_from_entry=aside)
    assert simplest(prover, astray) is astray


def test_legs_are_the_advances(given: list[ScopeMotion]) -> None:
    for motion in given:
        legs = legs_of(motion)
        assert legs.advances.sum() == pytest.approx(motion.states[-1, 0])
        assert legs.rows[-1, :2].tolist() == motion.states[-1, 1:].tolist()


def test_a_step_that_errs_within_its_tolerance_stays_free(
    small_lung: Lung, prover: MotionProver, simple: list[ScopeMotion]
) -> None:
    """Each error alone, as large as it may be, by the check's own kinematics and its own distances."""
    needed = SCOPE.radius_mm + SCOPE.lumen_margin_mm
    boxes = Environment(small_lung).boxes(not_lumen, needed + 1.0)
    tried = 0
    for motion in simple:
        allowed = prover.tolerances(motion)
        assert (allowed >= 0.0).all() and allowed.max() > 0.0
        for step, row in enumerate(allowed):
            for quantity, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)):
                states = wrong(motion.states[: step + 2], quantity, sign * row[quantity])
                if states is not None:
                    moved = motion_of(motion.lps_from_entry, states, motion.bending_length_mm)
                    assert least_gap_mm(moved, boxes, needed, 0.0) > needed - 1e-6
                    tried += 1
    assert tried > 100


def wrong(states: np.ndarray, quantity: int, error: float) -> np.ndarray | None:
    """Return states of which the last step errs all along in one of advance, twist and bend."""
    begin, end = states[-2].copy(), states[-1].copy()
    if quantity > 0:
        begin[quantity] += error
        end[quantity] += error
        return np.vstack([states[:-1], begin, end])
    if end[0] > begin[0]:
        end[0] = max(end[0] + error, begin[0])
        return np.vstack([states[:-1], end])
    if error < 0.0 and (
        len(states) < 3 or states[-2, 0] + error < states[-3, 0] or states[-2, 0] == states[-3, 0]
    ):
        return None
    begin[0] += error
    end[0] += error
    return np.vstack([states[:-2] if error < 0.0 else states[:-1], begin, end])
