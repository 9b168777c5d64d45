"""Load a patient from disk, prepared and cached; or a liver, for the needle alone."""

import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.lung import Lung
from anatomy.organ import Organ
from anatomy.plausibility import require_known_checks

if TYPE_CHECKING:
    from anatomy.build import Reused
    from anatomy.patient import PatientImages


def load_patient(
    path: str | os.PathLike[str],
    *,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] | None = None,
    accept: Collection[str] | None = (),
) -> Lung:
    """Return the `Lung` of a patient folder; the second time it comes from the cache.

    Args:
        path: A Med-RAD folder, a folder with a `patient.toml`, or output of TotalSegmentator.
        cache: Folder for prepared anatomies; `anatomy.base.cache.default_cache()` if None.
        accept (collection of str): Names of checks of `anatomy.plausibility.CHECKS` whose failure is
            accepted; None refuses nothing.

    Raises:
        LungaccessError: If the folder cannot be understood or an image in it is wrong, see
            `anatomy.io.load_patient`; or if the masks cannot be those of a patient.
    """
    from anatomy.io.inputs import input_hashes
    from anatomy.io.patients import load_patient as read_images
    from anatomy.store import open_lung

    require_known_checks(accept or ())
    folder = Path(path)
    return open_lung(
        input_hashes(folder),
        lambda: read_images(folder),
        cache=None if cache is None else Path(cache),
        progress=progress,
        accept=accept,
    )


def renewed_patient(
    path: Path,
    images: "PatientImages",
    reused: "Reused",
    *,
    cache: Path | None = None,
    accept: Collection[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Lung:
    """Return the `Lung` of a patient whose images are at hand, made anew where they have changed.

    Args:
        images: What `anatomy.io.load_patient` reads at `path`.
        reused: See `anatomy.build.build_lung`.

    Raises:
        LungaccessError: As `load_patient`.
    """
    from anatomy.io.inputs import input_hashes
    from anatomy.store import open_lung

    hashes = input_hashes(path)
    return open_lung(hashes, lambda: images, cache=cache, accept=accept, progress=progress, reused=reused)


def load_organ(
    path: str | os.PathLike[str],
    *,
    progress: Callable[[str], None] | None = None,
    accept: Collection[str] | None = (),
) -> Organ:
    """Return the liver of a Med-RAD folder, else what `load_patient` returns; parameters and errors as there.

    A liver has no airways: it is enough for a needle from a given start, not for scope and tubes.
    """
    from anatomy.io.liver import is_liver, load_liver
    from anatomy.liver import build_liver

    require_known_checks(accept or ())
    if is_liver(Path(path)):
        return build_liver(load_liver(Path(path)))
    return load_patient(path, progress=progress, accept=accept)
