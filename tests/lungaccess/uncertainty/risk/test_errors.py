"""Error models: presets and their table, files of one's own, and random numbers shared by all models."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest, norm, uniform

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.settings import parse, to_mapping
from anatomy.lung import Lung
from anatomy.motion.source import share_of_motion
from docs.write_tables import error_presets
from lungaccess.problem.error_files import DEFAULT_ERRORS, error_preset_names, load_errors
from lungaccess.problem.errors import (
    BREATHING,
    UNITS,
    AngleError,
    BreathingError,
    CurvatureError,
    ErrorModel,
    PositionError,
)
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations, Draws
from lungaccess.uncertainty.risk.patient_errors import phase

PRESETS = [load_errors(name) for name in error_preset_names()]
MODELS = st.sampled_from([each for each in PRESETS if not each.rests])
"""Those that need no plan."""
COUNT = 4000


def equal(a: Deviations, b: Deviations) -> bool:
    return all(
        np.array_equal(getattr(a, field), getattr(b, field)) for field in (*FIELD_OF.values(), "factor")
    )


# Presets and files -------------------------------------------------------------------------------


def test_the_page_states_every_entry_of_every_preset() -> None:
    names = error_preset_names()
    stated: dict[str, list[tuple[str, ...]]] = {name: [] for name in names}
    for line in error_presets().splitlines():
        if line.startswith("| `"):
            error, presets, *entry = (cell.strip() for cell in line.strip("|").split("|"))
            listed = set(re.findall(r"`([^`]+)`", presets))
            assert listed <= set(names)
            for name in names:
                if presets == "all" or name in listed:
                    stated[name].append((error, *entry))
    for name in names:
        for error, distribution, patient, attempt, source in stated[name]:
            term = load_errors(name).term(error.strip("`"))
            assert (distribution, source) == (term.distribution, term.source)
            assert (patient, attempt) != ("0", "0") or not term.size
            if not isinstance(term, BreathingError):
                sizes = [float(size.split(" ")[0]) for size in (patient, attempt)]
                assert sizes == [term.patient, term.attempt]
        assert [error.strip("`") for error, *_entry in stated[name]] == list(UNITS)


def test_the_presets_have_the_published_sizes() -> None:
    """Means of published distances, divided by the mean length of a standard normal vector in space."""
    mean = 2.0 * math.sqrt(2.0 / math.pi)
    published = {
        "gated-ct": {"scope_position": 2.01, "target_position": 1.3},
        "breath-hold": {"scope_position": 2.01, "target_position": 2.4},
        "resting": {"scope_position": 2.01, "target_position": 2.4},
        "expiratory-free": {"scope_position": 3.36, "target_position": 4.5},
        "vision-only": {
            "scope_position": 2.65,
            "target_position": 4.5,
            "scope_direction": math.degrees(0.19),
        },
        "inspiratory-ct": {"scope_position": 3.36, "target_position": 14.8},
    }
    assert set(published) == set(error_preset_names())
    for name, means in published.items():
        for kind, value in means.items():
            assert load_errors(name).term(kind).size == pytest.approx(value / mean, abs=0.051)
    free = load_errors("expiratory-free").breathing
    assert math.log(free.median_mm) == pytest.approx(2.85, abs=0.01) and free.patient_ln == 0.36


@pytest.mark.parametrize("name", error_preset_names())
def test_every_entry_states_its_source(name: str) -> None:
    model = load_errors(name)
    for kind in UNITS:
        source = model.term(kind).source
        assert source.startswith(("assumption", "[", "doi", "abstract")), (kind, source)
    assert set(model.assumed) >= {"tube_rotation", "tube_insertion", "needle_roll", "needle_insertion"}
    assert "target_position" not in model.assumed


def test_a_file_states_what_differs_from_a_preset(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('like = "gated-ct"\n[scope_position]\nattempt_mm = 0.5\nsource = "ours"\n')
    stated = load_errors(file)
    assert stated.label == "mine.toml"
    assert stated.scope_position == PositionError(attempt_mm=0.5, source="ours")
    base = load_errors("gated-ct")
    assert replace(stated, name="", scope_position=base.scope_position) == replace(
        base, name="", description=""
    )
    file.write_text("")
    assert replace(load_errors(file), name=DEFAULT_ERRORS) == replace(load_errors(), description="")


@pytest.mark.parametrize(
    "written",
    [
        "scope_position_mm = 1.0", "[scope_position]\nattempt_mm = nan",
        "[scope_position]\nattempt_mm = -1.0",
        "[scope_position]\nattempt_mm = 500.0", "[scope_position]\nattempt_deg = 1.0",
        "[shaft]\nsize = 1.0",
        '[scope_direction]\ndistribution = "cauchy"', '[needle_curvature]\ndistribution = "normal"',
        "[needle_curvature]\nstraight_share = 1.5", '[target_position]\nsource = ""', "scope_position = 1.0",
        "[scope_direction]\nbias_deg = [6.0]", "[scope_direction]\nbias_deg = 6.0",
        "[tube_rotation]\nbias_deg = [inf]", "[breathing]\nbias_mm = [1.0]", "[[place]]\ngeneration_from = 4",
        '[[place]]\nlobe = "upper"\n[place.tube_rotation]\nattempt_deg = 1.0',
        "[[place]]\ngeneration_from = 4\ngeneration_to = 3\n[place.tube_rotation]\nattempt_deg = 1.0",
        "[[place]]\n[place.target_position]\nbias_mm = [1.0, 2.0]",
        "[breathing]\nattempt_mm = 1.0", 'like = "gated"', "like = 3", "scope_position = = 1",
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused(tmp_path: Path, written: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(written)
    with pytest.raises(SettingsError) as refused:
        load_errors(file)
    assert refused.value.expected and refused.value.remedy


def test_wrong_names_and_values_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        load_errors(tmp_path / "nowhere.toml")
    with pytest.raises(SettingsError, match="gated-tc") as refused:
        load_errors("gated-tc")
    assert "gated-ct" in refused.value.remedy
    wrong: list[dict[str, Any]] = [{"scope_position": 1.0}, {"needle": PositionError()}]
    for values in wrong:
        with pytest.raises(SettingsError):
            ErrorModel(**values)
    with pytest.raises(SettingsError):
        AngleError(attempt_deg=math.inf)
    with pytest.raises(SettingsError, match="samples"):
        Draws(0, 1, 0)


BIASED = """
[scope_direction]
attempt_deg = 2.0
bias_deg = [6.0, -1.0]
source = "ours"

[[place]]
generation_from = 4
[place.scope_direction]
attempt_deg = 4.0
source = "ours"

[[place]]
lobe = "RUL"
generation_from = 4
generation_to = 5
[place.scope_position]
attempt_mm = 3.0
[place.scope_direction]
bias_deg = [10.0, 0.0]
"""


def test_the_last_place_that_holds_counts(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(BIASED)
    model = load_errors(file)
    assert model.at("right upper lobe", 3) == replace(model, place=())
    lower = model.at("right lower lobe", 4)
    assert lower.scope_direction == AngleError(attempt_deg=4.0, source="ours")
    assert lower.scope_position == model.scope_position
    upper = model.at("right upper lobe", 5)
    assert upper.scope_direction.bias == (10.0, 0.0) and upper.scope_position.size == 3.0
    assert model.at("right upper lobe", 6) == model.at("", 6) == lower
    assert "bias of scope direction 6 / -1°, others in some places" in model.words(with_needle=False)
    assert "bias" not in load_errors().words(with_needle=True)


def test_biases_and_places_are_restored_without_loss(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(BIASED)
    model = load_errors(file)
    plain = to_mapping(model)
    assert parse(ErrorModel, json.loads(json.dumps(plain)), "again") == model
    assert "place" not in to_mapping(load_errors()) and "bias_mm" not in to_mapping(PositionError())
    doubled = model.scaled(2.0)
    assert doubled.scope_direction.bias == (12.0, -2.0)
    assert doubled.place[1].terms["scope_direction"].bias == (20.0, 0.0)
    assert model.scope_direction.rms == pytest.approx(math.hypot(2.0, math.hypot(6.0, 1.0) / math.sqrt(2.0)))


# Sizes -------------------------------------------------------------------------------------------


def test_an_error_of_a_known_size_has_no_bias() -> None:
    # A shaft at rest is off by 5 mm in nearly all draws alike: scaling the bias with the little spread would
    # ask for errors of several decimetres.
    biased = PositionError(patient_mm=0.05, bias_mm=(3.0, -4.6, 0.0))
    model = ErrorModel(scope_position=biased).only("scope_position", 10.0)
    assert model.scope_position.bias == () and model.scope_position.size == pytest.approx(10.0)


@given(model=MODELS, kind=st.sampled_from(list(UNITS)), size=st.floats(0.01, 1.0))
def test_one_kind_alone_has_the_size_that_was_asked_for(model: ErrorModel, kind: str, size: float) -> None:
    alone = model.only(kind, size)
    assert alone.term(kind).size == pytest.approx(size)
    assert all(alone.term(other).size == 0.0 for other in UNITS if other != kind)
    term = model.term(kind)
    if term.size and not isinstance(term, BreathingError):
        assert alone.term(kind).patient * term.attempt == pytest.approx(
            term.patient * alone.term(kind).attempt
        )


# Draws -------------------------------------------------------------------------------------------


def test_without_errors_nothing_deviates() -> None:
    found = Draws(5, 2, 0, stretch=0.5).deviations(ErrorModel())
    assert (found.factor == 1.0).all()
    assert all(not getattr(found, field).any() for field in FIELD_OF.values())


def test_each_distribution_is_the_stated_one() -> None:
    model = ErrorModel(
        scope_position=PositionError(attempt_mm=2.0),
        target_position=PositionError(patient_mm=3.0, attempt_mm=4.0),
        tube_insertion=PositionError(distribution="bounded", attempt_mm=0.5),
        needle_curvature=CurvatureError(median=0.8, patient_ln=0.3, attempt_ln=0.4),
    )
    found = Draws(COUNT, 1, 1).deviations(model)
    for values, scale in ((found.scope_mm, 2.0), (found.target_mm, 5.0)):
        assert kstest(values.ravel(), norm(scale=scale).cdf).pvalue > 1e-3
    assert kstest(found.insertion_mm.ravel(), uniform(-0.5, 1.0).cdf).pvalue > 1e-3
    assert kstest(np.log(found.factor / 0.8), norm(scale=0.5).cdf).pvalue > 1e-3


def test_a_bias_is_added_to_the_same_luck() -> None:
    turned = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    frame = np.eye(4)
    frame[:3, :3] = turned
    biased = {
        "scope_position": PositionError(attempt_mm=1.0, bias_mm=(1.0, 2.0, 3.0)),
        "scope_direction": AngleError(attempt_deg=1.0, bias_deg=(6.0, 0.0)),
        "tube_rotation": AngleError(bias_deg=(5.0,)),
        "tube_insertion": PositionError(bias_mm=(0.5,)),
        "needle_roll": AngleError(attempt_deg=1.0, bias_deg=(-3.0,)),
        "needle_insertion": PositionError(bias_mm=(2.0,)),
        "target_position": PositionError(patient_mm=1.0, bias_mm=(0.0, 0.0, -4.0)),
    }
    means = {
        "scope_mm": turned @ [1.0, 2.0, 3.0],
        "tilt_rad": np.radians([6.0, 0.0]),
        "rotation_rad": np.radians(5.0),
        "insertion_mm": 0.5,
        "roll_rad": np.radians(-3.0),
        "stop_mm": 2.0,
        "target_mm": [0.0, 0.0, -4.0],
    }
    bias = {"bias_mm": (), "bias_deg": ()}
    plain = {
        kind: replace(term, **{name: none for name, none in bias.items() if hasattr(term, name)})
        for kind, term in biased.items()
    }
    one, other = (
        Draws(9, 2, 3, lps_from_scope_tip=frame).deviations(ErrorModel(**each)) for each in (biased, plain)
    )
    for field, mean in means.items():
        assert np.allclose(getattr(one, field), getattr(other, field) + mean, atol=1e-12), field
    twisted = Draws(9, 2, 3, 3).deviations(ErrorModel(**biased))
    assert np.allclose(twisted.relative_rad, np.radians(5.0)) and not twisted.rotation_rad.any()


def test_some_needles_go_straight() -> None:
    model = ErrorModel(needle_curvature=CurvatureError(attempt_ln=0.2, straight_share=0.15))
    factor = Draws(COUNT, 1, 1).deviations(model).factor
    assert np.mean(factor == 0.0) == pytest.approx(0.15, abs=4.0 * math.sqrt(0.15 * 0.85 / COUNT))
    bent = Draws(COUNT, 1, 1).deviations(ErrorModel(needle_curvature=CurvatureError(attempt_ln=0.2))).factor
    assert np.array_equal(factor[factor > 0.0], bent[factor > 0.0])


def test_attempts_on_one_patient_share_the_patients_part() -> None:
    model = ErrorModel(target_position=PositionError(patient_mm=3.0, attempt_mm=4.0))
    first, second = (Draws(COUNT, 1, 2, attempt=n).deviations(model).target_mm for n in (0, 1))
    assert np.mean(first * second) == pytest.approx(9.0, rel=0.15)
    assert np.mean(first[1:] * second[:-1]) == pytest.approx(0.0, abs=1.0)
    patients = ErrorModel(target_position=PositionError(patient_mm=3.0))
    alike = [Draws(COUNT, 1, 2, attempt=n).deviations(patients).target_mm for n in (0, 1)]
    assert np.array_equal(*alike)


def test_what_a_needle_has_of_its_patient_is_the_same_in_all_arcs() -> None:
    model = ErrorModel(needle_roll=AngleError(patient_deg=5.0, attempt_deg=0.0))
    roll = Draws(50, 3, 2).deviations(model).roll_rad
    assert (np.ptp(roll, axis=1) == 0.0).all() and roll[:, 0].std() > math.radians(3.0)


@given(model=MODELS, other=MODELS, seed=st.integers(0, 99))
def test_all_models_share_their_luck(model: ErrorModel, other: ErrorModel, seed: int) -> None:
    """What was drawn before changes nothing, and one kind deviates the same way, larger or smaller."""
    fresh, used = Draws(7, 2, seed, stretch=0.3), Draws(7, 2, seed, stretch=0.3)
    used.deviations(other)
    assert equal(fresh.deviations(model), used.deviations(model))
    first, second = (used.deviations(each).scope_mm for each in (model, other))
    ratio = model.scope_position.size / other.scope_position.size
    assert np.allclose(first, ratio * second)


@given(model=MODELS, seed=st.integers(0, 99))
def test_plans_with_more_arcs_share_their_luck(model: ErrorModel, seed: int) -> None:
    one, three = (Draws(9, arcs, seed).deviations(model) for arcs in (1, 3))
    assert np.array_equal(one.roll_rad, three.roll_rad[:, :1])
    assert np.array_equal(one.stop_mm, three.stop_mm[:, :1])
    assert np.array_equal(one.target_mm, three.target_mm)


def test_tubes_that_are_not_planar_turn_each_by_itself() -> None:
    found = Draws(COUNT, 1, 0, 3).deviations(ErrorModel(tube_rotation=AngleError(attempt_deg=2.0)))
    assert not found.rotation_rad.any()
    correlation = np.corrcoef(found.relative_rad.T)
    assert np.abs(correlation - np.eye(3)).max() < 0.1
    assert np.degrees(found.relative_rad.std()) == pytest.approx(2.0, rel=0.05)


# Breathing ---------------------------------------------------------------------------------------


def test_breathing_moves_the_target_against_the_scope() -> None:
    model = load_errors("expiratory-free").only(BREATHING)
    draws = Draws(COUNT, 1, 4, stretch=0.4)
    away = draws.deviations(model).target_mm
    assert not away[:, :2].any() and (away[:, 2] <= 0.0).all()
    assert not draws.deviations(model).scope_mm.any()
    # The mean of cos^6 over a cycle is 5/16, the mean of the lognormal motion exp(m + s^2 / 2).
    mean = 0.4 * 17.3 * math.exp(0.5 * 0.36**2) * 5.0 / 16.0
    assert -away[:, 2].mean() == pytest.approx(mean, rel=0.1)
    assert np.array_equal(Draws(COUNT, 1, 4, stretch=-0.4).deviations(model).target_mm, -away)
    assert not Draws(COUNT, 1, 4).deviations(model).target_mm.any()


def test_the_base_moves_most_and_exhalation_lasts_longest() -> None:
    assert share_of_motion(0.0) == 0.04 < share_of_motion(0.5) < share_of_motion(0.85)
    assert phase(np.array([0.0, 1.0])).tolist() == [1.0, 1.0] and phase(np.array([0.5]))[0] < 1e-9
    assert np.mean(phase(np.linspace(0.0, 1.0, 1001)) < 0.1) > 0.4


@pytest.mark.slow
def test_heights_in_the_lung(small_lung: Lung) -> None:
    inside = small_lung.grid.lps(np.argwhere(small_lung.mask("lung").array))
    top, bottom = inside[np.argmax(inside[:, 2])], inside[np.argmin(inside[:, 2])]
    heights = [small_lung.height_share(point) for point in (top, 0.5 * (top + bottom), bottom)]
    assert heights == sorted(heights) and heights[0] < 0.15 and heights[2] > 0.85
    assert 0.0 <= small_lung.height_share(top + [0.0, 0.0, 999.0]) == 0.0
