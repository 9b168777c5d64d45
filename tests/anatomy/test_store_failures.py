"""Lungs on disk: damage is repaired, nothing half-made is used."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from anatomy import store
from anatomy.base import unfinished
from anatomy.base.cache_entries import cache_entries, remove_abandoned
from anatomy.base.checksums import DamagedCacheWarning
from anatomy.base.errors import AnatomyError, FileError
from anatomy.base.unfinished import CONTENT, LOCK, filled_folder, is_abandoned, locked
from anatomy.build import build_lung, lung_key
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from anatomy.store import META, folder_name, open_lung
from tests.anatomy import toys
from tests.anatomy.stored_toy import FOLDER, KEY, SOURCES, no_reading, require_same
from tests.anatomy.toys import toy


def _truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _other_shape(file: Path) -> None:
    np.save(file, np.zeros((3, 4, 5), dtype=np.load(file).dtype, order="F"))


def _set_meta(**values: Any) -> Callable[[Path], None]:
    def change(file: Path) -> None:
        file.write_text(json.dumps({**json.loads(file.read_text()), **values}))

    return change


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        (META, Path.unlink),
        (META, _truncate),
        (META, lambda file: file.write_text("")),
        (META, lambda file: file.write_text("[1, 2]")),
        (META, lambda file: file.write_text('{"format": 0}')),
        (META, lambda file: file.write_bytes(b"\xff\xfe\x00")),
        (META, _set_meta(format=-1)),
        (META, _set_meta(lung=3)),
        (META, _set_meta(lung=None)),
        (META, _set_meta(lung={"name": "Toy", "fields": 3})),
        (META, _set_meta(lung={"tree": {"report": {"gaps_bridged": [1]}}})),
        ("labels.npy", Path.unlink),
        ("labels.npy", _truncate),
        ("labels.npy", lambda file: file.write_bytes(b"")),
        ("labels.npy", _other_shape),
        ("fields.obstacle.corners.npy", Path.unlink),
        ("fields.obstacle.corners.npy", _truncate),
        ("fields.obstacle.corners.npy", _other_shape),
        ("nodules.array.npy", _other_shape),
        ("lumen_depth.corners.npy", Path.unlink),
        ("arrays.npz", Path.unlink),
        ("arrays.npz", _truncate),
        ("arrays.npz", lambda file: file.write_bytes(b"")),
        ("arrays.npz", lambda file: np.savez(file, points_lps=np.zeros((2, 3)))),
    ],
)
def test_damage_is_repaired(
    cache: Path, name: str, damage: Callable[[Path], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    damage(cache / FOLDER / name)
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy()

    lung = open_lung(SOURCES, read, cache=cache)
    assert calls == [1]
    require_same(lung, open_lung(SOURCES, no_reading, cache=cache))
    assert [path.name for path in cache.iterdir()] == [FOLDER]


def _shift_starts(folder: Path) -> None:
    _shift(folder, "starts.0")


def _open_way(folder: Path) -> None:
    """Take an obstacle away without another size or type."""
    distances = np.load(folder / "fields.obstacle.corners.npy", mmap_mode="r+")
    distances[...] = distances.max()
    distances.flush()


def _shift_tree(folder: Path) -> None:
    _shift(folder, "tree.points_lps")


def _shift(folder: Path, name: str) -> None:
    with np.load(folder / "arrays.npz") as stored:
        arrays = dict(stored)
    np.savez(folder / "arrays.npz", **(arrays | {name: arrays[name] + 1.0}))


def _become_another(folder: Path) -> None:
    """Put the lung of another patient in its place."""
    other = {"lung.nii.gz": "f" * 64}
    open_lung(other, lambda: toy(nodules=None), cache=folder.parent)
    shutil.rmtree(folder)
    (folder.parent / folder_name(lung_key(other))).rename(folder)


@pytest.mark.parametrize("change", [_shift_starts, _open_way, _shift_tree, _become_another])
def test_what_was_changed_is_made_again_with_a_warning(cache: Path, change: Callable[[Path], None]) -> None:
    change(cache / FOLDER)
    with pytest.warns(DamagedCacheWarning, match="made again"):
        lung = open_lung(SOURCES, toy, cache=cache)
    require_same(lung, build_lung(toy(), key=KEY))
    require_same(lung, open_lung(SOURCES, no_reading, cache=cache))


def test_a_copy_of_the_cache_is_as_good(cache: Path, tmp_path: Path) -> None:
    """Files that differ in their time of change alone are read once and found to be the same."""
    shutil.copytree(cache, tmp_path / "copy", copy_function=shutil.copyfile)
    require_same(open_lung(SOURCES, no_reading, cache=tmp_path / "copy"), build_lung(toy(), key=KEY))


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (KeyboardInterrupt(), KeyboardInterrupt),
        (MemoryError(), MemoryError),
        (OSError(errno.ENOSPC, "No space left on device"), FileError),
    ],
)
@pytest.mark.parametrize("after", [0, 2, 6])
def test_a_build_that_fails_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    after: int,
    raised: BaseException,
    expected: type[BaseException],
) -> None:
    save, calls = np.save, []

    def failing(*args: Any, **kwargs: Any) -> None:
        calls.append(1)
        if len(calls) > after:
            raise raised
        save(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(store.np, "save", failing)
        with pytest.raises(expected):
            open_lung(SOURCES, toy, cache=tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert open_lung(SOURCES, toy, cache=tmp_path).name == "Toy"


def test_what_a_patient_may_not_be_is_not_stored(tmp_path: Path) -> None:
    with pytest.raises(AnatomyError):
        open_lung(SOURCES, lambda: toy(lung=np.zeros(toys.grid().shape, dtype=bool)), cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, sys
from pathlib import Path
from anatomy import store
from anatomy.base import unfinished
from tests.anatomy.toys import toy

def die(*_args):
    os.kill(os.getpid(), 9)

store._save_rest = die
store.open_lung({sources!r}, toy, cache=Path(sys.argv[1]))
"""


def test_a_killed_build_is_not_taken_for_a_lung(tmp_path: Path) -> None:
    """Nobody can tidy up after SIGKILL; what remains must have another name."""
    code = KILLED.format(sources=SOURCES)
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=root, env={**os.environ, "PYTHONPATH": str(root)}
    )
    assert done.returncode == -9
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".building-")
    assert (left / CONTENT / "labels.npy").is_file()
    assert open_lung(SOURCES, toy, cache=tmp_path).labels.any()
    assert [path.name for path in tmp_path.iterdir()] == [FOLDER], "what was left is gone"


def test_two_builds_at_once_end_with_one_lung(tmp_path: Path) -> None:
    """While one process builds, another finishes the same lung."""
    inner: list[Lung] = []

    def read() -> PatientImages:
        inner.append(open_lung(SOURCES, toy, cache=tmp_path))
        return toy()

    outer = open_lung(SOURCES, read, cache=tmp_path)
    require_same(outer, inner[0])
    assert [path.name for path in tmp_path.iterdir()] == [FOLDER]


def test_the_other_process_may_win_at_the_last_moment(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between looking and renaming, the folder appears: rename fails, and the other lung is as good."""
    late = tmp_path / "late"
    rename = os.replace

    def slow(source: Path, target: Path) -> None:
        shutil.copytree(cache / FOLDER, late / FOLDER)
        rename(source, target)

    monkeypatch.setattr(store.os, "replace", slow)
    lung = open_lung(SOURCES, toy, cache=late)
    require_same(lung, open_lung(SOURCES, no_reading, cache=cache))
    assert [path.name for path in late.iterdir()] == [FOLDER]


def test_a_mapped_lung_outlives_its_folder(cache: Path) -> None:
    lung = open_lung(SOURCES, no_reading, cache=cache)
    before = lung.labels.copy()
    shutil.rmtree(cache)
    assert (lung.labels == before).all()


def test_a_cache_that_cannot_be_written_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match=r"cannot be written.*--cache or LUNGACCESS_CACHE"):
        open_lung(SOURCES, toy, cache=tmp_path / "file")
    with pytest.raises(FileError, match="cannot be written"):
        open_lung(SOURCES, toy, cache=tmp_path / "file" / "below")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_stored_lung_is_read_from_a_cache_that_cannot_be_written(cache: Path) -> None:
    cache.chmod(0o500)
    try:
        assert open_lung(SOURCES, no_reading, cache=cache).name == "Toy"
        with pytest.raises(FileError, match="cannot be written"):
            open_lung({"other": "d" * 64}, toy, cache=cache)
    finally:
        cache.chmod(0o700)


def test_what_killed_builds_left_is_removed_and_what_is_being_built_stays(tmp_path: Path) -> None:
    """Whether its process lives is told by the lock of a folder, not by its age."""
    left = tmp_path / ".building-left"
    left.mkdir()
    (left / "labels.npy").write_bytes(b"half")
    with filled_folder(tmp_path) as alive:
        long_ago = time.time() - 2 * 24 * 3600
        os.utime(alive.parent, (long_ago, long_ago))
        open_lung(SOURCES, toy, cache=tmp_path)
        assert not left.exists() and alive.exists()
        assert not any(entry.abandoned for entry in cache_entries(tmp_path, {}))
    assert not alive.exists()


def test_a_folder_lost_before_its_lock_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process takes the folder for abandoned in the moment between making and locking it."""
    lock, lost = unfinished.locked, []

    def late(folder: Path) -> Any:
        if not lost:
            lost.append(folder)
            remove_abandoned(tmp_path)
        return lock(folder)

    with monkeypatch.context() as patch:
        patch.setattr(unfinished, "locked", late)
        with filled_folder(tmp_path) as folder:
            assert lost and folder.is_dir() and [*tmp_path.iterdir()] == [folder.parent]


def test_one_process_alone_holds_the_lock_of_a_folder(tmp_path: Path) -> None:
    with filled_folder(tmp_path) as folder:
        with pytest.raises(BlockingIOError), locked(folder.parent):
            pass
        (folder / "labels.npy").write_bytes(b"half")
    assert list(tmp_path.iterdir()) == []


def test_without_locks_the_age_of_a_folder_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some file systems of networks have none."""

    def refuse(_lock: FileLock) -> None:
        raise OSError(errno.ENOTSUP, "Operation not supported")

    monkeypatch.setattr(FileLock, "_acquire", refuse)
    with filled_folder(tmp_path) as folder:
        (folder.parent / LOCK).touch()
        assert not is_abandoned(folder.parent)
        long_ago = time.time() - 2 * 24 * 3600
        os.utime(folder.parent, (long_ago, long_ago))
        assert is_abandoned(folder.parent)


def test_no_file_of_a_folder_is_open_when_it_is_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows would refuse; what this process maps and has open is asked of the system where it tells."""
    told = [Path(f"/proc/self/{name}") for name in ("maps", "fd")]
    if not all(each.exists() for each in told):
        pytest.skip("the system does not tell which files are open")
    rename, seen = os.replace, []

    def looking(source: Path, target: Path) -> None:
        seen.append(source)
        assert str(source) not in told[0].read_text()
        opened = [os.readlink(each) for each in told[1].iterdir() if each.is_symlink()]
        assert not any(each.startswith(f"{source}{os.sep}") for each in opened)
        rename(source, target)

    monkeypatch.setattr(store.os, "replace", looking)
    open_lung(SOURCES, toy, cache=tmp_path)
    assert len(seen) == 1
