"""States put between those of a motion, and the tips in all states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.scope import ScopeMotion

ADVANCE = [0.0, 12.0, 12.0, 15.5, 15.5, 21.0]
TWIST = [0.0, 0.0, 0.8, 0.8, 0.2, 0.2]
BEND = [0.0, 0.0, 0.5, 0.5, -0.4, -0.4]
STATES = np.stack([ADVANCE, TWIST, BEND], axis=1)
MOTION = ScopeMotion(lps_from_entry=np.eye(4), states=STATES, bending_length_mm=14.0)


def test_tips_are_the_ends_of_the_bodies_up_to_each_state() -> None:
    for n, tip in enumerate(MOTION.tips):
        until = replace(MOTION, states=STATES[: n + 1])
        np.testing.assert_allclose(tip, until.lps_from_tip, atol=1e-12)


def test_states_between_change_nothing_else() -> None:
    dense = MOTION.between(1.0, 0.1)
    steps = np.abs(np.diff(dense.states, axis=0))
    assert (steps <= np.array([1.0, 0.1, 0.1]) + 1e-12).all()
    assert ((steps[:, 0] == 0.0) | (steps[:, 1:] == 0.0).all(axis=1)).all()
    for state in STATES:
        assert np.abs(dense.states - state).max(axis=1).min() < 1e-12
    np.testing.assert_allclose(dense.lps_from_tip, MOTION.lps_from_tip, atol=1e-12)
    np.testing.assert_allclose(dense.length_mm, MOTION.length_mm)
