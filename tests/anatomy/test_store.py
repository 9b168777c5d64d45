"""Lungs on disk: what is read back is what was built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy import store
from anatomy.airway_tree import GapBridged, LoopOpened, SpurPruned
from anatomy.base.cache import default_cache
from anatomy.build import build_lung
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from anatomy.store import META, open_lung
from tests.anatomy import toys
from tests.anatomy.stored_toy import FOLDER, KEY, SOURCES, no_reading, require_same
from tests.anatomy.toys import toy


def _arrays(value: Any) -> list[np.ndarray]:
    """Return every array within a result."""
    if isinstance(value, np.ndarray):
        return [value]
    if is_dataclass(value):
        return [a for field in dataclass_fields(value) for a in _arrays(getattr(value, field.name))]
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else ()
    return [array for part in parts for array in _arrays(part)]


def test_what_is_read_back_is_what_was_built(stored: Path) -> None:
    require_same(build_lung(toy(), key=KEY), open_lung(SOURCES, no_reading, cache=stored))


def test_the_first_lung_returned_is_the_stored_one(tmp_path: Path) -> None:
    first = open_lung(SOURCES, toy, cache=tmp_path)
    require_same(first, open_lung(SOURCES, no_reading, cache=tmp_path))


def test_a_lung_without_the_optional_parts_survives(tmp_path: Path) -> None:
    def read() -> PatientImages:
        return toy(
            wall=None, fissures=None, nodules=None, cost=None, starts=(), targets_lps=(), breath_hold=None
        )

    open_lung(SOURCES, read, cache=tmp_path)
    lung = open_lung(SOURCES, no_reading, cache=tmp_path)
    require_same(build_lung(read(), key=KEY), lung)
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
    require_same(report, open_lung(SOURCES, toy, cache=tmp_path).tree.report)


def test_a_gap_in_the_airway_is_reported_from_the_store_too(tmp_path: Path) -> None:
    """Real reports hold numbers of NumPy, which JSON does not know."""
    lumen = toy().lumen.array & ~toys.capsule((26.0, 0.0, -26.0), (27.5, 0.0, -27.5), 8.0)
    lung = open_lung(SOURCES, lambda: toy(lumen=lumen, wall=None), cache=tmp_path)
    again = open_lung(SOURCES, no_reading, cache=tmp_path)
    assert lung.tree.report.gaps_bridged or lung.tree.report.components_dropped
    require_same(lung.tree.report, again.tree.report)


def test_no_array_can_be_written(stored: Path) -> None:
    lung = open_lung(SOURCES, no_reading, cache=stored)
    arrays = _arrays(lung)
    assert len(arrays) > 20
    assert not any(array.flags.writeable for array in arrays)
    with pytest.raises(TypeError):
        lung.fields["airway"] = lung.fields["vessel"]  # type: ignore[index]


def test_arrays_are_mapped_not_read(stored: Path) -> None:
    lung = open_lung(SOURCES, no_reading, cache=stored)
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
    assert open_lung(SOURCES, no_reading, cache=cache).name == "Toy"


def test_progress_begins_with_reading(tmp_path: Path) -> None:
    steps: list[str] = []
    open_lung(SOURCES, toy, cache=tmp_path, progress=steps.append)
    assert steps[:2] == ["reading images", "airway tree"]
    steps.clear()
    open_lung(SOURCES, no_reading, cache=tmp_path, progress=steps.append)
    assert steps == []


def test_another_version_of_the_processing_builds_anew(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "FORMAT", store.FORMAT + 1)
    calls: list[int] = []

    def read() -> PatientImages:
        calls.append(1)
        return toy()

    open_lung(SOURCES, read, cache=cache)
    open_lung(SOURCES, no_reading, cache=cache)
    assert calls == [1]


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
    assert (tmp_path / "deep" / "cache" / FOLDER / META).is_file()


def test_a_lung_made_by_other_kernels_is_made_anew(stored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "kernel_digest", lambda *_rooms: "0123456789abcdef")
    with pytest.raises(AssertionError, match="the images were read"):
        open_lung(SOURCES, no_reading, cache=stored)
    monkeypatch.undo()
    open_lung(SOURCES, no_reading, cache=stored)
