"""Load a patient from disk, prepared and cached."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from anatomy.lung import Lung


def load_patient(
    path: str | os.PathLike[str],
    *,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Lung:
    """Return the `Lung` of a patient folder; the second time it comes from the cache.

    Parameters
    ----------
    path : path
        A Med-RAD folder, a folder with a `patient.toml`, or output of TotalSegmentator.
    cache : path, optional
        Folder for prepared anatomies; `anatomy.cache.default_cache()` if None.
    progress : callable, optional
        Receives each step as it begins.

    Raises
    ------
    LungaccessError
        If the folder cannot be understood or an image in it is wrong; see `anatomy.io.load_patient`.
    """
    from anatomy.io.inputs import input_hashes
    from anatomy.io.patients import load_patient as read_images
    from anatomy.store import open_lung

    folder = Path(path)
    return open_lung(
        input_hashes(folder),
        lambda: read_images(folder),
        cache=None if cache is None else Path(cache),
        progress=progress,
    )
