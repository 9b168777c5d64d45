"""The commands `lungaccess cache ...`."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from anatomy.store import META, open_lung
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from tests.anatomy.toys import toy


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Return a cache with two toys, the first of which was last used 40 days ago."""
    first = open_lung({"lung.nii.gz": "a" * 64}, toy, cache=tmp_path).folder
    open_lung({"lung.nii.gz": "b" * 64}, toy, cache=tmp_path)
    then = time.time() - 40 * 86400.0
    os.utime(Path(str(first)) / META, (then, then))
    return tmp_path


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    assert cli.main(["cache", *words, "--json"]) == ExitCode.OK
    return json.loads(capsys.readouterr().out)


def test_it_lists_prunes_and_clears(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = ("--cache", str(cache))
    listed = answer(capsys, *where)
    assert [each["kind"] for each in listed["entries"]] == ["anatomy", "anatomy"]
    assert [round(each["last_used_days_ago"]) for each in listed["entries"]] == [40, 0]
    assert listed["size_bytes"] == sum(each["size_bytes"] for each in listed["entries"])
    assert answer(capsys, "prune", *where)["removed"] == []
    pruned = answer(capsys, "prune", "--older-than", "30", *where)
    assert [each["path"] for each in pruned["removed"]] == [listed["entries"][0]["path"]]
    cleared = answer(capsys, "clear", *where)
    assert [each["path"] for each in cleared["removed"]] == [listed["entries"][1]["path"]]
    assert list(cache.iterdir()) == []


def test_it_says_so(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["cache", "--cache", str(cache)]) == ExitCode.OK
    said = " ".join(capsys.readouterr().out.split())
    assert "40 days ago" in said and "of at most 10.0 GB (LUNGACCESS_CACHE_LIMIT)" in said
    assert cli.main(["cache", "prune", "--max-size", "0", "--cache", str(cache)]) == ExitCode.OK
    assert "Removed 2 of what was kept" in capsys.readouterr().out


@pytest.mark.parametrize("words", [("--max-size", "big"), ("--older-than", "-1")])
def test_bad_sizes_and_times_are_refused(words: tuple[str, ...], cache: Path) -> None:
    assert cli.main(["cache", "prune", *words, "--cache", str(cache)]) == ExitCode.BAD_INPUT
    assert len(list(cache.iterdir())) == 2
