"""What is kept with a stored lung: made once, made anew where it is damaged or old, never for a copy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from anatomy.kept_records import kept
from anatomy.lung import Lung
from anatomy.store import open_lung
from tests.anatomy.toys import toy


@pytest.fixture(scope="module")
def lung(tmp_path_factory: pytest.TempPathFactory) -> Lung:
    return open_lung({"lung.nii.gz": "a" * 64}, toy, cache=tmp_path_factory.mktemp("cache"))


class Maker:
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, Any]:
        self.calls += 1
        return {"numbers": [1.5, 2], "text": "é"}


def test_it_is_made_once(lung: Lung) -> None:
    make = Maker()
    assert kept(lung, "once", 1, make) == kept(lung, "once", 1, make) == {"numbers": [1.5, 2], "text": "é"}
    assert make.calls == 1


def test_another_version_and_damage_make_it_anew(lung: Lung) -> None:
    make = Maker()
    kept(lung, "damaged", 1, make)
    kept(lung, "damaged", 2, make)
    assert make.calls == 2
    assert lung.folder is not None
    for text in ("", "[]", "{}", '{"version": 2}', "\x00"):
        (lung.folder / "damaged.json").write_text(text)
        assert kept(lung, "damaged", 2, make)["numbers"] == [1.5, 2]
    assert make.calls == 7


def test_a_changed_copy_keeps_nothing(lung: Lung) -> None:
    make, copy = Maker(), replace(lung, name="another")
    assert lung.folder is not None and copy.folder is None
    kept(lung, "copied", 1, make)
    kept(copy, "copied", 1, make)
    assert make.calls == 2


def test_a_lung_that_was_removed_meanwhile_still_works(tmp_path: Path) -> None:
    lung = open_lung({"lung.nii.gz": "b" * 64}, toy, cache=tmp_path)
    assert lung.folder is not None
    lung.folder.rename(tmp_path / "gone")
    assert kept(lung, "gone", 1, Maker())["text"] == "é"
    assert not lung.folder.exists()
