"""The cache: what it lists, what goes first, and that killed or concurrent processes do no harm."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from anatomy.base.cache import BUILDING, LUNG_FILE, REMOVED, cache_limit_bytes, parse_size
from anatomy.base.cache_entries import cache_entries, make_room, overdue, remove_entry
from anatomy.base.errors import FileError, SettingsError
from anatomy.kept_records import kept
from anatomy.patient import PatientImages
from anatomy.store import open_lung, stored_format
from tests.anatomy.toys import toy

FORMATS = {"anatomy": stored_format()}
DAY_S = 24 * 3600.0


def sources(letter: str) -> dict[str, str]:
    return {"lung.nii.gz": letter * 64}


def never() -> PatientImages:
    raise AssertionError("the images were read although the lung was stored")


def used(path: Path, days_ago: float) -> None:
    then = time.time() - days_ago * DAY_S
    os.utime(path / LUNG_FILE if path.is_dir() else path, (then, then))


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    """Return a cache with three toys, used 30, 20 and 10 days ago, and a file that is none of ours."""
    for letter, days in (("a", 30), ("b", 20), ("c", 10)):
        folder = open_lung(sources(letter), toy, cache=tmp_path).folder
        assert folder is not None
        used(folder, days)
    (tmp_path / "notes.txt").write_text("of the user")
    return tmp_path


def test_what_is_used_is_the_newest(cache: Path) -> None:
    before = cache_entries(cache, FORMATS)
    assert [entry.kind for entry in before] == ["anatomy"] * 3 and all(entry.current for entry in before)
    lung = open_lung(sources("a"), never, cache=cache)
    kept(lung, "projections", 1, lambda: ["x" * 1000])
    after = cache_entries(cache, FORMATS)
    assert after[-1].path == before[0].path == lung.folder
    assert after[-1].pictures_bytes > 1000 and after[0].pictures_bytes == 0
    assert after[-1].patient == lung.name
    files = [file.stat().st_size for file in after[-1].path.iterdir()]
    assert after[-1].size_bytes == sum(files)


def test_the_least_recently_used_goes_first_and_what_is_in_use_stays(cache: Path) -> None:
    oldest, middle, newest = cache_entries(cache, FORMATS)
    make_room(cache, oldest.size_bytes + middle.size_bytes + newest.size_bytes, FORMATS, keep=())
    assert len(cache_entries(cache, FORMATS)) == 3, "it is no larger than it may be"
    make_room(cache, middle.size_bytes + newest.size_bytes, FORMATS, keep=())
    assert [entry.path for entry in cache_entries(cache, FORMATS)] == [middle.path, newest.path]
    make_room(cache, 1, FORMATS, keep=(middle.path,))
    assert [entry.path for entry in cache_entries(cache, FORMATS)] == [middle.path]
    assert (cache / "notes.txt").read_text() == "of the user"


def test_storing_keeps_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cache_entries(tmp_path / "not there", FORMATS) == ()
    open_lung(sources("a"), toy, cache=tmp_path)
    monkeypatch.setenv("LUNGACCESS_CACHE_LIMIT", "1KB")
    lung = open_lung(sources("b"), toy, cache=tmp_path)
    assert [entry.path for entry in cache_entries(tmp_path, FORMATS)] == [lung.folder]
    monkeypatch.setenv("LUNGACCESS_CACHE_LIMIT", "a lot")
    with pytest.raises(SettingsError, match="a lot"):
        open_lung(sources("c"), toy, cache=tmp_path)


def test_old_formats_and_what_is_too_old_go(cache: Path) -> None:
    found = cache_entries(cache, FORMATS)
    assert [entry.path for entry in overdue(found, most_bytes=10**12, older_than_days=15)] == [
        entry.path for entry in found[:2]
    ]
    outdated = cache_entries(cache, {"anatomy": "another"})
    assert not any(entry.current for entry in outdated)
    assert list(overdue(outdated, most_bytes=10**12)) == list(outdated)


def test_what_is_being_written_stays_and_what_was_left_behind_goes(cache: Path) -> None:
    names = (f"{BUILDING}{'0' * 32}", f"{REMOVED}{'1' * 32}", f".{'a' * 12}.npz")
    for name in names:
        (cache / name).write_bytes(b"half")
    listed = [entry for entry in cache_entries(cache, FORMATS) if entry.kind == "unfinished"]
    assert {entry.path.name for entry in listed} == set(names)
    assert not any(entry.kind == "unfinished" for entry in overdue(tuple(listed), most_bytes=0))
    for name in names:
        used(cache / name, 2)
    gone = list(overdue(cache_entries(cache, FORMATS), most_bytes=10**12))
    assert {entry.path.name for entry in gone} == set(names)


def test_an_entry_that_another_process_removed_is_no_error(cache: Path) -> None:
    entry = cache_entries(cache, FORMATS)[0]
    remove_entry(entry)
    remove_entry(entry)
    assert not entry.path.exists() and not list(cache.glob(f"{REMOVED}*"))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_what_may_not_be_removed_says_so(cache: Path) -> None:
    entry = cache_entries(cache, FORMATS)[0]
    cache.chmod(0o500)
    try:
        with pytest.raises(FileError, match="cannot be removed"):
            remove_entry(entry)
    finally:
        cache.chmod(0o700)


def test_readers_survive_one_who_removes_all_the_time(tmp_path: Path) -> None:
    """Whatever is removed under its feet, every opening returns the whole lung."""
    stop = threading.Event()

    def remove() -> None:
        while not stop.is_set():
            make_room(tmp_path, 0, FORMATS, keep=())

    remover = threading.Thread(target=remove)
    remover.start()
    try:
        for _ in range(8):
            lung = open_lung(sources("a"), toy, cache=tmp_path)
            assert lung.labels.any() and lung.lumen_depth.corners.any()
    finally:
        stop.set()
        remover.join()


def test_a_killed_removal_leaves_nothing_half(cache: Path) -> None:
    script = (
        "import shutil, sys, time; from pathlib import Path\n"
        "shutil.rmtree = lambda *_, **__: (print('removing', flush=True), time.sleep(60))\n"
        "from anatomy.base.cache_entries import make_room\n"
        "make_room(Path(sys.argv[1]), 0, {}, keep=())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(cache)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "removing\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    kinds = [entry.kind for entry in cache_entries(cache, FORMATS)]
    assert sorted(kinds) == ["anatomy", "anatomy", "unfinished"]
    assert open_lung(sources("a"), toy, cache=cache).labels.any(), "it is made anew"
    open_lung(sources("b"), never, cache=cache)


@pytest.mark.parametrize(
    ("text", "size"), [("0", 0), ("2GB", 2 * 10**9), (" 1.5 mb ", 1_500_000), ("7", 7), ("1TB", 10**12)]
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text, "x") == size


@pytest.mark.parametrize("text", ["", "GB", "-1GB", "2 GiB", "1e3", "nan", "99999999999GB"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(SettingsError):
        parse_size(text, "x")


def test_the_limit_has_a_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LUNGACCESS_CACHE_LIMIT", raising=False)
    assert cache_limit_bytes() == 10**10
