"""What commands are given, made into what the library takes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.errors import SettingsError, TargetError
from anatomy.io.frames import parse_point
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.problem.system import System


STEP_SHARES = {
    "reading images": 0.02,
    "airway tree": 0.12,
    "labels": 0.24,
    "clearance to airway": 0.45,
    "clearance to vessel": 0.57,
    "clearance to pleura": 0.69,
    "clearance to fissure": 0.80,
}
"""Share of the preparation that is done when a step begins, as measured on CT of 512 x 512 x 500 voxels."""


def load_device(name: str, allow_fissures: bool | None) -> System:
    """Return the system, with its rule about fissures replaced if the user states one."""
    from dataclasses import replace

    from lungaccess.problem.system import load_system

    loaded = load_system(name)
    if allow_fissures is None or allow_fissures == loaded.fissures_allowed:
        return loaded
    rule = "fissures may be crossed" if allow_fissures else "fissures are obstacles"
    return replace(loaded, name=f"{loaded.name} ({rule})", fissures_allowed=allow_fissures)


def load_lung(patient: Path, cache: Path | None, *, thick_slices: bool = False) -> Lung:
    """Return a patient's lung, and show what is being done meanwhile.

    Raises
    ------
    SettingsError
        If the masks were made from thick slices, unless `thick_slices` accepts them.
    """
    from lungaccess.problem.patients import load_patient

    if not thick_slices:
        _refuse_thick_slices(patient)
    with progress(f"reading {patient}") as shown:
        return load_patient(
            patient, cache=cache, progress=lambda step: shown.step(step, STEP_SHARES.get(step))
        )


def _refuse_thick_slices(patient: Path) -> None:
    from anatomy.io.own_masks import thick_slices_mm

    distance_mm = thick_slices_mm(patient)
    if distance_mm:
        raise SettingsError(
            f"The masks of {patient} were made from slices {distance_mm:.1f} mm apart",
            expected="slices that show small airways and vessels: at most 3 mm",
            remedy="Segment a thinner reconstruction; `lungaccess plan --thick-slices` plans all the same",
        )


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
