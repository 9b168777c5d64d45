"""Which tests are run: those of one room, or the quick ones of `make test`.

The name of a room's folder is a mark of all tests in it: `pytest -m scope`.  What is not asked for is not
collected either, because to import a test takes longer than most tests run.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
ROOMS = {
    folder.name: folder
    for parent in (TESTS, TESTS / "stages", TESTS / "lungaccess", *(TESTS / "lungaccess").iterdir())
    if parent.is_dir()
    for folder in parent.iterdir()
    if folder.is_dir() and not folder.name.startswith("_")
}
"""The folder of each room."""
ONE_ROOM = re.compile(r"(\w+)( and (not )?slow)?")
TIERS = tomllib.loads((TESTS / "tiers.toml").read_text(encoding="utf-8"))
SLOWER = [TESTS.parent / place for place in TIERS["slower"]]
CASES = set(TIERS["cases"].values())
FILES_OF_CASES = {TESTS.parent / case.partition("::")[0] for case in CASES}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option of `make test`."""
    parser.addoption("--quick", action="store_true", help="leave out what tests/tiers.toml calls slower")


def pytest_configure(config: pytest.Config) -> None:
    """Register the rooms as marks; a room alone stands for its default tests."""
    for room in ROOMS:
        config.addinivalue_line("markers", f"{room}: tests in the folder of this room, marked by their path")
    if config.option.markexpr in ROOMS:
        config.option.markexpr += " and not slow"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out other rooms, where one is asked for, and slower files, where quick ones are."""
    asked = ONE_ROOM.fullmatch(config.option.markexpr)
    room = ROOMS.get(asked[1]) if asked else None
    if room and not (collection_path.is_relative_to(room) or room.is_relative_to(collection_path)):
        return True
    has_case = any(file.is_relative_to(collection_path) for file in FILES_OF_CASES)
    return (config.option.quick and is_slower(collection_path) and not has_case) or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests by their rooms; of slower files keep the cases alone, where quick ones are asked for."""
    for item in items:
        for room in ROOMS.keys() & item.path.parts[len(TESTS.parts) :][:3]:
            item.add_marker(room)
    if config.option.quick:
        left_out = {item for item in items if is_slower(item.path) and item.nodeid not in CASES}
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]


def is_slower(path: Path) -> bool:
    """Say whether a file or folder is one of those that compile many kernels, or run for long."""
    return any(path.is_relative_to(place) for place in SLOWER)
