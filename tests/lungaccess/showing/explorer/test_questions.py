"""Messages of the page: what is read, and what is refused in words."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.settings import parse, settings_toml
from lungaccess.problem.system import System, shipped_names
from lungaccess.showing.explorer.changed_system import ChosenPlace, plan_command, system_of
from lungaccess.showing.explorer.messages import frame, read_frame
from lungaccess.showing.explorer.questions import (
    CANCEL,
    QUESTIONS,
    PlanQuestion,
    WhatIf,
    number_of,
    read_message,
)

PLAN = {"ask": "plan", "id": 3, "target": "nodule 1"}


def test_a_question_is_read() -> None:
    name, question = read_message(json.dumps(PLAN | {"what_if": {"system": "ultrathin", "margin_mm": 1.0}}))
    assert (name, question.id, question.what_if.margin_mm, question.iterations) == ("plan", 3, 1.0, 20)
    assert read_message('{"ask": "cancel", "id": 7}') == (CANCEL, 7)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{",
        '{"ask": "plan"}',
        '{"ask": "everything", "id": 1}',
        '{"ask": ["plan"], "id": 1}',
        '{"ask": "__init__", "id": 1}',
        *(
            json.dumps(PLAN | wrong)
            for wrong in (
                {"id": -1},
                {"id": True},
                {"id": "1"},
                {"target": ""},
                {"target": "x" * 201},
                {"iterations": 10**9},
                {"iterations": 1.5},
                {"what_if": {"needle_radius_mm": 1.0}},
                {"what_if": {"scope": 1.0}},
                {"worker": "answers"},
                {"entry": -1},
                {"slot": "x" * 99},
            )
        ),
        '{"ask": "place", "id": 1, "point": [NaN, 0, 0]}',
        '{"ask": "place", "id": 1, "point": [1e999, 0, 0]}',
        '{"ask": "place", "id": 1, "point": [1, 2]}',
        '{"ask": "export", "id": 1, "plan": "a", "what": "/etc/passwd"}',
        "[" * 50_000,
        '{"ask": "plan", "id": 1, "target": "' + "x" * 30_000 + '"}',
    ],
)
def test_anything_else_is_refused_in_words(text: str) -> None:
    with pytest.raises(SettingsError) as refused:
        read_message(text)
    assert refused.value.found


def test_an_error_goes_to_the_question_that_it_is_of() -> None:
    assert number_of(json.dumps(PLAN | {"iterations": -1})) == 3
    assert [number_of(text) for text in ("", "[]", "3", '{"id": true}', '{"id": "3"}', "[" * 50_000)] == [
        None
    ] * 6


def test_frames_carry_messages_and_arrays_without_loss() -> None:
    arrays = {
        "points": np.arange(6, dtype=np.float32).reshape(2, 3), "kinds": np.array([1, 2, 3], dtype=np.uint8),
        "numbers": np.array([-1, 2**31 - 1], dtype=np.int32), "none": np.zeros((0, 3), dtype=np.float32),
    }  # fmt: skip
    sent = frame({"id": 1, "answer": "exits", "words": "µm <b>"}, arrays)
    assert isinstance(sent, bytes)
    message, got = read_frame(sent)
    assert message == {"id": 1, "answer": "exits", "words": "µm <b>"}
    for name, array in arrays.items():
        assert got[name].dtype == array.dtype
        np.testing.assert_array_equal(got[name], array)
    assert read_frame(frame({"id": 2, "answer": "end"})) == ({"id": 2, "answer": "end"}, {})
    with pytest.raises(ValueError, match="JSON"):
        frame({"id": 1, "cost": float("nan")})


@pytest.mark.parametrize("name", shipped_names())
def test_a_system_survives_as_toml(name: str) -> None:
    system = la.load_system(name)
    assert parse(System, tomllib.loads(settings_toml(system)), name) == system


def test_a_text_survives_as_toml() -> None:
    system = replace(la.load_system("ultrathin"), name='a "b" \\ \n \x7f é ]', sources=("x",))
    assert parse(System, tomllib.loads(settings_toml(system)), "text") == system


def test_what_is_changed_is_changed_alone() -> None:
    preset = la.load_system("lung-default")
    assert system_of(WhatIf(), {}) == preset
    assert system_of(WhatIf(needle_radius_mm=preset.needle.min_radius_of_curvature_mm), {}) == preset
    changed = system_of(
        WhatIf(scope_diameter_mm=3.5, needle_radius_mm=50.0, needle_length_mm=80.0, margin_mm=1.0), {}
    )
    assert changed.name == (
        "lung-default with scope 3.5 mm, needle radius 50 mm, needle length 80 mm, margin 1 mm"
    )
    assert changed == replace(
        preset,
        name=changed.name,
        scope=replace(preset.scope, outer_diameter_mm=3.5),
        needle=replace(preset.needle, max_curvature_per_mm=1 / 50.0, max_length_mm=80.0),
        margins=replace(preset.margins, segmentation_margin_mm=1.0),
    )


def test_an_impossible_change_is_refused() -> None:
    with pytest.raises(SettingsError):
        system_of(WhatIf(scope_diameter_mm=1.0), {})
    with pytest.raises(SettingsError, match="needle"):
        system_of(WhatIf(system="tubes-only", needle_radius_mm=50.0), {})
    with pytest.raises(SettingsError, match="There is no system"):
        system_of(WhatIf(system="/etc/passwd"), {})


@pytest.mark.parametrize(
    ("what_if", "device"),
    [
        (WhatIf(system="ultrathin"), "--system ultrathin"),
        (WhatIf(system="ultrathin", fissures_allowed=True), "--system ultrathin --allow-fissures"),
        (WhatIf(system="ultrathin", fissures_allowed=False), "--system ultrathin"),
        (WhatIf(system="ultrathin", needle_radius_mm=50.0), "--system system.toml"),
        (WhatIf(system="mine"), "--system '/a b/mine.toml'"),
    ],
)
def test_the_command_names_the_devices(what_if: WhatIf, device: str) -> None:
    mine = replace(la.load_system("ultrathin"), name="mine")
    question = PlanQuestion(id=1, target="lps:1.5,2,3", what_if=what_if, iterations=7, seed=5)
    system = system_of(what_if, {"mine": mine})
    line = plan_command(Path("/p/it's"), question, system, {"mine": Path("/a b/mine.toml")}, None)
    assert line == (
        f"""lungaccess plan '/p/it'"'"'s' --target lps:1.5,2,3 {device} --iterations 7 --seed 5 --out plan"""
    )
    place = ChosenPlace.of("scope tip", np.array([1.0, -2.34567, 25.0]))
    through = plan_command(Path("p"), question, system, {"mine": Path("mine.toml")}, None, place)
    assert " --target lps:1.5,2,3 --scope-tip lps:1.0,-2.346,25.0 --scope-tip-within 1.5 --system " in through


def test_every_question_has_an_answer() -> None:
    from lungaccess.showing.explorer.answers import Answers

    assert all(callable(getattr(Answers, f"_{name}")) for name in QUESTIONS)
