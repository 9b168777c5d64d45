"""Atlases on disk: found again, also for another needle; damaged or foreign ones are made anew."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import FileError
from anatomy.lung import Lung
from lungaccess.planning.coupled import atlas as atlas_store
from lungaccess.planning.coupled.atlas import Atlas, atlas_format, atlas_is_kept, open_atlas
from stages.tube import design_shapes
from stages.tube.design_shapes import shapes_format

SYSTEM = la.load_system("ultrathin")
COARSE: dict[str, Any] = {"rotations": 4, "stop_spacing_mm": 10.0, "site_spacing_mm": 4.0}


@pytest.fixture(scope="module")
def enumerated(small_lung: Lung) -> Atlas:
    """An atlas as the store has it made: what is in it does not matter to the store."""
    return atlas_store.build_atlas(small_lung, SYSTEM, **COARSE)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, enumerated: Atlas) -> list[str]:
    """The systems for which an atlas was asked of `build_atlas`; it always has the same contents."""
    names: list[str] = []

    def counted(lung: Lung, system: Any, **_options: Any) -> Atlas:
        names.append(system.name)
        return replace(enumerated, lung=lung, system=system)

    monkeypatch.setattr(atlas_store, "build_atlas", counted)
    return names


def same(one: Any, other: Any) -> bool:
    """Tell whether two records are equal, field by field and record by record."""
    if is_dataclass(one):
        names = [item.name for item in fields(one) if item.name not in ("lung", "system", "index", "build_s")]
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    return bool(np.array_equal(one, other)) if isinstance(one, np.ndarray) else bool(one == other)


def test_found_again(small_lung: Lung, tmp_path: Path, made: list[str]) -> None:
    first = open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE)
    again = open_atlas(small_lung, SYSTEM, cache=str(tmp_path), **COARSE)
    assert made == [SYSTEM.name] and same(first, again) and first.deployments.count > 0
    assert not again.deployments.positions.flags.writeable
    other = replace(SYSTEM, name="other", needle=replace(SYSTEM.needle, max_curvature_per_mm=1 / 40))
    served = open_atlas(small_lung, other, cache=tmp_path, **COARSE)
    assert len(made) == 1 and served.system == other, "the needle does not matter"


def test_what_matters_is_made_anew(small_lung: Lung, tmp_path: Path, made: list[str]) -> None:
    open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE)
    changes: list[Any] = [
        replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=3.2)),
        replace(SYSTEM, tubes=replace(SYSTEM.tubes, min_wall_angle_deg=20.0)),
        replace(SYSTEM, margins=replace(SYSTEM.margins, segmentation_margin_mm=0.7)),
        replace(SYSTEM, fissures_allowed=not SYSTEM.fissures_allowed),
    ]
    for number, system in enumerate(changes, start=2):
        open_atlas(small_lung, system, cache=tmp_path, **COARSE)
        assert len(made) == number
    open_atlas(replace(small_lung, key="another"), SYSTEM, cache=tmp_path, **COARSE)
    open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE | {"rotations": 5})
    assert len(made) == len(changes) + 3


def test_what_is_kept_is_known_without_reading_it(small_lung: Lung, tmp_path: Path, made: list[str]) -> None:
    assert not atlas_is_kept(small_lung, SYSTEM, cache=tmp_path / "none", **COARSE)
    open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE)
    (path,) = tmp_path.iterdir()
    path.write_bytes(b"")
    needle = replace(SYSTEM.require_needle("The test"), max_curvature_per_mm=0.02)
    other_needle = replace(SYSTEM, name="other", needle=needle)
    assert all(atlas_is_kept(small_lung, each, cache=tmp_path, **COARSE) for each in (SYSTEM, other_needle))
    other_scope = replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=3.2))
    assert not atlas_is_kept(small_lung, other_scope, cache=tmp_path, **COARSE)
    assert not atlas_is_kept(small_lung, SYSTEM, cache=tmp_path), "on another grid"
    assert made == [SYSTEM.name] and path.read_bytes() == b""


@pytest.mark.parametrize("keep", [0, 100, 5000])
def test_a_damaged_file_is_replaced(small_lung: Lung, tmp_path: Path, made: list[str], keep: int) -> None:
    first = open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE)
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:keep])
    again = open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE)
    assert len(made) == 2 and same(first, again)
    assert same(open_atlas(small_lung, SYSTEM, cache=tmp_path, **COARSE), first) and len(made) == 2


def test_a_folder_that_cannot_be(small_lung: Lung, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="--cache"):
        open_atlas(small_lung, SYSTEM, cache=tmp_path / "file" / "cache", **COARSE)


def test_an_atlas_and_shapes_of_other_kernels_are_others(monkeypatch: pytest.MonkeyPatch) -> None:
    here = atlas_format(), shapes_format()
    for module in (atlas_store, design_shapes):
        monkeypatch.setattr(module, "kernel_digest", lambda *_rooms: "0123456789abcdef")
    assert here[0] != atlas_format() and here[1] != shapes_format()
