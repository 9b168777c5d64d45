"""From masks that were read to a patient: what is missing is named, what is empty refused or left out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.io.lungs import with_contents, with_lobes
from anatomy.io.masks import MaskSet
from anatomy.io.placement import place
from anatomy.io.voxels import from_stored
from anatomy.patient import PatientImages

LUNG_ROLES: Mapping[str, str] = {"lumen": "the airway lumen", "vessels": "the vessels", "lung": "the lungs"}
"""Masks that a lung cannot be without, and what messages call them."""
MAY_BE_EMPTY = ("fissures", "nodules")


def assemble(masks: MaskSet, *, name: str, kind: str, where: Path, **others: Any) -> PatientImages:
    """Make the `PatientImages` of masks that were read, after checking that none is missing or empty.

    Args:
        name, kind: As in `PatientImages`.
        where: The patient's folder, for messages.
        others: Further fields of `PatientImages`; `warnings` and `sources` are added to.

    Raises:
        AnatomyError: If lumen, vessels or lung is missing, or a mask is empty.  An empty mask of fissures or
            nodules only causes a warning.
    """
    masks = with_contents(with_lobes(masks))
    missing = [words for role, words in LUNG_ROLES.items() if role not in masks.masks]
    if missing:
        raise AnatomyError(
            f"{where} holds no mask of {', '.join(missing)}",
            expected="masks of the airway lumen, the vessels and the lungs (or their five lobes)",
            remedy=describe_yourself(),
        )
    volumes, empty = volumes_of(masks)
    known: dict[str, Any] = dict(volumes)
    if masks.lobes is not None:
        known["lobes"] = Volume(grid=masks.grid, array=masks.lobes)
    if masks.nodule_labels is not None:
        known["nodule_labels"] = Volume(grid=masks.grid, array=masks.nodule_labels)
    return PatientImages(
        name=name,
        kind=kind,
        grid=masks.grid,
        sources={**masks.sources, **others.pop("sources", {})},
        warnings=(*others.pop("warnings", ()), *masks.statements, *empty),
        **known,
        **others,
    )


def describe_yourself() -> str:
    """Return the remedy for a folder whose files are not known by their names."""
    return (
        "Rename the files, or write a file patient.toml beside them that names them: "
        'lumen = "airway.nii.gz", vessels = "vessels.nii.gz", lung = "lungs.nii.gz" (a line each)'
    )


def volumes_of(masks: MaskSet) -> tuple[dict[str, Volume], list[str]]:
    """Return the masks that are not empty as volumes, and a warning for each that is.

    Raises:
        AnatomyError: If a mask is empty that is neither of fissures nor of nodules.
    """
    volumes: dict[str, Volume] = {}
    warnings: list[str] = []
    for role, mask in masks.masks.items():
        if mask.any():
            volumes[role] = Volume(grid=masks.grid, array=mask)
        else:
            warnings.append(_empty(role, masks))
    return volumes, warnings


def _empty(role: str, masks: MaskSet) -> str:
    own = masks.files.get(role, ())
    if role in MAY_BE_EMPTY:
        return f"The mask of {role} ({', '.join(own)}) is empty; it is taken as absent"
    outside = [said for said in masks.statements if any(said.startswith(file) for file in own)]
    raise AnatomyError(
        " ".join([f"The mask of {role} is empty ({', '.join(own)}).", *outside]),
        expected="at least one voxel that is not zero",
        remedy="Segment the structure again, or remove the file if the structure is unknown",
    )


def require_cost(volume: Volume, grid: Grid) -> Volume:
    """Return a cost map as float32 on the grid of the masks; forbidden where it does not reach."""
    array = from_stored(volume.array)
    if not grid.is_close(volume.grid):
        array = place(array, volume.grid, grid, fill=np.inf).array
    return Volume(grid=grid, array=array)
