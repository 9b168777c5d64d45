"""Lungs on disk: what is read back is what was built, damage is repaired, nothing half-made is used."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy import store
from anatomy.build import build_lung, lung_key
from anatomy.cache import default_cache
from anatomy.errors import AnatomyError, FileError
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from anatomy.store import META, open_lung
from anatomy.tree_report import GapBridged, LoopOpened, SpurPruned
from tests.anatomy import toys
from tests.anatomy.toys import toy

SOURCES = {"airway.nii.gz": "a" * 64, "lung.nii.gz": "b" * 64}
KEY = lung_key(SOURCES)


def _no_reading() -> PatientImages:
    raise AssertionError("the images were read although the lung was stored")


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


def _require_same(a: Any, b: Any, where: str = "lung") -> None:
    """Compare dataclasses, arrays, tuples and mappings to the last bit."""
    if is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclass_fields(a):
            if field.name == "folder":  # Where a lung is stored is no part of what it is.
                continue
            _require_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray) and a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, err_msg=where)
        assert a.flags.f_contiguous == b.flags.f_contiguous, where
    elif isinstance(a, Mapping):
        assert set(a) == set(b), where
        for key in a:
            _require_same(a[key], b[key], f"{where}[{key}]")
    elif isinstance(a, tuple):
        assert isinstance(b, tuple) and len(a) == len(b), where
        for n, (x, y) in enumerate(zip(a, b, strict=True)):
            _require_same(x, y, f"{where}[{n}]")
    else:
        assert a == b and type(a) is type(b), where


def _arrays(value: Any) -> list[np.ndarray]:
    """Return every array within a result."""
    if isinstance(value, np.ndarray):
        return [value]
    if is_dataclass(value):
        return [a for field in dataclass_fields(value) for a in _arrays(getattr(value, field.name))]
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else ()
    return [array for part in parts for array in _arrays(part)]


def test_what_is_read_back_is_what_was_built(stored: Path) -> None:
    _require_same(build_lung(toy(), key=KEY), open_lung(SOURCES, _no_reading, cache=stored))


def test_the_first_lung_returned_is_the_stored_one(tmp_path: Path) -> None:
    first = open_lung(SOURCES, toy, cache=tmp_path)
    _require_same(first, open_lung(SOURCES, _no_reading, cache=tmp_path))


def test_a_lung_without_the_optional_parts_survives(tmp_path: Path) -> None:
    def read() -> PatientImages:
        return toy(
            wall=None, fissures=None, nodules=None, cost=None, starts=(), targets_lps=(), breath_hold=None
        )

    open_lung(SOURCES, read, cache=tmp_path)
    lung = open_lung(SOURCES, _no_reading, cache=tmp_path)
    _require_same(build_lung(read(), key=KEY), lung)
    assert lung.nodules is None and lung.cost is None and not lung.has_fissures


def test_everything_the_tree_reports_survives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = replace(
        build_lung(toy()).tree.report,
        gaps_bridged=(GapBridged(position_lps=np.array([1.0, 2.0, 0.1]), length_mm=0.3, voxels_joined=7),),
        spurs_pruned=(SpurPruned(position_lps=np.array([4.0, 5.0, 6.0]), length_mm=1 / 3),),
        loops_opened=(LoopOpened(position_lps=np.array([7.0, 8.0, 9.0]), length_mm=20.0),),
        components_dropped=2,
        voxels_dropped=33,
        cavity_voxels=4,
        warnings=("The tree is hand-made.",),
    )

    def build(*args: Any, **kwargs: Any) -> Lung:
        lung = build_lung(*args, **kwargs)
        return replace(lung, tree=replace(lung.tree, report=report))

    monkeypatch.setattr(store, "build_lung", build)
    _require_same(report, open_lung(SOURCES, toy, cache=tmp_path).tree.report)


def test_a_gap_in_the_airway_is_reported_from_the_store_too(tmp_path: Path) -> None:
    """Real reports hold numbers of NumPy, which JSON does not know."""
    lumen = toy().lumen.array & ~toys.capsule((26.0, 0.0, -26.0), (27.5, 0.0, -27.5), 8.0)
    lung = open_lung(SOURCES, lambda: toy(lumen=lumen, wall=None), cache=tmp_path)
    again = open_lung(SOURCES, _no_reading, cache=tmp_path)
    assert lung.tree.report.gaps_bridged or lung.tree.report.components_dropped
    _require_same(lung.tree.report, again.tree.report)


def test_no_array_can_be_written(stored: Path) -> None:
    lung = open_lung(SOURCES, _no_reading, cache=stored)
    arrays = _arrays(lung)
    assert len(arrays) > 20
    assert not any(array.flags.writeable for array in arrays)
    with pytest.raises(TypeError):
        lung.fields["airway"] = lung.fields["vessel"]  # type: ignore[index]


def test_arrays_are_mapped_not_read(stored: Path) -> None:
    lung = open_lung(SOURCES, _no_reading, cache=stored)
    for array in (lung.labels, lung.fields["obstacle"].corners, lung.lumen_depth.corners):
        base: Any = array
        while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
            base = base.base
        assert isinstance(base, np.memmap)


def test_other_sources_are_another_lung(cache: Path) -> None:
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy(name="Other")

    other = open_lung({**SOURCES, "lung.nii.gz": "c" * 64}, read, cache=cache)
    assert (calls, other.name) == ([1], "Other")
    assert open_lung(SOURCES, _no_reading, cache=cache).name == "Toy"


def test_progress_begins_with_reading(tmp_path: Path) -> None:
    steps: list[str] = []
    open_lung(SOURCES, toy, cache=tmp_path, progress=steps.append)
    assert steps[:2] == ["reading images", "airway tree"]
    steps.clear()
    open_lung(SOURCES, _no_reading, cache=tmp_path, progress=steps.append)
    assert steps == []


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
        (META, _set_meta(shape=[1, 2])),
        (META, _set_meta(shape=[1, 2, 3])),
        (META, _set_meta(lps_from_ijk=[[0.0]])),
        (META, _set_meta(fields=3)),
        (META, _set_meta(tree_report=None)),
        (META, _set_meta(tree_report={"gaps_bridged": [1]})),
        ("labels.npy", Path.unlink),
        ("labels.npy", _truncate),
        ("labels.npy", lambda file: file.write_bytes(b"")),
        ("labels.npy", _other_shape),
        ("obstacle.npy", Path.unlink),
        ("obstacle.npy", _truncate),
        ("obstacle.npy", _other_shape),
        ("nodules.npy", _other_shape),
        ("lumen_depth.npy", Path.unlink),
        ("tree.npz", Path.unlink),
        ("tree.npz", _truncate),
        ("tree.npz", lambda file: file.write_bytes(b"")),
        ("tree.npz", lambda file: np.savez(file, points_lps=np.zeros((2, 3)))),
    ],
)
def test_damage_is_repaired(
    cache: Path, name: str, damage: Callable[[Path], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    damage(cache / KEY / name)
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy()

    lung = open_lung(SOURCES, read, cache=cache)
    assert calls == [1]
    _require_same(lung, open_lung(SOURCES, _no_reading, cache=cache))
    assert [path.name for path in cache.iterdir()] == [KEY]


def test_another_version_of_the_processing_builds_anew(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "FORMAT", store.FORMAT + 1)
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy()

    open_lung(SOURCES, read, cache=cache)
    open_lung(SOURCES, _no_reading, cache=cache)
    assert calls == [1]


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
    assert (left / "labels.npy").is_file()
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy()

    open_lung(SOURCES, read, cache=tmp_path)
    assert calls == [1]


def test_two_builds_at_once_end_with_one_lung(tmp_path: Path) -> None:
    """While one process builds, another finishes the same lung."""
    inner: list[Lung] = []

    def read() -> PatientImages:
        inner.append(open_lung(SOURCES, toy, cache=tmp_path))
        return toy()

    outer = open_lung(SOURCES, read, cache=tmp_path)
    _require_same(outer, inner[0])
    assert [path.name for path in tmp_path.iterdir()] == [KEY]


def test_the_other_process_may_win_at_the_last_moment(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between looking and renaming, the folder appears: rename fails, and the other lung is as good."""
    late = tmp_path / "late"
    rename = os.replace

    def slow(source: Path, target: Path) -> None:
        shutil.copytree(cache / KEY, late / KEY)
        rename(source, target)

    monkeypatch.setattr(store.os, "replace", slow)
    lung = open_lung(SOURCES, toy, cache=late)
    _require_same(lung, open_lung(SOURCES, _no_reading, cache=cache))
    assert [path.name for path in late.iterdir()] == [KEY]


def test_a_mapped_lung_outlives_its_folder(cache: Path) -> None:
    lung = open_lung(SOURCES, _no_reading, cache=cache)
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
        assert open_lung(SOURCES, _no_reading, cache=cache).name == "Toy"
        with pytest.raises(FileError, match="cannot be written"):
            open_lung({"other": "d" * 64}, toy, cache=cache)
    finally:
        cache.chmod(0o700)


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"LUNGACCESS_CACHE": "/a/b"}, Path("/a/b")),
        ({"LUNGACCESS_CACHE": "/a/b", "XDG_CACHE_HOME": "/x"}, Path("/a/b")),
        ({"XDG_CACHE_HOME": "/x"}, Path("/x/lungaccess")),
        ({"HOME": "/home/somebody"}, Path("/home/somebody/.cache/lungaccess")),
        ({"LUNGACCESS_CACHE": "", "XDG_CACHE_HOME": "", "HOME": "/h"}, Path("/h/.cache/lungaccess")),
    ],
)
def test_where_the_cache_is(
    environment: dict[str, str], expected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LUNGACCESS_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert default_cache() == expected


def test_the_default_cache_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LUNGACCESS_CACHE", str(tmp_path / "deep" / "cache"))
    open_lung(SOURCES, toy)
    assert (tmp_path / "deep" / "cache" / KEY / META).is_file()


def test_what_a_killed_build_left_is_removed_a_day_later(tmp_path: Path) -> None:
    images = toy()
    old, new = tmp_path / ".building-old", tmp_path / ".building-new"
    for folder in (old, new):
        folder.mkdir()
        (folder / "labels.npy").write_bytes(b"half")
    long_ago = time.time() - 2 * 24 * 3600
    os.utime(old, (long_ago, long_ago))
    open_lung(dict(images.sources), lambda: images, cache=tmp_path)
    assert not old.exists()
    assert new.exists()
