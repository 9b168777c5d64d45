"""A patient on disk, with its atlas in the cache."""

from __future__ import annotations

from pathlib import Path

import pytest

import lungaccess as la
from anatomy.phantom import Phantom, write_phantom


@pytest.fixture(scope="session")
def patient(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small phantom, prepared, in a folder with an odd name."""
    folder = tmp_path_factory.mktemp("explored") / "<img src=x onerror=alert(1)>"
    write_phantom(small_phantom, folder)
    lung = la.load_patient(folder, cache=folder.parent / "cache")
    la.open_atlas(lung, la.load_system("ultrathin"), cache=folder.parent / "cache")
    return folder
