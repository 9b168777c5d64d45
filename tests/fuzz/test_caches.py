"""A tampered cache gives the right result, or is made again with a warning; nothing else comes of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.cache_entries import cache_entries
from anatomy.base.checksums import DamagedCacheWarning
from anatomy.base.records import plain_values
from anatomy.kept_records import kept
from anatomy.lung import Lung
from anatomy.motion.source import MotionSource
from anatomy.patient import PatientImages
from anatomy.store import open_lung
from lungaccess.planning.coupled import atlas as atlas_store
from lungaccess.planning.coupled.atlas import open_atlas
from stages.tube import ShapeGrid, ShapeLimits, design_shapes, open_shapes
from tests.anatomy.stored_toy import SOURCES, require_same
from tests.anatomy.toys import toy
from tests.fuzz.caches import tamper

IN_CI, IN_ALL = 45, 500
SYSTEM = la.load_system("ultrathin")
COARSE: dict[str, Any] = {"rotations": 4, "stop_spacing_mm": 10.0, "site_spacing_mm": 4.0}
PICTURES = {name: {"cells": [1.5, 2, 3], "text": name * 99} for name in ("surfaces", "labels", "projections")}
SILENT = ("_removed", "_json format", "_json version")
"""What is made again without a word: what is not there, and what another version of the program left."""


@dataclass
class Cache:
    """One kind of cache: how it is opened, also for another patient or design, and what was made."""

    open: Callable[[Path], Any]
    open_other: Callable[[Path], Any]
    made: list[str]


@pytest.fixture
def lungs() -> Cache:
    made: list[str] = []

    def read() -> PatientImages:
        made.append("lung")
        return toy(motion=MotionSource(description="others", masks_phase=0.5, population_motion_mm=10.0))

    def pictures(lung: Lung) -> tuple[Any, ...]:
        return tuple(kept(lung, name, 1, lambda: made.append(name) or PICTURES[name]) for name in PICTURES)  # noqa: B023

    def opened(cache: Path) -> Any:
        lung = open_lung(SOURCES, read, cache=cache)
        return lung, pictures(lung)

    def other(cache: Path) -> Any:
        lung = open_lung({"a": "c" * 64}, lambda: toy(nodules=None), cache=cache)
        return tuple(kept(lung, name, 1, lambda: {"cells": [9.0]}) for name in PICTURES)

    return Cache(opened, other, made)


@pytest.fixture
def atlases(small_lung: Lung, monkeypatch: pytest.MonkeyPatch) -> Cache:
    made: list[str] = []
    enumerated = atlas_store.build_atlas(small_lung, SYSTEM, **COARSE)

    def again(lung: Lung, system: la.System, **_options: Any) -> la.Atlas:
        made.append("atlas")
        return replace(enumerated, lung=lung, system=system)

    monkeypatch.setattr(atlas_store, "build_atlas", again)

    def opened(cache: Path) -> Any:
        atlas, arrays = open_atlas(small_lung, SYSTEM, cache=cache, **COARSE), dict[str, Any]()
        values = plain_values((atlas.motions, atlas.deployments), "", arrays)
        return {"values": values, **{name: np.ascontiguousarray(each) for name, each in arrays.items()}}

    other = replace(SYSTEM, margins=replace(SYSTEM.margins, segmentation_margin_mm=0.7))
    return Cache(opened, lambda cache: open_atlas(small_lung, other, cache=cache, **COARSE), made)


@pytest.fixture
def shapes(monkeypatch: pytest.MonkeyPatch) -> Cache:
    made: list[str] = []
    tubes = (SYSTEM.tubes.inner, SYSTEM.tubes.outer)
    fine, coarse = ShapeGrid(stop_mm=10.0, rotations=4), ShapeGrid(stop_mm=20.0, rotations=4)
    enumerated = {grid: design_shapes.tube_shapes(tubes, ShapeLimits(), grid) for grid in (fine, coarse)}
    monkeypatch.setattr(
        design_shapes, "tube_shapes", lambda *design, **_: made.append("shapes") or enumerated[design[-1]]
    )

    def opened(cache: Path, grid: ShapeGrid = fine) -> Any:
        return open_shapes(tubes, ShapeLimits(), grid, cache=cache)

    return Cache(opened, lambda cache: opened(cache, coarse), made)


@pytest.fixture(params=["lungs", "atlases", "shapes"])
def kind(request: pytest.FixtureRequest) -> Cache:
    found: Cache = request.getfixturevalue(request.param)
    return found


def _tampered_again_and_again(kind: Cache, cache: Path, seeds: range) -> None:
    intact = kind.open(cache / "intact")
    kind.open(cache)
    (entry,) = (each.path for each in cache_entries(cache, {}))
    kind.open_other(cache)
    (other,) = (each.path for each in cache_entries(cache, {}) if each.path != entry)
    for seed in seeds:
        kind.made.clear()
        what = f"seed {seed}: {tamper(np.random.default_rng(seed), entry, other)}"
        cache_entries(cache, {})
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            require_same(kind.open(cache), intact, what)
        assert {each.category for each in said} <= {DamagedCacheWarning}, what
        assert bool(said) == bool(kind.made) or any(word in what for word in SILENT), f"{what}: {kind.made}"
        kind.made.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            require_same(kind.open(cache), intact, what)
        assert not kind.made, f"{what}: it stays damaged"


@pytest.mark.slow
def test_a_tampered_cache_gives_the_right_result(kind: Cache, tmp_path: Path) -> None:
    _tampered_again_and_again(kind, tmp_path, range(IN_CI // 3))


@pytest.mark.slow
def test_five_hundred_tampered_caches_give_the_right_result(kind: Cache, tmp_path: Path) -> None:
    _tampered_again_and_again(kind, tmp_path, range(1000, 1000 + IN_ALL // 3 + 1))
