"""What commands are given, made into what the library takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.errors import TargetError
from anatomy.io.frames import parse_point
from lungaccess import terminal

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.system import System


def load_device(name: str, allow_fissures: bool | None) -> System:
    """Return the system, with its rule about fissures replaced if the user states one."""
    from dataclasses import replace

    from lungaccess.system import load_system

    loaded = load_system(name)
    if allow_fissures is None or allow_fissures == loaded.fissures_allowed:
        return loaded
    rule = "fissures may be crossed" if allow_fissures else "fissures are obstacles"
    return replace(loaded, name=f"{loaded.name} ({rule})", fissures_allowed=allow_fissures)


def load_lung(patient: Path, cache: Path | None) -> Lung:
    """Return a patient's lung, and show what is being done meanwhile."""
    from lungaccess.patients import load_patient

    with terminal.console.status(f"reading {terminal.escaped(str(patient))}") as status:
        return load_patient(patient, cache=cache, progress=lambda step: status.update(step))


def require_one_target(target: str | None, nodule: int | None) -> None:
    """Raise TargetError unless either a point or a nodule is given, and the point can be read."""
    if (target is None) == (nodule is None):
        raise TargetError(
            "No target was given" if target is None else "Both a target and a nodule were given",
            expected="either --target ras:x,y,z (or lps:x,y,z) or --nodule",
            remedy="lungaccess plan --help shows examples",
        )
    if target is not None:
        parse_point(target)
