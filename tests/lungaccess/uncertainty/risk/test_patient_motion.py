"""Breathing of the patient in the error model: where the target is against the devices, and when."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.grid import Grid
from anatomy.motion.motion import Motion
from lungaccess.judging.checking.window import Breath
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import IN_WINDOW, ErrorModel
from lungaccess.uncertainty.risk.deviations import Draws
from lungaccess.uncertainty.risk.patient_errors import BREATHS_LN, PatientMotion, model_for, phase

TARGET, TIP = np.array([20.0, 5.0, -30.0]), np.array([3.0, -4.0, 12.0])
WINDOW = np.array([[0.1, 0.3], [0.6, 0.65]])


def motion() -> Motion:
    grid = Grid.from_spacing((16, 16, 24), (5.0, 5.0, 5.0), (-30.0, -30.0, -60.0))
    z = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))[..., 2]
    d = np.stack([0.02 * z, -0.001 * z**2 / 9.0, -0.003 * (z - 60.0) ** 2 / 3.0], axis=-1)
    return Motion(
        grid=grid, nodes=np.stack([d, d]), middle_x_mm=0.0, masks_phase=0.2, amplitude=0.9,
        source="made", warning_only=False, figures={"left_95_mm": 12.0, "right_95_mm": 10.0},
    )  # fmt: skip


def plan(phases: Any = WINDOW) -> Any:
    frame = np.eye(4)
    frame[:3, 3] = TIP
    window = None if phases is None else SimpleNamespace(phases=np.asarray(phases))
    return SimpleNamespace(target_lps=TARGET, window=window, scope=SimpleNamespace(lps_from_scope_tip=frame))


def test_the_devices_see_the_target_where_the_check_sees_it() -> None:
    luck = np.array([0.1, 0.4, 0.8, 0.97])
    shifts = PatientMotion(plan(), motion()).shifts_mm(np.full(4, 12.0), luck, in_window=False)
    breath = Breath(motion(), TARGET, TIP)
    for at, shift in zip(phase(luck), shifts, strict=True):
        seen, true = breath.carried((TARGET + shift)[None], float(at)), breath.moved(TARGET[None], float(at))
        assert np.allclose(seen, true, atol=1e-9)
    assert np.linalg.norm(shifts, axis=1).max() > 1.0


def test_half_the_motion_of_the_breath_is_half_the_amplitude() -> None:
    one, half = (PatientMotion(plan(), replace(motion(), amplitude=a)) for a in (0.9, 0.45))
    luck = np.linspace(0.0, 1.0, 7)
    assert np.allclose(
        one.shifts_mm(np.full(7, 6.0), luck, in_window=False),
        half.shifts_mm(np.full(7, 12.0), luck, in_window=False),
    )


def test_the_phases_of_a_window_are_drawn_uniformly() -> None:
    of_plan = PatientMotion(plan(), motion())
    luck = np.array([0.0, 0.4, 0.796, 0.9, 1.0])
    in_window = of_plan.shifts_mm(np.full(5, 12.0), luck, in_window=True)
    breath = Breath(motion(), TARGET, TIP)
    for at, shift in zip((0.1, 0.2, 0.299, 0.625, 0.65), in_window, strict=True):
        seen, true = breath.carried((TARGET + shift)[None], at), breath.moved(TARGET[None], at)
        assert np.allclose(seen, true, atol=1e-9)


def test_the_motion_of_the_patient_takes_the_place_of_the_populations() -> None:
    free, held = load_errors("expiratory-free"), load_errors("breath-hold")
    lung: Any = SimpleNamespace(motion=motion(), vessel_border_mm=())
    known = model_for(free, plan(), lung).breathing
    assert (known.median_mm, known.patient_ln, known.distribution) == (12.0, BREATHS_LN, "lognormal")
    assert "made" in known.source
    gated = model_for(held, plan(), lung)
    assert gated.breathing.distribution == IN_WINDOW
    assert model_for(held, plan(phases=None), lung) is held
    assert model_for(held, plan(phases=np.zeros((0, 2))), lung) is held
    for still in (None, replace(motion(), warning_only=True)):
        unknown: Any = SimpleNamespace(motion=still, vessel_border_mm=())
        assert model_for(free, plan(), unknown) is free
    assert replace(gated, breathing=held.breathing) == held


def test_draws_of_a_patient_replace_those_of_the_population() -> None:
    lung: Any = SimpleNamespace(motion=motion(), vessel_border_mm=())
    model = ErrorModel(breathing=model_for(load_errors("expiratory-free"), plan(), lung).breathing)
    of_plan = PatientMotion(plan(), motion())
    drawn = Draws(500, 1, 3, stretch=0.4, motion=of_plan).deviations(model).target_mm
    assert np.array_equal(drawn, Draws(500, 1, 3, motion=of_plan).deviations(model).target_mm)
    still = np.linalg.norm(drawn, axis=1)
    assert np.median(still) < np.percentile(still, 95) < 40.0
    other = Draws(500, 1, 3, stretch=0.4).deviations(model).target_mm
    assert (other[:, :2] == 0.0).all() and not (drawn[:, :2] == 0.0).all()


def test_a_window_that_is_not_known_is_refused() -> None:
    model = ErrorModel(breathing=replace(load_errors("expiratory-free").breathing, distribution=IN_WINDOW))
    for known in (None, PatientMotion(plan(phases=None), motion())):
        with pytest.raises(SettingsError, match="no window is known"):
            Draws(10, 1, 0, stretch=0.4, motion=known).deviations(model)
