"""Fixtures of the tests of studies: one cache, and the runs of one small study."""

from __future__ import annotations

from pathlib import Path

import pytest

from lungaccess.running.study.runs import Run, runs_of
from lungaccess.running.study.settings import Study, study_of
from tests.lungaccess.running.study.toys import content


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One cache of anatomies for all tests of studies."""
    return tmp_path_factory.mktemp("study-cache")


@pytest.fixture
def study() -> Study:
    return study_of(content())


@pytest.fixture(scope="session")
def runs(cache: Path) -> list[Run]:
    """The four runs of the study: two targets, two seeds."""
    return list(runs_of(study_of(content()), cache=cache))
