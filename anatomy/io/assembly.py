"""From masks that were read to a patient: lungs are made whole, what is missing is named or refused."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Mask
from anatomy.grid import Grid, Volume
from anatomy.io.mask_values import require_label_values
from anatomy.io.masks import MaskSet, place
from anatomy.io.voxels import from_stored
from anatomy.lobes import LOBES, UNKNOWN, fissures_between, grown_into, main_pieces
from anatomy.morphology import bounds, grown_by_one, window
from anatomy.patient import PatientImages

EXCLUDED_SHARE, TOUCHING_SHARE = 0.05, 0.5
"""A label map has one label a voxel: of its vessels less than the first share lies in the lungs, and of their
surface at least the second share touches the lungs.  Vessels that lie elsewhere do not touch them."""


def _with_lobes(masks: MaskSet) -> MaskSet:
    """Make lungs and fissures of lobes, as far as they have no masks of their own.

    The lungs are the union of the lobes, see `fill_lung`.  A fissure lies on both sides of every border
    between two lobes of the same lung.  What was derived is stated.
    """
    if masks.lobes is None:
        return masks
    known = dict(masks.masks)
    statements = list(masks.statements)
    are_the_lungs = "lung" not in known
    main = np.zeros_like(masks.lobes)
    for number, name in LOBES.items():
        lobe = masks.lobes == number
        kept = main_pieces(lobe)
        main[kept] = number
        stray = int(np.count_nonzero(lobe)) - int(np.count_nonzero(kept))
        if stray:
            statements.append(
                f"{stray} voxels of the mask of the {name} lie apart from it: they are lung, but of no lobe."
            )
    union = masks.lobes > 0 if are_the_lungs else known["lung"] | (masks.lobes > 0)
    masks = replace(masks, masks={**known, "lung": union})
    known = dict((fill_lung(masks) if are_the_lungs else masks).masks)
    lobes = grown_into(main, known["lung"])
    if are_the_lungs:
        absent = [name for number, name in LOBES.items() if not (lobes == number).any()]
        statements += [f"There is no mask of the {name}: what lies there is not lung." for name in absent]
    if "fissures" not in known or not known["fissures"].any():
        fissures = fissures_between(lobes)
        if fissures.any():
            known["fissures"] = fissures
            statements.append(
                f"No fissure mask: {np.count_nonzero(fissures)} voxels on both sides of the borders between "
                "lobes of the same lung are taken as fissures."
            )
    return replace(masks, masks=known, lobes=lobes, statements=tuple(statements))


def fill_lung(masks: MaskSet) -> MaskSet:
    """Count airways and vessels, and the rim between them and a lobe, as lung.

    Masks of lobes leave out the larger bronchi and vessels, and two networks do not agree on a border to the
    voxel.  All that is added is airway or vessel, hence an obstacle, or lies in a gap of at most two voxels
    between one of them and a lobe, so that the mediastinum does not become passable.
    """
    roles = [masks.masks[role] for role in ("lumen", "wall", "vessels") if role in masks.masks]
    if "lung" not in masks.masks or not masks.masks["lung"].any() or not roles:
        return masks
    lobes = masks.masks["lung"]
    tubes: Mask = np.logical_or.reduce(roles)
    lung: Mask = lobes | tubes
    box = window(*bounds(lung, 2))
    closed = ~grown_by_one(~grown_by_one(lung[box]))
    lung[box] |= closed & grown_by_one(tubes[box]) & grown_by_one(grown_by_one(lobes[box]))
    return replace(masks, masks={**masks.masks, "lung": lung})


def _with_contents(masks: MaskSet) -> MaskSet:
    """Count what a mask of the lungs leaves out of them as lung, where it has the air alone.

    A label map cannot have a voxel twice, so that its lungs have holes where vessels, airways, fissures and
    nodules are.  What is added is one of these, or a gap as in `fill_lung`; it is stated.
    """
    held = masks.masks
    if not {"lung", "vessels"} <= held.keys() or not held["vessels"].any():
        return masks
    lung, vessels = held["lung"], held["vessels"]
    if np.count_nonzero(vessels & lung) >= EXCLUDED_SHARE * np.count_nonzero(vessels):
        return masks
    surface = vessels & grown_by_one(~vessels)
    if np.count_nonzero(surface & grown_by_one(lung)) < TOUCHING_SHARE * np.count_nonzero(surface):
        return masks
    inside = [held[role] for role in ("fissures", "nodules") if role in held]
    filled = fill_lung(replace(masks, masks={**held, "lung": np.logical_or.reduce([lung, *inside])}))
    added = np.count_nonzero(filled.masks["lung"]) - np.count_nonzero(lung)
    said = (
        "The mask of the lungs leaves out the vessels, as a label map does: they, airways, fissures and "
        f"nodules count as lung, {added * masks.grid.voxel_volume_mm3 / 1000.0:.0f} ml."
    )
    return replace(filled, statements=(*masks.statements, said))


LUNG_ROLES: Mapping[str, str] = {"lumen": "the airway lumen", "vessels": "the vessels", "lung": "the lungs"}
"""Masks that a lung cannot be without, and what messages call them."""
DESCRIBE_YOURSELF = (
    "Rename the files, or write a file patient.toml beside them that names them: "
    'lumen = "airway.nii.gz", vessels = "vessels.nii.gz", lung = "lungs.nii.gz" (a line each)'
)
"""The remedy for a folder whose files are not known by their names."""


def assemble(masks: MaskSet, *, name: str, kind: str, where: Path, **others: Any) -> PatientImages:
    """Make the `PatientImages` of masks that were read, after checking that none is missing or empty.

    Messages name the patient's folder, `where`.  Of the further fields `warnings` and `sources` are added
    to.  Raises AnatomyError if lumen, vessels or lung is missing, or a mask is empty.  An empty mask of
    fissures or nodules only causes a warning.
    """
    masks = _with_contents(_with_lobes(masks))
    missing = [words for role, words in LUNG_ROLES.items() if role not in masks.masks]
    if missing:
        raise AnatomyError(
            f"{where} holds no mask of {', '.join(missing)}",
            expected="masks of the airway lumen, the vessels and the lungs (or their five lobes)",
            remedy=DESCRIBE_YOURSELF,
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


def volumes_of(masks: MaskSet) -> tuple[dict[str, Volume], list[str]]:
    """Return the masks that are not empty as volumes, and a warning for each that is.

    Raises AnatomyError if a mask is empty that is neither of fissures nor of nodules.
    """
    volumes: dict[str, Volume] = {}
    warnings: list[str] = []
    for role, mask in masks.masks.items():
        if mask.any():
            volumes[role] = Volume(grid=masks.grid, array=mask)
            continue
        own = masks.files.get(role, ())
        if role not in ("fissures", "nodules"):
            outside = [said for said in masks.statements if any(said.startswith(file) for file in own)]
            raise AnatomyError(
                " ".join([f"The mask of {role} is empty ({', '.join(own)}).", *outside]),
                expected="at least one voxel that is not zero",
                remedy="Segment the structure again, or remove the file if the structure is unknown",
            )
        warnings.append(f"The mask of {role} ({', '.join(own)}) is empty; it is taken as absent")
    return volumes, warnings


def require_cost(volume: Volume, grid: Grid) -> Volume:
    """Return a cost map as float32 on the grid of the masks; forbidden where it does not reach."""
    array = from_stored(volume.array)
    if not grid.is_close(volume.grid):
        array = place(array, volume.grid, grid, fill=np.inf).array
    return Volume(grid=grid, array=array)


def require_band(volume: Volume, grid: Grid) -> Volume:
    """Return an image of fissures as uint8 on the grid of the masks; see `anatomy.lobes.UNKNOWN`.

    Raises AnatomyError if a value is none of such an image.
    """
    require_label_values(volume.array, "The image of the fissures' band")
    least, most = int(volume.array.min()), int(volume.array.max())
    if least < 0 or not (most < 50 or most == UNKNOWN):
        raise AnatomyError(
            f"The image of the fissures' band holds values from {least} to {most}",
            expected=f"1 and 2 for a border, 3 to 49 for a chance in percent, {UNKNOWN} for not known",
            remedy="Name the fissures.nii.gz of `segment`, or leave fissure_band out",
        )
    array = volume.array.astype(np.uint8)
    if not grid.is_close(volume.grid):
        array = place(array, volume.grid, grid).array
    return Volume(grid=grid, array=array)
