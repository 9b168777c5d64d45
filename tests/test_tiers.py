"""Rooms and quick tests are chosen as stated, and what is stated exists."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.tiers import CASES, FILES_OF_CASES, ROOMS, SLOWER, TESTS, TIERS, is_slower, pytest_ignore_collect


def collected(folder: Path, markexpr: str = "not slow", *, quick: bool = False) -> set[Path]:
    """Return the files of tests that are imported where so much is asked for."""
    config: Any = SimpleNamespace(option=SimpleNamespace(markexpr=markexpr, quick=quick))
    found: set[Path] = set()
    for path in folder.iterdir():
        if not pytest_ignore_collect(path, config):
            found |= collected(path, markexpr, quick=quick) if path.is_dir() else {path}
    return {path for path in found if path.match("test_*.py")}


def test_what_is_slower_exists() -> None:
    assert [place for place in SLOWER if not place.exists()] == []


def test_nothing_is_stated_twice() -> None:
    assert TIERS["slower"] == sorted(set(TIERS["slower"]))
    assert [place for place in SLOWER if any(is_slower(parent) for parent in place.parents)] == []


def test_there_is_one_case_a_stage_in_the_folder_of_its_room() -> None:
    assert TIERS["cases"].keys() == {"anatomy", "scope", "tube", "needle", "coupled"}
    for room, case in TIERS["cases"].items():
        path, name = TESTS.parent / case.partition("::")[0], case.rpartition("::")[2]
        assert path.is_relative_to(ROOMS[room])
        assert f"def {name.partition('[')[0]}(" in path.read_text()


def test_quick_tests_are_all_but_the_slower_ones_and_the_cases() -> None:
    quick = {path for path in collected(TESTS) if not is_slower(path)}
    assert collected(TESTS, quick=True) == quick | FILES_OF_CASES
    assert len(FILES_OF_CASES) <= len(CASES)


@pytest.mark.parametrize("markexpr", ["scope", "scope and not slow", "scope and slow"])
def test_one_room_is_collected_alone(markexpr: str) -> None:
    assert collected(TESTS, markexpr) == collected(ROOMS["scope"]) != set()


@pytest.mark.parametrize("markexpr", ["scope or tube", "not scope", "slow"])
def test_else_all_rooms_are_collected(markexpr: str) -> None:
    assert collected(TESTS, markexpr) == collected(TESTS)


def test_every_test_is_marked_by_the_rooms_in_whose_folders_it_lies(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        rooms = {room for room, folder in ROOMS.items() if item.path.is_relative_to(folder)}
        assert {mark.name for mark in item.iter_markers()} & ROOMS.keys() == rooms
