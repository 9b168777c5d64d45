"""What studies run on: patients below LUNGACCESS_DATA, and a synthetic one where it is not set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.errors import FileError

if TYPE_CHECKING:
    from anatomy.lung import Lung

PHANTOM = "phantom"
PATIENTS = ("Patient1", "Patient2")


def data_folder() -> Path | None:
    """Return the folder of real anatomy that LUNGACCESS_DATA names, or None where it is not set.

    Raises:
        FileError: If it names something else than a folder.
    """
    stated = os.environ.get("LUNGACCESS_DATA")
    if not stated:
        return None
    if not Path(stated).is_dir():
        raise FileError(
            f"LUNGACCESS_DATA names {stated}, which is not a folder",
            expected="the folder that holds med-rad/Patient1",
            remedy="Set it to the folder of the data, or unset it to use synthetic anatomy",
        )
    return Path(stated)


def require_data(part: str) -> Path:
    """Return a folder or file below LUNGACCESS_DATA.

    Raises:
        FileError: If LUNGACCESS_DATA is not set or has no such part.
    """
    folder = data_folder()
    if folder is None or not (folder / part).exists():
        raise FileError(
            f"{part} was not found: LUNGACCESS_DATA {'is not set' if folder is None else 'lacks it'}",
            expected=f"a folder that holds {part}",
            remedy="Set LUNGACCESS_DATA; this study cannot run on synthetic anatomy",
        )
    return folder / part


def default_anatomies() -> tuple[str, ...]:
    """Return the names of the patients where LUNGACCESS_DATA is set, and of the phantom otherwise."""
    return (PHANTOM,) if data_folder() is None else PATIENTS


def anatomy(name: str) -> Lung:
    """Return the lung of that name.

    Args:
        name: "phantom" (a child's size, seed 3), the name of a folder below med-rad of LUNGACCESS_DATA, or a
            path.

    Raises:
        FileError: If there is no such patient.
    """
    from anatomy.build import build_lung
    from anatomy.phantom import make_phantom
    from lungaccess.problem.patients import load_patient

    if name == PHANTOM:
        return build_lung(make_phantom(seed=3, size="small").images)
    return load_patient(name if Path(name).exists() else require_data(f"med-rad/{name}"))
