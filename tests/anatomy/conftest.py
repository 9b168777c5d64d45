"""Caches that hold the toy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from anatomy.store import open_lung
from tests.anatomy.stored_toy import SOURCES
from tests.anatomy.toys import toy


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache that holds the toy; not to be changed."""
    cache = tmp_path_factory.mktemp("cache")
    open_lung(SOURCES, toy, cache=cache)
    return cache


@pytest.fixture
def cache(stored: Path, tmp_path: Path) -> Path:
    """Return a copy of the cache, to be changed at will."""
    shutil.copytree(stored, tmp_path / "cache")
    return tmp_path / "cache"
