"""Caches as accidents and hands change them: one change by a seed, of one file or of a whole entry."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.unfinished import clear_place
from tests.fuzz.mutations import mutated

DEEP = "[" * 5000 + "]" * 5000
VALUES: tuple[Any, ...] = (
    float("nan"), float("inf"), -1, 0, 2**70, "", "x" * 5000, None, True, [], {}, [[1, 2], [3]], [0.0] * 16
)  # fmt: skip


def tamper(rng: np.random.Generator, entry: Path, other: Path) -> str:
    """Change an entry of a cache (a folder or a file) and return what was done to it.

    Args:
        other: An intact entry of the same kind that belongs to another patient or design.
    """
    if entry.is_dir() and rng.random() < 0.2:
        of_all = (_other_entry, _emptied, _a_file_instead, _more_files, _swapped_files, _removed)
        change = _chosen(rng, of_all)
        change(rng, entry, other)
        return str(change.__name__)
    files = _files(entry)
    file = _chosen(rng, files)
    times = file.stat().st_atime_ns, file.stat().st_mtime_ns
    theirs = other / file.name if other.is_dir() else other
    of_its_kind = {".npy": _array, ".npz": _members, ".json": _json}[file.suffix]
    change = _chosen(
        rng, (_bytes, _bytes, _cut, _removed, _touched, _others_file, _a_folder) + (of_its_kind,) * 3
    )
    what = change(rng, file, theirs) or change.__name__
    if hidden := bool(file.exists() and rng.random() < 0.5):
        os.utime(file, ns=times)
    return f"{what} {file.name}{' with its old time' if hidden else ''}"


def _files(entry: Path) -> list[Path]:
    if entry.is_file():
        return [entry]
    return [path for path in sorted(entry.iterdir()) if path.is_file() and path.stem != "more"]


def _chosen(rng: np.random.Generator, things: Any) -> Any:
    return things[int(rng.integers(len(things)))]


def _bytes(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    file.write_bytes(mutated(rng, file.read_bytes()))


def _cut(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    os.truncate(file, int(_chosen(rng, (0, 1, file.stat().st_size // 2, file.stat().st_size - 1))))


def _removed(rng: np.random.Generator, place: Path, theirs: Path) -> None:
    clear_place(place)


def _touched(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    os.utime(file)


def _others_file(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    if theirs.is_file():
        shutil.copy2(theirs, file)


def _a_folder(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    file.unlink()
    file.mkdir()


def _array(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    np.save(file, _changed(rng, np.load(file)))


def _members(rng: np.random.Generator, file: Path, theirs: Path) -> None:
    with np.load(file) as stored:
        arrays = dict(stored)
    one, two = (_chosen(rng, sorted(arrays)) for _ in range(2))
    if rng.random() < 0.2:
        del arrays[one]
    elif rng.random() < 0.25:
        arrays[one], arrays[two] = arrays[two], arrays[one]
    else:
        arrays[one] = _changed(rng, arrays[one])
    np.savez(file, **arrays)


def _changed(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    """Return an array with another type or shape, or with values that do not belong there."""
    if array.dtype.kind in "US":
        return np.array(_chosen(rng, (DEEP, "", "{}", str(array)[: len(str(array)) // 2])))
    changes: list[Callable[[], np.ndarray]] = [
        lambda: array.astype(_chosen(rng, ("f2", "f4", "f8", "i1", "i4", "i8", "u2", "c16", "?", "U3"))),
        lambda: array[: len(array) // 2] if array.ndim else array[None],
        lambda: array.reshape(-1),
        lambda: np.roll(array, 1),
        lambda: array.T.copy(),
        lambda: np.zeros_like(array),
        lambda: np.concatenate([array, array]) if array.ndim else array[None],
        lambda: _with(array, rng, -1),
        lambda: _with(array, rng, 2**31 - 1),
        lambda: _with(array, rng, np.nan),
    ]
    with np.errstate(all="ignore"):
        return np.asarray(_chosen(rng, changes)())


def _with(array: np.ndarray, rng: np.random.Generator, value: float) -> np.ndarray:
    changed = array.copy()
    if changed.size:
        whole = changed.dtype.kind != "f" and not np.isfinite(value)
        changed.reshape(-1)[int(rng.integers(changed.size))] = np.array(2**15 if whole else value).astype(
            array.dtype
        )
    return changed


def _json(rng: np.random.Generator, file: Path, theirs: Path) -> str:
    values = json.loads(file.read_text())
    place, key = values, _chosen(rng, sorted(values))
    while isinstance(place[key], dict | list) and place[key] and rng.random() < 0.7:
        place = place[key]
        key = _chosen(rng, sorted(place)) if isinstance(place, dict) else int(rng.integers(len(place)))
    if rng.random() < 0.2:
        del place[key]
    elif isinstance(place[key], float | int) and rng.random() < 0.5:
        place[key] += 5
    else:
        place[key] = _chosen(rng, VALUES)
    text = json.dumps(values)
    file.write_text(text.replace('""', DEEP) if rng.random() < 0.2 else text)
    return f"_json {key}"


def _other_entry(rng: np.random.Generator, entry: Path, other: Path) -> None:
    shutil.rmtree(entry)
    shutil.copytree(other, entry)


def _emptied(rng: np.random.Generator, entry: Path, other: Path) -> None:
    shutil.rmtree(entry)
    entry.mkdir()


def _a_file_instead(rng: np.random.Generator, entry: Path, other: Path) -> None:
    shutil.rmtree(entry)
    entry.write_bytes(b"x")


def _more_files(rng: np.random.Generator, entry: Path, other: Path) -> None:
    np.save(entry / "more.npy", np.zeros(3))
    (entry / "more.json").write_text(DEEP)
    (entry / "folder").mkdir()


def _swapped_files(rng: np.random.Generator, entry: Path, other: Path) -> None:
    one, two = rng.choice(
        [path for path in sorted(entry.iterdir()) if path.suffix == ".npy"], 2, replace=False
    )
    kept = one.read_bytes()
    shutil.copy2(two, one)
    two.write_bytes(kept)
